"""Labelling margins and insets of one kind of objects, by what its tracks show (M15)."""

from math import exp

from boxreg_ros.core.method.arrays import POSE
from boxreg_ros.core.method.compile import kernel, loop
from boxreg_ros.core.method.expectation import constant_part, FACES
from boxreg_ros.core.method.selection import nth, sum_of
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
GAP, OCCLUSION, RANGE = np.arange(3)  # of literals each would compile its functions again
"""Quantities that the faces of a track show."""


@loop
def add_value(quantity, face, value, share, sums):
    """Add one value of a quantity of a face to the sums of its track, (3, 3, 6)."""
    sums[quantity, 0, face] += value
    sums[quantity, 1, face] += 1.0
    sums[quantity, 2, face] += share


@loop
def sum_faces(kind, lengths, terms, inputs, constants, sums):
    """
    Sum what the faces of each window show of its track.

    Parameters
    ----------
    kind, lengths : array, shape (B,)
        Of the windows, see `Problem`; all their observations count.
    terms : array of `TERMS`, shape (B, N)
        Their face observations.
    inputs : array of `INPUTS`, shape (K,)
        What these were made with, by kind.
    constants : array of one record of `Constants`, shape (1,)
        Of the method.
    sums : array, shape (B, 3, 3, 6)
        Zeros, to which these are added: see `TRACK`.

    """
    constants = constants[0]
    for b in range(len(terms)):
        known = inputs[kind[b]]
        for n in range(lengths[b]):
            term = terms[b, n]
            has_points = term.num_points >= constants.min_box_points
            for face in range(FACES):
                distance, margin = term.distance[face], known.margin[face]
                if not (term.visibility[face] > 0 and abs(distance) < constants.max_gap):
                    continue
                occlusion_inset = known.occlusion_inset[face]
                occluded, distant = term.inset_shares[0, face], term.inset_shares[1, face]
                if not occlusion_inset > 0:
                    occluded = 0.0  # the bottom is observed by the road
                is_visible = occluded < constants.min_share / 2
                is_distant = distant > constants.min_share
                if has_points and is_visible and not is_distant:
                    add_value(GAP, face, margin - distance, 1.0, sums[b])
                if has_points and occluded > constants.min_share:
                    # Counted from the present gap.
                    inset = occluded * occlusion_inset - distance
                    add_value(OCCLUSION, face, inset, occluded, sums[b])
                if is_visible and is_distant:
                    inset = distant * known.range_inset[face] - distance + margin
                    add_value(RANGE, face, inset, distant, sums[b])


@loop
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
    middle = sum_of(values[quarter : n - quarter]) / (n - 2 * quarter)
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


@loop
def median_extent(tracks, axis, values):
    """Return the median of an extent of the tracks, in logarithms the mean of the middle two."""
    n = len(tracks)
    for track in range(n):
        values[track] = tracks[track].evidence[0, axis]
    return exp((nth(values, (n - 1) // 2) + nth(values, n // 2)) / 2)


@kernel
def fill_margins(k, tracks, settings, gap_deviations, occlusion_insets, learns, constants, inputs):
    """
    Write margins and insets of one kind of objects.

    Parameters
    ----------
    k : int
        The kind.
    tracks : array of `TRACK`, shape (n,)
        What at least one track of it shows.
    settings : array of `CLASS_SETTINGS`, shape (K,)
        Of all kinds.
    gap_deviations, occlusion_insets : array, shape (4,)
        Prior deviation of each margin from the one of the settings, and expected insets [m].
    learns : bool
        Whether margins and occlusion insets are estimated; the range inset always is.
    constants : array of one record of `Constants`, shape (1,)
        Of the method, with the settings.
    inputs : array of `INPUTS`, shape (K,)
        Of all kinds, with their errors: that of the kind is written.

    """
    constants, settings, inputs = constants[0], settings[k], inputs[k]
    values = np.empty(len(tracks))
    strength = constants.half_weight
    for group in range(GROUPS):
        face = FIRST_FACE[group]
        axis = face // 2
        bias = settings.pose[axis] * inputs.deviation[axis]
        bias *= constant_part(inputs.correlation[axis], 1.0)
        half_extent = settings.extent * inputs.extent_error[axis] / 2
        half_extent *= constant_part(inputs.correlation[POSE + axis], 1.0)
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
