"""
Stitch: fragments of one object become one track.

A fragment continues another one if motion and extents of both agree. Boxes are compared after
registration, so position and extents are those of the points. Where two continuations are nearly
as good, none is made. Fragments that take turns have their boxes in the gaps of each other.

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

from boxreg_ros.config import Config
from boxreg_ros.core.method.constants import CONSTANTS
from boxreg_ros.core.motion import EndMotion
from boxreg_ros.core.support import is_owned
from boxreg_ros.rotations import wrap_angle
from boxreg_ros.structures import BOX_EXTENT, Floats, LENGTH, on_lines, X, Y, YAW, Z
from boxreg_ros.tracks.decided import Decided, NOTHING
from boxreg_ros.tracks.fill import fill
from boxreg_ros.tracks.prune import by_evidence
from boxreg_ros.tracks.tracklet import end_motion, joined_tracklets, Tracklet
import numpy as np
from scipy.optimize import linear_sum_assignment

AMBIGUITY = 6.0
"""Least difference of cost to the next best choice. Derived: costs are -2 ln of a likelihood, so 6
is a likelihood ratio of 20."""


class Links(NamedTuple):
    """Pairs of tracklets that continue each other, earlier and later one."""

    pairs: list[tuple[int, int]]
    ambiguous: list[tuple[int, int]]  # left alone, because another choice is nearly as good


def best_links(costs: Floats) -> Links:
    """Return the pairs of least total cost (n, n) of predecessors, inf for none, one for each."""
    is_possible = np.isfinite(costs)
    found = Links([], [])
    if not is_possible.any():
        return found
    # Any possible pair is better than none.
    worst = costs[is_possible].max() + 1.0
    gains = np.where(is_possible, worst - costs + AMBIGUITY, 0.0)
    for before, after in zip(*linear_sum_assignment(gains, maximize=True), strict=True):
        if not is_possible[before, after]:
            continue
        # A later part of the same chain is no alternative: it continues the pair.
        later = np.where(is_possible[after], np.inf, costs[before])
        earlier = np.where(is_possible[:, before], np.inf, costs[:, after])
        others = np.append(np.delete(later, after), np.delete(earlier, before))
        is_clear = others.min(initial=np.inf) >= costs[before, after] + AMBIGUITY
        (found.pairs if is_clear else found.ambiguous).append((int(before), int(after)))
    return found


def join_links(
    tracklets: list[Tracklet], pairs: list[tuple[int, int]], decided: Decided = NOTHING
) -> list[Tracklet]:
    """
    Join the tracklets of each chain of pairs.

    Parameters
    ----------
    tracklets : list of Tracklet
        In the order of their start.
    pairs : list of (int, int)
        Index of a tracklet, and of the one that continues it. Each is at most once in either
        place.
    decided : Decided
        A chain has at most one of the tracks that a person has named, and its id.

    Returns
    -------
    tracklets : list of Tracklet
        In the order of their start.

    """
    successor = dict(allowed(tracklets, pairs, decided))
    followers = set(successor.values())
    whole = []
    for index in range(len(tracklets)):
        if index in followers:
            continue
        chain = [index]
        while chain[-1] in successor:
            chain.append(successor[chain[-1]])
        parts = [tracklets[part] for part in chain]
        whole.append(joined_tracklets(parts, decided.names) if len(parts) > 1 else parts[0])
    return whole


def allowed(
    tracklets: Sequence[Tracklet], pairs: Sequence[tuple[int, int]], decided: Decided
) -> list[tuple[int, int]]:
    """Return the pairs, earlier ones first, without those that decisions keep apart."""
    found = []
    name_of = {
        index: tracklet.track_id
        for index, tracklet in enumerate(tracklets)
        if tracklet.track_id in decided.names
    }  # of the chain that ends with each tracklet
    for before, after in sorted(pairs):
        is_apart = {tracklets[before].track_id, tracklets[after].track_id} & set(decided.apart)
        if is_apart or (before in name_of and after in name_of):
            continue
        if before in name_of:
            name_of[after] = name_of[before]
        found.append((before, after))
    return found


STITCH_GATE = 24.3
"""Greatest squared distance; derived: 99.9 % of chi-square with 7 degrees of freedom."""
EXTENT_DEVIATION = 0.07
"""Standard deviation of the logarithm of an extent; literature: PointRCNN errs by 7 % of it."""
HEADING_DEVIATION = 0.15
"""Least standard deviation of the heading of a fragment [rad]; chosen: a few boxes."""
MIN_KNOWN_MOTION = 3
"""The longer of two fragments has at least so many boxes, so that its motion is known; chosen."""
HEIGHT_DEVIATION = 0.2
"""Standard deviation of the height of a centre [m]; chosen: two times that of one box."""


def stitch(
    tracklets: list[Tracklet], config: Config, decided: Decided = NOTHING
) -> tuple[list[Tracklet], list[tuple[str, str]]]:
    """
    Join tracklets that continue each other.

    Parameters
    ----------
    tracklets : list of Tracklet
        In the order of their start, in the fixed frame.
    config : Config
        Gaps up to `complete.fill_gap` [s] are bridged.
    decided : Decided
        The decisions of a person, by default none.

    Returns
    -------
    tracklets : list of Tracklet
        In the order of their start.
    ambiguous : list of (str, str)
        Ids of pairs that may be one object, but were left alone.

    """
    n = len(tracklets)
    counts = [len(tracklet.stamps_ns) for tracklet in tracklets]
    spans = [(tracklet.last_ns - tracklet.first_ns) * 1e-9 for tracklet in tracklets]
    firsts = [end_motion(tracklet, False, config) for tracklet in tracklets]
    lasts = [end_motion(tracklet, True, config) for tracklet in tracklets]
    kinds = [tracklet.model(config) for tracklet in tracklets]
    costs = np.full((n, n), np.inf)
    for i in range(n):
        for j in range(n):
            gap = (firsts[j].stamp_ns - lasts[i].stamp_ns) * 1e-9
            is_known = max(counts[i], counts[j]) >= MIN_KNOWN_MOTION
            # A motion is not predicted for longer than it was observed: two ghosts fit anything.
            limit = min(config.complete.fill_gap, spans[i] + spans[j])
            is_possible = is_known and 0 < gap <= limit and kinds[i] is kinds[j]
            if is_possible and allowed(tracklets, [(i, j)], decided):
                costs[i, j] = _cost(lasts[i], firsts[j])
    links = best_links(costs)
    ambiguous = [(tracklets[i].track_id, tracklets[j].track_id) for i, j in links.ambiguous]
    return join_links(tracklets, links.pairs, decided), ambiguous


def _cost(before: EndMotion, after: EndMotion) -> float:
    """
    Return -2 ln of the likelihood that a fragment continues another; inf beyond `STITCH_GATE`.

    The sum of the squared deviations of position, height, extents and heading, plus the log
    determinant of the covariance of the position.

    """
    forward = _position_cost(before, after)
    backward = _position_cost(after, before)
    distance, log_det = max(forward, backward)
    seconds = (after.stamp_ns - before.stamp_ns) * 1e-9
    up = HEIGHT_DEVIATION + CONSTANTS.vertical * seconds**2 / 2
    distance += (after.box[Z] - before.box[Z]) ** 2 / up**2
    extents = BOX_EXTENT
    ratios = np.log(after.box[extents] / before.box[extents])
    distance += np.square(ratios).sum() / (2 * EXTENT_DEVIATION**2)
    predicted_yaw = before.predict(after.stamp_ns)[YAW]
    turn = wrap_angle(2 * (after.box[YAW] - predicted_yaw)) / 2  # without half turns
    heading = max(HEADING_DEVIATION, before.model.heading)
    distance += float(turn) ** 2 / (2 * heading**2)
    return float(distance + log_det) if distance < STITCH_GATE else np.inf


def _position_cost(known: EndMotion, other: EndMotion) -> tuple[float, float]:
    """Return squared distance and log determinant of the prediction of another box."""
    offset = (other.box - known.predict(other.stamp_ns))[X : Y + 1]
    covariance = known.covariance(other.stamp_ns)
    distance = float(offset @ np.linalg.solve(covariance, offset))
    return distance, float(np.linalg.slogdet(covariance)[1])


TURNS_PART = 0.5
"""Part of the boxes of a track that are where gaps of another one with more evidence are filled,
for both to be one object; chosen: the majority."""


def join_turns(
    tracklets: list[Tracklet], config: Config, decided: Decided = NOTHING
) -> tuple[list[Tracklet], list[Tracklet]]:
    """
    Join tracklets that take turns at one place.

    A detector that loses an object and finds it again under a new id, then under the old one,
    leaves tracks of which each would be filled over the boxes of the other.

    Parameters
    ----------
    tracklets : list of Tracklet
        In any order, in the fixed frame.
    config : Config
        Settings of the kinds of objects.
    decided : Decided
        The decisions of a person, by default none.

    Returns
    -------
    whole : list of Tracklet
        In the order of their start.
    left : list of Tracklet
        Of the boxes at one stamp those of the track with less evidence, under the id that the
        joined track does not have.

    """
    whole: list[Tracklet] = []
    left: list[Tracklet] = []
    for tracklet in by_evidence(tracklets):
        for index, other in enumerate(whole):
            pair = [other, tracklet]
            if allowed([other, tracklet], [(0, 1)], decided) and _take_turns(
                other, tracklet, config
            ):
                is_common = np.isin(tracklet.stamps_ns, other.stamps_ns)
                common, own = (tracklet.take(np.flatnonzero(x)) for x in (is_common, ~is_common))
                parts = [other, own] if len(own.stamps_ns) else [other]
                whole[index] = joined_tracklets(parts, decided.names)
                (free,) = {one.track_id for one in pair} - {whole[index].track_id}
                if len(common.stamps_ns):
                    left.append(replace(common, track_id=free))
                break
        else:
            whole.append(tracklet)
    return sorted(whole, key=lambda one: one.first_ns), left


def _take_turns(first: Tracklet, second: Tracklet, config: Config) -> bool:
    """
    Return whether most boxes of the second track are where gaps of the first are filled.

    Boxes at a stamp of the first one do not count: two objects that overlap have many of them.

    """
    is_apart = second.last_ns < first.first_ns or first.last_ns < second.first_ns
    if is_apart or first.model(config) is not second.model(config):
        return False
    centers = on_lines(first.stamps_ns, first.boxes[:, X : Y + 1], second.stamps_ns)
    away = np.linalg.norm(second.boxes[:, X : Y + 1] - centers, axis=1)
    if away.min() > max(first.boxes[0, LENGTH], second.boxes[0, LENGTH]):
        return False
    box_at = dict(zip(second.stamps_ns.tolist(), second.boxes, strict=True))
    turns = sum(
        is_owned(box, box_at[stamp_ns][None])
        for gap in fill(first, second.stamps_ns, config)
        for stamp_ns, box in zip(gap.stamps_ns.tolist(), gap.boxes, strict=True)
    )
    return turns >= TURNS_PART * len(second.stamps_ns)
