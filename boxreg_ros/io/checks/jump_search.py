"""Steps in the motion of a sensor: corrections of a localisation, and what no vehicle does."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from math import inf

from boxreg_ros.io.transform_edge import Edge
from boxreg_ros.io.transform_tree import TransformTree
from boxreg_ros.io.transforms import inverse, matrix
from boxreg_ros.structures import Floats
import numpy as np

MIN_STEP = 0.15
"""
Smallest step between two samples of a transform that is a correction [m].

Chosen: the error of a detected centre is of this size, that of a localisation between corrections
a third of it.

"""
STEP_RADIUS = 20.0
"""Distance from the sensor at which a rotation counts as a step [m]; chosen: that of objects."""
MIN_STEP_ANGLE = MIN_STEP / STEP_RADIUS
"""Smallest turn between two samples that is one [rad]."""
MAX_EGO_SPEED = 100.0
"""Speed that no vehicle has [m/s]; derived: 360 km/h."""
MAX_EGO_ACCELERATION = 20.0
"""Acceleration that no vehicle has [m/s^2]; derived: tyres transmit that of gravity, and twice."""
MAX_EGO_YAW_ACCELERATION = 5.0
"""
Yaw acceleration that no vehicle has [rad/s^2].

Chosen: an evasive manoeuvre has 3, a robot that begins to turn on the spot 4.

"""
MIN_REVERSALS = 3
"""Steps in a row, each back along the one before it, that no vehicle makes; chosen."""


@dataclass(slots=True)
class FrameSteps:
    """Steps of the transform between two frames."""

    parent: str
    child: str
    unit: str = 'm'
    count: int = 0
    largest: float = 0.0
    """In metres, a rotation as the way at `STEP_RADIUS`; or rotations alone, in degrees."""
    first_ns: int = 0

    def add(self, step: float, stamp_ns: int) -> None:
        """Add a step [m] at a stamp [ns]."""
        self.first_ns = self.first_ns or stamp_ns
        self.count += 1
        self.largest = max(self.largest, step)

    def __str__(self) -> str:
        """Return number and size of the steps."""
        steps = f'{self.count} steps of up to' if self.count > 1 else 'a step of'
        return (
            f'{self.parent} -> {self.child} has {steps} {self.largest:.2f} {self.unit}, the '
            f'first at {self.first_ns} ns, as localisation makes them'
        )


@dataclass
class JumpSearch:
    """
    Search of corrections between a fixed frame and the frame that a sensor moves smoothly in.

    By REP 105 a localisation corrects ``map -> odom`` in steps, while ``odom`` is smooth. The
    lowest moving transform is the motion itself; those above it should not step.

    """

    steps: dict[tuple[str, str], FrameSteps] = field(default_factory=dict)
    """By parent and child, of the transforms that stepped."""
    alternations: dict[tuple[str, str], FrameSteps] = field(default_factory=dict)
    """Steps of the motion itself that no vehicle makes: too fast, or back and forth."""
    jumps: list[tuple[tuple[str, str, str], int, int, float]] = field(default_factory=list)
    """Steps of the motion itself after which it goes on as before, displaced, until `MotionCheck`
    takes them: of parent, child and unit, the stamps before and after them, and their size."""
    _seen_ns: dict[tuple[str, str], int] = field(default_factory=dict)
    _reversals: Counter[tuple[str, str]] = field(default_factory=Counter)
    """Steps back and forth up to the last sample."""

    def look(self, tree: TransformTree, fixed_frame: str, sensor_frame: str) -> None:
        """Add the samples that are new in `tree`, between both frames."""
        route = tree.route(fixed_frame, sensor_frame)
        moving = [edge for edge in route if not tree.is_constant(edge) and _moves(edge)]
        known_ns = inf  # up to which the motion below is known: localisation may be stamped ahead
        for number, edge in enumerate(moving):
            for row in self._new_rows(edge, known_ns):
                if number:
                    self._add_step(tree, edge, row, sensor_frame)
                else:
                    self._add_speed(edge, row)
                    self._add_jump(edge, row)
            known_ns = min(known_ns, edge.stamps[-1])

    def smooth_frame(self, tree: TransformTree, fixed_frame: str, sensor_frame: str) -> str:
        """Return the topmost frame on the way to the sensor that no transform below it steps."""
        for edge in tree.route(fixed_frame, sensor_frame):
            if (edge.parent, edge.child) in self.steps:
                return edge.child
        return fixed_frame

    def _new_rows(self, edge: Edge, until_ns: float) -> range:
        """Return the rows of samples after one before them, which were not looked at."""
        key = edge.parent, edge.child
        seen_ns = self._seen_ns.get(key, -1)
        first = 1 + int(np.searchsorted(edge.stamps[1:], seen_ns, 'right'))
        rows = range(first, int(np.searchsorted(edge.stamps, until_ns, 'right')))
        if rows:
            self._seen_ns[key] = edge.stamps[rows[-1]]
        return rows

    def _add_step(self, tree: TransformTree, edge: Edge, row: int, sensor_frame: str) -> None:
        """Compare a sample with the one before it, at the place of the sensor."""
        stamp_ns = edge.stamps[row]
        T_child_sensor = tree.find(edge.child, sensor_frame, stamp_ns)
        if T_child_sensor is None:
            return
        before, after = (matrix(pose) @ T_child_sensor for pose in edge.poses[row - 1 : row + 1])
        change = inverse(before) @ after
        cosine = np.clip((np.trace(change[:3, :3]) - 1) / 2, -1, 1)
        step = float(np.linalg.norm(change[:3, 3]) + np.arccos(cosine) * STEP_RADIUS)
        if step >= MIN_STEP:
            key = edge.parent, edge.child
            self.steps.setdefault(key, FrameSteps(*key)).add(step, stamp_ns)

    def _add_speed(self, edge: Edge, row: int) -> None:
        """Note two samples of the motion that lie too far apart, or go back and forth."""
        key = edge.parent, edge.child
        step = edge.poses[row][:3] - edge.poses[row - 1][:3]
        way = float(np.linalg.norm(step))
        seconds = (edge.stamps[row] - edge.stamps[row - 1]) * 1e-9
        before = edge.poses[row - 1][:3] - edge.poses[max(row - 2, 0)][:3]
        goes_back = min(way, float(np.linalg.norm(before))) >= MIN_STEP and step @ before < 0
        self._reversals[key] = self._reversals[key] + 1 if goes_back else 0
        is_too_fast = way > MIN_STEP and way > MAX_EGO_SPEED * seconds
        if is_too_fast or self._reversals[key] >= MIN_REVERSALS:
            self.alternations.setdefault(key, FrameSteps(*key)).add(way, edge.stamps[row])

    def _add_jump(self, edge: Edge, row: int) -> None:
        """
        Note a step of the motion that no acceleration explains, two samples before the newest one.

        With acceleration a, the velocity in the middle of five steps differs from their median by
        at most a times half of their time. A single wrong sample is a step there and one back.

        """
        if row < 5:
            return
        middle = edge.poses[row - 3 : row - 1]
        is_displaced, is_turned = _is_displaced(*middle), _is_turned(*middle)
        if not (is_displaced or is_turned):
            return
        stamps_ns = edge.stamps[row - 5 : row + 1]
        poses = np.array(edge.poses[row - 5 : row + 1])
        seconds = np.asarray(np.diff(stamps_ns) * 1e-9, float)
        jump, unit = 0.0, 'm'
        if is_displaced:
            steps = np.diff(poses[:, :3], axis=0)
            jump = _jump_of(steps, seconds, MIN_STEP, MAX_EGO_ACCELERATION)
        if is_turned and not jump:
            turns = _turns_between(poses[:, 3:])
            jump = np.degrees(_jump_of(turns, seconds, MIN_STEP_ANGLE, MAX_EGO_YAW_ACCELERATION))
            unit = 'degrees'
        if jump:
            key = edge.parent, edge.child, unit
            self.jumps.append((key, stamps_ns[2], stamps_ns[3], float(jump)))


def _is_displaced(one: Floats, other: Floats) -> bool:
    """Return whether two poses (7,) are as far apart as the smallest jump."""
    return bool(np.linalg.norm(other[:3] - one[:3]) > MIN_STEP)


def _is_turned(one: Floats, other: Floats) -> bool:
    """Return whether two poses (7,) are turned to each other by as much as the smallest jump."""
    first, second = one[3:], other[3:]
    cosine_squared = (first @ second) ** 2 / ((first @ first) * (second @ second))
    return bool(cosine_squared < np.cos(MIN_STEP_ANGLE / 2) ** 2)


def _jump_of(steps: Floats, seconds: Floats, least: float, acceleration: float) -> float:
    """Return how far the third of steps (5, 3) exceeds the motion around it; 0 if it may."""
    rate = np.sort(steps / seconds[:, None], axis=0)[2]  # their median
    steps = steps - rate * seconds[:, None]
    jump = steps[2]
    limit = max(least, acceleration * seconds[2] * seconds.sum() / 2)
    pairs = jump, jump + steps[1], jump + steps[3]
    is_jump = min(map(np.linalg.norm, pairs)) > limit
    return float(np.linalg.norm(jump)) if is_jump else 0.0


def _turns_between(quaternions_xyzw: Floats) -> Floats:
    """Return the rotations (n - 1, 3) [rad] from each of n quaternions to the next one."""
    unit = quaternions_xyzw / np.linalg.norm(quaternions_xyzw, axis=1, keepdims=True)
    (v, w), (v2, w2) = ((q[:, :3], q[:, 3:]) for q in (unit[:-1], unit[1:]))
    axes = w * v2 - w2 * v - np.cross(v, v2)
    cosines = (unit[:-1] * unit[1:]).sum(axis=1, keepdims=True)
    sines = np.linalg.norm(axes, axis=1, keepdims=True)
    angles = 2 * np.arctan2(sines, np.abs(cosines)) * np.sign(cosines)
    turns: Floats = axes / np.maximum(sines, np.finfo(float).tiny) * angles
    return turns


def _moves(edge: Edge) -> bool:
    """Return whether poses differ: publishers of ROS 1 repeat static ones on /tf."""
    poses = edge.poses  # empty where all samples were unset
    return len(poses) > 0 and not np.array_equal(poses[0], poses[-1])
