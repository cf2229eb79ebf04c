"""
Means and deviations of one window before its points are used, in plain loops.

And evidence of the points about its extents, after a round. The torch twins are `expect`
and `evidence_of_extents` of `boxreg_ros.core.expectation`; the formulas are (M15) to (M17).

"""

from math import exp, hypot, inf, isfinite, log, sqrt
from typing import Any, NamedTuple

from boxreg_ros.core.kernels.compile import kernel
from boxreg_ros.core.kernels.normal_equations import (
    ANCHOR,
    BIAS,
    EXTENT,
    GAP,
    PIVOT,
    SIDESLIP,
)
import numpy as np

POSE, SIZE = 6, 3
"""Numbers of a pose, and of an extent."""
ROLL, HEADING = 3, 5
"""Indices of roll and yaw in a pose."""


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
def fill_mean_extents(b, windows, mean):
    """Write the mean input extents, marginalised ones included; of pinned boxes if there are."""
    has_pin = windows.pinned[b].any()
    for k in range(SIZE):
        total, count = 0.0, 0.0
        if not has_pin:
            total, count = windows.marginalised_extents[b, k], windows.marginalised_extents[b, 3]
        for n in range(windows.lengths[b]):
            if windows.pinned[b, n] or not has_pin:
                total += windows.boxes[b, n, 3 + k]
                count += 1.0
        mean[k] = total / count


@kernel
def fill_ratios(b, windows, known, numbers, work):
    """Write how large and how correlated the errors of the input of one window are."""
    kind, length = windows.kind[b], windows.lengths[b]
    weight = known.weight[kind]
    interval = windows.times[b, length - 1] / max(length - 1, 1)
    for j in range(POSE + SIZE):
        typical = numbers.typical_correlation
        correlation = typical + weight * (known.correlation[kind, j] - typical)
        work.widening[j] = sqrt((1 + correlation) / (1 - correlation))
        slow = correlation ** (numbers.correlation_interval / interval) - numbers.white_correlation
        work.slow[j] = clamp(slow / numbers.correlation_span, 0.1, 1.0)
    offset = known.offset[kind]
    filtered = ((offset[0] + offset[1] + offset[POSE]) / 3 / numbers.filtered_offset) ** 2
    filtered = weight * min(filtered, numbers.max_filtered_bias)
    for j in range(POSE):
        deviation = known.deviation[kind, j]
        lowered = deviation * min((deviation / numbers.low_noise_ratio) ** 2, 1.0)
        lowered = clamp(lowered, numbers.ratio_bounds[0], numbers.ratio_bounds[1])
        ratio = sqrt(1 + weight * (lowered**2 - 1))
        work.ratio[j] = ratio
        work.constant[j] = clamp(max(ratio, filtered) if j < SIZE else ratio, 0.1, 2.0)


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
def fill_expectation(b, windows, of_class, known, numbers, work, expected):
    """Write means and deviations of window `b`, given what `work` has of its input."""
    kind = windows.kind[b]
    has_pin = windows.pinned[b].any()
    usual, usual_extent = of_class.pose[b], of_class.extent[b]
    shared, deviation, mean = expected.shared, expected.deviation, work.mean
    shared[:] = 0.0
    for j in range(POSE):
        share = numbers.yaw_bias if j == HEADING else 1.0
        bias = usual[j] * share * work.slow[j] * work.constant[j]
        expected.pose_deviation[j] = usual[j] * work.ratio[j]
        expected.widened_deviation[j] = usual[j] * work.ratio[j] * work.widening[j]
        expected.unmodelled_bias[j] = bias if has_pin else 0.0
        deviation[BIAS + j] = numbers.pinned_extent if has_pin else bias
    for k in range(SIZE):
        part = usual_extent * work.slow[POSE + k] * min(2 * work.constant[k], 1.0)
        factor = population_factor(
            k, mean, part, known.median[kind], known.slopes[kind], numbers.population_radius
        )
        shared[EXTENT + k] = mean[k] if has_pin else mean[k] * factor
        deviation[EXTENT + k] = numbers.pinned_extent if has_pin else mean[k] * factor * part
    widening = max(2 - 2 * work.constant[0], 1.0)
    for face in range(6):
        size = max(mean[face // 2] / numbers.large_extent[face // 2], 1.0)
        shared[GAP + face] = of_class.gaps[b, face] + known.gap_correction[kind, face]
        deviation[GAP + face] = of_class.gap_spread[b] * size * widening
    shared[PIVOT] = mean[0] * of_class.pivot[b]
    deviation[PIVOT] = mean[0] * numbers.pivot_deviation
    deviation[ANCHOR:SIDESLIP] = 1.0
    deviation[SIDESLIP] = of_class.sideslip[b]


@kernel
def margin_variance(variance, tracks, errors, usual, numbers):
    """Return the posterior variance of the margins of one face between tracks (M18a)."""
    squares, weights = numbers.spread_squares, numbers.spread_weights
    degrees = max(tracks - 1.0, 0.0)
    most = -inf
    for q in range(len(squares)):
        total = errors + usual**2 * squares[q]
        most = max(most, -0.5 * degrees * (log(total) + variance / total))
    mean, norm = 0.0, 0.0
    for q in range(len(squares)):
        total = errors + usual**2 * squares[q]
        information = -0.5 * degrees * (log(total) + variance / total)
        part = weights[q] * exp(information - most)
        mean += part * usual**2 * squares[q]
        norm += part
    return mean / norm


@kernel
def fill_margin_error(b, windows, of_class, known, numbers, work, expected):
    """Write the deviations of the labelling margins of window `b` (M28), (6,)."""
    kind, mean = windows.kind[b], work.mean
    usual = of_class.gap_spread[b] * max(2 - 2 * work.constant[0], 1.0)
    distance = population_distance(mean, known.median[kind], numbers.population_radius)
    similarity = 1 / (1 + distance)
    for face, twin in ((0, 1), (2, 3), (4, 4), (5, 5)):  # two faces of one kind share their tracks
        k = face // 2
        size = max(mean[k] / numbers.large_extent[k], 1.0)
        bias = of_class.pose[b, k] * work.slow[k] * work.constant[k]
        part = of_class.extent[b] * work.slow[POSE + k] * min(2 * work.constant[k], 1.0)
        noise = known.gap_noise[kind, face] * expected.widened_deviation[k] ** 2
        errors = bias**2 + (mean[k] / size * part / 2) ** 2 + noise
        square = margin_variance(
            known.gap_variance[kind, face], known.gap_tracks[kind, face], errors, usual, numbers
        )
        spread = sqrt(usual**2 + similarity * (square - usual**2))
        expected.error[GAP + face] = spread * size
        expected.error[GAP + twin] = spread * size


@kernel
def fill_input_error(b, windows, of_class, known, numbers, work, expected):
    """Write the deviations of the errors of mean extents and bias of window `b` (M28), (9,)."""
    kind = windows.kind[b]
    weight = known.weight[kind]
    slow = max(work.slow[:ROLL].max(), work.slow[HEADING:].max())  # without roll and pitch
    deviation, error, mean = expected.deviation, expected.error, work.mean
    count = windows.lengths[b] + windows.marginalised_extents[b, 3]
    for k in range(SIZE):
        j = POSE + k
        noise = sqrt(1 + weight * (known.deviation[kind, j] ** 2 - 1))
        of_mean = min(work.widening[j] / sqrt(count), 1.0)
        constant = slow * noise
        if kind != numbers.estimated_kind:
            constant = max(min(noise / numbers.low_noise_ratio, 1.0), noise)
        constant *= numbers.constant_extent_errors[kind][k]
        error[EXTENT + k] = mean[k] * of_class.extent[b] * hypot(noise * of_mean, constant)
    for j in range(POSE):
        noise = sqrt(1 + weight * (known.deviation[kind, j] ** 2 - 1))
        share = numbers.yaw_bias if j == HEADING else 1.0
        error[BIAS + j] = of_class.pose[b, j] * noise * slow * share
    has_pin = windows.pinned[b].any()
    for s in range(GAP):
        error[s] = deviation[s] if has_pin else max(error[s], deviation[s])


@kernel
def expect(b, windows, of_class, known, numbers, work, expected):
    """
    Write means and deviations of window `b`.

    Parameters
    ----------
    b : int
        The window.
    windows : WindowArrays
        Input of the windows.
    of_class : ClassArrays
        Settings of the class of each window.
    known : InputArrays
        Noise, margins and population of the input, by kind.
    numbers : ExpectationNumbers
        Constants.
    work : ExpectationWork
        Arrays to work in.
    expected : ExpectedArrays
        Written.

    """
    fill_mean_extents(b, windows, work.mean)
    fill_ratios(b, windows, known, numbers, work)
    fill_expectation(b, windows, of_class, known, numbers, work, expected)
    fill_input_error(b, windows, of_class, known, numbers, work, expected)
    fill_margin_error(b, windows, of_class, known, numbers, work, expected)


@kernel
def fill_evidence(given, expected, deviation, shared, corner, min_gain, evidence):
    """Write corrections of the extents by the points alone, and their weights, (2, 3) (M17)."""
    for k in range(SIZE):
        gain = 1 - corner[k, k] / deviation[k] ** 2
        power = (deviation[k] / expected[k]) ** 2
        by_points = log(shared[EXTENT + k] / expected[k]) / gain + log(expected[k])
        is_evidence = gain > min_gain and isfinite(by_points)
        evidence[0, k] = (by_points - given[k]) / power if is_evidence else 0.0
        evidence[1, k] = gain * power if is_evidence else 0.0
