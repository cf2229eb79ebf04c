"""
The paper's objective to the letter, Eq. 4 to 8, and its solver.

Its terms are functions of boxes and points, differentiated automatically. The default objective
is in `method`; it shares no code with this one but the optimiser.

"""

from typing import NamedTuple

from boxreg_ros.config import Config, KINDS, PaperConfig
from boxreg_ros.core.geometry import face_distances, rotation_from_rpy
from boxreg_ros.core.lbfgs import HISTORY, minimize
from boxreg_ros.core.method.arrays import INPUTS, no_priors, Posterior, Solution
from boxreg_ros.core.problem import Problem
from boxreg_ros.rotations import wrap_angle
from boxreg_ros.structures import Floats, KINEMATICS, POSE
import numpy as np
import torch
from torch import Tensor

EPSILON = 1e-9
"""Added inside square roots: the norms of Eq. 6 and 7 have a gradient at zero [m^2]. Chosen: the
norm of a zero vector becomes 3e-5."""
INITIAL_ROUNDING = 0.3
"""Added inside the same roots in the first multiplier round [m^2]. Chosen."""
ROUNDING_DECAY = 0.01
"""Factor on the rounding from one multiplier round to the next. Chosen: it has reached `EPSILON`
in the fifth."""
STATIONARITY = 1e-9
"""Relative decrease of the objective that ends the search of one multiplier round. Chosen."""
FULL_STEP = 0.1
"""Step from which on its direction counts in full in Eq. 7 [m]. Chosen."""
NEAREST = 8
"""K, the closest points of each visible face in Eq. 4. Chosen: the paper does not state it."""
MULTIPLIER_ROUNDS = 5
"""Updates of the two Lagrange multipliers. Chosen: see `ROUNDING_DECAY`."""
PADDING_POSITION = 1e6
"""Coordinate of padding points [m]. Derived: near no box, and finite in float32."""


class Observed(NamedTuple):
    """What the terms compare boxes with."""

    points: Tensor
    """(B, N, M, 3), in the frame of the boxes [m]."""
    mask: Tensor
    """(B, N, M), False for padding."""
    valid: Tensor
    """(B, N), False for padding."""

    @classmethod
    def of(cls, problem: Problem) -> 'Observed':
        """Return the points of a problem, padded."""
        place = np.arange(problem.width)
        mask = place < problem.counts[..., None]
        index = (problem.first[..., None] + problem.stride * place)[mask]
        points = np.full((*mask.shape, 3), PADDING_POSITION, np.float32)
        points[mask] = problem.points[index]
        centred = points + problem.boxes[..., None, :3]
        return cls(*map(torch.from_numpy, (centred, mask, problem.valid)))


def closeness(boxes: Tensor, points: Tensor, mask: Tensor, nearest: int) -> Tensor:
    """
    Return the squared distances of the K points closest to each visible face [Eq. 4].

    Parameters
    ----------
    boxes : Tensor, shape (B, N, 9)
        Boxes [m, rad].
    points, mask : Tensor, shapes (B, N, M, 3) and (B, N, M)
        Points in the frame of the boxes [m]; False for padding.
    nearest : int
        K.

    Returns
    -------
    loss : Tensor, shape (B,)
        Mean over observations and K, summed over the three axes [m^2].

    Notes
    -----
    One face per axis is visible, the one on the side of the points' centre of mass. The choice
    of faces and of points follows the boxes at every evaluation. With fewer than K points the
    mean is over those there are.

    """
    distances = face_distances(points, boxes)  # (B, N, M, 6)
    weight = mask.to(boxes)
    outward = (distances[..., 0::2] - distances[..., 1::2]) * weight[..., None]
    front_is_seen = outward.sum(-2, keepdim=True) > 0
    squares = torch.where(front_is_seen, distances[..., 0::2], distances[..., 1::2]) ** 2
    squares = torch.where(mask[..., None], squares, torch.inf)
    closest = squares.topk(min(nearest, squares.shape[-2]), dim=-2, largest=False).values
    is_point = closest.isfinite()
    mean = torch.where(is_point, closest, 0.0).sum(-2) / is_point.sum(-2).clamp(min=1)
    return _mean(mean.sum(-1), mask.any(-1))


def enclosure(boxes: Tensor, points: Tensor, mask: Tensor) -> Tensor:
    """
    Return the mean L1 distance from the points to the six faces [Eq. 5].

    Parameters
    ----------
    boxes : Tensor, shape (B, N, 9)
        Boxes [m, rad].
    points, mask : Tensor, shapes (B, N, M, 3) and (B, N, M)
        As of `closeness`.

    Returns
    -------
    loss : Tensor, shape (B,)
        [m]. It is constant while a point is inside and grows once it leaves: only points outside
        have a gradient.

    """
    weight = mask.to(boxes)
    distances = face_distances(points, boxes).abs().mean(-1) * weight
    return _mean(distances.sum(-1) / weight.sum(-1).clamp(min=1), mask.any(-1))


def smoothness(boxes: Tensor, valid: Tensor, rounding: float = EPSILON) -> Tensor:
    """
    Return the mean change of the pose's step from box to box [Eq. 6].

    Parameters
    ----------
    boxes : Tensor, shape (B, N, 9)
        Boxes [m, rad].
    valid : Tensor, shape (B, N)
        False for padding.
    rounding : float
        Added inside the root, which gives equal steps a gradient.

    Returns
    -------
    loss : Tensor, shape (B,)
        [m, rad]; steps of the angles are wrapped.

    """
    pose = boxes[..., POSE]
    step = pose[:, 1:] - pose[:, :-1]
    step = torch.cat([step[..., :3], wrap_angle(step[..., 3:])], -1).abs()
    change = (step[:, 1:] - step[:, :-1]).square().sum(-1)
    return _mean((change + rounding).sqrt(), valid[:, 2:])


def alignment(boxes: Tensor, valid: Tensor, rounding: float = EPSILON) -> Tensor:
    """
    Return the mean distance between heading and direction of motion [Eq. 7].

    Parameters
    ----------
    boxes : Tensor, shape (B, N, 9)
        Boxes [m, rad].
    valid : Tensor, shape (B, N)
        False for padding.
    rounding : float
        Added inside the roots.

    Returns
    -------
    loss : Tensor, shape (B,)
        Of unit vectors, so without a unit.

    Notes
    -----
    The direction of a step of length zero is undefined: the weight of a step grows linearly up to
    `FULL_STEP`. A window whose mean motion is against its headings is taken for a reversing
    object: its direction of motion is reversed. The paper also wraps its alpha, the roll, into
    [-pi/2, pi/2]; this term does not depend on it.

    """
    heading = rotation_from_rpy(boxes[:, :-1, 6:9])[..., 0]
    step = boxes[:, 1:, :3] - boxes[:, :-1, :3]
    length = (step.square().sum(-1) + rounding).sqrt()
    direction = step / length[..., None]
    along = ((heading * step).sum(-1) * valid[:, 1:]).sum(-1)
    forward = torch.where(along < 0, -1.0, 1.0)[:, None, None]
    deviation = ((heading - forward * direction).square().sum(-1) + rounding).sqrt()
    return _mean(deviation * (length / FULL_STEP).clamp(max=1.0), valid[:, 1:])


def total(
    boxes: Tensor, seen: Observed, weights: PaperConfig, multipliers: Tensor, rounding: float
) -> tuple[Tensor, Tensor]:
    """
    Return the objective (B,) [Eq. 8] and the violation (B, 2) of its two constraints.

    Notes
    -----
    The paper names weights and augmented Lagrange multipliers without saying how they are
    combined. Here smoothness and alignment are constraints c = 0, each adding m c + w c^2 / 2
    with its weight w and its multiplier m, a column of `multipliers` (B, 2).

    """
    points, mask, valid = seen
    constraints = [term(boxes, valid, rounding) for term in (smoothness, alignment)]
    violation = torch.stack(constraints, -1)
    penalty = violation.new_tensor([weights.smoothness, weights.alignment])
    loss = weights.closeness * closeness(boxes, points, mask, NEAREST)
    loss = loss + weights.enclosure * enclosure(boxes, points, mask)
    return loss + (multipliers * violation + penalty * violation**2 / 2).sum(-1), violation


def solve_paper(problem: Problem, config: Config) -> Solution:
    """
    Minimise the paper's objective (Eq. 8) by L-BFGS, with multiplier updates in between.

    Returns the poses, the mean extents of the input, and the squared errors of the input as
    covariances: the paper's terms have no scale from which any could be derived.

    Notes
    -----
    A zigzag satisfies Eq. 6, and a search gets stuck at the kinks of norms that are not squared.
    The norms of Eq. 6 and 7 are therefore rounded, less in every round; the last round minimises
    the equations to the letter.

    """
    settings = config.paper
    length = problem.length
    mean = problem.mean_extents()
    extent = torch.from_numpy(mean)[:, None].expand(-1, length, -1)
    free = torch.from_numpy(problem.free_variables(config))[:, : 6 * length]
    x = torch.from_numpy(problem.boxes[..., POSE]).flatten(1)
    seen = Observed.of(problem)
    every = torch.arange(len(x))
    penalty = x.new_tensor([settings.smoothness, settings.alignment])
    multipliers = penalty.repeat(len(x), 1)

    def boxes(x: Tensor, rows: Tensor) -> Tensor:
        pose = x.unflatten(1, (length, 6))
        return torch.cat([pose[..., :3], extent[rows], pose[..., 3:]], -1)

    for turn in range(MULTIPLIER_ROUNDS):
        rounding = max(INITIAL_ROUNDING * ROUNDING_DECAY**turn, EPSILON)

        def function(
            x: Tensor,
            rows: Tensor,
            multipliers: Tensor = multipliers,
            rounding: float = rounding,
        ) -> tuple[Tensor, Tensor]:
            with torch.enable_grad():
                x = x.detach().requires_grad_()
                part = Observed(*(of_all[rows] for of_all in seen))
                loss, _ = total(boxes(x, rows), part, settings, multipliers[rows], rounding)
                (gradient,) = torch.autograd.grad(loss.sum(), x)
            return loss.detach(), gradient * free[rows]

        x = minimize(function, x, settings.iterations, HISTORY, STATIONARITY).x
        _, violation = total(boxes(x, every), seen, settings, multipliers, rounding)
        multipliers = multipliers + violation * penalty
    B = len(mean)
    shared = problem.expected_shared(np.zeros(len(KINDS), INPUTS))
    of_poses, of_extents = np.zeros((B, length, 6, 6)), np.zeros((B, 3, 3))
    of_poses[...] = _diagonal(problem.of_class['pose'] ** 2)[:, None]
    of_extents[...] = _diagonal((mean * problem.of_class['extent'][:, None]) ** 2)
    unknown = np.zeros((B, length), KINEMATICS)  # its terms have no scale
    posterior = Posterior(of_poses, of_extents, np.zeros((B, length, 6)), unknown)
    poses = x.numpy().reshape(B, length, 6)
    return Solution(poses, shared, np.zeros((B, 3, 3)), posterior, no_priors(0))


def _diagonal(values: Floats) -> Floats:
    """Return diagonal matrices (B, n, n) of `values` (B, n)."""
    return values[..., None] * np.eye(values.shape[1])


def _mean(values: Tensor, valid: Tensor) -> Tensor:
    """Return the mean over the `valid` ones of `values` (B, n); 0 without any."""
    weight = valid.to(values)
    return (values * weight).sum(-1) / weight.sum(-1).clamp(min=1)
