"""
The errors of the input poses and extents, estimated from their residuals (M16).

docs/method.md, section Input model, has the formulas.

"""

from collections.abc import Sequence

from boxreg_ros.core.input_statistics import NOISE
from boxreg_ros.core.method.constants import Constants
from boxreg_ros.core.method.expectation import SIZE
from boxreg_ros.core.method.noise import estimate, fill_residuals
from boxreg_ros.core.problem import Problem
from boxreg_ros.structures import Floats
import numpy as np
from numpy.typing import NDArray

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
        weights /= np.where(count > 0, count, 1.0)[..., None]
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
    """Return the residuals (B, N, 9) of `noise.fill_residuals`, in the order of `NOISE`."""
    residuals = np.empty((*problem.counts.shape, 9))
    fill_residuals(problem, np.ascontiguousarray(poses), np.ascontiguousarray(extents), residuals)
    return residuals
