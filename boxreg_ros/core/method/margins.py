"""Labelling margins and insets of one kind of objects, by what its tracks show (M15)."""

from math import exp

from boxreg_ros.core.method.compile import kernel
from boxreg_ros.core.method.expectation import constant_part, SIZE
from boxreg_ros.core.method.selection import nth
import numpy as np

MIN_HITS = 3
"""Detections that confirm a track, and its face observations, and tracks, that a margin needs;
literature: SORT."""
FIRST_FACE = (0, 2, 4, 5, 6)
"""The first of the faces with one labelling margin: ends, sides, top, bottom; and the end."""
GROUPS = len(FIRST_FACE) - 1
QUARTILES_TO_DEVIATION = 0.74
"""Standard deviation over interquartile range. Derived: 1 / 1.349 for a Gaussian."""
MIDMEAN_FACTOR = 1.2
"""Variance of the mean of the middle half over that of the mean. Derived: for a Gaussian."""
GAP, OCCLUSION, RANGE = 0, 1, 2
"""Quantities that the faces of a track show."""


@kernel
def pooled(values, mean, variance, between, prior_tracks):
    """
    Return what values (n,) of n tracks show of a quantity that differs from track to track.

    A normal-inverse-chi-squared distribution, robustly: its mean, the variance of this estimate,
    and the variance between tracks. Given are those of the prior; its variance counts as that of
    `prior_tracks`. The values are reordered.

    """
    n = len(values)
    if n < MIN_HITS:
        return mean, variance, between
    quarter = n // 4
    first = nth(values, quarter)
    last = nth(values[quarter:], n - 1 - 2 * quarter)
    power = n * (QUARTILES_TO_DEVIATION * (last - first)) ** 2
    between = (prior_tracks * between + power) / (prior_tracks + n)
    information = n / (MIDMEAN_FACTOR * between)
    middle = values[quarter : n - quarter].sum() / (n - 2 * quarter)
    after = 1 / (1 / variance + information)
    return after * (mean / variance + information * middle), after, between


@kernel
def track_means(tracks, quantity, group, less, values):
    """Write the means of a quantity `less` a number, of the tracks that show it; return these."""
    count = 0
    for track in range(len(tracks)):
        total, hits, share = 0.0, 0.0, 0.0
        for sums in (tracks[track].sums[quantity], tracks[track].at_input[quantity]):
            for face in range(FIRST_FACE[group], FIRST_FACE[group + 1]):
                total += sums[0, face]
                hits += sums[1, face]
                share += sums[2, face]
        if hits >= MIN_HITS:
            values[count] = (total - less * hits) / share
            count += 1
    return values[:count]


@kernel
def median_extent(tracks, axis, values):
    """Return the median of an extent of the tracks, in logarithms the mean of the middle two."""
    n = len(tracks)
    for track in range(n):
        values[track] = tracks[track].evidence[0, axis]
    return exp((nth(values, (n - 1) // 2) + nth(values, n // 2)) / 2)


@kernel
def fill_margins(tracks, settings, gap_deviations, occlusion_insets, learns, constants, inputs):
    """
    Write margins and insets of one kind of objects.

    Parameters
    ----------
    tracks : array of `TRACK`, shape (n,)
        What at least one track shows.
    settings : record `CLASS_SETTINGS`
        Of the kind.
    gap_deviations, occlusion_insets : array, shape (4,)
        Prior deviation of each margin from the one of the settings, and expected insets [m].
    learns : bool
        Whether margins and occlusion insets are estimated; the range inset always is.
    constants : record of `Constants`
        Of the method, with the settings.
    inputs : record `INPUTS`
        Of the kind, with its errors: written.

    """
    values = np.empty(len(tracks))
    strength = constants.half_weight
    for group in range(GROUPS):
        face = FIRST_FACE[group]
        axis = face // 2
        bias = settings.pose[axis] * inputs.deviation[axis]
        bias *= constant_part(inputs.correlation[axis], 1.0)
        half_extent = settings.extent * inputs.extent_error[axis] / 2
        half_extent *= constant_part(inputs.correlation[-SIZE + axis], 1.0)
        half_extent *= median_extent(tracks, axis, values)
        spread = settings.gap_spread if group < GROUPS - 1 else constants.road_spread
        of_face = max(constants.face_deviations[face], settings.roughness)
        between = spread**2 + bias**2 + half_extent**2 + of_face**2
        variance = gap_deviations[group] ** 2
        gap, gap_variance, gap_between = pooled(
            track_means(tracks, GAP, group, 0.0, values), 0.0, variance, between, strength
        )
        range_inset, _, _ = pooled(
            track_means(tracks, RANGE, group, gap, values), 0.0, variance, between, strength
        )
        inset, _, _ = pooled(
            track_means(tracks, OCCLUSION, group, 0.0, values), occlusion_insets[group],
            variance, between, strength,
        )  # fmt: skip
        for own in range(face, FIRST_FACE[group + 1]):
            inputs.range_inset[own] = range_inset
            if learns:
                inputs.margin[own] = gap
                inputs.margin_variance[own] = gap_variance
                inputs.spread[own] = (gap_between / between) ** 0.5
                inputs.occlusion_inset[own] = inset
