"""One rigid shape per track: what all its observations say of it in the frame of its box."""

from boxreg_ros.geometry import rotation_from_rpy
from boxreg_ros.objective import EXTENT, Problem, State
import torch
from torch import Tensor

CELLS = 8, 3, 3  # into which a box is cut, each a piece of surface
LEAST = 8  # points that make a surface
FLATNESS = 3.0  # how much wider than thick a surface is, in squares
MARGIN = 0.3  # points this far outside a box are part of the shape [m]
SAY = 20.0  # points of one observation that err on their own


def agreement(problem: Problem, state: State) -> tuple[Tensor, Tensor]:
    """
    Compare each observation with the shape that all of its track make together.

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
    B, N, M = problem.mask.shape
    R = rotation_from_rpy(state.pose[..., 3:]).to(problem.points)
    shift = (state.pose[..., :3] - problem.pose[..., :3]).to(problem.points)
    local = (problem.points - shift[..., None, :]) @ R
    half = (state.shared[:, None, None, EXTENT] / 2).to(local)
    counts = torch.tensor(CELLS, device=local.device)
    near = ((local.abs() - half).amax(-1) < MARGIN) & problem.mask
    window, step, _ = near.nonzero(as_tuple=True)
    p = local[near]
    index = ((local / half + 1) / 2 * counts).long()[near].clamp(counts * 0, counts - 1)
    cell = ((window * CELLS[0] + index[:, 0]) * CELLS[1] + index[:, 1]) * CELLS[2] + index[:, 2]
    products = (p[:, :, None] * p[:, None]).flatten(1)
    sums = p.new_zeros(B * int(counts.prod()), 13)
    sums.index_add_(0, cell, torch.cat([torch.ones_like(p[:, :1]), p, products], 1))
    number = sums[:, :1].clamp(min=1)
    mean = sums[:, 1:4] / number
    spread = (sums[:, 4:] / number).unflatten(1, (3, 3)) - mean[:, :, None] * mean[:, None]
    power, axes = torch.linalg.eigh(spread)
    thickness = power[:, 0].clamp(min=0) + problem.deviations['shape'].to(p).repeat_interleave(int(counts.prod()))**2
    flat = (power[:, 1] > FLATNESS * thickness) & (number[:, 0] >= LEAST)
    weight = torch.where(flat, 1 / thickness, 0.0)
    plane = torch.cat([axes[:, :, 0], mean, thickness[:, None], weight[:, None]], 1)[cell]
    normal, thickness, weight = plane[:, :3], plane[:, 6], plane[:, 7]
    off = (normal * (p - plane[:, 3:6])).sum(1)
    weight = weight / (1 + off**2 / thickness)
    lever = torch.cat([normal, torch.linalg.cross(p, normal)], 1)
    parts = [(lever[:, :, None] * lever[:, None]).flatten(1), lever * off[:, None]]
    parts = torch.cat([*parts, (weight[:, None] > 0).to(p) / weight[:, None].clamp(min=1e-9)], 1) * weight[:, None]
    total = p.new_zeros(B * N, 43).index_add_(0, window * N + step, parts).to(state.pose)
    total = total * (SAY / total[:, 42:].clamp(min=SAY))
    information = total[:, :36].reshape(B, N, 6, 6)
    eye = 1e-3 * torch.eye(6).to(information)
    wanted = torch.linalg.solve(information + eye, total[:, 36:42].reshape(B, N, 6))
    return information, wanted
