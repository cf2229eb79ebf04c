"""Sweeps as the detector sees them: points above the ground, in grids around the sensor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from boxreg_ros.rotations import matrix_from_rpy, wrap_angle
from boxreg_ros.structures import (
    BOX_CENTER,
    BOX_EXTENT,
    Floats,
    LENGTH,
    ROLL,
    Sweep,
    WIDTH,
    X,
    Y,
    YAW,
    Z,
)  # fmt: skip
import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates, minimum_filter

CELL = 0.4
"""Side of a cell of the grid [m]; chosen: as large as the accuracy allows, for a CPU."""
STRIDE = 2
"""Cells of the grid along a cell of the heatmaps."""
REACH = 48.0
"""Half of the side of the grid around the sensor [m]."""
GROUND_CLEARANCE = 0.3
"""Points lower than this above the ground are left out [m]: recordings that hold the road around
true boxes alone must not show where these are."""
GROUND_CELL = 2.0
"""Side of the cells whose lowest points the ground is fitted to [m]."""
GROUND_SCALE = 0.1
"""Height above the ground at which the lowest point of a cell has weight 1/2 [m]."""
GROUND_SPREADS = (2.0, 10.0)
"""Standard deviations of the weights of cells around and farther away [cells]."""
FAR_WEIGHT = 0.01
"""Weight of the cells farther away, beside those around."""
MIN_WAY = 1.0
"""A sensor that moves less has the heading of the fixed frame [m]."""
GROUND_ITERATIONS = 10
SLICES = (0.7, 1.2, 1.8, 2.6)
"""Heights above the ground between which occupancy has a channel each [m]."""
CHANNELS = 6 + len(SLICES)
NUM_VALUES = 10
"""
Values of a box in a cell: offset in x and y, z, logarithms of its extents, sin and cos of twice
its yaw, which is accurate where front and rear are alike, and of yaw, for the sign.

"""


@dataclass(frozen=True, slots=True)
class Frame:
    """
    The points of a sweep above the ground, with x along the way of the sensor.

    Attributes
    ----------
    stamp_ns : int
        Of the sweep [ns].
    origin : array, shape (3,)
        Position of the sensor in the fixed frame [m].
    heading : float
        Direction of its way in the fixed frame [rad].
    points : array, shape (M, 3), float32
        x along and y across the way from the sensor, height above the ground [m].
    ground : array, shape (n, n)
        Of `ground_of` [m].

    """

    stamp_ns: int
    origin: Floats
    heading: float
    points: Floats
    ground: Floats

    def local(self, boxes: Floats) -> Floats:
        """Return boxes (n, 9) of the fixed frame, upright, as `points` are."""
        moved = boxes.copy()
        moved[:, BOX_CENTER] -= self.origin
        _, moved = turned(np.zeros((0, 3)), moved, -self.heading)
        moved[:, Z] -= ground_at(self.ground, moved[:, X], moved[:, Y])
        moved[:, ROLL:YAW] = 0
        return moved

    def fixed(self, boxes: Floats) -> Floats:
        """Return boxes (n, 9) from `local` in the fixed frame, upright."""
        moved = boxes.copy()
        moved[:, Z] += ground_at(self.ground, moved[:, X], moved[:, Y])
        _, moved = turned(np.zeros((0, 3)), moved, self.heading)
        moved[:, BOX_CENTER] += self.origin
        return moved


def frames_of(sweeps: Sequence[Sweep]) -> list[Frame]:
    """Return the points of the sweeps of a drive above the ground within `REACH`."""
    way = sweeps[-1].origin - sweeps[0].origin
    heading = float(np.arctan2(way[1], way[0])) if np.hypot(*way[:2]) > MIN_WAY else 0.0
    return [_frame_of(sweep, heading) for sweep in sweeps]


def _frame_of(sweep: Sweep, heading: float) -> Frame:
    points = sweep.in_frame().points - sweep.origin
    points, _ = turned(points.astype(np.float32), np.zeros((0, 9)), -heading)
    points = points[np.abs(points[:, :2]).max(axis=1) < REACH]
    ground = ground_of(points)
    height = points[:, 2] - ground_at(ground, points[:, 0], points[:, 1])
    raised = np.column_stack([points[:, :2], height])[height > GROUND_CLEARANCE]
    return Frame(sweep.stamp_ns, sweep.origin, heading, raised.astype(np.float32), ground)


def ground_of(points: Floats) -> Floats:
    """
    Return the height (n, n) of the ground in cells of `GROUND_CELL` around the sensor, y first.

    The weighted mean of the lowest points of the cells around, by iteratively reweighted least
    squares: a lowest point far above the ground is on an object, so its weight is that of a
    Cauchy function. Where cells around are empty, those farther away count.

    """
    size = round(2 * REACH / GROUND_CELL)
    column, row = np.floor((points[:, :2] + REACH) / GROUND_CELL).astype(np.int64).T
    lowest = np.full((size, size), np.inf)
    np.minimum.at(lowest, (row, column), points[:, 2])
    is_known = np.isfinite(lowest)
    ground = minimum_filter(lowest, 5)
    heights = np.where(is_known, lowest, 0.0)
    for _ in range(GROUND_ITERATIONS):
        above = np.where(is_known, np.maximum(heights - ground, 0), 0)
        weights = is_known / (1 + np.square(above / GROUND_SCALE))
        narrow, wide = (
            [gaussian_filter(values, spread) for values in (weights, weights * heights)]
            for spread in GROUND_SPREADS
        )
        far = wide[1] / np.maximum(wide[0], 1e-12)
        ground = (narrow[1] + FAR_WEIGHT * far) / (narrow[0] + FAR_WEIGHT)
    return ground


def ground_at(ground: Floats, x: Floats, y: Floats) -> Floats:
    """Return the height (n,) of the ground at x and y (n,) from the sensor [m]."""
    places = np.stack([y, x]) / GROUND_CELL + (len(ground) - 1) / 2
    return np.asarray(map_coordinates(ground, places, order=1, mode='nearest'))


def num_points(points: Floats, boxes: Floats, margin: float = 0.1) -> Floats:
    """Return how many of the points (M, 3) are in each box (n, 9), grown by `margin` [m]."""
    counts = np.zeros(len(boxes), np.int64)
    for i, box in enumerate(boxes):
        reach = np.hypot(box[LENGTH], box[WIDTH]) / 2 + margin
        near = points[(np.abs(points[:, :2] - box[:2]) < reach).all(axis=1)]
        offsets = np.abs((near - box[:3]) @ matrix_from_rpy(box[ROLL:]))
        counts[i] = (offsets < box[BOX_EXTENT] / 2 + margin).all(axis=1).sum()
    return counts


def turned(
    points: Floats, boxes: Floats, angle: float, is_mirrored: bool = False
) -> tuple[Floats, Floats]:
    """Return points (M, 3) and upright boxes (n, 9) turned about z, and mirrored in y before."""
    sign = -1.0 if is_mirrored else 1.0
    R = matrix_from_rpy(np.array([0, 0, angle])) @ np.diag([1, sign, 1])
    moved = boxes.copy()
    moved[:, BOX_CENTER] = boxes[:, BOX_CENTER] @ R.T
    moved[:, YAW] = wrap_angle(sign * boxes[:, YAW] + angle)
    return points @ R.T.astype(np.float32), moved


def grid_of(points: Floats, corner: Floats, size: int) -> Floats:
    """
    Return the channels (CHANNELS, size, size) of the cells from `corner` (2,) [m] on, y first.

    The logarithm of the number of points, their greatest, mean and least height, the mean of x
    and of y from the centre of the cell, and whether there are points in each of the slices.

    """
    place = (points[:, :2] - corner) / CELL
    inside = ((place >= 0) & (place < size)).all(axis=1)
    place, z = place[inside], points[inside, 2]
    column = place.astype(np.int64)
    cell = column[:, 1] * size + column[:, 0]
    count = np.bincount(cell, minlength=size * size)
    least = np.maximum(count, 1)
    high = np.zeros(size * size, np.float32)
    np.maximum.at(high, cell, z)
    low = np.full(size * size, np.inf, np.float32)
    np.minimum.at(low, cell, z)
    low[count == 0] = 0
    means = [
        np.bincount(cell, values, size * size) / least for values in (z, *(place - column - 0.5).T)
    ]
    channels = [np.log1p(count) / 2, high, means[0], low, *means[1:]]
    part = np.searchsorted(SLICES, z)
    for i in range(len(SLICES)):
        occupied = np.zeros(size * size, np.float32)
        occupied[cell[part == i]] = 1
        channels.append(occupied)
    return np.stack(channels).astype(np.float32).reshape(CHANNELS, size, size)
