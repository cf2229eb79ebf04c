"""Assignment of ids to boxes: association of each box with a track, over time."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

from boxreg_ros.structures import BOX_CENTER, BOX_EXTENT, BoxArray, Floats, Ints, is_valid_box
import numpy as np

CENTER_STD = 0.3
"""Standard deviation of a detected centre [m]."""
INITIAL_SPEED_STD = 10.0
"""Standard deviation of the velocity of an object at its first detection [m/s], per axis."""
ACCELERATION_STD = 3.0
"""Standard deviation of the acceleration [m/s^2], constant between two detections."""
LOG_EXTENT_STD = 0.3
"""Standard deviation of the logarithm of the ratio of two detected extents."""
GATE = 20.0
"""
Largest squared distance of a box to its track, in standard deviations.

Centre and extents have six degrees of freedom: chi-square has 99.7 % below 20.

"""
MIN_JUMPS = 5
"""Jumps of ids from object to object that a finding needs; chosen."""
MIN_JUMP_SHARE = 0.03
"""
Share of the boxes at which ids jump.

Chosen: trackers switch below 1 % of their boxes; ids that are the rows of a message, 10 % and
more.

"""


@dataclass(eq=False, slots=True)
class _Track:
    """A constant-velocity Kalman filter of the centre, with one covariance (2, 2) for all axes."""

    track_id: str
    stamp_ns: int
    center: Floats
    velocity: Floats
    covariance: Floats
    extent: Floats

    @classmethod
    def started(cls, track_id: str, stamp_ns: int, box: Floats) -> _Track:
        covariance = np.diag([CENTER_STD**2, INITIAL_SPEED_STD**2])
        extent = box[BOX_EXTENT]
        return cls(track_id, stamp_ns, box[BOX_CENTER], np.zeros(3), covariance, extent)

    def predicted(self, stamp_ns: int) -> tuple[Floats, Floats]:
        """Return centre (3,) and covariance (2, 2) at a stamp."""
        seconds = (stamp_ns - self.stamp_ns) * 1e-9
        F = np.array([[1.0, seconds], [0.0, 1.0]])
        G = np.array([seconds**2 / 2, abs(seconds)]) * ACCELERATION_STD
        return self.center + seconds * self.velocity, F @ self.covariance @ F.T + np.outer(G, G)

    def update(self, stamp_ns: int, box: Floats) -> None:
        """Update the filter with the newest box of this track."""
        center, covariance = self.predicted(stamp_ns)
        gain = covariance[0] / (covariance[0, 0] + CENTER_STD**2)
        innovation = box[BOX_CENTER] - center
        self.stamp_ns = stamp_ns
        self.center = center + gain[0] * innovation
        self.velocity = self.velocity + gain[1] * innovation
        self.covariance = covariance - np.outer(gain, covariance[0])
        self.extent = box[BOX_EXTENT]


class Costs(NamedTuple):
    """How well the boxes of an array fit the tracks before it."""

    rows: Ints
    """(n,) rows of the valid boxes in their array."""
    track_ids: list[str]
    """Of the tracks before it."""
    values: Floats
    """(n, tracks) squared distances in standard deviations."""


class Tracker:
    """
    Assign ids that stay with the object; ids of the input are not used.

    Boxes are assigned to the predictions of the tracks with least total cost, within a gate. A box
    without a track starts one; a track without a box for longer than `max_gap` [s], which may
    change, ends. The result depends on the order of calls only. `count` ids have been assigned so
    far; `costs` are those of the last array.

    """

    def __init__(self, max_gap: float) -> None:
        self.max_gap = max_gap
        self.count = 0
        self.forget()

    def forget(self) -> None:
        """End all tracks; ids that were assigned are not used again."""
        self._tracks: list[_Track] = []
        self._newest_ns: int | None = None
        self.costs = Costs(np.zeros(0, np.int64), [], np.zeros((0, 0)))

    def identify(self, boxes: BoxArray) -> BoxArray:
        """
        Return boxes in a fixed frame with ids; invalid boxes get the id ``''``.

        Boxes with an older stamp than others before are assigned to tracks but do not change them;
        without a track they get an id that is not used again. If stamps go back further than
        `max_gap`, all tracks end.

        """
        from scipy.optimize import linear_sum_assignment  # slow, and only association needs it

        stamp_ns, max_gap_ns = boxes.stamp_ns, round(self.max_gap * 1e9)
        if self._newest_ns is not None and stamp_ns < self._newest_ns - max_gap_ns:
            self.forget()  # a recording in a loop
        is_late = self._newest_ns is not None and stamp_ns <= self._newest_ns
        if not is_late:
            self._newest_ns = stamp_ns
            oldest = stamp_ns - max_gap_ns
            self._tracks = [track for track in self._tracks if track.stamp_ns >= oldest]
        rows = np.flatnonzero(is_valid_box(boxes.boxes))
        costs = self._costs(stamp_ns, boxes.boxes[rows])
        ids = [''] * len(boxes.boxes)
        # Costs are cut off at the gate: a pair beyond it costs as much as no pair.
        pairs = zip(*linear_sum_assignment(np.minimum(costs, GATE)), strict=True)
        found = {int(rows[i]): self._tracks[k] for i, k in pairs if costs[i, k] < GATE}
        self.costs = Costs(rows, [track.track_id for track in self._tracks], costs)
        for row in rows.tolist():
            track = found.get(row)
            if track is None:
                self.count += 1
                track = _Track.started(str(self.count), stamp_ns, boxes.boxes[row])
                if not is_late:
                    self._tracks.append(track)
            elif not is_late:
                track.update(stamp_ns, boxes.boxes[row])
            ids[row] = track.track_id
        return replace(boxes, track_ids=tuple(ids))

    def _costs(self, stamp_ns: int, boxes: Floats) -> Floats:
        """Return the squared distances (boxes, tracks) in standard deviations."""
        if not self._tracks:
            return np.zeros((len(boxes), 0))
        predicted = [track.predicted(stamp_ns) for track in self._tracks]
        centers = np.array([center for center, _ in predicted])
        variances = np.array([covariance[0, 0] for _, covariance in predicted])
        extents = np.array([track.extent for track in self._tracks])
        away = np.square(boxes[:, None, BOX_CENTER] - centers).sum(axis=2)
        unlike = np.square(np.log(boxes[:, None, BOX_EXTENT] / extents)).sum(axis=2)
        costs: Floats = away / (variances + CENTER_STD**2) + unlike / LOG_EXTENT_STD**2
        return costs


class IdCheck:
    """
    Detect ids that jump from object to object: rows of a message, ids that are given anew.

    Boxes are also associated by their motion alone. An id jumps where its box does not fit the
    track that had the id before, and is associated with that of another object. `finding` says so
    once enough have; it is empty before.

    """

    def __init__(self, max_gap: float) -> None:
        self._tracker = Tracker(max_gap)
        self.jumps = 0
        self.boxes = 0
        self.forget()

    def forget(self) -> None:
        """Forget all tracks, after a time jump; counts stay."""
        self._tracker.forget()
        self._id_of: dict[str, str] = {}  # of the input, by that of the association

    def add(self, boxes: BoxArray) -> None:
        """
        Add the next boxes.

        Parameters
        ----------
        boxes : BoxArray
            In a fixed frame, with the ids of the input; those without an id do not count.

        """
        associated = self._tracker.identify(boxes).track_ids
        costs = self._tracker.costs
        column_of = {
            self._id_of[name]: column
            for column, name in enumerate(costs.track_ids)
            if name in self._id_of
        }
        known = set(costs.track_ids)
        for row, cost in zip(costs.rows.tolist(), costs.values, strict=True):
            own = column_of.get(boxes.track_ids[row])
            if own is None or not boxes.track_ids[row]:
                continue
            self.boxes += 1
            is_others = associated[row] != costs.track_ids[own] and associated[row] in known
            self.jumps += bool(is_others and cost[own] >= GATE)
        self._id_of = {name: self._id_of[name] for name in known if name in self._id_of}
        self._id_of |= {
            name: given for name, given in zip(associated, boxes.track_ids, strict=True) if name
        }

    @property
    def finding(self) -> str:
        """Return that the ids jump; empty if they do not, or too few boxes are known."""
        if self.jumps < MIN_JUMPS or self.jumps < MIN_JUMP_SHARE * self.boxes:
            return ''
        return (
            f'track ids jump from object to object, at {self.jumps} of {self.boxes} boxes: '
            f'expected one id for each object over time, got ids such as the row of a box in its '
            f'message'
        )
