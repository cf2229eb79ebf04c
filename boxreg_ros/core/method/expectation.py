"""
Means and deviations of one window before its points are used, by the model of the input (M14).

And evidence of the points about its extents, after a round (M18).

"""

from math import exp, isfinite, log, sqrt

from boxreg_ros.core.method.arrays import BIAS, BOTTOM, EXTENT, GAP, PIVOT, POSE, SHARED, SIDESLIP
from boxreg_ros.core.method.compile import loop
from boxreg_ros.core.method.selection import sum_of

SIZE, FACES = 3, 6
"""Numbers of an extent, and of the faces of a box."""
HEADING = 5
"""Index of the yaw in a pose."""
LEAST_PART = 0.1
"""Least bias over the error that changes along a track. Chosen."""
EXTENT_TAILS = (1.28, 1.05, 1.18)
"""Standard over robust deviation of errors of length, width and height. Measured of PointRCNN on
KITTI."""
PINNED_DEVIATION = 0.01
"""Deviation of the bias of a pinned box [m, rad]: practically held. Chosen."""


@loop
def interval_of(b, problem):
    """Return the mean time step of window `b` [s]."""
    length = problem.lengths[b]
    return problem.times[b, length - 1] / max(length - 1, 1)


@loop
def constant_part(correlation, steps):
    """
    Return the deviation of the constant part of an error over that of the changing one (M17).

    By the `correlation` from one observation to the next, and the number of `steps` after which
    what remains correlated is constant.

    """
    later = correlation**steps
    return min(max(2 * later / (1 - later), LEAST_PART), 1.0)


@loop
def population_distance(mean, median, radius):
    """Return the squared distance of mean extents from those of the population of tracks."""
    distance = 0.0
    for m in range(SIZE):
        distance += ((log(mean[m]) - median[m]) / radius) ** 2
    return distance


@loop
def population_factor(k, mean, part, median, slopes, radius):
    """Return expected over given extent `k`, by the population of tracks (M18)."""
    pull = 0.0
    for m in range(SIZE):
        pull += slopes[k, m] * (log(mean[m]) - median[m])
    return exp(part**2 * pull / (1 + population_distance(mean, median, radius)))


@loop
def fill_poses(b, problem, inputs, constants, common):
    """Write the deviations of the errors of the input poses of window `b` (M17)."""
    of_class, interval = problem.of_class[b], interval_of(b, problem)
    has_pin = sum_of(problem.pinned[b]) > 0
    claimed = inputs.low_noise**2
    for j in range(POSE):
        correlation = inputs.correlation[j]
        error = of_class.pose[j] * inputs.deviation[j]
        bias = error * constant_part(correlation, constants.correlation_interval / interval)
        bias *= constants.yaw_bias if j == HEADING else 1.0
        common.unclaimed[BIAS + j] = 0.0 if has_pin else bias**2 * (1 - claimed**2)
        error *= claimed
        bias *= claimed
        common.pose_deviation[j] = error
        common.widened_deviation[j] = error * sqrt((1 + correlation) / (1 - correlation))
        common.unmodelled_bias[j] = bias if has_pin else 0.0
        common.deviation[BIAS + j] = PINNED_DEVIATION if has_pin else bias


@loop
def fill_shared(b, problem, inputs, constants, mean, common):
    """Write means and deviations of extents, margins and motion of window `b`."""
    of_class, interval = problem.of_class[b], interval_of(b, problem)
    pins = sum_of(problem.pinned[b])
    count = problem.lengths[b] + problem.marginalised_extents[b, 3]
    shared, deviation = common.shared, common.deviation
    for s in range(SHARED):  # deviations of the bias come later
        shared[s], deviation[s] = 0.0, 1.0
    for k in range(SIZE):
        correlation = inputs.correlation[POSE + k]
        error = of_class.extent * inputs.extent_error[k]
        part = constant_part(correlation, constants.correlation_interval / interval)
        part *= error * inputs.low_noise
        factor = 1.0
        if not pins:
            factor = population_factor(
                k, mean, part, inputs.median, inputs.slopes, constants.population_radius
            )
        shared[EXTENT + k] = mean[k] * factor
        deviation[EXTENT + k] = shared[EXTENT + k] * part
        common.unclaimed[EXTENT + k] = 0.0
        if pins:
            deviation[EXTENT + k] = constants.pin_deviations[POSE] / sqrt(float(pins))
            continue
        changing = of_class.extent * inputs.deviation[POSE + k]
        of_mean = min((1 + correlation) / (1 - correlation) / count, 1.0)
        variance = (EXTENT_TAILS[k] * error) ** 2 - part**2 + of_mean * changing**2
        common.unclaimed[EXTENT + k] = mean[k] ** 2 * variance
    distance = population_distance(mean, inputs.median, constants.population_radius)
    for face in range(FACES):
        shared[GAP + face] = of_class.gaps[face] + inputs.margin[face]
        between = 1 + (inputs.spread[face] ** 2 - 1) / (1 + distance)
        spread = constants.road_spread if face == BOTTOM else of_class.gap_spread
        deviation[GAP + face] = spread * sqrt(between)
        common.margin_variance[face] = inputs.margin_variance[face]
    shared[PIVOT] = deviation[PIVOT] = mean[0] * constants.pivot
    deviation[SIDESLIP] = constants.sideslip


@loop
def expect(b, problem, inputs, constants, mean, common):
    """
    Write means and deviations of window `b`.

    Parameters
    ----------
    b : int
        The window.
    problem : Problem
        Input of the batch.
    inputs : record `INPUTS`
        The model of the input, of its kind.
    constants : record of `Constants`
        Of the method, with the settings.
    mean : array, shape (3,)
        Mean input extents of the window [m].
    common : record `COMMON`
        Of the window: written.

    """
    fill_shared(b, problem, inputs, constants, mean, common)
    fill_poses(b, problem, inputs, constants, common)


@loop
def fill_evidence(common, shared, corner, min_gain, evidence):
    """
    Write the evidence of the points alone about the extents (M18), see `Solution.evidence`.

    `corner` (S, S) is the covariance of the shared variables: the part of the prior in the fit
    is removed.

    """
    for k in range(SIZE):
        deviation, mean = common.deviation[EXTENT + k], common.shared[EXTENT + k]
        gain = 1 - corner[EXTENT + k, EXTENT + k] / deviation**2
        power = (deviation / mean) ** 2
        by_points = log(shared[EXTENT + k] / mean) / gain + log(mean)
        is_evidence = gain > min_gain and isfinite(by_points)
        evidence[1, k] = (by_points - evidence[0, k]) / power if is_evidence else 0.0
        evidence[2, k] = gain * power if is_evidence else 0.0
