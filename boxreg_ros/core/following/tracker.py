"""
Follow one object through sweeps, from boxes of a person: predict, register, update.

A way starts at a seed and takes one sweep after the other, in either direction in time. Between
two seeds there are two ways; each is tested where it arrives at the other seed.

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, Self

from boxreg_ros.core.following.extents import faces, MAX_GROWTH
from boxreg_ros.core.following.sweeps import Sweeps
from boxreg_ros.core.method import sweep_fit, turn_rate
from boxreg_ros.core.method.constants import CONSTANTS
from boxreg_ros.core.method.follow_numbers import FOLLOW
from boxreg_ros.core.method.surface import empty_surface, insert_foreign
from boxreg_ros.core.method.sweep_fit import Expected, Registered, Target
from boxreg_ros.rotations import matrix_from_rpy, wrap_angle
from boxreg_ros.structures import BOX_EXTENT, Floats, Ints, PITCH, ROLL, YAW
import numpy as np

POSE4 = [0, 1, 2, YAW]
"""Columns of a box that are followed; roll and pitch are those of the seed."""

SEED_DEVIATIONS = np.array([0.03, 0.03, 0.03, 0.02])
"""Of x y z [m] and yaw [rad] of a box that a person has drawn."""
CLIMB = 0.1
"""The height of a box changes by this in a second, as a random walk [m]; chosen."""
PARKED_NOISE = 0.1
"""Factor on the noise of the motion of a parked object; chosen."""

HOLD, HOLD_PARKED = 2.0, 5.0
"""An object that is not found for so long is lost [s]."""
YOUNG = 1.0
"""A way of this duration does not yet know its speed well [s]."""
SPEED_AFTER_LOSS = 2.0
"""Deviation of the speed of a young way after a loss [m/s]."""

MAX_GAP = 0.3
"""A way has arrived at a seed if it is nearer than this [m]; swept in findings: 0.2 to 0.5."""
MAX_GAP_YAW = 0.15
"""And if its heading differs by less [rad]."""

NEAR_SEEDS = 1.5
"""Seeds nearer in time give the speed [s]; chosen: acceleration changes it by less than 3 m/s."""
SEARCH_SWEEPS = 5
"""Sweeps in each direction that a start speed is tested with."""
SPEEDS_TESTED = 4
"""Most likely speeds by the first sweeps that are tested with `SEARCH_SWEEPS`."""
START_INFORMATION = np.diag(np.array([0.5, 0.5, 0.1, 0.05]) ** -2.0)
"""Of the starts of a search for the speed: x y z [m] and yaw [rad]."""
MAX_EXTENT_SWEEPS = 60
"""Sweeps of a track whose points show the extents; chosen."""

ARRIVED, END_OF_SWEEPS = 'arrived', 'end_of_sweeps'


class KindOfMotion(NamedTuple):
    """
    Motion of a kind of object: densities of `turn_rate.predict`, speed [m/s], road [m].

    Of others than rigid objects points do not show the extents: limbs move.
    """

    noise: Floats
    max_speed: float
    clearance: float
    is_rigid: bool = False


MOTIONS = {
    'vehicle': KindOfMotion(np.array([1.0, 0.1, 0.004, 1e-4]), 40.0, 0.25, True),
    'cyclist': KindOfMotion(np.array([1.0, 0.4, 0.01, 1e-3]), 12.0, 0.2),
    'pedestrian': KindOfMotion(np.array([0.6, 0.4, 0.02, 5e-3]), 3.0, 0.2),
}


class Seeds(NamedTuple):
    """Boxes (N, 9) of a person in the sweeps `rows` (N,), ascending."""

    rows: Ints
    boxes: Floats


class Way(NamedTuple):
    """
    Poses from a seed outwards.

    Attributes
    ----------
    poses : dict
        Pose (4,) by row of the sweep, without that of the seed.
    seen : set of int
        Rows where points support the pose; it is predicted in the others.
    reason : str
        Why it ends: `ARRIVED`, `END_OF_SWEEPS`, or `_reason`.

    """

    poses: dict[int, Floats]
    seen: set[int]
    reason: str


@dataclass(slots=True, eq=False)
class Walk:
    """
    A way under way.

    Attributes
    ----------
    row, sign : int
        The sweep that it is at, and its direction in time.
    state : _State
        There.
    begin, last_seen : float
        Times of the seed and of the last sweep where points support the pose [s].
    usual : float
        Running mean of the score of the fit.
    poses, seen
        As of `Way`.
    reason : str
        Why points do not support the pose here; empty if they do.
    is_over : bool
        True if it has been lost for too long.

    """

    row: int
    sign: int
    state: _State
    begin: float
    last_seen: float
    usual: float
    poses: dict[int, Floats] = field(default_factory=dict)
    seen: set[int] = field(default_factory=set)
    reason: str = ''
    is_over: bool = False


class _State(NamedTuple):
    """State and covariance of `motion`, height, its variance, and the information of the pose."""

    planar: Floats
    covariance: Floats
    z: float
    z_variance: float
    information: Floats

    @classmethod
    def at_seed(cls, pose: Floats, speed: float) -> Self:
        deviations = [*SEED_DEVIATIONS[[0, 1, 3]], 1.0, 0.1]
        planar = np.array([pose[0], pose[1], pose[3], speed, 0.0])
        covariance = np.diag(np.square(deviations))
        return cls(planar, covariance, pose[2], SEED_DEVIATIONS[2] ** 2, START_INFORMATION)

    def updated(self, found: Registered) -> Self:
        """Return the state with a registered pose."""
        planar, covariance = turn_rate.update(
            self.planar, self.covariance, found.pose, found.covariance
        )
        z, z_variance = found.pose[2], found.covariance[2, 2]
        return type(self)(planar, covariance, z, z_variance, self.information)

    @property
    def pose(self) -> Floats:
        return np.array([self.planar[0], self.planar[1], self.z, self.planar[2]])

    @property
    def speed(self) -> float:
        """Speed along the heading [m/s]."""
        return float(self.planar[3])

    @property
    def is_parked(self) -> bool:
        return bool(abs(self.speed) < CONSTANTS.parked_speed)


class Owned:
    """Boxes of objects that are followed already: their points are of no other object."""

    def __init__(self) -> None:
        self._boxes: dict[int, tuple[Floats, int]] = {}  # by row of the sweep; rows in use

    def add(self, rows: Ints, boxes: Floats, owner: int = -1) -> None:
        """Add the boxes (N, 9) of the object `owner` in the sweeps `rows` (N,)."""
        known = np.empty((len(boxes), 16))
        known[:, :3], known[:, 3:6] = boxes[:, :3], boxes[:, BOX_EXTENT] / 2
        known[:, 6:15] = matrix_from_rpy(boxes[:, ROLL:]).reshape(-1, 9)
        known[:, 15] = owner
        for row, box in zip(rows.tolist(), known, strict=True):
            of_row, count = self._boxes.get(row, (np.empty((8, 16)), 0))
            if count == len(of_row):
                of_row = np.concatenate([of_row, np.empty_like(of_row)])
            of_row[count] = box
            self._boxes[row] = of_row, count + 1

    def __getitem__(self, row: int, /) -> Floats:
        """Return those in a sweep, as `sweep_fit.near` takes them."""
        boxes, count = self._boxes.get(row, (np.empty((0, 16)), 0))
        return boxes[:count]


class Follower:
    """
    Follow one object.

    Parameters
    ----------
    sweeps : Sweeps
        All of a drive.
    seeds : Seeds
        Of the object, one or more.
    kind : str
        One of `MOTIONS`.
    owned : Owned
        Boxes of other objects.
    same : sequence of int
        Those of them in `owned` that have a seed in one of this object.

    """

    def __init__(
        self, sweeps: Sweeps, seeds: Seeds, kind: str, owned: Owned, same: Sequence[int] = ()
    ) -> None:
        self._sweeps = sweeps
        self._seeds = seeds
        self._kind = MOTIONS[kind]
        self._owned = owned
        self._same = np.array(same, np.float64)
        half = seeds.boxes[:, BOX_EXTENT].mean(0) / 2
        tilt = matrix_from_rpy(np.append(seeds.boxes[0, [ROLL, PITCH]], 0.0))
        self._target = Target(half, tilt, self._kind.clearance, empty_surface(half))
        self._pivot = CONSTANTS.pivot * 2 * half[0] if kind == 'vehicle' else 0.0
        self._road = np.nan
        self._start_speeds: dict[int, float] = {}
        self.num_points = 0
        for row, pose in zip(seeds.rows.tolist(), seeds.boxes[:, POSE4], strict=True):
            points = self._near(row, pose)
            around = self._in_box(points, pose, FOLLOW.rim)
            insert_foreign(around, half, self._target.surface.slots)
            self.num_points += sweep_fit.learn(points, pose, self._target)
            if np.isnan(self._road):
                self._road = sweep_fit.road_below(points, pose, self._target)

    def way(self, seed: int, sign: int, stop: int) -> Way:
        """Follow the object from a seed to the row `stop`, forwards or backwards."""
        walk = self.walk(seed, sign)
        while walk.row != stop and not walk.is_over:
            self.step(walk)
        return Way(walk.poses, walk.seen, walk.reason or ARRIVED)

    def walk(self, seed: int, sign: int) -> Walk:
        """Return a way of no step yet from a seed, forwards or backwards."""
        row = int(self._seeds.rows[seed])
        pose = self._seeds.boxes[seed, POSE4]
        if seed not in self._start_speeds:
            self._start_speeds[seed] = self._start_speed(seed)
        state = _State.at_seed(pose, self._start_speeds[seed])
        time = self._sweeps.times[row]
        return Walk(row, sign, state, time, time, self._score(row, pose))

    def step(self, walk: Walk) -> None:
        """Follow the object to the next sweep of a way."""
        times = self._sweeps.times
        walk.row += walk.sign
        row = walk.row
        state = self._predicted(walk.state, times[row] - times[row - walk.sign])
        points, found = self._find(row, state, walk)
        if found.reason:
            if not walk.reason and abs(walk.last_seen - walk.begin) < YOUNG:
                state.covariance[3, 3] += SPEED_AFTER_LOSS**2
            hold = HOLD_PARKED if state.is_parked else HOLD
            walk.is_over = abs(times[row] - walk.last_seen) > hold
            if not walk.is_over:
                walk.poses[row] = state.pose
            walk.state = state
            walk.reason = sweep_fit.REASONS[found.reason]
            return
        walk.state = state.updated(found)
        walk.reason = ''
        walk.poses[row] = found.pose
        walk.seen.add(row)
        walk.last_seen = times[row]
        walk.usual += (found.fit.score - walk.usual) / 5
        if found.fit.part > FOLLOW.min_fit_to_learn:
            sweep_fit.learn(points, found.pose, self._target)
            if np.isnan(self._road):
                self._road = sweep_fit.road_below(points, found.pose, self._target)

    def continue_in(self, sweeps: Sweeps, owned: Owned) -> None:
        """Go on with further sweeps, and the boxes of other objects in them."""
        self._sweeps = sweeps
        self._owned = owned

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
        some = np.unique(np.linspace(0, len(rows) - 1, MAX_EXTENT_SWEEPS).round().astype(int))
        points = [
            self._in_box(self._near(int(rows[i]), pose, MAX_GROWTH), pose, MAX_GROWTH)
            for i, pose in zip(some, boxes[:, POSE4][some], strict=True)
        ]
        sees_top = [self._sees_top(int(rows[i]), boxes[i, POSE4]) for i in some]
        low, high = faces(points, self._target.half, is_of_class, np.array(sees_top))
        grown = boxes.copy()
        shift = (low + high) / 2
        grown[:, :3] += matrix_from_rpy(boxes[:, ROLL:]) @ shift
        grown[:, BOX_EXTENT] = high - low
        return grown

    def _sees_top(self, row: int, pose: Floats) -> bool:
        """Return whether the sensor would see points above the box."""
        limits = self._sweeps.sight_limits
        if limits is None:
            return False
        half = self._target.half
        top = pose[2] + half[2] + FOLLOW.tolerance
        return bool(limits.height(row, pose, float(np.hypot(*half[:2]))) > top)

    def jumps(self, seed: int) -> bool:
        """Return whether the next seed is farther away than such an object can move."""
        rows, boxes = self._seeds.rows[seed : seed + 2], self._seeds.boxes[seed : seed + 2]
        seconds = self._sweeps.times[rows[1]] - self._sweeps.times[rows[0]]
        distance = np.linalg.norm(boxes[1, :2] - boxes[0, :2])
        return bool(distance > self._kind.max_speed * seconds + 1.0)

    def fit_of(self, rows: Ints, poses: Floats) -> float:
        """Return the mean score of poses (n, 4) in sweeps `rows` (n,)."""
        scores = [self._score(row, pose) for row, pose in zip(rows.tolist(), poses, strict=True)]
        return float(np.mean(scores)) if scores else 0.0

    def _find(self, row: int, state: _State, walk: Walk) -> tuple[Floats, Registered]:
        """Return the points around a prediction, and the pose by them."""
        is_lost = bool(walk.reason)
        step, count = FOLLOW.slip_step, FOLLOW.slips
        if is_lost:
            reach = 2.5 * np.sqrt(state.covariance[0, 0] + state.covariance[1, 1])
            step = FOLLOW.search_step
            count = min(int(reach / step), FOLLOW.max_search)
        points = self._near(row, state.pose, FOLLOW.around + step * count)
        expected = Expected(
            state.pose, state.information, step, count, is_lost, walk.usual, self._road
        )
        found: Registered = sweep_fit.find(points, expected, self._target)
        return points, found

    def _registered(self, row: int, start: Floats, information: Floats, steps: int) -> Registered:
        """Return the pose in a sweep from one start."""
        points = self._near(row, start)
        found: Registered = sweep_fit.registered(
            points, start, start, information, self._target, steps
        )
        return found

    def _start_speed(self, seed: int) -> float:
        """Return the speed at a seed [m/s]: by its neighbours in time, or searched."""
        rows = self._seeds.rows
        times = self._sweeps.times
        near = [i for i in (seed - 1, seed + 1) if 0 <= i < len(rows)]
        near = [i for i in near if abs(times[rows[i]] - times[rows[seed]]) < NEAR_SEEDS]
        if not near:
            return self._searched_speed(seed)
        first, last = min(*near, seed), max(*near, seed)
        travel = self._seeds.boxes[last, :2] - self._seeds.boxes[first, :2]
        yaw = self._seeds.boxes[seed, YAW]
        forward = travel @ [np.cos(yaw), np.sin(yaw)]
        return float(forward / (times[rows[last]] - times[rows[first]]))

    def _searched_speed(self, seed: int) -> float:
        """Return the speed at a seed by which the sweeps around it fit best [m/s]."""
        row = int(self._seeds.rows[seed])
        pose = self._seeds.boxes[seed, POSE4]
        times = self._sweeps.times
        around = [other for other in (row - 1, row + 1) if self._sweeps.has(other)]
        if not around:
            return 0.0
        period = max(abs(times[other] - times[row]) for other in around)
        step = min(3.0, 0.35 / max(period, 1e-3))
        count = int(self._kind.max_speed / step)
        speeds = step * np.arange(-count // 3, count + 1)
        forward = np.array([np.cos(pose[3]), np.sin(pose[3]), 0.0, 0.0])
        scores = np.zeros(len(speeds))
        for i, speed in enumerate(speeds):
            for other in around:
                start = pose + speed * (times[other] - times[row]) * forward
                scores[i] += self._registered(other, start, START_INFORMATION, 6).fit.score
            scores[i] = scores[i] / len(around) - _cost(speed)
        likely = speeds[np.argsort(-scores, kind='stable')[:SPEEDS_TESTED]]
        tested = [self._tested_speed(row, pose, speed) for speed in likely]
        return max(tested)[1]

    def _tested_speed(self, row: int, pose: Floats, speed: float) -> tuple[float, float]:
        """Return the score of a start speed over several sweeps, and the mean speed by them."""
        times = self._sweeps.times
        total, weights = 0.0, 1e-9
        found_speeds = []
        for sign in (1, -1):
            state = _State.at_seed(pose, speed)
            for count in range(1, SEARCH_SWEEPS + 1):
                other = row + sign * count
                if not self._sweeps.has(other):
                    break
                state = self._predicted(state, times[other] - times[other - sign])
                found = self._registered(other, state.pose, state.information, 8)
                total += sweep_fit.rank(found) / count
                weights += 1 / count
                z, z_variance = state.z, state.z_variance
                state = state.updated(found)._replace(z=z, z_variance=z_variance)
            found_speeds.append(state.planar[3])
        return total / weights - _cost(speed), float(np.mean(found_speeds))

    def _predicted(self, state: _State, seconds: float) -> _State:
        noise = self._kind.noise * (PARKED_NOISE if state.is_parked else 1.0)
        planar, covariance, z_variance, information = turn_rate.predict(
            state.planar, state.covariance, state.z_variance, seconds, noise, CLIMB**2, self._pivot
        )
        return _State(planar, covariance, state.z, z_variance, information)

    def _near(self, row: int, pose: Floats, margin: float = 0.0) -> Floats:
        """Return the points (n, 3) around a pose that are not in the box of another object."""
        near: Floats = sweep_fit.near(
            self._sweeps.points[row], pose, self._target.half, margin, self._owned[row], self._same
        )
        return near

    def _in_box(self, points: Floats, pose: Floats, margin: float) -> Floats:
        found: Floats = sweep_fit.in_box(points, pose, self._target, margin)
        return found

    def _score(self, row: int, pose: Floats) -> float:
        """Return how well the points of a sweep fit a pose, see `Fit`."""
        return float(sweep_fit.fit(self._near(row, pose), pose, self._target).score)


def _cost(speed: float) -> float:
    """Return how much better the score of a speed has to be than that of a parked object."""
    return 0.03 * (abs(speed) > 0.7) + 0.1 * (speed < -0.7) + 0.002 * abs(speed)
