"""
Follow one object through sweeps, from boxes of a person: predict, register, update.

A way starts at a seed and takes one sweep after the other, in either direction in time. Between
two seeds there are two ways; each is tested where it arrives at the other seed.

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import dist

from boxreg_ros.config import Config
from boxreg_ros.core.following.extents import faces
from boxreg_ros.core.following.motion_kinds import is_parked, MotionModel, MOTIONS
from boxreg_ros.core.following.object_points import ObjectPoints, Owned
from boxreg_ros.core.following.start_speed import at_seed, POSE4, Seeds, StartSpeeds
from boxreg_ros.core.following.sweeps import Sweeps
from boxreg_ros.core.method import sweep_fit, turn_rate
from boxreg_ros.core.method.follow_numbers import FOLLOW
from boxreg_ros.core.method.surface import empty_surface
from boxreg_ros.core.method.sweep_fit import Expected, Registered, Target
from boxreg_ros.core.method.turn_rate import SPEED_STATE, State
from boxreg_ros.core.observation import crop_numbers
from boxreg_ros.rotations import matrix_from_rpy, wrap_angle
from boxreg_ros.structures import BOX_EXTENT, Floats, Ints, PITCH, ROLL, YAW
import numpy as np

CROP_NUMBERS = crop_numbers(Config())
"""How the road is found, as for the boxes of a detector."""
USUAL_SWEEPS = 5
"""Sweeps that the usual score of a fit is averaged over; chosen."""


@dataclass(slots=True, eq=False)
class Way:
    """Poses from a seed outwards, in one direction in time."""

    row: int
    """The sweep that it is at."""
    sign: int
    """Its direction."""
    state: State
    begin: float
    """Time of the seed [s]."""
    last_seen: float
    """That of the last sweep where points support the pose [s]."""
    usual: float
    """Running mean of the score of the fit."""
    poses: dict[int, Floats] = field(default_factory=dict)
    """Pose (4,) by row of the sweep, without that of the seed."""
    seen: set[int] = field(default_factory=set)
    """Rows where points support the pose; it is predicted in the others."""
    reason: str = ''
    """Why points do not support the pose here, of `sweep_fit.REASONS`; empty if they do."""
    is_over: bool = False
    """Whether it has been lost for too long."""


class Follower:
    """
    Follow one object of a kind of `MOTIONS` through sweeps, from one or more seeds.

    `owned` are the boxes of other objects; those of `same` have a seed in one of this object.

    """

    def __init__(
        self, sweeps: Sweeps, seeds: Seeds, kind: str, owned: Owned, same: Sequence[int] = ()
    ) -> None:
        self._seeds = seeds
        self._kind = MOTIONS[kind]
        half = seeds.boxes[:, BOX_EXTENT].mean(0) / 2
        tilt = matrix_from_rpy(np.append(seeds.boxes[0, [ROLL, PITCH]], 0.0))
        road = CROP_NUMBERS._replace(clearance=self._kind.clearance)
        self._target = Target(half, tilt, road, empty_surface(half), self._kind.is_rigid)
        self._points = ObjectPoints(sweeps, owned, same, self._target)
        self._motion = MotionModel.of(kind, 2 * half[0])
        self._speeds = StartSpeeds(self._points, seeds, self._motion, self._kind.max_speed)
        self._road = np.nan
        self.num_points = 0
        for row, box in zip(seeds.rows.tolist(), seeds.boxes, strict=True):
            pose = box[POSE4]  # contiguous, as kernels are compiled for; columns are not
            self.num_points += self._learn(self._points.near(row, pose), pose, is_seed=True)

    def way(self, seed: int, sign: int, stop: int) -> Way:
        """Follow the object from a seed to the row `stop`, forwards or backwards."""
        way = self.begin(seed, sign)
        while way.row != stop and not way.is_over:
            self.step(way)
        return way

    def begin(self, seed: int, sign: int) -> Way:
        """Return a way of no step yet from a seed, forwards or backwards."""
        row = int(self._seeds.rows[seed])
        pose = self._seeds.boxes[seed, POSE4]
        state = at_seed(pose, self._speeds.at(seed))
        time = self._points.sweeps.times[row]
        return Way(row, sign, state, time, time, self._points.score(row, pose))

    def step(self, way: Way) -> None:
        """Follow the object to the next sweep of a way."""
        times = self._points.sweeps.times
        way.row += way.sign
        row = way.row
        state = self._motion.predicted(way.state, times[row] - times[row - way.sign])
        points, found = self._find(row, state, way)
        if found.reason:
            if not way.reason and abs(way.last_seen - way.begin) < FOLLOW.young:
                state.covariance[SPEED_STATE, SPEED_STATE] += FOLLOW.young_speed**2
            hold = FOLLOW.hold_parked if is_parked(state) else FOLLOW.hold
            way.is_over = abs(times[row] - way.last_seen) > hold
            if not way.is_over:
                way.poses[row] = state.pose
            way.state = state
            way.reason = sweep_fit.REASONS[found.reason]
            return
        way.state = turn_rate.update(state, found.pose, found.covariance)
        way.reason = ''
        way.poses[row] = found.pose
        way.seen.add(row)
        way.last_seen = times[row]
        way.usual += (found.fit.score - way.usual) / USUAL_SWEEPS
        if found.fit.part > FOLLOW.min_sure_fit:
            self._learn(points, found.pose)

    def continue_in(self, sweeps: Sweeps, owned: Owned) -> None:
        """Go on with further sweeps, and the boxes of other objects in them."""
        self._points.sweeps = sweeps
        self._points.owned = owned

    def box(self, pose: Floats, travel: float = 0.0) -> Floats:
        """Return the object at a pose (4,), moved forward by `travel` [m], as a row (9,)."""
        box: Floats = self._seeds.boxes[0].copy()
        box[BOX_EXTENT] = 2 * self._target.half
        box[POSE4] = pose
        box[YAW] = wrap_angle(box[YAW])
        box[:2] += travel * np.array([np.cos(box[YAW]), np.sin(box[YAW])])
        return box

    def grown(self, rows: Ints, boxes: Floats, is_of_class: bool) -> Floats:
        """Return the boxes (n, 9) in sweeps `rows` (n,) with the extents that points show."""
        if not self._kind.is_rigid:
            return boxes
        some = np.unique(
            np.linspace(0, len(rows) - 1, FOLLOW.max_extent_sweeps).round().astype(int)
        )
        seen = [(int(rows[i]), boxes[i, POSE4]) for i in some]
        points = [
            self._points.in_box(
                self._points.near(row, pose, FOLLOW.max_growth), pose, FOLLOW.max_growth
            )
            for row, pose in seen
        ]
        sees_top = [self._sees_top(row, pose) for row, pose in seen]
        low, high = faces(points, self._target.half, is_of_class, np.array(sees_top))
        grown = boxes.copy()
        shift = (low + high) / 2
        grown[:, :3] += matrix_from_rpy(boxes[:, ROLL:]) @ shift
        grown[:, BOX_EXTENT] = high - low
        return grown

    @property
    def is_rigid(self) -> bool:
        """Return whether the object is a vehicle, which keeps its shape."""
        return self._kind.is_rigid

    def _sees_top(self, row: int, pose: Floats) -> bool:
        """Return whether the sensor would see points above the box."""
        limits = self._points.sweeps.sight_limits
        if limits is None:
            return False
        half = self._target.half
        top = pose[2] + half[2] + FOLLOW.tolerance
        return bool(limits.height(row, pose, float(np.hypot(*half[:2]))) > top)

    def jumps(self, seed: int) -> bool:
        """Return whether the next seed is farther away than such an object can move."""
        rows, boxes = self._seeds.rows[seed : seed + 2], self._seeds.boxes[seed : seed + 2]
        seconds = self._points.sweeps.times[rows[1]] - self._points.sweeps.times[rows[0]]
        distance = dist(*boxes[:, :2].tolist())
        return bool(distance > self._kind.max_speed * seconds + FOLLOW.seed_error)

    def fit_of(self, rows: Ints, poses: Floats) -> float:
        """Return the mean score of poses (n, 4) in sweeps `rows` (n,)."""
        scores = [
            self._points.score(row, pose) for row, pose in zip(rows.tolist(), poses, strict=True)
        ]
        return float(np.mean(scores)) if scores else 0.0

    def _find(self, row: int, state: State, way: Way) -> tuple[Floats, Registered]:
        """Return the points around a prediction, and the pose by them."""
        reach = 0.0
        if way.reason:
            deviation = float(np.sqrt(state.covariance[0, 0] + state.covariance[1, 1]))
            reach = min(FOLLOW.search_deviations * deviation, FOLLOW.max_search)
        points = self._points.near(row, state.pose, FOLLOW.around + max(reach, 2 * FOLLOW.cell))
        expected = Expected(state, reach, way.usual, self._road)
        found: Registered = sweep_fit.find(points, expected, self._target)
        return points, found

    def _learn(self, points: Floats, pose: Floats, is_seed: bool = False) -> int:
        """Add points at a pose to the surface, and find the road; return how many are new."""
        count: int
        count, self._road = sweep_fit.learn(points, pose, self._target, is_seed, self._road)
        return count
