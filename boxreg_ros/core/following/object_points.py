"""The points of one object in the sweeps, and their fit to its surface."""

from __future__ import annotations

from collections.abc import Sequence

from boxreg_ros.core.following.sweeps import Sweeps
from boxreg_ros.core.method import sweep_fit
from boxreg_ros.core.method.sweep_fit import Registered, Target
from boxreg_ros.core.method.turn_rate import State
from boxreg_ros.rotations import matrix_from_rpy
from boxreg_ros.structures import BOX_EXTENT, Floats, Ints, ROLL
import numpy as np


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


class ObjectPoints:
    """
    Points of `sweeps` near one object, but those in the boxes of others.

    `owned` are the boxes of other objects; those of `same` have a seed in one of this object.
    `target` is the surface of the object.

    """

    def __init__(self, sweeps: Sweeps, owned: Owned, same: Sequence[int], target: Target) -> None:
        self.sweeps = sweeps
        self.owned = owned
        self.target = target
        self._same = np.array(same, np.float64)

    def near(self, row: int, pose: Floats, margin: float = 0.0) -> Floats:
        """Return the points (n, 3) around a pose that are not in the box of another object."""
        near: Floats = sweep_fit.near(
            self.sweeps.points[row], pose, self.target.half, margin, self.owned[row], self._same
        )
        return near

    def in_box(self, points: Floats, pose: Floats, margin: float) -> Floats:
        """Return those of points (n, 3) in the box at a pose, larger by a margin [m]."""
        found: Floats = sweep_fit.in_box(points, pose, self.target, margin)
        return found

    def score(self, row: int, pose: Floats) -> float:
        """Return how well the points of a sweep fit a pose, see `Fit`."""
        return float(sweep_fit.score(self.near(row, pose), pose, self.target))

    def fitted(self, row: int, state: State, steps: int) -> Registered:
        """Return the pose in a sweep from one start."""
        points = self.near(row, state.pose)
        found: Registered = sweep_fit.fitted(points, state, self.target, steps)
        return found
