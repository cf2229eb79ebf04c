"""Tracks that changed places: two ids whose objects are swapped from some stamp on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from boxreg_ros.core.tables import rows_by_key
from boxreg_ros.structures import Floats, Ints
import numpy as np

Centers = tuple[Ints, Floats]
"""Stamps (n,) [ns] and centres (n, 2) [m] of the boxes of one id."""
SWITCH_SPEED = 10.0
"""
Least deviation from constant velocity that is an id switch [m/s].

Derived: within the 0.2 s of two observations no road user changes its velocity by 10 m/s, which
is 50 m/s^2.

"""
SWITCH_TIME = 0.2
"""Time up to which `SWITCH_SPEED` says what a switch is [s]; derived, see there."""
SWITCH_ACCELERATION = 3.0
"""
Acceleration after `SWITCH_TIME` [m/s^2].

Chosen: between usual braking (1.5) and cornering (4). Ids given to another object after a pause of
0.6 to 1.6 s cost 0.002 of 3D IoU with it and `MIN_SIZE_RATIO`, 0.028 by the speed alone; pauses of
one object cost what they did.

"""
MIN_PAUSE = 0.3
"""
Shortest time without a box after which another size is another object [s].

Literature: trackers give an object up after three missed detections, at 10 Hz.

"""
MIN_SIZE_RATIO = 2.0
"""Ratio of volumes that is another size; chosen: noise of 15 % of each extent is a third."""
MOST_APART = 8.0
"""Objects that change places are so near each other [m]; chosen: two lanes."""
NUM_BOXES = 4
"""Boxes before and after that show the motion; chosen: .4 s at 10 Hz."""
MOTION_TIME = 0.3
"""Time by which a difference of velocities counts as a distance [s]; chosen."""
MAX_SHARE = 0.4
"""Largest cost of the exchange, as part of that of the ids as they are; chosen."""
MIN_SWITCH_GAIN = 2.0
"""Least difference of both [m]; chosen: boxes err by 0.2 m, so each cost by less than 1 m."""


def switch_distance(seconds: float) -> float:
    """Return how far from constant velocity no object comes after a time [m]."""
    after_pause = SWITCH_SPEED * SWITCH_TIME + SWITCH_ACCELERATION / 2 * seconds**2
    return min(SWITCH_SPEED * seconds, after_pause)


def is_other_size(volume: float, other: float, seconds: float) -> bool:
    """Return whether two volumes [m^3], a time apart, are not of one object."""
    ratio = max(volume, other) / min(volume, other)
    return seconds > MIN_PAUSE and ratio > MIN_SIZE_RATIO


class Switch(NamedTuple):
    """Two ids that are exchanged from a stamp on."""

    stamp_ns: int
    first: str
    second: str

    def exchanged(self, track_id: str, stamp_ns: int) -> str:
        """Return the id of an object that has `track_id` at a stamp."""
        if stamp_ns < self.stamp_ns or track_id not in (self.first, self.second):
            return track_id
        return self.second if track_id == self.first else self.first


def by_id(track_ids: Sequence[str], stamps_ns: Ints, centers: Floats) -> dict[str, Centers]:
    """Return stamps and centres of each id, of boxes (n,) in any order; without an id of none."""
    in_time = np.argsort(stamps_ns, kind='stable')
    rows_of = rows_by_key([track_ids[row] for row in in_time.tolist()])
    return {
        name: (stamps_ns[in_time[rows]], centers[in_time[rows]])
        for name, rows in rows_of.items()
        if name
    }


def id_switches(tracks: Mapping[str, Centers]) -> list[Switch]:
    """Return where two tracks, by id, continue each other better than themselves, oldest first."""
    known = {name: track for name, track in tracks.items() if len(track[0]) >= 2 * NUM_BOXES}
    names = sorted(known)
    stamps = np.array([known[name][0][[0, -1]] for name in names]).reshape(-1, 2)
    low = np.array([known[name][1].min(0) for name in names]).reshape(-1, 2)
    high = np.array([known[name][1].max(0) for name in names]).reshape(-1, 2)
    found = []
    for i, first in enumerate(names):
        others = slice(i + 1, None)
        gaps = np.maximum(low[i] - high[others], low[others] - high[i])
        is_near = (gaps < MOST_APART).all(1)
        is_near &= (stamps[i, 0] <= stamps[others, 1]) & (stamps[others, 0] <= stamps[i, 1])
        for j in np.flatnonzero(is_near):
            found += _switches_of(first, names[i + 1 + j], known)
    return sorted(found)


def _switches_of(first: str, second: str, tracks: Mapping[str, Centers]) -> list[Switch]:
    """Return the switches of two tracks: the best in each run of stamps that show one."""
    (stamps, centers), (others, other_centers) = tracks[first], tracks[second]
    common, rows, other_rows = np.intersect1d(stamps, others, return_indices=True)
    if len(common) < 2 * NUM_BOXES:
        return []
    both = np.stack([centers[rows], other_centers[other_rows]], 1)  # (n, 2 tracks, 2)
    at = np.arange(NUM_BOXES, len(common) - NUM_BOXES + 1)  # first rows after a switch
    at = at[np.linalg.norm(both[at, 0] - both[at, 1], axis=1) < MOST_APART]
    if not len(at):
        return []
    seconds = (common - common[0]) * 1e-9
    middle = (seconds[at - 1] + seconds[at]) / 2
    before = _lines(seconds, both, at - NUM_BOXES, middle)
    after = _lines(seconds, both, at, middle)
    own = np.linalg.norm(before - after, axis=-1).sum((1, 2))
    exchanged = np.linalg.norm(before - after[:, :, ::-1], axis=-1).sum((1, 2))
    is_switch = (exchanged < MAX_SHARE * own) & (own - exchanged > MIN_SWITCH_GAIN)
    shown = np.flatnonzero(is_switch)
    runs = np.split(shown, np.flatnonzero(np.diff(at[shown]) >= NUM_BOXES) + 1)
    best = [run[np.argmax((own - exchanged)[run])] for run in runs if len(run)]
    return [Switch(int(common[at[row]]), first, second) for row in best]


def _lines(seconds: Floats, places: Floats, begin: Ints, middle: Floats) -> Floats:
    """
    Return lines through `NUM_BOXES` places (n, 2 tracks, 2) from each of m rows on.

    Places at the times `middle` (m,), and velocities as distances; (m, 2, 2 tracks, 2) [m].

    """
    rows = begin[:, None] + np.arange(NUM_BOXES)
    times = seconds[rows] - middle[:, None]  # (m, NUM_BOXES)
    mean = times.mean(1)
    offsets = times - mean[:, None]
    slope = offsets / np.square(offsets).sum(1, keepdims=True)
    velocity = np.einsum('mk,mktc->mtc', slope, places[rows])
    at_middle = places[rows].mean(1) - mean[:, None, None] * velocity
    return np.stack([at_middle, MOTION_TIME * velocity], 1)
