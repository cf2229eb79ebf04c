"""
The errors of the input poses and extents, estimated from their residuals (M16).

docs/method.md, section Input model, has the formulas.

"""

from collections.abc import Sequence

from boxreg_ros.core.input_statistics import NOISE
from boxreg_ros.core.method.constants import Constants
from boxreg_ros.core.method.expectation import SIZE
from boxreg_ros.core.method.noise import estimate
from boxreg_ros.core.problem import Problem
from boxreg_ros.rotations import matrix_from_rpy
from boxreg_ros.structures import BOX_EXTENT, Floats, Ints, POSE
import numpy as np
from numpy.typing import NDArray

REPEATED_BOX_TOLERANCE = 1e-3
"""A box that differs from the one before by less repeats it [m, rad]. Chosen."""
EXTENT_ERRORS = ((0.9, 0.9, 0.9), (0.8, 1.6, 0.65), (2.7, 1.6, 0.65))
"""Error of extents that is constant along a track, over the one of the settings, of vehicles,
cyclists and pedestrians. Measured of PointRCNN on KITTI, widths of the latter two on PandaSet."""
DETECTED = [0, 1, 2, 5]
"""Variables of a pose that detectors estimate, with one correlation: x, y, z, yaw."""
LEAST_RATIO = 0.02
"""Least estimated error over the one of the settings. Chosen."""


def set_noise(
    inputs: NDArray[np.void],
    residuals: Sequence[Floats],
    past: NDArray[np.void],
    constants: Constants,
) -> None:
    """
    Set the errors of each of `KINDS` in records `INPUTS` (K,) (M16), (M17).

    Of `normalised_residuals` of the tracks of each kind (B, N, 9), NaN is left out, and of other
    drives, records `NOISE` (K,). The settings are the prior of all kinds together, and these of
    each: a kind that was seen in few boxes errs as the others do, in proportion to its settings.

    """
    found = np.array([noise_of(of_kind, constants) for of_kind in residuals])
    boxes = np.stack([past['boxes'], found['boxes']])  # (2, K)
    variances = np.stack([past['deviation'], found['deviation']]) ** 2  # (2, K, 9)
    correlations = np.stack([past['correlation'], found['correlation']])
    variance = np.ones((len(inputs), 9))
    correlation = np.full((len(inputs), 9), constants.typical_correlation)
    is_own = np.eye(len(inputs))
    for taken in (1.0 - is_own, is_own):
        weights = taken[:, None] * boxes  # (K, 2, K): of each part of each kind, for a kind
        count = weights.sum((1, 2))[:, None]
        share = count / (count + constants.half_weight)
        weights /= np.maximum(count, 1.0)[..., None]
        variance += share * (np.tensordot(weights, variances, 2) - variance)
        correlation += share * (np.tensordot(weights, correlations, 2) - correlation)
    correlation[:, DETECTED] = correlation[:, DETECTED].mean(1, keepdims=True)
    deviation = np.sqrt(variance).clip(LEAST_RATIO)
    inputs['deviation'], inputs['correlation'] = deviation, correlation
    of_centres = np.exp(np.log(deviation[:, :SIZE]).mean(1))
    inputs['low_noise'] = (of_centres / constants.low_noise).clip(max=1.0)
    # Trackers may hold the extents: no residual shows their errors. Those of the centre do.
    inputs['extent_error'] = EXTENT_ERRORS * inputs['low_noise'][:, None]


def noise_of(residuals: Floats, constants: Constants) -> NDArray[np.void]:
    """Estimate the noise of tracks (B, N, 9) of one kind (M16), a record `NOISE`."""
    found = np.zeros((), NOISE)
    if len(residuals):
        found['boxes'] = estimate(
            np.ascontiguousarray(residuals), constants.record(), found['deviation'],
            found['correlation'],
        )  # fmt: skip
    return found


def normalised_residuals(problem: Problem, poses: Floats, extents: Floats) -> Floats:
    """
    Return input minus fit over the deviations of the settings, shape (B, N, 9).

    Along the axes of the boxes at `poses` (B, N, 6) of `extents` (B, 3), in the order of
    `NOISE`. NaN for boxes that repeat the one before, since boxes that a tracker holds have
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
