"""
The population of tracks: how the input errs in extents that differ from the usual ones (M18).

docs/method.md, section Input model, has the formulas.

"""

from boxreg_ros.core.method.constants import Constants
from boxreg_ros.structures import Floats
import numpy as np

CROSS_SLOPE_INFORMATION = 4.0
"""Prior information of slopes over the other two extents. Chosen: half the deviation of the own
one."""


def population_slopes(evidence: Floats, constants: Constants) -> tuple[Floats, Floats]:
    """
    Return the regression of extent corrections on extents.

    Trained detectors shrink extents toward those of the majority, noise spreads them. Tracks with
    evidence about their extents show which, and by how much: a ridge regression of their
    corrections on the distance of all three extents from the medians, in logarithms and in
    proportion to the square of the error, so that low-noise input is left as it is. Objects unlike
    the majority, trucks among cars, are corrected little, and the medians not at all: the
    labelling margin accounts for a common error.

    `evidence` (n, 3, 3) is of the points of n tracks. Rows of length, width and height: logarithms
    of the input's; corrections to these, over the square of their expected error; the weights of
    these, 0 without enough evidence. Returned are the medians (3,) of the logarithms of extents,
    and the slopes (3, 3) of the corrections, one row for each corrected extent.

    """
    log, correction, weight = evidence.swapaxes(0, 1)  # (n, 3) each
    median = np.sort(log, axis=0)[(len(log) - 1) // 2]
    off = log - median
    similarity = 1 / (1 + np.square(off / constants.population_radius).sum(1, keepdims=True))
    A = similarity * off
    weighted = weight.T[..., None] * A  # (3, n, 3)
    ridge = np.full((3, 3), CROSS_SLOPE_INFORMATION) - (CROSS_SLOPE_INFORMATION - 1) * np.eye(3)
    curvature = (
        weighted.swapaxes(1, 2) @ A + ridge[:, None] * np.eye(3) / constants.slope_deviation**2
    )
    pull = (similarity * correction).T[:, None] @ weighted  # (3, 1, 3)
    return median, np.linalg.solve(curvature, pull.swapaxes(1, 2))[..., 0]
