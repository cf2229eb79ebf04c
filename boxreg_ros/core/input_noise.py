"""
The errors of the input poses and extents, estimated from their residuals (M14).

docs/method.md, section Input model, has the formulas.

"""

from itertools import chain
from typing import NamedTuple

from boxreg_ros.config import KINDS
from boxreg_ros.core.method.constants import Constants
from boxreg_ros.core.method.noise import estimate
from boxreg_ros.core.problem import Problem
from boxreg_ros.rotations import matrix_from_rpy
from boxreg_ros.structures import BOX_EXTENT, Floats, Ints, POSE
import numpy as np
from numpy.typing import NDArray

REPEATED_BOX_TOLERANCE = 1e-3
"""A box that differs from the one before by less repeats it [m, rad]. Chosen."""


class InputNoise(NamedTuple):
    """
    Estimated errors of the input poses and extents, of tracks of one kind.

    Attributes
    ----------
    deviation, correlation : array, shape (9,)
        Robust standard deviation about the mean of a track, along the box axes: lon lat z roll
        pitch yaw, and the extents; correlation from one observation to the next. In units of the
        deviations of the settings.
    weight : array, shape (1,)
        Weight of the estimate against the settings: 0 without observations, 1/2 after
        `half_weight`, near 1 after many.

    """

    deviation: Floats
    correlation: Floats
    weight: Floats


def set_noise(
    inputs: NDArray[np.void], residuals: Floats, kind: Ints, constants: Constants
) -> None:
    """
    Estimate the noise of each of `KINDS` from tracks (B, N, 9) of a `kind` (B,) (M14).

    It is set in records `INPUTS` (K,).

    Of `normalised_residuals`; NaN is left out. The noise of all other kinds together is the prior
    of each: a kind of which few boxes were seen is expected to err as the others do, in proportion
    to the settings of its kind.

    """
    seen = frozenset(kind.tolist())
    # Often all tracks are of one kind, and the same set is needed for several kinds.
    sets = [(seen & {k}, seen - {k}) for k in range(len(KINDS))]
    unknown = InputNoise(np.zeros(9), np.zeros(9), np.zeros(1))
    estimates = {frozenset[int](): unknown, seen: noise_of(residuals, constants)}
    for kinds in set(chain.from_iterable(sets)) - estimates.keys():
        rows = np.isin(kind, list(kinds))
        estimates[kinds] = noise_of(residuals[rows], constants)
    own, others = (
        InputNoise(*map(np.stack, zip(*(estimates[kinds] for kinds in side), strict=True)))
        for side in zip(*sets, strict=True)
    )
    weight = own.weight + (1 - own.weight) * others.weight
    share = own.weight / weight.clip(1e-9)
    inputs['deviation'] = others.deviation + share * (own.deviation - others.deviation)
    inputs['correlation'] = others.correlation + share * (own.correlation - others.correlation)
    inputs['weight'] = weight[:, 0]


def add_past_noise(inputs: NDArray[np.void], past: NDArray[np.void], constants: Constants) -> None:
    """Add the noise of other drives, records `NOISE` (K,), which counts by its boxes."""
    if not past['boxes'].any():
        return
    boxes = constants.half_weight * inputs['weight'] / (1 - inputs['weight'])
    together = (past['boxes'] + boxes)[:, None]
    share = past['boxes'][:, None] / np.maximum(together, 1.0)
    squares = np.square(inputs['deviation'])
    inputs['deviation'] = np.sqrt(squares + share * (np.square(past['deviation']) - squares))
    inputs['correlation'] += share * (past['correlation'] - inputs['correlation'])
    inputs['weight'] = together[:, 0] / (together[:, 0] + constants.half_weight)


def noise_of(residuals: Floats, constants: Constants) -> InputNoise:
    """Estimate the noise of tracks (B, N, 9) of one kind (M14), shapes (9,) and (1,)."""
    found = InputNoise(np.zeros(9), np.zeros(9), np.zeros(1))
    total = estimate(
        np.ascontiguousarray(residuals), constants.record(), found.deviation, found.correlation
    )
    found.weight[:] = total / (total + constants.half_weight)
    return found


def normalised_residuals(problem: Problem, poses: Floats, extents: Floats) -> Floats:
    """
    Return input minus fit over the deviations of the settings, shape (B, N, 9).

    Along the axes of the boxes at `poses` (B, N, 6) of `extents` (B, 3), in the order of
    `InputNoise`. NaN for boxes that repeat the one before, since boxes that a tracker holds have
    no new error, and for those without points, since their fit follows the input.

    """
    # The first box is compared with the last one: a track that is held throughout is left out.
    before = np.roll(problem.boxes, 1, axis=1)
    has_points = problem.counts > 0
    residuals = _residuals(problem.boxes, before, poses, extents[:, None], has_points)
    return residuals / problem.errors[:, None]


def residuals_at(problem: Problem, poses: Floats, extents: Floats, columns: Ints) -> Floats:
    """Return `normalised_residuals` (B, 9) of one observation of each window, in `columns`."""
    rows = np.arange(len(problem.boxes))
    boxes, before = problem.boxes[rows, columns], problem.boxes[rows, columns - 1]
    has_points = problem.counts[rows, columns] > 0
    residuals = _residuals(boxes, before, poses[rows, columns], extents, has_points)
    return residuals / problem.errors


def _residuals(
    boxes: Floats, before: Floats, pose: Floats, extent: Floats, has_points: NDArray[np.bool_]
) -> Floats:
    """Return input minus fit (..., 9), NaN for boxes without points or as the one `before`."""
    difference = boxes[..., POSE] - pose
    to_box = np.swapaxes(matrix_from_rpy(pose[..., 3:]), -1, -2)
    along = (to_box @ difference[..., :3, None])[..., 0]
    residuals = np.concatenate(
        [along, difference[..., 3:], boxes[..., BOX_EXTENT] / extent - 1], axis=-1
    )
    is_repeated = np.abs(boxes - before).max(-1) < REPEATED_BOX_TOLERANCE
    residuals[~has_points | is_repeated] = np.nan
    return residuals
