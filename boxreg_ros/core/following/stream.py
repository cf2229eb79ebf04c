"""Objects that are followed sweep by sweep while a stream arrives, each from one box."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from boxreg_ros.config import Config
from boxreg_ros.core.following.object_points import Owned
from boxreg_ros.core.following.start_speed import POSE4, Seeds
from boxreg_ros.core.following.sweeps import ascending, nearest, Sweeps
from boxreg_ros.core.following.tracker import Follower, Way
from boxreg_ros.core.method.follow_numbers import FOLLOW
from boxreg_ros.core.observation import GOOD_POINTS
from boxreg_ros.core.support import is_owned
from boxreg_ros.structures import BoxArray, Floats, is_valid_box, Sweep
import numpy as np

HISTORY_NS = int(1e9 * FOLLOW.history)
INTERRUPTED = 'interrupted'
"""Reason for a loss: no sweeps, or no boxes of the stream, for longer than the history."""


class Lost(NamedTuple):
    """Where an object was seen last [ns], [m], and why it is followed no more."""

    track_id: str
    stamp_ns: int
    box: Floats
    reason: str


class FollowedBox(NamedTuple):
    """The box (9,) of a followed object."""

    track_id: str
    class_name: str
    box: Floats


@dataclass(slots=True, eq=False)
class _Object:
    class_name: str
    follower: Follower
    way: Way
    last: tuple[int, Floats]
    """Stamp [ns] and box where points have supported it last."""


class _Arrived:
    """The sweeps of the last `HISTORY_NS`, by a number that counts them."""

    def __init__(self) -> None:
        self.sweeps: dict[int, Sweep] = {}
        self._points: dict[int, Floats] = {}
        self._next = 0

    def add(self, sweep: Sweep) -> None:
        if self.sweeps and sweep.stamp_ns <= self.sweeps[self._next - 1].stamp_ns:
            return
        self.sweeps[self._next] = sweep
        self._next += 1
        for row in list(self.sweeps):
            if self.sweeps[row].stamp_ns >= sweep.stamp_ns - HISTORY_NS:
                break
            del self.sweeps[row]
            self._points.pop(row, None)

    def __getitem__(self, row: int, /) -> Floats:
        """Return the points of a sweep, ascending by x."""
        if row not in self._points:
            points = ascending(self.sweeps[row].in_frame().points)
            self._points[row] = np.asarray(points, np.float64)
        return self._points[row]

    def until(self, last: int) -> Sweeps:
        """Return the sweeps up to one of them."""
        times = {row: sweep.stamp_ns * 1e-9 for row, sweep in self.sweeps.items()}
        return Sweeps(times, self, last + 1, min(times))


class FollowedObjects:
    """
    Follow objects through the sweeps of a stream; all are in one fixed frame.

    From the sweep nearest to its box in time, an object is followed as by `follow`, but forwards
    only, and lost under the same tests. Of two in one place, the one goes on that has been seen in
    more of the last sweeps, else the first.

    Parameters
    ----------
    config : Config
        The groups of object classes are used.

    Attributes
    ----------
    lost : list of Lost
        Objects that have been lost; to be emptied by the caller.
    refused : list of (str, str)
        Track id of each box that is not followed, and why; to be emptied by the caller.

    """

    def __init__(self, config: Config) -> None:
        self.lost: list[Lost] = []
        self.refused: list[tuple[str, str]] = []
        self._config = config
        self._arrived = _Arrived()
        self._waiting: list[tuple[int, FollowedBox]] = []
        self._objects: dict[str, _Object] = {}

    @property
    def has_objects(self) -> bool:
        """Return whether any object is followed, or waits for its first sweep."""
        return bool(self._waiting or self._objects)

    @property
    def track_ids(self) -> tuple[str, ...]:
        """Return the ids of the objects that are followed."""
        return tuple(self._objects)

    def add(self, boxes: BoxArray) -> None:
        """Follow the objects of some boxes; one that is followed starts anew from its box."""
        is_valid = is_valid_box(boxes.boxes)
        for row, track_id in enumerate(boxes.track_ids):
            one = FollowedBox(track_id, boxes.class_names[row], boxes.boxes[row])
            if not track_id:
                self._refuse(one, boxes.stamp_ns, 'expected a track id, got none')
            elif not is_valid[row]:
                self._refuse(one, boxes.stamp_ns, 'expected finite numbers, positive extents')
            else:
                self._waiting.append((boxes.stamp_ns, one))

    def add_sweep(self, sweep: Sweep) -> None:
        """Add the next sweep."""
        if not sweep.is_dropped:
            self._arrived.add(sweep)

    def boxes_at(self, stamp_ns: int, sweep_ns: int, others: Floats) -> list[FollowedBox]:
        """
        Follow all objects to a sweep; return the boxes at `stamp_ns` that points support there.

        The sweep of the stamp `sweep_ns` was added; `others` (n, 9) are boxes of other objects.

        """
        if not self.has_objects:
            return []
        rows = {sweep.stamp_ns: row for row, sweep in self._arrived.sweeps.items()}
        if sweep_ns not in rows:
            return []
        last = rows[sweep_ns]
        sweeps = self._arrived.until(last)
        owned = Owned()
        owned.add(np.full(len(others), last), others)
        self._start(sweeps, owned)
        found: list[FollowedBox] = []
        # Points belong to the object that has been seen in more of the last sweeps.
        by_support = sorted(self._objects.items(), key=lambda item: -len(item[1].way.seen))
        for track_id, one in by_support:
            one.follower.continue_in(sweeps, owned)
            self._step(track_id, one, last)
            if last in one.way.seen:
                travel = one.way.state.speed * (stamp_ns - sweep_ns) * 1e-9
                box = one.follower.box(one.way.poses[last], travel)
                same = [other.track_id for other in found if is_owned(box, other.box[None])]
                if same:
                    self.refused.append((track_id, f'its object is followed as {same[0]!r}'))
                    self._objects.pop(track_id, None)
                    continue
                owned.add(np.array([last]), box[None])
                one.last = stamp_ns, box
                found.append(FollowedBox(track_id, one.class_name, box))
        return found

    def _start(self, sweeps: Sweeps, owned: Owned) -> None:
        """Start the objects whose sweep has arrived."""
        stamps_ns = np.array([sweep.stamp_ns for sweep in self._arrived.sweeps.values()], np.int64)
        waiting = self._waiting
        self._waiting = []
        for stamp_ns, one in waiting:
            row, away, period = nearest(stamps_ns, stamp_ns)
            row += sweeps.first
            if away > period / 2 and not stamps_ns[-1] < stamp_ns < stamps_ns[-1] + HISTORY_NS:
                what = 'expected the stamp of a cloud of the last 2 s, the nearest is'
                self._refuse(one, stamp_ns, f'{what} {away * 1e-9:.2f} s away')
            elif away > period / 2 or not sweeps.has(row):
                self._waiting.append((stamp_ns, one))
            else:
                self._begin(one, row, sweeps, owned)

    def _begin(self, one: FollowedBox, row: int, sweeps: Sweeps, owned: Owned) -> None:
        seeds = Seeds(np.array([row]), one.box[None])
        stamp_ns = self._arrived.sweeps[row].stamp_ns
        follower = Follower(sweeps, seeds, self._config.kind(one.class_name), owned)
        if follower.num_points < GOOD_POINTS:
            got = f'expected {GOOD_POINTS} points in it, got {follower.num_points}'
            self._refuse(one, stamp_ns, f'{got}: correct it, or its frame')
            return
        way = follower.begin(0, 1)
        way.poses[row] = one.box[POSE4]
        way.seen.add(row)
        self._objects[one.track_id] = _Object(one.class_name, follower, way, (stamp_ns, one.box))

    def _step(self, track_id: str, one: _Object, last: int) -> None:
        """Follow an object up to a sweep, or delete it where it is lost."""
        way = one.way
        reason = '' if way.row in self._arrived.sweeps else INTERRUPTED
        while way.row < last and not reason:
            one.follower.step(way)
            reason = way.reason if way.is_over else ''
        if reason:
            self.lost.append(Lost(track_id, *one.last, reason))
            del self._objects[track_id]
        for row in [row for row in way.poses if row not in self._arrived.sweeps]:
            del way.poses[row]
            way.seen.discard(row)

    def _refuse(self, one: FollowedBox, stamp_ns: int, what: str) -> None:
        self.refused.append((one.track_id, f'box at {stamp_ns}: {what}'))
