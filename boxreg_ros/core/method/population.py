"""The population of tracks: how the input errs in extents unlike the usual ones (M18)."""

from boxreg_ros.core.method.arrowhead import factorise_corner, solve_corner
from boxreg_ros.core.method.compile import kernel, loop, small_array
from boxreg_ros.core.method.expectation import SIZE
from boxreg_ros.core.method.selection import lower_median
import numpy as np

CROSS_SLOPE_INFORMATION = 4.0
"""Prior information of slopes over the other two extents. Chosen: half the deviation of the own
one."""


@kernel
def population_slopes(evidence, constants, median, slopes):
    """
    Write the regression of extent corrections on extents.

    Trained detectors shrink extents toward those of the majority, noise spreads them. Tracks with
    evidence about their extents show which, and by how much: a ridge regression of their
    corrections on the distance of all three extents from the medians, in logarithms and in
    proportion to the square of the error, so that low-noise input is left as it is. Objects unlike
    the majority, trucks among cars, are corrected little, and the medians not at all: the
    labelling margin accounts for a common error.

    Parameters
    ----------
    evidence : array, shape (n, 3, 3)
        Of the points of n tracks. Rows of length, width and height: logarithms of the input's;
        corrections to these, over the square of their expected error; the weights of these, 0
        without enough evidence.
    constants : array of one record of `Constants`, shape (1,)
        Of the method.
    median, slopes : array, shapes (3,) and (3, 3)
        Written: the medians of the logarithms of extents, and the slopes of the corrections, one
        row for each corrected extent.

    """
    constants = constants[0]
    values = np.empty(len(evidence))
    for m in range(len(median)):
        for track in range(len(evidence)):
            values[track] = evidence[track, 0, m]
        median[m] = lower_median(values)
    fill_slopes(evidence, constants, median, np.empty((SIZE, SIZE, SIZE)), slopes)


@loop
def fill_slopes(evidence, constants, median, curvature, slopes):
    """Write the slopes of `population_slopes`; `curvature` (3, 3, 3) is to work in."""
    information = 1 / constants.slope_deviation**2
    off = small_array(SIZE)
    for k in range(SIZE):
        for m in range(SIZE):
            slopes[k, m] = 0.0
            for j in range(SIZE):
                own = 1.0 if m == k else CROSS_SLOPE_INFORMATION
                curvature[k, m, j] = information * own if m == j else 0.0
    for track in range(len(evidence)):
        log, correction, weight = evidence[track, 0], evidence[track, 1], evidence[track, 2]
        away = 0.0
        for m in range(SIZE):
            off[m] = log[m] - median[m]
            away += (off[m] / constants.population_radius) ** 2
        similarity = 1 / (1 + away)
        for m in range(SIZE):
            off[m] *= similarity
        for k in range(SIZE):
            for m in range(SIZE):
                weighted = weight[k] * off[m]
                slopes[k, m] += similarity * correction[k] * weighted
                for j in range(m, SIZE):
                    curvature[k, m, j] += weighted * off[j]
    for k in range(len(slopes)):
        factorise_corner(curvature[k])
        solve_corner(curvature[k], slopes[k])
