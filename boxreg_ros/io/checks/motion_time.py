"""Check of the time of the motion: clouds by poses of another moment lie off standing boxes."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from typing import NamedTuple

from boxreg_ros.io.checks.pose import PairedCheck, points_around
from boxreg_ros.io.checks.size import POINT_MARGIN
from boxreg_ros.io.clocks import seconds_text
from boxreg_ros.rotations import matrix_from_rpy, wrap_angle
from boxreg_ros.structures import (
    BOX_CENTER,
    BOX_EXTENT,
    BoxArray,
    Floats,
    is_valid_box,
    ROLL,
    Sweep,
    YAW,
)
import numpy as np
from numpy.typing import NDArray

# All of these are chosen, except where an origin stands beside them.
MOTION_TIMES = np.arange(-0.5, 0.501, 0.05)
"""Times of the motion that are compared [s]."""
IN_TIME = len(MOTION_TIMES) // 2
"""The one of a motion that is in time."""
SPEED_NS = 4 * 10**8
"""Time by which the velocity of the sensor is known [ns]: jitter of 0.1 m errs by 0.25 m/s."""
MIN_SENSOR_SPEED = 3.0
"""Speed of the sensor from which clouds show the time [m/s]: 0.3 m by 0.1 s."""
STANDING_NS = 10**9
"""Time in which an object that stands still has not moved [ns]."""
MAX_DRIFT = 0.8
"""Speed of one that stands still, by noise of its boxes [m/s]; if it moved, 0.1 s are 0.08 m."""
MIN_POINTS_OF_BOX = 10
"""Points that a box must have in one of the places to be counted."""
ROAD_CLEARANCE = 0.3
"""Points up to this height above the bottom of a box may be of the road [m]."""
MIN_STANDING = 8
"""Objects that a finding needs."""
MIN_COMPARED_BOXES = 150
"""Boxes that a finding needs: fewer are of one moment, and their errors of one kind."""
FEWEST_BOXES = 3
"""Boxes of an object that is counted, ahead or behind."""
MIN_OF_SIDE = 3
"""Objects ahead, and behind, that a finding needs: of one side all may be too long or too far."""
MIN_MOTION_OFFSET = 0.075
"""Offset that is named [s]; derived: clouds whose points have no times look half a sweep off."""
MIN_GAIN_DEVIATIONS = 2.0
"""Deviations by which objects fit better, in the mean; in time none did (64 inputs)."""
MAX_STANDING_BOXES = 1000
"""After so many boxes, with points or without, the check ends."""
MAX_BEGINS = 1000
"""Tracks whose begins are known at once: more are of ids that name nothing."""


class _Motion(NamedTuple):
    """Where the sensor is, and how it moves, in the fixed frame."""

    position: Floats  # (3,) [m]
    velocity: Floats  # (3,) [m/s]
    yaw_rate: float  # [rad/s]

    @property
    def speed(self) -> float:
        """Return the speed of the sensor [m/s]."""
        return float(np.linalg.norm(self.velocity))

    def displaced(self, box: Floats) -> Floats:
        """Return a box as it lies to a cloud by the motion of each of `MOTION_TIMES`, (C, 9)."""
        turn = -self.yaw_rate * MOTION_TIMES
        x, y, z = (box[BOX_CENTER] - self.position - self.velocity * MOTION_TIMES[:, None]).T
        boxes = np.tile(box, (len(MOTION_TIMES), 1))
        cos, sin = np.cos(turn), np.sin(turn)
        boxes[:, BOX_CENTER] = np.stack([cos * x - sin * y, sin * x + cos * y, z], axis=1)
        boxes[:, BOX_CENTER] += self.position
        boxes[:, YAW] += turn
        return boxes


class MotionTimeCheck(PairedCheck):
    """
    Compare boxes that stand still with the points of clouds, as of earlier and later poses.

    Where boxes are given in a frame that does not move with the sensor, clouds that are placed by
    poses of another moment lie off them, by the way of the sensor in between: the check finds the
    time by which they lie on them. Boxes in the frame of the sensor show nothing: they are moved
    with the clouds, and objects that are all ahead neither: boxes that are too far off would seem
    late, too. `finding` says so; it is empty before. Sweeps and boxes arrive in any order, in one
    frame, at most `AT_ONCE` [s] apart. The check ends after `MAX_STANDING_BOXES`.

    """

    def __init__(self) -> None:
        super().__init__()
        self._begins: dict[str, tuple[int, Floats]] = {}  # first stamp and centre of each track
        # By whether the object is ahead of the sensor, and track: (C,) of each box.
        self._shares = defaultdict[tuple[bool, str], list[Floats]](list)
        self._speeds: list[float] = []
        self._seen = 0
        self.finding = ''

    def add(
        self,
        item: Sweep | BoxArray,
        pose_of: Callable[[int], Floats | None],
        frame: str,
        clock_offset: float,
    ) -> None:
        """
        Add the next sweep, or boxes of a frame that does not move, and update `finding`.

        Parameters
        ----------
        item : Sweep or BoxArray
            In the fixed frame; boxes with ids.
        pose_of : callable
            Returns the pose (4, 4) of the sensor in that frame at a stamp; None if unknown.
        frame : str
            Name of the frame of the sensor.
        clock_offset : float
            What is added to the stamps of the motion already [s].

        """
        if self._seen >= MAX_STANDING_BOXES:
            return
        if isinstance(item, BoxArray):
            item = self._standing(item)
            if not item.track_ids or _motion(pose_of, item.stamp_ns) is None:
                return  # the points of no cloud are sorted for nothing
        pair = self._paired(item)
        motion = pair and _motion(pose_of, item.stamp_ns)
        if pair and motion:
            self._compare(*pair, motion)
            self.finding = self._text(item.frame_id, frame, clock_offset)

    def _standing(self, boxes: BoxArray) -> BoxArray:
        """Return those of the boxes that have stood still so far."""
        if len(self._begins) > MAX_BEGINS:
            self._begins.clear()
        rows = []
        is_known = is_valid_box(boxes.boxes) & np.array([*map(bool, boxes.track_ids)], bool)
        for row in np.flatnonzero(is_known).tolist():
            center = boxes.boxes[row, BOX_CENTER]
            now = boxes.stamp_ns, center
            begin_ns, begin = self._begins.setdefault(boxes.track_ids[row], now)
            passed_ns = boxes.stamp_ns - begin_ns
            drift = float(np.linalg.norm(center - begin))
            if passed_ns >= STANDING_NS and drift <= MAX_DRIFT * passed_ns * 1e-9:
                rows.append(row)
        return boxes.take(np.array(rows, int))

    def _compare(self, points: NDArray[np.floating], boxes: BoxArray, motion: _Motion) -> None:
        """Add the points that each box has in each place, as parts of the most."""
        self._seen += len(boxes.boxes)
        for track_id, box in zip(boxes.track_ids, boxes.boxes, strict=True):
            reach = float(np.linalg.norm(box[BOX_EXTENT])) + MOTION_TIMES[-1] * motion.speed
            away = points_around(points, box[BOX_CENTER], reach)
            if len(away) < MIN_POINTS_OF_BOX:
                continue
            places = motion.displaced(box)
            R = matrix_from_rpy(places[:, ROLL:])
            local = (away + box[BOX_CENTER] - places[:, None, BOX_CENTER]) @ R  # (C, points, 3)
            limit = box[BOX_EXTENT] / 2
            is_inside = (np.abs(local) <= limit + POINT_MARGIN).all(axis=2)
            counts = (is_inside & (local[..., 2] > ROAD_CLEARANCE - limit[2])).sum(axis=1)
            if counts.max() >= MIN_POINTS_OF_BOX:
                is_ahead = bool((box[BOX_CENTER] - motion.position) @ motion.velocity > 0)
                self._shares[is_ahead, track_id].append(counts / counts.max())
                self._speeds.append(motion.speed)

    def _text(self, fixed_frame: str, frame: str, clock_offset: float) -> str:
        """Return by which time of the motion boxes fit better; empty where it is in time."""
        known = {key: one for key, one in self._shares.items() if len(one) >= FEWEST_BOXES}
        is_ahead = np.array([key[0] for key in known], bool)
        objects = len({track_id for _, track_id in known})
        is_of_side = ~is_ahead, is_ahead
        is_one_sided = min(map(np.count_nonzero, is_of_side)) < MIN_OF_SIDE
        if is_one_sided or objects < MIN_STANDING or len(self._speeds) < MIN_COMPARED_BOXES:
            return ''
        shares = np.array([np.mean(one, axis=0) for one in known.values()])
        # Boxes that are too long, short or far lie off to one side ahead, to the other behind.
        fits = np.mean([shares[side].mean(axis=0) for side in is_of_side], axis=0)
        best = max(range(len(fits)), key=lambda time: (fits[time], -abs(time - IN_TIME)))
        seconds = float(MOTION_TIMES[best])
        if abs(seconds) < MIN_MOTION_OFFSET:
            return ''
        for other in IN_TIME, len(MOTION_TIMES) - 1 - best:  # short boxes fit by both times
            gains = shares[:, best] - shares[:, other]
            deviation = float(gains.std(ddof=1)) / np.sqrt(len(gains))
            is_clear = gains.mean() >= MIN_GAIN_DEVIATIONS * deviation
            if not (is_clear and all(gains[side].mean() > 0 for side in is_of_side)):
                return ''
        way = abs(seconds) * float(np.median(self._speeds))
        where, when = ('ahead of', 'late') if seconds > 0 else ('behind', 'early')
        total = seconds_text(clock_offset - seconds)
        return (
            f'boxes of {objects} objects that stand still in {fixed_frame!r} lie {way:.1f} m '
            f'{where} their points, on the way of {frame!r}: clouds are placed by a motion that '
            f'is about {abs(seconds):.2g} s {when}, and refined boxes are off as much; correct it '
            f'with --clock-offset={total} (node: clock_offset:={total}); otherwise a static '
            f'transform of {frame!r} is off, or the boxes were brought to {fixed_frame!r} by '
            f'poses of another moment, as of a late detector, which refinement mends'
        )


def _motion(pose_of: Callable[[int], Floats | None], stamp_ns: int) -> _Motion | None:
    """Return the motion of the sensor at a stamp; None where it is slow, or not known."""
    before, now = pose_of(stamp_ns - SPEED_NS), pose_of(stamp_ns)
    if before is None or now is None:
        return None
    seconds = SPEED_NS * 1e-9
    yaws = np.arctan2([before[1, 0], now[1, 0]], [before[0, 0], now[0, 0]])
    velocity = (now[:3, 3] - before[:3, 3]) / seconds
    motion = _Motion(now[:3, 3], velocity, float(wrap_angle(yaws[1] - yaws[0])) / seconds)
    return motion if motion.speed >= MIN_SENSOR_SPEED else None
