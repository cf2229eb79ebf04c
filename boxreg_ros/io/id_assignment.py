"""Assignment of ids to boxes: association of each box with a track, over time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar, NamedTuple

from boxreg_ros.structures import (
    BOX_CENTER,
    BOX_EXTENT,
    BoxArray,
    Columns,
    concatenated,
    Floats,
    Ints,
    is_valid_box,
)
import numpy as np
from numpy.typing import NDArray

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
JUMPS_OF_AN_ID = 2
"""Jumps of each id that jumps at all, in the mean, that a finding needs. Derived: where a tracker
begins its ids anew, each jumps once."""
MIN_JUMP_SHARE = 0.02
"""
Share of the boxes at which ids jump.

Measured on the simulated street, highway, articulated and parked drives, whole and with broken
tracks and ghosts: ids of a tracker jump at none; where two neighbours swap theirs at 1 % of the
boxes, at .003 to .038; where the three nearest objects have their row, at .075 to .22, where all
have, at .52 to .77.

"""
CERTAIN_JUMP_SHARE = 0.05
"""Share of the boxes at which no tracker errs; between swaps and rows of three objects, above."""
MIN_UNUSABLE_SHARE = 0.5
"""
Share of the boxes without an id, or with one that no box had before.

Chosen: objects come and go, and trackers begin again after gaps, at far fewer boxes.

"""


@dataclass(frozen=True, eq=False, slots=True)
class _Tracks(Columns):
    """
    Constant-velocity Kalman filters of the centres of K tracks, each with one covariance per axis.

    `covariances` are (K, 3): variance of the position, covariance with the velocity, variance of
    the velocity.

    """

    COLUMNS: ClassVar[tuple[str, ...]] = (
        *('ids', 'stamps_ns', 'centers', 'velocities', 'covariances', 'extents'),
    )

    ids: tuple[str, ...]
    stamps_ns: Ints
    centers: Floats
    velocities: Floats
    covariances: Floats
    extents: Floats

    @classmethod
    def started(cls, ids: list[str], stamp_ns: int, boxes: Floats) -> _Tracks:
        """Return tracks (K) that begin with boxes (K, 9)."""
        count = len(boxes)
        covariances = np.tile([CENTER_STD**2, 0.0, INITIAL_SPEED_STD**2], (count, 1))
        stamps_ns = np.full(count, stamp_ns, np.int64)
        centers, extents = boxes[:, BOX_CENTER], boxes[:, BOX_EXTENT]
        return cls(tuple(ids), stamps_ns, centers, np.zeros((count, 3)), covariances, extents)

    def predicted(self, stamp_ns: int) -> tuple[Floats, Floats]:
        """Return centres (K, 3) and covariances (K, 3) at a stamp."""
        seconds = (stamp_ns - self.stamps_ns) * 1e-9
        position, cross, speed = self.covariances.T
        of_position = seconds**2 / 2 * ACCELERATION_STD
        of_speed = np.abs(seconds) * ACCELERATION_STD
        covariances = np.stack(
            [
                position + 2 * seconds * cross + seconds**2 * speed + of_position**2,
                cross + seconds * speed + of_position * of_speed,
                speed + of_speed**2,
            ],
            axis=1,
        )
        return self.centers + seconds[:, None] * self.velocities, covariances

    def distances(
        self,
        predicted: tuple[Floats, Floats],
        boxes: Floats,
        columns: Ints | slice = slice(None),
    ) -> Floats:
        """
        Return squared distances of boxes from tracks at a stamp, in standard deviations.

        Parameters
        ----------
        predicted : tuple of arrays (K, 3)
            The tracks at the stamp of the boxes, see `predicted`.
        boxes : array, shape (n, 9) or (n, 1, 9)
            One for each of `columns`, or each for all of them.
        columns : array, shape (n,), or slice
            The tracks.

        Returns
        -------
        distances : array, shape (n,) or (n, tracks)
            Of centres and extents together.

        """
        centers, covariances = (values[columns] for values in predicted)
        away = np.square(boxes[..., BOX_CENTER] - centers).sum(axis=-1)
        ratios = boxes[..., BOX_EXTENT] / self.extents[columns]
        unlike = np.square(np.log(ratios)).sum(axis=-1)
        found: Floats = away / (covariances[:, 0] + CENTER_STD**2) + unlike / LOG_EXTENT_STD**2
        return found

    def are_apart(self, centers: Floats, boxes: Floats) -> NDArray[np.bool_]:
        """
        Return whether boxes (n, 9) are apart from tracks at `centers` (K, 3), (n, K).

        Boxes of clusters change size with what is seen of their object, and their centres move:
        those of one object overlap.

        """
        away = np.linalg.norm(boxes[:, None, BOX_CENTER] - centers, axis=-1)
        longest = boxes[:, None, BOX_EXTENT].max(-1), self.extents.max(-1, initial=0.0)
        return np.asarray(away > np.maximum(*longest) / 2)

    def update(
        self, predicted: tuple[Floats, Floats], columns: Ints, stamp_ns: int, boxes: Floats
    ) -> None:
        """Update the filters of some tracks, `predicted` to a stamp, with their boxes (n, 9)."""
        centers, covariances = (values[columns] for values in predicted)
        position, cross, speed = covariances.T
        gains = covariances[:, :2] / (position + CENTER_STD**2)[:, None]
        innovations = boxes[:, BOX_CENTER] - centers
        self.stamps_ns[columns] = stamp_ns
        self.centers[columns] = centers + gains[:, :1] * innovations
        self.velocities[columns] += gains[:, 1:] * innovations
        self.covariances[columns] = np.stack(
            [
                position - gains[:, 0] * position,
                cross - gains[:, 0] * cross,
                speed - gains[:, 1] * cross,
            ],
            axis=1,
        )
        self.extents[columns] = boxes[:, BOX_EXTENT]


class Costs(NamedTuple):
    """How well the boxes of an array fit the tracks before it."""

    rows: Ints
    """(n,) rows of the valid boxes in their array."""
    track_ids: tuple[str, ...]
    """Of the tracks before it."""
    values: Floats
    """(n, tracks) squared distances in standard deviations."""
    is_apart: NDArray[np.bool_]
    """(n, tracks), whether their centres are half of the longest side, or more, apart."""


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
        self._tracks = _Tracks.started([], 0, np.zeros((0, 9)))
        self._newest_ns: int | None = None
        self.costs = Costs(np.zeros(0, np.int64), (), np.zeros((0, 0)), np.zeros((0, 0), bool))

    @property
    def track_ids(self) -> tuple[str, ...]:
        """Return the ids of the tracks that may go on."""
        return self._tracks.ids

    def known_motion(self, max_deviation: float) -> tuple[Floats, Floats]:
        """Return centres and velocities (K, 3) of the tracks of which these err less [m/s]."""
        tracks = self._tracks
        is_known = tracks.covariances[:, 2] < max_deviation**2
        return tracks.centers[is_known], tracks.velocities[is_known]

    def identify(self, boxes: BoxArray) -> BoxArray:
        """
        Return boxes with the ids of their objects.

        Parameters
        ----------
        boxes : BoxArray
            In a fixed frame; their own ids are not used. Those with an older stamp than others
            before are assigned to tracks but do not change them; without a track they get an id
            that is not used again. If stamps go back further than `max_gap`, all tracks end.

        Returns
        -------
        boxes : BoxArray
            The same, in their order; invalid boxes have the id ``''``.

        """
        from scipy.optimize import linear_sum_assignment  # slow, and only association needs it

        is_late = self.is_late(boxes.stamp_ns)
        self._end_tracks(boxes.stamp_ns)
        rows = np.flatnonzero(is_valid_box(boxes.boxes))
        predicted = self._tracks.predicted(boxes.stamp_ns)
        costs = self._tracks.distances(predicted, boxes.boxes[rows, None])
        is_apart = self._tracks.are_apart(predicted[0], boxes.boxes[rows])
        self.costs = Costs(rows, self._tracks.ids, costs, is_apart)
        # Costs are cut off at the gate: a pair beyond it costs as much as no pair.
        chosen, columns = linear_sum_assignment(np.minimum(costs, GATE))
        is_near = costs[chosen, columns] < GATE
        chosen, columns = rows[chosen[is_near]], columns[is_near]
        ids = self._assign(boxes, rows, chosen, columns, None if is_late else predicted)
        return replace(boxes, track_ids=ids)

    def keep(self, boxes: BoxArray, track_of: Mapping[str, str]) -> tuple[str, ...] | None:
        """
        Return the ids that were assigned to those of boxes, or None if one is far off.

        Parameters
        ----------
        boxes : BoxArray
            In a fixed frame; invalid boxes get the id ``''``.
        track_of : mapping of str to str
            Assigned ids by those of the input. A box with another one starts a track.

        Returns
        -------
        tuple of n str, or None
            As of `identify`; None, and nothing is changed but that old tracks have ended, where a
            box is beyond the gate of its track, or two boxes have one.

        """
        is_late = self.is_late(boxes.stamp_ns)
        self._end_tracks(boxes.stamp_ns)
        rows = np.flatnonzero(is_valid_box(boxes.boxes))
        column_of = {name: column for column, name in enumerate(self._tracks.ids)}
        names = [track_of.get(boxes.track_ids[row], '') for row in rows.tolist()]
        columns = np.array([column_of.get(name, -1) for name in names], np.int64)
        kept, columns = rows[columns >= 0], columns[columns >= 0]
        if len(set(columns.tolist())) < len(columns):
            return None
        predicted = self._tracks.predicted(boxes.stamp_ns)
        if (self._tracks.distances(predicted, boxes.boxes[kept], columns) >= GATE).any():
            return None
        return self._assign(boxes, rows, kept, columns, None if is_late else predicted)

    def is_late(self, stamp_ns: int) -> bool:
        """Return whether an array is not newer than one before it, and of the same pass."""
        newest_ns = self._newest_ns
        return newest_ns is not None and newest_ns - self._max_gap_ns <= stamp_ns <= newest_ns

    def _end_tracks(self, stamp_ns: int) -> None:
        """End the tracks that an array ends."""
        if self.is_late(stamp_ns):
            return
        if self._newest_ns is not None and stamp_ns < self._newest_ns:
            self.forget()  # a recording in a loop
        goes_on = self._tracks.stamps_ns >= stamp_ns - self._max_gap_ns
        if not goes_on.all():
            self._tracks = self._tracks.take(np.flatnonzero(goes_on))

    @property
    def _max_gap_ns(self) -> int:
        return round(self.max_gap * 1e9)

    def _assign(
        self,
        boxes: BoxArray,
        rows: Ints,
        chosen: Ints,
        columns: Ints,
        predicted: tuple[Floats, Floats] | None,
    ) -> tuple[str, ...]:
        """
        Return ids of boxes: some of the valid `rows` continue tracks, others start one.

        These are `predicted` to the stamp of the boxes; None of late ones, which change none.

        """
        tracks = self._tracks
        ids = [''] * len(boxes.boxes)
        for row, column in zip(chosen.tolist(), columns.tolist(), strict=True):
            ids[row] = tracks.ids[column]
        is_new = np.zeros(len(ids), bool)
        is_new[rows] = True
        is_new[chosen] = False
        new = np.flatnonzero(is_new)
        names = [str(self.count + number) for number in range(1, len(new) + 1)]
        self.count += len(new)
        for row, name in zip(new.tolist(), names, strict=True):
            ids[row] = name
        if predicted is not None:
            self._newest_ns = boxes.stamp_ns
            tracks.update(predicted, columns, boxes.stamp_ns, boxes.boxes[chosen])
            if names:
                started = _Tracks.started(names, boxes.stamp_ns, boxes.boxes[new])
                self._tracks = concatenated([tracks, started])
        return tuple(ids)


class IdCheck:
    """
    Detect ids that do not identify objects: rows of a message, new ones, equal ones, or none.

    Where a box does not fit the track that had its id before, boxes are also associated by their
    motion alone: the id jumps if that gives the box to another object. `finding` says so once
    enough have; it is empty before. `tracker` has the objects, associated by motion alone.

    """

    def __init__(self, max_gap: float) -> None:
        self.tracker = Tracker(max_gap)
        self.jumps = 0
        self._jumped = set[str]()  # ids
        self.boxes = 0
        self.new = 0
        self.compared = 0
        self.nameless = 0
        self.twice = 0
        self.count = 0
        self.forget()

    def forget(self) -> None:
        """Forget all tracks, after a time jump; counts stay."""
        self.tracker.forget()
        self._track_of: dict[str, str] = {}  # of the association, by the id of the input

    def add(self, boxes: BoxArray) -> None:
        """
        Add the next boxes.

        Parameters
        ----------
        boxes : BoxArray
            In a fixed frame, with the ids of the input. Late ones, and those of a second message
            with one stamp, are not compared: they are kept. Invalid ones are on no track.

        """
        if self.tracker.is_late(boxes.stamp_ns):
            return
        self.count += len(boxes.track_ids)
        self.nameless += boxes.track_ids.count('')
        is_compared = is_valid_box(boxes.boxes) & np.array([*map(bool, boxes.track_ids)], bool)
        if not is_compared.all():
            boxes = boxes.take(np.flatnonzero(is_compared).tolist())
        self.twice += len(boxes.track_ids) - len(set(boxes.track_ids))
        associated = self.tracker.keep(boxes, self._track_of)
        if associated is None:
            associated = self.tracker.identify(boxes).track_ids
            self.jumps += self._jumps(boxes, associated)
        known = sum(map(self._track_of.__contains__, boxes.track_ids))
        self.boxes += known
        if not set(self.tracker.track_ids).isdisjoint(self._track_of.values()):
            self.compared += len(boxes.track_ids)
            self.new += len(boxes.track_ids) - known
        pairs = zip(boxes.track_ids, associated, strict=True)
        given = {track_id: name for track_id, name in pairs if name}
        # A track has the id that came with it last; where boxes lie on one another, another
        # track has it for a moment.
        others = set(self.tracker.track_ids) - set(given.values())
        kept = {track_id: name for track_id, name in self._track_of.items() if name in others}
        self._track_of = kept | given

    def _jumps(self, boxes: BoxArray, associated: tuple[str, ...]) -> int:
        """Count the boxes that are apart from the track of their id, and on that of another."""
        costs = self.tracker.costs
        column_of = {name: column for column, name in enumerate(costs.track_ids)}
        count = 0
        for at, row in enumerate(costs.rows.tolist()):
            own = column_of.get(self._track_of.get(boxes.track_ids[row], ''))
            if own is None:
                continue
            is_far = costs.values[at, own] >= GATE and costs.is_apart[at, own]
            if is_far and associated[row] in column_of:
                count += 1
                self._jumped.add(boxes.track_ids[row])
        return count

    @property
    def is_certain(self) -> bool:
        """Return whether there is a finding by more boxes than those at which a tracker errs."""
        jump = self.jumps > CERTAIN_JUMP_SHARE * self.boxes
        are_new = self.new > MIN_UNUSABLE_SHARE * self.compared
        are_missing = self.nameless > MIN_UNUSABLE_SHARE * self.count
        return (jump or are_new or are_missing) and bool(self.finding)

    @property
    def finding(self) -> str:
        """Return that the ids identify no objects; empty if they do, or few boxes are known."""
        if self.nameless >= max(MIN_JUMPS, MIN_UNUSABLE_SHARE * self.count):
            return f'{self.nameless} of {self.count} boxes have no track id'
        if self.new >= max(MIN_JUMPS, MIN_UNUSABLE_SHARE * self.compared):
            return (
                f'track ids are new at {self.new} of {self.compared} boxes: expected one id for '
                f'each object over time, got one for each box'
            )
        if self.twice >= max(MIN_JUMPS, MIN_JUMP_SHARE * self.count):
            return (
                f'{self.twice} of {self.count} boxes have the track id of another box of their '
                f'message, as of trackers for one class each: expected one id for each object'
            )
        least = max(MIN_JUMPS, MIN_JUMP_SHARE * self.boxes, JUMPS_OF_AN_ID * len(self._jumped))
        if self.jumps < least:
            return ''
        return (
            f'track ids jump from object to object, at {self.jumps} of {self.boxes} boxes: '
            f'expected one id for each object over time, got ids such as the row of a box in its '
            f'message'
        )
