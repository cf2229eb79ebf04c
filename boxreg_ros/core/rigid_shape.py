"""One rigid shape per track: what all its observations say of it in the frame of its box."""

from boxreg_ros.core.arrowhead import product
from boxreg_ros.core.face_support import carried, in_box_axes
from boxreg_ros.core.objective import EXTENT, Problem, State
import torch
from torch import Tensor

CELLS = 8, 3, 3  # into which a box is cut, each a piece of surface
LEAST = 8  # points that make a surface
FLATNESS = 3.0  # how much wider than thick a surface is, in squares
MARGIN = 0.3  # points this far outside a box are part of the shape [m]
SAY = 20.0  # points of one observation that err on their own
PAIRS = [[0, 1, 2, 3], [1, 4, 5, 6], [2, 5, 7, 8], [3, 6, 8, 9]]  # 10 products make a square


def agreement(problem: Problem, state: State) -> tuple[Tensor, Tensor]:
    """
    Compare each observation with the shape that all of its track make together.

    Parameters
    ----------
    problem : Problem
        B windows of N observations.
    state : State
        Where their boxes are in this round.

    Returns
    -------
    information : Tensor, shape (B, N, 6, 6)
        How well the shape pins x y z and the three rotations, in box axes.
    wanted : Tensor, shape (B, N, 6)
        The step of the pose after which the observation agrees best with the shape [m, rad].

    Notes
    -----
    The returns of a whole track, carried into its box, fall into cells, and each cell that holds
    a piece of surface tells a plane and how thick the observations smear it. Distances to these
    planes are linear in a small step of the pose: their sums of squares are all that is kept.

    """
    local = in_box_axes(carried(problem, state), problem, state.pose)
    half = (state.shared[:, EXTENT] / 2).to(local)[:, None, :, None]
    counts, (B, N, _, M) = local.new_tensor(CELLS)[:, None], local.shape
    place = ((local / half + 1) * (counts / 2)).floor().clamp(counts * 0, counts - 1)
    cell = (place * counts.new_tensor([[CELLS[1] * CELLS[2]], [CELLS[2]], [1]])).sum(2).long()
    count = CELLS[0] * CELLS[1] * CELLS[2]
    cell += count * torch.arange(B, device=cell.device)[:, None, None]
    # What is not near the box, or not finite, counts as zeros in the first cell; coordinates go
    # by columns. That is several times as fast as picking out rows.
    near = ((local.abs() - half).amax(2) < MARGIN).flatten()
    cell, local = torch.where(near, cell.flatten(), 0), local.movedim(2, 0).flatten(1)
    p = torch.cat([torch.where(near, local, 0.0), near[None].to(local)])
    # Moments of the points in each cell, their number last; a plane through them.
    products = (a * b for i, a in enumerate(p) for b in p[i:])
    sums = torch.stack([torch.bincount(cell, values, B * count) for values in products], 1)
    number = sums[:, -1].clamp(min=1)
    mean = (sums / number[:, None])[:, PAIRS]
    power, axes = torch.linalg.eigh(mean[:, :3, :3] - mean[:, :3, 3:] * mean[:, 3:, :3])
    plane = torch.cat([axes[..., 0], -(axes[..., :1].mT @ mean[:, :3, 3:])[..., 0]], 1)
    rough = problem.of('shape')[:, 0].to(p).repeat_interleave(count) ** 2
    thickness = power[:, 0].clamp(min=0) + rough
    is_surface = (power[:, 1] > FLATNESS * thickness) & (number >= LEAST)
    plane = plane.mT.index_select(1, cell)
    off = (plane * p).sum(0)
    weight = ((is_surface[cell] & near) / (thickness[cell] + off**2)).view(B, N, 1, M)
    # The levers of all points of an observation, and how far off each is.
    found = torch.cat([plane[:3], torch.linalg.cross(p[:3], plane[:3], dim=0), off[None]])
    lever = found.view(7, B, N, M).movedim(0, 2).contiguous()
    weight = weight * SAY / (weight > 0).sum(3, keepdim=True).clamp(min=SAY)
    # What torch makes of the product depends, on some processors, on how many windows there are.
    total = product(lever * weight, lever.mT).to(state.pose)
    information, pull = total[..., :6, :6], total[..., :6, 6]
    return information, torch.linalg.solve(information + 1e-3 * torch.eye(6).to(pull), pull)
