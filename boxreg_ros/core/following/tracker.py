"""
Follow one object through sweeps, from boxes of a person: predict, register, update.

A way starts at a seed and takes one sweep after the other, in either direction in time. Between
two seeds there are two ways; each is tested where it arrives at the other seed.

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from boxreg_ros.config import Config
from boxreg_ros.core.following.extents import faces
from boxreg_ros.core.following.person import ANGLE, POSITION
from boxreg_ros.core.following.sweeps import Sweeps
from boxreg_ros.core.method import sweep_fit, turn_rate
from boxreg_ros.core.method.constants import CONSTANTS
from boxreg_ros.core.method.follow_numbers import FOLLOW
from boxreg_ros.core.method.surface import empty_surface, insert_foreign
from boxreg_ros.core.method.sweep_fit import Expected, Registered, Target
from boxreg_ros.core.method.turn_rate import SPEED_STATE, State
from boxreg_ros.core.observation import crop_numbers, GROUND_CLEARANCE
from boxreg_ros.rotations import matrix_from_rpy, wrap_angle
from boxreg_ros.structures import BOX_EXTENT, Floats, Ints, PITCH, ROLL, YAW
import numpy as np

POSE4 = [0, 1, 2, YAW]
"""Columns of a box that are followed; roll and pitch are those of the seed."""


class KindOfMotion(NamedTuple):
    """
    Motion of a kind of object.

    Attributes
    ----------
    noise : array, shape (5,)
        Spectral densities of acceleration [m^2/s^3], angular acceleration [rad^2/s^3], slip
        sideways and upward [m^2/s] and turning [rad^2/s], see `turn_rate.predict`. Chosen.
    max_speed : float
        Largest speed [m/s]. Chosen.
    is_rigid : bool
        Whether points show the extents; of other objects limbs move.
    clearance : float
        Points nearer to the road may be of it [m].

    """

    noise: Floats
    max_speed: float
    is_rigid: bool = False
    clearance: float = GROUND_CLEARANCE


MOTIONS = {
    'vehicle': KindOfMotion(np.array([1.0, 0.1, 0.004, 0.01, 1e-4]), 40.0, True, 0.25),
    'cyclist': KindOfMotion(np.array([1.0, 0.4, 0.01, 0.01, 1e-3]), 12.0),
    'pedestrian': KindOfMotion(np.array([0.6, 0.4, 0.02, 0.01, 5e-3]), 3.0),
}
SEED = np.diag([*[POSITION] * 3, ANGLE, 1.0, 0.1]) ** 2
"""Covariance of the state at a seed, with speed [m/s] and turn rate [rad/s]; chosen."""
START = np.diag([*[FOLLOW.around] * 2, 0.1, 0.05, 1.0, 1.0]) ** 2
"""Covariance of the starts of a search for the speed [m, rad]; chosen."""
CROP_NUMBERS = crop_numbers(Config())
"""How the road is found, as for the boxes of a detector."""


class Seeds(NamedTuple):
    """Boxes (N, 9) of a person in the sweeps `rows` (N,), ascending."""

    rows: Ints
    boxes: Floats


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


def at_seed(pose: Floats, speed: float) -> State:
    """Return the state at a seed (4,)."""
    return State(np.array([*pose, speed, 0.0]), SEED)


def is_parked(state: State) -> bool:
    """Return whether an object is held as a parked one."""
    return abs(state.speed) < CONSTANTS.parked_speed


def steering(noise: Floats, length: float) -> tuple[Floats, float]:
    """Return noise and pivot of a vehicle by its length: long ones turn more slowly."""
    found = noise.copy()
    found[1] *= min(1.0, FOLLOW.steered_length / length) ** 2
    return found, max(CONSTANTS.pivot * length, length / 2 - FOLLOW.overhang)


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
    Follow one object of a kind of `MOTIONS` through sweeps, from one or more seeds.

    `owned` are the boxes of other objects; those of `same` have a seed in one of this object.

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
        road = CROP_NUMBERS._replace(clearance=self._kind.clearance)
        self._target = Target(half, tilt, road, empty_surface(half), self._kind.is_rigid)
        self._noise, self._pivot = self._kind.noise, 0.0
        if kind == 'vehicle':
            self._noise, self._pivot = steering(self._noise, 2 * half[0])
        self._road = np.nan
        self._start_speeds: dict[int, float] = {}
        self.num_points = 0
        for row, pose in zip(seeds.rows.tolist(), seeds.boxes[:, POSE4], strict=True):
            points = self._near(row, pose)
            around = self._in_box(points, pose, FOLLOW.margin)
            insert_foreign(around, half, self._target.surface.slots)
            self.num_points += sweep_fit.learn(points, pose, self._target)
            if np.isnan(self._road):
                self._road = sweep_fit.road_below(points, pose, self._target)

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
        if seed not in self._start_speeds:
            self._start_speeds[seed] = self._start_speed(seed)
        state = at_seed(pose, self._start_speeds[seed])
        time = self._sweeps.times[row]
        return Way(row, sign, state, time, time, self._score(row, pose))

    def step(self, way: Way) -> None:
        """Follow the object to the next sweep of a way."""
        times = self._sweeps.times
        way.row += way.sign
        row = way.row
        state = self._predicted(way.state, times[row] - times[row - way.sign])
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
        way.usual += (found.fit.score - way.usual) / 5
        if found.fit.part > FOLLOW.min_sure_fit:
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
        some = np.unique(
            np.linspace(0, len(rows) - 1, FOLLOW.max_extent_sweeps).round().astype(int)
        )
        points = [
            self._in_box(
                self._near(int(rows[i]), pose, FOLLOW.max_growth), pose, FOLLOW.max_growth
            )
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
        return bool(distance > self._kind.max_speed * seconds + FOLLOW.seed_error)

    def fit_of(self, rows: Ints, poses: Floats) -> float:
        """Return the mean score of poses (n, 4) in sweeps `rows` (n,)."""
        scores = [self._score(row, pose) for row, pose in zip(rows.tolist(), poses, strict=True)]
        return float(np.mean(scores)) if scores else 0.0

    def _find(self, row: int, state: State, way: Way) -> tuple[Floats, Registered]:
        """Return the points around a prediction, and the pose by them."""
        reach = 0.0
        if way.reason:
            deviation = float(np.sqrt(state.covariance[0, 0] + state.covariance[1, 1]))
            reach = min(FOLLOW.search_deviations * deviation, FOLLOW.max_search)
        points = self._near(row, state.pose, FOLLOW.around + max(reach, 2 * FOLLOW.cell))
        expected = Expected(state, reach, way.usual, self._road)
        found: Registered = sweep_fit.find(points, expected, self._target)
        return points, found

    def _registered(self, row: int, state: State, steps: int) -> Registered:
        """Return the pose in a sweep from one start."""
        information = turn_rate.pose_information(state)
        points = self._near(row, state.pose)
        found: Registered = sweep_fit.registered(
            points, state.pose, state.pose, information, self._target, steps
        )
        return found

    def _start_speed(self, seed: int) -> float:
        """Return the speed at a seed [m/s]: by its neighbours in time, or searched."""
        rows = self._seeds.rows
        times = self._sweeps.times
        beside = [i for i in (seed - 1, seed + 1) if 0 <= i < len(rows)]
        near = [i for i in beside if abs(times[rows[i]] - times[rows[seed]]) < FOLLOW.near_seeds]
        beside = near or beside
        mean = 0.0
        if beside:
            first, last = min(*beside, seed), max(*beside, seed)
            travel = self._seeds.boxes[last, :2] - self._seeds.boxes[first, :2]
            yaw = self._seeds.boxes[seed, YAW]
            forward = travel @ [np.cos(yaw), np.sin(yaw)]
            mean = float(forward / (times[rows[last]] - times[rows[first]]))
        return mean if near else self._searched_speed(seed, mean)

    def _searched_speed(self, seed: int, mean: float) -> float:
        """Return the speed at a seed by which the sweeps fit best, given a mean one [m/s]."""
        row = int(self._seeds.rows[seed])
        pose = self._seeds.boxes[seed, POSE4]
        times = self._sweeps.times
        around = [other for other in (row - 1, row + 1) if self._sweeps.has(other)]
        if not around:
            return 0.0
        period = max(abs(times[other] - times[row]) for other in around)
        step = min(FOLLOW.max_speed_step, FOLLOW.start_shift / period)
        count = int(self._kind.max_speed / step)
        speeds = step * np.arange(-count // FOLLOW.forward_over_reverse, count + 1)
        forward = np.array([np.cos(pose[3]), np.sin(pose[3]), 0.0, 0.0])
        scores = np.zeros(len(speeds))
        for i, speed in enumerate(speeds):
            for other in around:
                start = pose + speed * (times[other] - times[row]) * forward
                state = State(np.array([*start, speed, 0.0]), START)
                scores[i] += self._registered(other, state, FOLLOW.start_iterations).fit.score
            scores[i] = scores[i] / len(around) - _cost(speed, mean)
        likely = speeds[np.argsort(-scores, kind='stable')[: FOLLOW.speeds_tested]]
        tested = [self._tested_speed(row, pose, speed, mean) for speed in likely]
        return max(tested)[1]

    def _tested_speed(
        self, row: int, pose: Floats, speed: float, mean: float
    ) -> tuple[float, float]:
        """Return the score of a start speed over several sweeps, and the speed by them."""
        times = self._sweeps.times
        total, weights = 0.0, 1e-9
        found_speeds = []
        for sign in (1, -1):
            state = at_seed(pose, speed)
            for count in range(1, FOLLOW.search_sweeps + 1):
                other = row + sign * count
                if not self._sweeps.has(other):
                    break
                state = self._predicted(state, times[other] - times[other - sign])
                found = self._registered(other, state, FOLLOW.test_iterations)
                total += sweep_fit.rank(found) / count
                weights += 1 / count
                state = turn_rate.update(state, found.pose, found.covariance)
            found_speeds.append(state.speed)
        return total / weights - _cost(speed, mean), float(np.mean(found_speeds))

    def _predicted(self, state: State, seconds: float) -> State:
        noise = self._noise * (FOLLOW.parked_noise if is_parked(state) else 1.0)
        found: State = turn_rate.predict(state, seconds, noise, self._pivot)
        return found

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


def _cost(speed: float, mean: float) -> float:
    """Return how much better the score of a speed has to be than that of the mean speed."""
    cost = FOLLOW.difference_cost * abs(speed - mean)
    if abs(speed - mean) > FOLLOW.same_speed:
        cost += FOLLOW.speed_cost
        if speed < -FOLLOW.same_speed:
            cost += FOLLOW.reverse_cost
    return cost
