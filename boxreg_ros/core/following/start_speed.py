"""The speed of an object at a seed, where a way along it starts."""

from __future__ import annotations

from typing import NamedTuple

from boxreg_ros.core.following.motion_kinds import MotionModel
from boxreg_ros.core.following.object_points import ObjectPoints
from boxreg_ros.core.following.person import ANGLE, POSITION
from boxreg_ros.core.method import turn_rate
from boxreg_ros.core.method.follow_numbers import FOLLOW
from boxreg_ros.core.method.turn_rate import State
from boxreg_ros.structures import Floats, Ints, YAW
import numpy as np

POSE4 = [0, 1, 2, YAW]
"""Columns of a box that are followed; roll and pitch are those of the seed."""
SEED = np.diag([*[POSITION] * 3, ANGLE, 1.0, 0.1]) ** 2
"""Covariance of the state at a seed, with speed [m/s] and turn rate [rad/s]; chosen."""
START = np.diag([*[FOLLOW.around] * 2, 0.1, 0.05, 1.0, 1.0]) ** 2
"""Covariance of the starts of a search for the speed [m, rad]; chosen."""


class Seeds(NamedTuple):
    """Boxes (N, 9) of a person in the sweeps `rows` (N,), ascending."""

    rows: Ints
    boxes: Floats


class StartSpeeds:
    """
    Speeds at seeds, each estimated once.

    By the neighbours of a seed in time where they are near, else by a search for the speed by
    which the sweeps around it fit best, up to `max_speed` [m/s].

    """

    def __init__(
        self, points: ObjectPoints, seeds: Seeds, motion: MotionModel, max_speed: float
    ) -> None:
        self._points = points
        self._seeds = seeds
        self._motion = motion
        self._max_speed = max_speed
        self._known: dict[int, float] = {}

    def at(self, seed: int) -> float:
        """Return the speed at a seed [m/s]."""
        if seed not in self._known:
            self._known[seed] = self._of(seed)
        return self._known[seed]

    def _of(self, seed: int) -> float:
        """Return the speed at a seed [m/s]: by its neighbours in time, or searched."""
        rows = self._seeds.rows
        times = self._points.sweeps.times
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
        times = self._points.sweeps.times
        around = [other for other in (row - 1, row + 1) if self._points.sweeps.has(other)]
        if not around:
            return 0.0
        period = max(abs(times[other] - times[row]) for other in around)
        step = min(FOLLOW.max_speed_step, FOLLOW.start_shift / period)
        count = int(self._max_speed / step)
        speeds = step * np.arange(-count // FOLLOW.forward_over_reverse, count + 1)
        forward = np.array([np.cos(pose[3]), np.sin(pose[3]), 0.0, 0.0])
        scores = np.zeros(len(speeds))
        for i, speed in enumerate(speeds):
            for other in around:
                start = pose + speed * (times[other] - times[row]) * forward
                state = State(np.array([*start, speed, 0.0]), START)
                scores[i] += self._points.fitted(other, state, FOLLOW.start_iterations).fit.score
            scores[i] = scores[i] / len(around) - _cost(speed, mean)
        likely = speeds[np.argsort(-scores, kind='stable')[: FOLLOW.speeds_tested]]
        tested = [self._tested_speed(row, pose, speed, mean) for speed in likely]
        return max(tested)[1]

    def _tested_speed(
        self, row: int, pose: Floats, speed: float, mean: float
    ) -> tuple[float, float]:
        """Return the score of a start speed over several sweeps, and the speed by them."""
        times = self._points.sweeps.times
        total, weights = 0.0, 1e-9
        found_speeds = []
        for sign in (1, -1):
            state = at_seed(pose, speed)
            for count in range(1, FOLLOW.search_sweeps + 1):
                other = row + sign * count
                if not self._points.sweeps.has(other):
                    break
                state = self._motion.predicted(state, times[other] - times[other - sign])
                found = self._points.fitted(other, state, FOLLOW.test_iterations)
                total += found.rank / count
                weights += 1 / count
                state = turn_rate.update(state, found.pose, found.covariance)
            found_speeds.append(state.speed)
        return total / weights - _cost(speed, mean), float(np.mean(found_speeds))


def at_seed(pose: Floats, speed: float) -> State:
    """Return the state at a seed (4,)."""
    return State(np.array([*pose, speed, 0.0]), SEED)


def _cost(speed: float, mean: float) -> float:
    """Return how much better the score of a speed has to be than that of the mean speed."""
    cost = FOLLOW.difference_cost * abs(speed - mean)
    if abs(speed - mean) > FOLLOW.same_speed:
        cost += FOLLOW.speed_cost
        if speed < -FOLLOW.same_speed:
            cost += FOLLOW.reverse_cost
    return cost
