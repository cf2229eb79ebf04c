"""
Labels of points: the object that each point of a sweep is on, and whether that object moves.

Boxes are taken at the time of each point. Points of the road, and points that no box explains, are
background. Where boxes are missing or uncertain, points are unknown and never background.

"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from boxreg_ros.config import Config
from boxreg_ros.core.method import labelling
from boxreg_ros.core.method.crop import near_points
from boxreg_ros.core.method.labelling import (
    MOVING,
    Objects,
    PARKED,
    STOOD,
    SURFACE_TOLERANCE,
    UNCERTAIN_BAND,
    UNKNOWN_MOTION,
)
from boxreg_ros.core.observation import crop_numbers, shapes_of
from boxreg_ros.rotations import matrix_from_rpy, wrap_angle
from boxreg_ros.structures import Floats, Ints, ROLL, Sweep, X, Y, YAW, Z
import numpy as np
from numpy.typing import NDArray

Bytes = NDArray[np.uint8]
Mask = NDArray[np.bool_]

BACKGROUND, UNKNOWN = labelling.BACKGROUND, labelling.UNKNOWN
"""Values of `PointLabels.track` without an object."""
CERTAIN_GAP = 0.6
"""Between boxes of a moving object that are further apart in time, its place is unknown [s]."""
COAST_SECONDS = 0.5
"""For so long before its first and after its last box a moving object is somewhere near [s]: five
sweeps at 10 Hz."""


class ObjectTrack(NamedTuple):
    """The boxes of one object."""

    track_id: str
    class_name: str
    stamps_ns: Ints
    """(n,), strictly increasing [ns]."""
    boxes: Floats
    """(n, 9), in the fixed frame."""
    is_certain: Mask
    """(n,), whether the points confirm the box."""


class PointLabels(NamedTuple):
    """Labels of the points of a sweep."""

    track: Ints
    """(M,), row of the track that each point is on, `BACKGROUND` or `UNKNOWN`."""
    motion: Bytes
    """(M,), of its object, or of the one that an unknown point is next to; `UNKNOWN_MOTION` for
    points on none."""
    rows: Ints
    """(L,), of the points on an object, ascending."""
    local: Floats
    """(L, 3), these points in the frame of their box at their own time [m]."""
    owner: Ints
    """(L,), row of their object in `objects`."""
    objects: Objects
    """Those of the stamp."""
    tracks: Sequence[ObjectTrack]
    """All T objects of the drive."""
    moves: Mask
    """(T,), whether each of them moves at some time."""

    def at_stamp(self) -> Floats:
        """Return the points on an object, moved with it to the stamp, (L, 3), fixed frame [m]."""
        boxes: Floats = self.objects.boxes
        R = matrix_from_rpy(boxes[:, ROLL:])[self.owner]
        turned: Floats = np.einsum('lij,lj->li', R, self.local)
        return turned + boxes[self.owner, X : Z + 1]

    @property
    def is_dynamic(self) -> Mask:
        """Return which points are on an object that moves now or later, or may be, (M,)."""
        is_dynamic: Mask = (self.track != BACKGROUND) & (self.motion != PARKED)
        return is_dynamic


class PointLabeller:
    """
    Label the points of sweeps by the boxes of tracks, all T objects of the drive.

    At `array_stamps_ns` (a,) the input has boxes, or states that there are none. Of `config` are
    used `max_gap`, `reach`, and the time that boxes are of, `sampling.box_time`. `margins` (T, 6)
    are the labelling margins of front, rear, left, right, top and bottom [m].

    """

    def __init__(
        self,
        tracks: Sequence[ObjectTrack],
        array_stamps_ns: Ints,
        config: Config,
        margins: Floats,
    ) -> None:
        self.tracks = list(tracks)
        self._config = config
        self._array_stamps_ns = np.unique(array_stamps_ns)
        self._limits = SURFACE_TOLERANCE - margins[:, [0, 2, 4, 5]]  # ends, sides, top, bottom
        self._reach_ns = round(config.reach * 1e9)
        self._gap_ns = round(config.max_gap * 1e9)
        empty = np.zeros(0, np.int64), np.zeros((0, 9)), np.zeros(0, bool)
        columns = [track[2:] for track in tracks] or [empty]
        self._stamps_ns, self._boxes, self._is_certain = map(
            np.concatenate, zip(*columns, strict=True)
        )
        self._first = np.cumsum([0, *(len(track.stamps_ns) for track in tracks)])
        self._begin_ns = int(self._stamps_ns.min()) if tracks else 0
        self._span_ns = int(np.ptp(self._stamps_ns)) + 2 if tracks else 0
        of_tracks = np.repeat(np.arange(len(tracks)), np.diff(self._first))
        self._order = self._stamps_ns - self._begin_ns + of_tracks * self._span_ns  # ascending
        t = (self._stamps_ns - self._begin_ns) * 1e-9
        values = np.ascontiguousarray(self._boxes[:, [X, Y, Z, YAW]])
        self._rates, moves, is_known = labelling.motions(self._first, t, values)
        self._moves = np.zeros(len(tracks), bool)
        np.logical_or.at(self._moves, of_tracks, moves)
        rests = np.where(self._moves[of_tracks], STOOD, PARKED)
        self._motion = np.where(is_known, np.where(moves, MOVING, rests), UNKNOWN_MOTION)

    def label(self, sweep: Sweep) -> PointLabels:
        """Return the labels of a sweep in the fixed frame; its times are used where known."""
        objects = self.objects_at(sweep.stamp_ns)
        times = np.zeros(0, np.float32)
        if sweep.times is not None and objects.velocities.any():
            times = sweep.times.astype(np.float32)
        numbers = crop_numbers(self._config)
        margin = max(numbers.margin, SURFACE_TOLERANCE + UNCERTAIN_BAND)
        shapes = shapes_of(sweep, objects.boxes, margin)
        way = objects.velocities * np.abs(times).max(initial=0) * 2  # before or after the stamp
        shapes = shapes._replace(reach=shapes.reach + np.abs(way @ shapes.turn))
        near = near_points(np.ascontiguousarray(sweep.points.T), shapes)
        elsewhere = BACKGROUND if self.knows(sweep.stamp_ns) else UNKNOWN
        track, motion, rows, owner, local = labelling.label(
            near,
            len(sweep.points),
            times,
            shapes,
            objects,
            self._limits[objects.track],
            self._config.sampling.box_time == 'stamp',
            elsewhere,
            numbers,
        )
        return PointLabels(track, motion, rows, local, owner, objects, self.tracks, self._moves)

    def knows(self, stamp_ns: int) -> bool:
        """Return whether the boxes of the input say what is there at a stamp."""
        known = self._array_stamps_ns
        after = int(np.searchsorted(known, stamp_ns))
        before_ns = stamp_ns - int(known[after - 1]) if after else None
        after_ns = int(known[after]) - stamp_ns if after < len(known) else None
        gaps = [gap for gap in (before_ns, after_ns) if gap is not None]
        if len(gaps) == 2 and sum(gaps) <= self._gap_ns:
            return True
        return min(gaps, default=self._reach_ns + 1) <= self._reach_ns

    def objects_at(self, stamp_ns: int) -> Objects:
        """
        Return the objects of a stamp: their boxes, or those between the nearest two.

        A moving object goes on for `COAST_SECONDS` beyond its boxes, as one that is lost.

        """
        first, last = self._first[:-1], self._first[1:] - 1
        passed = np.clip(stamp_ns - self._begin_ns, 0, self._span_ns - 1)
        at = np.searchsorted(self._order, passed + self._span_ns * np.arange(len(first)))
        after = np.minimum(at, last)
        before = np.where(self._stamps_ns[after] == stamp_ns, after, np.maximum(at - 1, first))
        gap_ns = self._stamps_ns[after] - self._stamps_ns[before]
        moves = (self._motion[before] == MOVING) | (self._motion[after] == MOVING)
        late_ns = stamp_ns - self._stamps_ns[before]
        is_late = late_ns * 2 >= gap_ns
        nearest = np.where(is_late, after, before)
        is_between = (before < after) & ~(moves & (gap_ns > self._gap_ns))
        seconds = (stamp_ns - self._stamps_ns[nearest]) * 1e-9
        part = np.where(is_between, late_ns / np.maximum(gap_ns, 1), is_late)[:, None]
        old, new = self._boxes[before], self._boxes[after]
        boxes = (1 - part) * old + part * new
        boxes[:, ROLL:YAW] = self._boxes[nearest, ROLL:YAW]
        turns = wrap_angle(2 * (new[:, YAW] - old[:, YAW])) / 2  # no half turns
        boxes[:, YAW] = old[:, YAW] + part[:, 0] * turns
        steps = np.column_stack([(new - old)[:, X : Z + 1], turns])
        per_second = moves / np.maximum(gap_ns * 1e-9, 1e-9)
        rates = np.where(is_between[:, None], steps * per_second[:, None], self._rates[nearest])
        ahead = np.where(is_between, 0.0, seconds)[:, None] * rates
        boxes[:, X : Z + 1] += ahead[:, :3]
        boxes[:, YAW] += ahead[:, 3]
        is_far = np.abs(seconds) > np.where(is_between, np.inf, self._reach_ns * 1e-9)
        motion = self._motion[nearest]
        is_lost = (is_far & (motion >= STOOD)) | (
            is_between & moves & (gap_ns > CERTAIN_GAP * 1e9)
        )
        is_certain = self._is_certain[before] & self._is_certain[after] & ~is_lost
        rows = np.flatnonzero(~is_far | (is_lost & (np.abs(seconds) <= COAST_SECONDS)))
        columns = rates[:, :3], rates[:, 3], motion, is_certain, is_lost
        return Objects(rows, boxes[rows], *(column[rows] for column in columns))
