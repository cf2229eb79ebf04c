"""
One rigid shape per track: all its points in the frame of its box, as small planes.

The residual is (M4) of docs/method.md.

"""

from boxreg_ros.core.arrowhead import product
from boxreg_ros.core.batch import EXTENT, Problem, State
from boxreg_ros.core.face_support import motion_compensated, to_box_frame
from boxreg_ros.core.kernels import compiled, contiguous
from boxreg_ros.core.kernels.arrays import ShapeNumbers
from boxreg_ros.core.threads import run
import numpy as np
import torch
from torch import Tensor

# All of these are chosen; `boxreg bench sensitivity` halves and doubles each of them.
CELLS = (8, 3, 3)
"""Cells into which a box is cut along x, y and z, each with one piece of surface."""
MIN_CELL_POINTS = 8
"""Fewest points that make a piece of surface."""
MIN_FLATNESS = 3.0
"""Smallest ratio of the second variance of a piece of surface to that across it."""
SHAPE_MARGIN = 0.3
"""Points up to this far outside a box are part of the shape [m]."""
EFFECTIVE_POINTS = 20.0
"""Points of one observation with independent errors; more add no information."""
STEP_RIDGE = 1e-3
"""Information added to that of a step: without points none is wanted."""
MOMENT_INDEX = [[0, 1, 2, 3], [1, 4, 5, 6], [2, 5, 7, 8], [3, 6, 8, 9]]
"""Where the 10 products of (x, y, z, 1) are in their symmetric 4 x 4 matrix."""


def agreement(problem: Problem, state: State) -> tuple[Tensor, Tensor]:
    """
    Compare each observation with the common shape of its track.

    Parameters
    ----------
    problem : Problem
        B windows of N observations.
    state : State
        Boxes of this round.

    Returns
    -------
    information : Tensor, shape (B, N, 6, 6)
        Information of the shape about a step in x y z and the three rotations, in box axes.
    wanted : Tensor, shape (B, N, 6)
        The step of the pose after which the observation agrees best with the shape [m, rad].

    Notes
    -----
    The points of a whole track, transformed into its box, fall into cells. Each cell that holds a
    piece of surface gives a plane and the thickness to which the observations smear it. Distances
    from these planes are linear in a small step of the pose: their sums of squares are all that
    is kept, as in point-to-plane ICP.

    """
    if compiled(state.pose) is not None:
        return agreement_compiled(problem, state)
    return agreement_torch(problem, state)


def agreement_compiled(problem: Problem, state: State) -> tuple[Tensor, Tensor]:
    """Return the same as `agreement`, by the kernel."""
    kernels = compiled(state.pose)
    assert kernels is not None
    B, N = problem.valid.shape
    information = np.empty((B, N, 6, 6))
    wanted = np.empty((B, N, 6))
    run(
        kernels.rigid_shape.agreement, B, problem.arrays(), contiguous(state.pose),
        contiguous(state.shared[:, EXTENT]), contiguous(problem.of_class('shape')[:, 0]),
        shape_numbers(problem), information, wanted,
    )  # fmt: skip
    return torch.from_numpy(information), torch.from_numpy(wanted)


def shape_numbers(problem: Problem) -> ShapeNumbers:
    """Return the constants for the kernel."""
    return ShapeNumbers(
        cells=CELLS,
        margin=SHAPE_MARGIN,
        flatness=MIN_FLATNESS,
        min_cell_points=float(MIN_CELL_POINTS),
        effective_points=EFFECTIVE_POINTS,
        ridge=STEP_RIDGE,
        is_moving=problem.returns.is_moving,
    )


def agreement_torch(problem: Problem, state: State) -> tuple[Tensor, Tensor]:
    """Return the same as `agreement`, by torch."""
    points = motion_compensated(problem, state)
    local = to_box_frame(points.to(state.pose), problem, state.pose)
    half = (state.shared[:, EXTENT] / 2)[:, None, :, None]
    B, N, _, M = local.shape
    # Points that are not near the box, or not finite, count as zeros in the first cell;
    # coordinates are rows. That is several times as fast as selecting points.
    is_near = ((local.abs() - half).amax(2) < SHAPE_MARGIN).flatten()
    cell = torch.where(is_near, _cells(local, half).flatten(), 0)
    local = local.movedim(2, 0).flatten(1)
    p = torch.cat([torch.where(is_near, local, 0.0), is_near[None].to(local)])  # (4, B N M)
    deviation = problem.of_class('shape')[:, 0].to(p)
    plane, thickness, is_surface = _surface_planes(p, cell, deviation)

    plane = plane.mT.index_select(1, cell)
    distance = (plane * p).sum(0)
    weight = (is_surface[cell] & is_near) / (thickness[cell] + distance**2)
    weight = weight.view(B, N, 1, M)
    weight = (
        weight * EFFECTIVE_POINTS / (weight > 0).sum(3, keepdim=True).clamp(min=EFFECTIVE_POINTS)
    )
    # Derivatives of the distances of all points by the step of the pose, and these distances.
    moment_arm = torch.linalg.cross(p[:3], plane[:3], dim=0)
    rows = torch.cat([plane[:3], moment_arm, distance[None]])
    rows = rows.view(7, B, N, M).movedim(0, 2).contiguous()
    # Torch's own product depends, on some processors, on the number of windows.
    total = product(rows * weight, rows.mT).to(state.pose)  # (B, N, 7, 7)
    information = total[..., :6, :6]
    ridge = STEP_RIDGE * torch.eye(6).to(total)
    return information, torch.linalg.solve(information + ridge, total[..., :6, 6])


def _cells(local: Tensor, half: Tensor) -> Tensor:
    """Return the index of the cell of each point, counted on over the windows, (B, N, M)."""
    counts = local.new_tensor(CELLS)[:, None]
    place = ((local / half + 1) * (counts / 2)).floor().clamp(counts * 0, counts - 1)
    stride = counts.new_tensor([[CELLS[1] * CELLS[2]], [CELLS[2]], [1]])
    cell = (place * stride).sum(2).long()
    per_box = CELLS[0] * CELLS[1] * CELLS[2]
    cell += per_box * torch.arange(len(local), device=cell.device)[:, None, None]
    return cell


def _surface_planes(p: Tensor, cell: Tensor, deviation: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """
    Fit a plane to the points of each cell.

    Parameters
    ----------
    p : Tensor, shape (4, P)
        Homogeneous points in box axes [m]; zeros are no points.
    cell : Tensor, shape (P,)
        The cell of each.
    deviation : Tensor, shape (B,)
        How far the surface of each window's object is from rigid [m].

    Returns
    -------
    plane : Tensor, shape (C, 4)
        Normal and offset.
    thickness : Tensor, shape (C,)
        Variance of the points across the plane [m^2].
    is_surface : Tensor, shape (C,)
        Whether the cell holds a piece of surface.

    """
    per_box = CELLS[0] * CELLS[1] * CELLS[2]
    products = [a * b for i, a in enumerate(p) for b in p[i:]]
    count = len(deviation) * per_box
    sums = torch.stack([torch.bincount(cell, values, count) for values in products], 1)
    number = sums[:, -1].clamp(min=1)
    mean = (sums / number[:, None])[:, MOMENT_INDEX]
    centre = mean[:, :3, 3:]
    variance, axes = torch.linalg.eigh(mean[:, :3, :3] - centre * centre.mT)
    offset = -(axes[..., :1].mT @ centre)[..., 0]
    plane = torch.cat([axes[..., 0], offset], 1)
    thickness = variance[:, 0].clamp(min=0) + deviation.repeat_interleave(per_box) ** 2
    is_surface = (variance[:, 1] > MIN_FLATNESS * thickness) & (number >= MIN_CELL_POINTS)
    return plane, thickness, is_surface
