"""
Means and deviations of one window before its points are used (M15) to (M16), (M18a).

And evidence of the points about its extents, after a round (M17).

"""

from math import exp, hypot, inf, isfinite, log, sqrt
from typing import Any, NamedTuple

from boxreg_ros.core.method.arrays import ANCHOR, BIAS, EXTENT, GAP, PIVOT, POSE, SIDESLIP
from boxreg_ros.core.method.compile import kernel
import numpy as np

SIZE = 3
"""Numbers of an extent."""
ROLL, HEADING = 3, 5
"""Indices of roll and yaw in a pose."""
VEHICLE = 0
"""The kind of objects whose extents are estimated, among `config.KINDS`."""
LEAST_RATIO, MOST_RATIO = 0.02, 4.0
"""Bounds of an estimated error over the one of the settings. Chosen."""
LEAST_PART = 0.1
"""Least part of an error that is constant along a track. Chosen."""
PINNED_DEVIATION = 0.01
"""Deviation of the bias of a pinned box [m, rad]: practically held. Chosen."""
CONSTANT_EXTENT_ERRORS = ((1.6, 2.9, 1.6), (1.9, 3.1, 2.0), (2.9, 3.2, 1.7))
"""
Error of length, width and height that is constant along a track, over the one that changes.

Of vehicles, cyclists and pedestrians. Measured of PointRCNN on KITTI: of cars 0.217, 0.083 and
0.071 m over 0.176, 0.030 and 0.052 m, times the ratios of standard to robust deviation, 1.28, 1.05
and 1.18; of cyclists 0.101, 0.112 and 0.078 m over 0.053, 0.036 and 0.039 m; of pedestrians 0.152,
0.117 and 0.080 m over 0.052, 0.037 and 0.047 m.

"""
SPREAD_NODES, MAX_SPREAD = 24, 5.0
"""Nodes of the quadrature over the spread of margins, and its end in deviations of the settings.
Derived: exact to 1 mm for 200 tracks; P(|z| > 5) is below 10^-6."""


class ExpectationWork(NamedTuple):
    """
    Intermediate values of the expectation of one window.

    Attributes
    ----------
    mean : array, shape (3,)
        Mean input extents [m].
    ratio, constant : array, shape (6,)
        Errors of the input over those of the settings, lowered for low-noise input; of the part
        that is constant along a track.
    widening : array, shape (9,)
        Factor on deviations for the correlation of neighbours.
    slow : array, shape (9,)
        Part of the errors that is constant over the window.

    """

    mean: Any
    ratio: Any
    constant: Any
    widening: Any
    slow: Any


@kernel
def empty_expectation_work():
    """Return the arrays for one window."""
    return ExpectationWork(np.empty(SIZE), np.empty(6), np.empty(6), np.empty(9), np.empty(9))


@kernel
def clamp(value, low, high):
    """Return a value within bounds."""
    return min(max(value, low), high)


@kernel
def fill_mean_extents(b, problem, mean):
    """Write the mean input extents, marginalised ones included; of pinned boxes if there are."""
    has_pin = problem.pinned[b].any()
    for k in range(SIZE):
        total, count = 0.0, 0.0
        if not has_pin:
            total, count = problem.marginalised_extents[b, k], problem.marginalised_extents[b, 3]
        for n in range(problem.lengths[b]):
            if problem.pinned[b, n] or not has_pin:
                total += problem.boxes[b, n, 3 + k]
                count += 1.0
        mean[k] = total / count


@kernel
def fill_ratios(b, problem, inputs, constants, work):
    """Write how large and how correlated the errors of the input of one window are."""
    length = problem.lengths[b]
    weight = inputs.weight
    interval = problem.times[b, length - 1] / max(length - 1, 1)
    for j in range(POSE + SIZE):
        typical = constants.typical_correlation
        correlation = typical + weight * (inputs.correlation[j] - typical)
        work.widening[j] = sqrt((1 + correlation) / (1 - correlation))
        later = correlation ** (constants.correlation_interval / interval)
        slow = (later - constants.white_correlation) / constants.correlation_span
        work.slow[j] = clamp(slow, LEAST_PART, 1.0)
    for j in range(POSE):
        deviation = inputs.deviation[j]
        lowered = deviation * min((deviation / constants.low_noise_ratio) ** 2, 1.0)
        lowered = clamp(lowered, LEAST_RATIO, MOST_RATIO)
        work.ratio[j] = sqrt(1 + weight * (lowered**2 - 1))
        work.constant[j] = clamp(work.ratio[j], LEAST_PART, 2.0)


@kernel
def population_distance(mean, median, radius):
    """Return the squared distance of mean extents from those of the population of tracks."""
    distance = 0.0
    for m in range(SIZE):
        distance += ((log(mean[m]) - median[m]) / radius) ** 2
    return distance


@kernel
def population_factor(k, mean, part, median, slopes, radius):
    """Return expected over given extent `k`, by the population of tracks (M16)."""
    pull = 0.0
    for m in range(SIZE):
        pull += slopes[k, m] * (log(mean[m]) - median[m])
    return exp(part**2 * pull / (1 + population_distance(mean, median, radius)))


@kernel
def fill_expectation(b, problem, inputs, constants, work, common):
    """Write means and deviations of window `b`, given what `work` has of its input (M15)."""
    of_class = problem.of_class[b]
    pins = problem.pinned[b].sum()
    has_pin = pins > 0
    usual, usual_extent = of_class.pose, of_class.extent
    shared, deviation, mean = common.shared, common.deviation, work.mean
    shared[:] = 0.0
    for j in range(POSE):
        share = constants.yaw_bias if j == HEADING else 1.0
        bias = usual[j] * share * work.slow[j] * work.constant[j]
        common.pose_deviation[j] = usual[j] * work.ratio[j]
        common.widened_deviation[j] = usual[j] * work.ratio[j] * work.widening[j]
        common.unmodelled_bias[j] = bias if has_pin else 0.0
        deviation[BIAS + j] = PINNED_DEVIATION if has_pin else bias
    for k in range(SIZE):
        part = usual_extent * work.slow[POSE + k] * min(2 * work.constant[k], 1.0)
        factor = population_factor(
            k, mean, part, inputs.median, inputs.slopes, constants.population_radius
        )
        shared[EXTENT + k] = mean[k] if has_pin else mean[k] * factor
        deviation[EXTENT + k] = mean[k] * factor * part
        if has_pin:
            deviation[EXTENT + k] = constants.pin_deviations[POSE] / sqrt(float(pins))
    for face in range(6):
        shared[GAP + face] = of_class.gaps[face] + inputs.gap_correction[face]
        deviation[GAP + face] = usual_spread(of_class, work)
    shared[PIVOT] = deviation[PIVOT] = mean[0] * constants.pivot
    deviation[ANCHOR:SIDESLIP] = 1.0
    deviation[SIDESLIP] = constants.sideslip


@kernel
def usual_spread(of_class, work):
    """Return the spread of margins by the settings, twice as large for low-noise input [m]."""
    return of_class.gap_spread * max(2 - 2 * work.constant[0], 1.0)


@kernel
def margin_variance(variance, tracks, errors, usual):
    """
    Return the posterior variance of the margins of one face between tracks (M18a).

    By quadrature over a half-normal prior of the spread.

    """
    degrees = max(tracks - 1.0, 0.0)
    most = -inf
    for q in range(SPREAD_NODES):
        square = ((q + 0.5) * MAX_SPREAD / SPREAD_NODES) ** 2
        total = errors + usual**2 * square
        most = max(most, -0.5 * degrees * (log(total) + variance / total))
    mean, norm = 0.0, 0.0
    for q in range(SPREAD_NODES):
        square = ((q + 0.5) * MAX_SPREAD / SPREAD_NODES) ** 2
        total = errors + usual**2 * square
        information = -0.5 * degrees * (log(total) + variance / total)
        part = exp(information - most - square / 2)
        mean += part * usual**2 * square
        norm += part
    return mean / norm


@kernel
def fill_margin_error(b, problem, inputs, constants, work, common):
    """Write the deviations of the labelling margins of window `b` (M28), (6,)."""
    mean, of_class = work.mean, problem.of_class[b]
    usual = usual_spread(of_class, work)
    distance = population_distance(mean, inputs.median, constants.population_radius)
    similarity = 1 / (1 + distance)
    for face, twin in ((0, 1), (2, 3), (4, 4), (5, 5)):  # two faces of one kind share their tracks
        k = face // 2
        bias = of_class.pose[k] * work.slow[k] * work.constant[k]
        part = of_class.extent * work.slow[POSE + k] * min(2 * work.constant[k], 1.0)
        noise = inputs.gap_noise[face] * common.widened_deviation[k] ** 2
        errors = bias**2 + (mean[k] * part / 2) ** 2 + noise
        square = margin_variance(inputs.gap_variance[face], inputs.gap_tracks[face], errors, usual)
        spread = sqrt(usual**2 + similarity * (square - usual**2))
        common.error[GAP + face] = spread
        common.error[GAP + twin] = spread


@kernel
def fill_input_error(b, problem, inputs, constants, work, common):
    """Write the deviations of the errors of mean extents and bias of window `b` (M28), (9,)."""
    kind, of_class = problem.kind[b], problem.of_class[b]
    weight = inputs.weight
    slow = max(work.slow[:ROLL].max(), work.slow[HEADING:].max())  # detectors set roll and pitch
    deviation, error, mean = common.deviation, common.error, work.mean
    count = problem.lengths[b] + problem.marginalised_extents[b, 3]
    for k in range(SIZE):
        j = POSE + k
        noise = sqrt(1 + weight * (inputs.deviation[j] ** 2 - 1))
        of_mean = min(work.widening[j] / sqrt(count), 1.0)
        constant = slow * noise
        if kind != VEHICLE:
            constant = max(min(noise / constants.low_noise_ratio, 1.0), noise)
        constant *= CONSTANT_EXTENT_ERRORS[kind][k]
        error[EXTENT + k] = mean[k] * of_class.extent * hypot(noise * of_mean, constant)
    for j in range(POSE):
        noise = sqrt(1 + weight * (inputs.deviation[j] ** 2 - 1))
        share = constants.yaw_bias if j == HEADING else 1.0
        error[BIAS + j] = of_class.pose[j] * noise * slow * share
    has_pin = problem.pinned[b].any()
    for s in range(GAP):
        error[s] = deviation[s] if has_pin else max(error[s], deviation[s])


@kernel
def expect(b, problem, inputs, constants, work, common):
    """
    Write means and deviations of window `b`.

    Parameters
    ----------
    b : int
        The window.
    problem : Problem
        Input of the batch.
    inputs : record `INPUTS`
        Noise, margins and population of the input, of its kind.
    constants : record of `Constants`
        Of the method, with the settings.
    work : ExpectationWork
        Arrays to work in.
    common : record `COMMON`
        Of the window: written.

    Notes
    -----
    The error of an input has a part that is constant over its track, the bias, and one that
    changes. The correlation widens the deviation of the latter; without correlation over
    `correlation_interval` there is no bias. The estimated deviation of low-noise input is lowered
    further, and its bias and extents are held. Margins of low-noise input differ between objects
    by twice as much: human labels follow each object.

    """
    fill_mean_extents(b, problem, work.mean)
    fill_ratios(b, problem, inputs, constants, work)
    fill_expectation(b, problem, inputs, constants, work, common)
    fill_input_error(b, problem, inputs, constants, work, common)
    fill_margin_error(b, problem, inputs, constants, work, common)


@kernel
def fill_evidence(common, shared, corner, min_gain, evidence):
    """
    Write the evidence of the points alone about the extents (M17), see `Solution.evidence`.

    `corner` (23, 23) is the covariance of the shared variables: the part of the prior in the fit
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
