"""
Labels of points: the object that each point of a sweep is on, and whether that object moves.

Boxes are taken at the time of each point. Points of the road, and points that no box explains, are
background. Where boxes are missing or uncertain, points are unknown and never background.

"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from boxreg_ros.config import Config
from boxreg_ros.core.method.constants import CONSTANTS
from boxreg_ros.core.motion import MOTION_SECONDS
from boxreg_ros.core.observation import crop, own_points
from boxreg_ros.rotations import matrix_from_rpy, wrap_angle
from boxreg_ros.structures import Floats, Ints, LENGTH, ROLL, Sweep, X, YAW, Z
import numpy as np
from numpy.typing import NDArray

Bytes = NDArray[np.uint8]
Mask = NDArray[np.bool_]

BACKGROUND, UNKNOWN = -1, -2
"""Values of `PointLabels.track` without an object."""
UNKNOWN_MOTION, PARKED, STOOD, MOVING = range(4)
"""Motion of an object: never seen to move, stands now but moves at another time, moves."""

# All of these are chosen; `test/measure/points.py` draws what they change.
SURFACE_TOLERANCE = 0.12
"""Points up to this far outside of the surface that the margins predict are of the object [m]."""
BAND = 0.1
"""Points up to this far outside of that are unknown: of the object or beside it [m]."""
UNCERTAIN_BAND = 0.5
"""The same of boxes that no points confirm: kept ones, and ones between those of a gap [m]."""
LABEL_CLEARANCE = 0.06
"""Points less than this above the road are of the road [m]: above its noise, below a bumper."""
MOVING_DISTANCE = 0.35
"""Least distance that an object moves within the boxes that state its speed [m]: 3 deviations."""
MOVING_DEVIATIONS = 5.0
"""Least speed in standard errors: boxes that jump once, as estimates that settle, do not move."""
LEAST_WAY = 1.0
"""Between two rests an object moves at least so far [m]: farther than an estimate jumps."""
MIN_MOTION_SECONDS = 0.25
"""Shorter tracks have no known motion [s]."""
CERTAIN_GAP = 0.6
"""Between boxes of a moving object that are further apart in time, its place is unknown [s]."""


class ObjectTrack(NamedTuple):
    """
    The boxes of one object.

    Attributes
    ----------
    track_id, class_name : str
        Identity and category.
    stamps_ns : array, shape (n,)
        Strictly increasing [ns].
    boxes : array, shape (n, 9)
        In the fixed frame.
    is_certain : array, shape (n,)
        Whether the points confirm the box.

    """

    track_id: str
    class_name: str
    stamps_ns: Ints
    boxes: Floats
    is_certain: Mask


class Objects(NamedTuple):
    """
    The objects of one stamp.

    Attributes
    ----------
    track : array, shape (k,)
        Row of the track of each.
    boxes : array, shape (k, 9)
        At the stamp, in the fixed frame.
    velocities : array, shape (k, 3)
        Of the centres [m/s].
    turn_rates : array, shape (k,)
        Of the headings [rad/s].
    motion : array, shape (k,)
        `PARKED`, `STOOD`, `MOVING` or `UNKNOWN_MOTION`.
    is_certain : array, shape (k,)
        Whether the box is where the points are.
    is_lost : array, shape (k,)
        Whether the box is a guess, in a long gap of a moving object.

    """

    track: Ints
    boxes: Floats
    velocities: Floats
    turn_rates: Floats
    motion: Bytes
    is_certain: Mask
    is_lost: Mask


class PointLabels(NamedTuple):
    """
    Labels of the points of a sweep.

    Attributes
    ----------
    track : array, shape (M,)
        Row of the track that each point is on, `BACKGROUND` or `UNKNOWN`.
    motion : array, shape (M,)
        Motion of its object, or of the one that an unknown point is next to; `UNKNOWN_MOTION` for
        points on none.
    rows : array, shape (L,)
        Rows of the points on an object, ascending.
    local : array, shape (L, 3)
        These points in the frame of their box at their own time [m].
    own_boxes : array, shape (L, 9)
        The box of each of these points, at the stamp of the sweep.
    tracks : sequence of T ObjectTrack
        All objects of the drive.
    moves : array, shape (T,)
        Whether each of them moves at some time.

    """

    track: Ints
    motion: Bytes
    rows: Ints
    local: Floats
    own_boxes: Floats
    tracks: Sequence[ObjectTrack]
    moves: Mask

    def at_stamp(self) -> Floats:
        """Return the points on an object, moved with it to the stamp, (L, 3), fixed frame [m]."""
        R = matrix_from_rpy(self.own_boxes[:, ROLL:])
        turned: Floats = np.einsum('lij,lj->li', R, self.local)
        return turned + self.own_boxes[:, X : Z + 1]

    @property
    def is_dynamic(self) -> Mask:
        """Return which points are on an object that moves now or later, or may be, (M,)."""
        is_dynamic: Mask = (self.track != BACKGROUND) & (self.motion != PARKED)
        return is_dynamic


class PointLabeller:
    """
    Label the points of sweeps by the boxes of tracks.

    Parameters
    ----------
    tracks : sequence of ObjectTrack
        All objects of the drive.
    array_stamps_ns : array, shape (a,)
        Stamps at which the input has boxes, or states that there are none [ns].
    config : Config
        `max_gap`, `reach`, `tolerance`, and the time that boxes are of, `sampling.box_time`.
    margins : array, shape (T, 6)
        Labelling margin of each face of each track: front, rear, left, right, top, bottom [m].
    coast : float
        How long an object goes on after its last box, for tracks that have not ended [s].

    """

    def __init__(
        self,
        tracks: Sequence[ObjectTrack],
        array_stamps_ns: Ints,
        config: Config,
        margins: Floats,
        coast: float = 0.0,
    ) -> None:
        self.tracks = list(tracks)
        self._config = config
        self._array_stamps_ns = np.unique(array_stamps_ns)
        self._limits = SURFACE_TOLERANCE - margins[:, [0, 2, 4, 5]]  # ends, sides, top, bottom
        self._motions = [_track_motion(track) for track in tracks]
        self._names = self.tracks, np.array([MOVING in one.motion for one in self._motions], bool)
        self._first_ns = np.array([track.stamps_ns[0] for track in tracks], np.int64)
        self._last_ns = np.array([track.stamps_ns[-1] for track in tracks], np.int64)
        self._reach_ns = round(max(config.reach, config.tolerance) * 1e9)
        self._coast_ns = max(self._reach_ns, round(coast * 1e9))
        self._gap_ns = round(config.max_gap * 1e9)

    def label(self, sweep: Sweep) -> PointLabels:
        """Return the labels of a sweep in the fixed frame; its times are used where known."""
        M = len(sweep.points)
        track = np.full(M, BACKGROUND if self.knows(sweep.stamp_ns) else UNKNOWN)
        motion = np.zeros(M, np.uint8)
        objects = self.objects_at(sweep.stamp_ns)
        if not len(objects.track) or not M:
            nothing = np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 9))
            return PointLabels(track, motion, *nothing, *self._names)
        row, owner, offset, excess = self._near(sweep, objects)
        band = np.where(objects.is_certain, BAND, UNCERTAIN_BAND)
        is_unknown = (excess < band[owner]) & ((excess > 0) | objects.is_lost[owner])
        track[row[is_unknown]] = UNKNOWN
        motion[row[is_unknown]] = objects.motion[owner[is_unknown]]
        is_on = np.flatnonzero((excess <= 0) & ~objects.is_lost[owner])
        deepest_last = is_on[np.argsort(-excess[is_on], kind='stable')]
        chosen = np.full(M, -1)
        chosen[row[deepest_last]] = deepest_last
        rows = np.flatnonzero(chosen >= 0)
        pairs = chosen[rows]
        owners = owner[pairs]
        track[rows] = objects.track[owners]
        motion[rows] = objects.motion[owners]
        boxes = objects.boxes[owners]
        R = matrix_from_rpy(objects.boxes[:, ROLL:])[owners]
        local = np.einsum('lji,lj->li', R, offset[:, pairs].T)
        return PointLabels(track, motion, rows, local, boxes, *self._names)

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
        """Return the objects of a stamp: their boxes, or those between the nearest two."""
        is_near = (self._first_ns <= stamp_ns + self._reach_ns) & (
            self._last_ns >= stamp_ns - self._coast_ns
        )
        found = [self._object_at(int(t), stamp_ns) for t in np.flatnonzero(is_near)]
        present = [one for one in found if one is not None]
        if not present:
            return Objects(
                np.zeros(0, np.int64), np.zeros((0, 9)), np.zeros((0, 3)), np.zeros(0),
                np.zeros(0, np.uint8), np.zeros(0, bool), np.zeros(0, bool),
            )  # fmt: skip
        return Objects(*(np.array(column) for column in zip(*present, strict=True)))

    def _object_at(self, t: int, stamp_ns: int) -> tuple[object, ...] | None:
        """Return one row of `Objects`; None where the track has a gap."""
        track = self.tracks[t]
        known = self._motions[t]
        after = int(np.searchsorted(track.stamps_ns, stamp_ns))
        if after < len(track.stamps_ns) and track.stamps_ns[after] == stamp_ns:
            i = after
            facts = known.velocities[i], known.turn_rates[i], known.motion[i]
            return t, track.boxes[i], *facts, track.is_certain[i], False
        if after in (0, len(track.stamps_ns)):  # before the first or after the last box
            i = min(after, len(track.stamps_ns) - 1)
            seconds = (stamp_ns - int(track.stamps_ns[i])) * 1e-9
            box = track.boxes[i].copy()
            box[X : Z + 1] += known.velocities[i] * seconds
            box[YAW] += known.turn_rates[i] * seconds
            facts = known.velocities[i], known.turn_rates[i], known.motion[i]
            return t, box, *facts, track.is_certain[i], False
        before_ns, after_ns = (int(ns) for ns in track.stamps_ns[after - 1 : after + 1])
        seconds = (after_ns - before_ns) * 1e-9
        moves = MOVING in known.motion[after - 1 : after + 1]
        if moves and after_ns - before_ns > self._gap_ns:
            return None
        first, second = track.boxes[after - 1 : after + 1]
        part = (stamp_ns - before_ns) / (after_ns - before_ns)
        turn = float(wrap_angle(2 * (second[YAW] - first[YAW]))) / 2  # no half turns
        box = (1 - part) * first + part * second
        box[ROLL:] = first[ROLL:]
        box[YAW] = first[YAW] + part * turn
        nearest = after - 1 if part < 0.5 else after
        velocity = (second - first)[X : Z + 1] / seconds * moves
        is_certain = bool(track.is_certain[after - 1 : after + 1].all())
        is_lost = moves and seconds > CERTAIN_GAP
        facts = velocity, turn / seconds * moves, known.motion[nearest]
        return t, box, *facts, is_certain and not is_lost, is_lost

    def _near(self, sweep: Sweep, objects: Objects) -> tuple[Ints, Ints, Floats, Floats]:
        """
        Return pairs of a point above the road and an object near it.

        Returns
        -------
        row, owner : array, shape (P,)
            Of the point and of the object.
        offset : array, shape (3, P)
            From the centre of the box to the point, moved back to the stamp with its object;
            axes of the fixed frame [m].
        excess : array, shape (P,)
            How far it is outside of the surface and `SURFACE_TOLERANCE`, negative inside [m].

        """
        boxes = objects.boxes
        half = boxes[:, LENGTH:ROLL] / 2
        R = matrix_from_rpy(boxes[:, ROLL:])
        searched = boxes
        shift = np.zeros((len(boxes), 3))
        moves = np.asarray(objects.velocities.any(axis=1))
        times = sweep.times if moves.any() else None
        if times is not None:
            ends = np.array([times.min(), times.max()])
            shift = objects.velocities * ends.mean()
            searched = boxes.copy()
            searched[:, X : Z + 1] += shift
            searched[:, LENGTH] += np.linalg.norm(objects.velocities, axis=1) * np.ptp(ends)
        row, owner, offset, outside = crop(sweep, searched, SURFACE_TOLERANCE + UNCERTAIN_BAND)
        if times is not None:
            moved = np.flatnonzero(moves[owner])
            own = owner[moved]
            delays = self._delays(times[row[moved]], own, len(boxes))
            there = offset[:, moved].T + shift[own] - objects.velocities[own] * delays[:, None]
            there = _turned(there, -objects.turn_rates[own] * delays)
            offset[:, moved] = there.T
            outside[:, moved] = np.abs(np.einsum('pji,pj->ip', R[own], there)) - half[own].T
        up = R[:, :, 2]
        above = np.einsum('ip,pi->p', offset, up[owner])  # the centre, along z of the box
        ends, sides, top, bottom = self._limits[objects.track].T
        excess = np.maximum(outside[0] - ends[owner], outside[1] - sides[owner])
        vertical = np.where(above > 0, top[owner], bottom[owner])
        np.maximum(excess, outside[2] - vertical, out=excess)
        road = np.nan_to_num(own_points(sweep, boxes, self._config).road)
        lowest = road - half[:, 2] + LABEL_CLEARANCE
        is_near = np.flatnonzero((above > lowest[owner]) & (excess < UNCERTAIN_BAND))
        return row[is_near], owner[is_near], offset[:, is_near], excess[is_near]

    def _delays(self, times: Floats, owner: Ints, n: int) -> Floats:
        """Return the times of points (P,) relative to the time of their box [s]."""
        if self._config.sampling.box_time == 'stamp':
            return times
        middle = np.zeros(n)
        for i in range(n):
            own = times[owner == i]
            middle[i] = np.median(own) if len(own) else 0.0
        return times - middle[owner]


class _TrackMotion(NamedTuple):
    """Motion at the boxes of a track; as in `Objects`."""

    velocities: Floats
    turn_rates: Floats
    motion: Bytes


def _track_motion(track: ObjectTrack) -> _TrackMotion:
    """Return the motion at each box of a track, by the slope of those around it."""
    seconds = (track.stamps_ns - track.stamps_ns[0]) * 1e-9
    n = len(seconds)
    if seconds[-1] < MIN_MOTION_SECONDS:
        return _TrackMotion(np.zeros((n, 3)), np.zeros(n), np.zeros(n, np.uint8))
    yaws = np.unwrap(track.boxes[:, YAW], period=np.pi)
    values = np.column_stack([track.boxes[:, X : Z + 1], yaws])
    slopes, errors, span = _slopes(seconds, values, MOTION_SECONDS)
    speed = np.linalg.norm(slopes[:, :2], axis=1)
    moves = speed > np.maximum(CONSTANTS.parked_speed, MOVING_DISTANCE / span)
    moves &= speed > MOVING_DEVIATIONS * np.linalg.norm(errors[:, :2], axis=1)
    moves = _without_jumps(moves, track.boxes[:, X : Z + 1])
    motion = np.where(moves, MOVING, STOOD if moves.any() else PARKED).astype(np.uint8)
    near, _, _ = _slopes(seconds, values, MOTION_SECONDS / 2)  # less smooth, for the place
    slopes = np.where(moves[:, None], near, 0.0)
    return _TrackMotion(slopes[:, :3], slopes[:, 3], motion)


def _without_jumps(moves: Mask, centres: Floats) -> Mask:
    """Return which boxes (n,) move, without motions between two rests that lead nowhere."""
    steps = np.diff(np.concatenate([[False], moves, [False]]).astype(int))
    begins, ends = np.flatnonzero(steps == 1), np.flatnonzero(steps == -1)
    kept = moves.copy()
    for begin, end in zip(begins, ends, strict=True):
        is_inner = begin > 0 and end < len(moves)
        if is_inner and np.linalg.norm(centres[end] - centres[begin - 1]) < LEAST_WAY:
            kept[begin:end] = False
    return kept


def _slopes(seconds: Floats, values: Floats, span: float) -> tuple[Floats, Floats, Floats]:
    """
    Return the slope of values (n, c) at n times, its standard error, and the time it spans [s].

    The boxes of a window of length `span` are used, in the middle of which the time is; at an end
    of the track all of it is on one side.

    """
    n = len(seconds)
    begin = np.clip(seconds - span / 2, seconds[0], max(seconds[0], seconds[-1] - span)) - 1e-6
    first = np.searchsorted(seconds, begin)
    last = np.searchsorted(seconds, begin + span + 2e-6)
    first = np.minimum(first, np.maximum(np.arange(n) - 1, 0))  # two boxes at least
    last = np.maximum(last, np.minimum(np.arange(n) + 2, n))
    t = seconds[:, None]
    values = values - values[0]
    columns = np.hstack([np.ones_like(t), t, t * t, values, t * values, values * values])
    sums = np.vstack([np.zeros(columns.shape[1]), np.cumsum(columns, axis=0)])
    sums = sums[last] - sums[first]
    c = values.shape[1]
    count, total, squares = sums[:, :1], sums[:, 1:2], sums[:, 2:3]
    of_values, products, of_squares = np.split(sums[:, 3:], [c, 2 * c], axis=1)
    spread = squares - total * total / count
    slopes: Floats = (products - total * of_values / count) / spread
    residuals = of_squares - of_values * of_values / count - slopes * slopes * spread
    errors = np.sqrt((residuals / np.maximum(count - 2, 1) / spread).clip(0))
    return slopes, errors, seconds[last - 1] - seconds[first]


def _turned(vectors: Floats, angles: Floats) -> Floats:
    """Return vectors (P, 3), each turned about z by its angle (P,) [rad]."""
    cos, sin = np.cos(angles), np.sin(angles)
    x, y, z = vectors.T
    return np.column_stack([cos * x - sin * y, sin * x + cos * y, z])
