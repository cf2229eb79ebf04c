"""A box for an object that a person points at: its points, their shape, and the class by size."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from boxreg_ros.core.l_shape import closest_heading, completed, span, turned
from boxreg_ros.errors import RecordingError
from boxreg_ros.structures import Floats
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

FIT_REACH = 9.0
"""Points up to this far from the place are looked at [m]; chosen: half an articulated bus."""
FIT_CELL = 0.25
"""Points in touching cells of this size are of one object [m]; chosen: cars park farther apart."""
ROAD_CELL = 1.5
"""The lowest point of a cell of this size is of the road [m]; chosen."""
FIT_CLEARANCE = 0.25
"""Points so far above the road are of objects [m]; chosen: curbs are lower."""
PLANE_STEPS = 8
"""Times that cells above the plane of the road are left out; chosen: it no longer changes."""
MIN_ROAD_CELLS = 6
"""Fewer cells do not show the slope of the road."""
MAX_HEIGHT = 4.5
"""Points higher above the road are of bridges and trees [m]."""
MAX_AWAY = 1.5
"""An object is not farther from the place that a person points at [m]; chosen."""
MIN_POINTS = 5
"""Fewer points do not show the shape of an object."""
ANGLES = np.radians(np.arange(0, 90, 1.5))
"""Headings that are tried [rad]."""
MISSING = np.array([0.3, 0.5, 0.7])
"""Weights of length, width and height that are not seen; chosen: the width is seen more often."""
DRAWN_STRIP = 0.6, 1.3
"""Points up to half a length from the line that a person draws are of the object, within these
bounds [m]; chosen: half a pedestrian with its arms, half a truck."""
DRAWN_QUANTILE = 0.98
"""Of width and height; chosen: one point in fifty may be of something else."""
DRAWN_RANGE = (0.8, 0.8), (1.3, 1.6)
"""Least and largest width and height of an object, in parts of those usual for its class; chosen:
a van is a car half as high again."""
USUAL_EXTENTS = {
    'car': np.array([4.5, 1.9, 1.6]),
    'truck': np.array([8.0, 2.6, 3.2]),
    'bus': np.array([11.5, 2.6, 3.2]),
    'cyclist': np.array([1.8, 0.7, 1.7]),
    'pedestrian': np.array([0.7, 0.7, 1.7]),
}
"""Length, width and height of classes that a drive has no track of [m]; chosen: mid-sizes."""


class Fitted(NamedTuple):
    """A box (9,) [m, rad], the class whose size is nearest, and the points of the object."""

    box: Floats
    class_name: str
    num_points: int


def fitted(
    points: NDArray[np.floating],
    place: Floats,
    sensor: Floats,
    heading: float,
    extents: Mapping[str, Floats],
) -> Fitted:
    """
    Return the box of the object at a place that a person points at.

    The points around it that are above the road and touch each other are the object. The heading
    is that whose sides are nearest to the points (the closeness of L-shapes). Sides that the
    sensor does not see are completed by the size of the class. Fewer than `MIN_POINTS` points get
    a box of the usual size around their middle, of the first class.

    Parameters
    ----------
    points : array, shape (M, 3)
        Of a sweep, z up [m].
    place : array, shape (2,)
        x and y, in the frame of the points [m].
    sensor : array, shape (2,)
        x and y of the sensor [m].
    heading : float
        Of the sensor [rad]; of both directions of the box the one that is nearer to it is taken.
    extents : mapping of str to array, shape (3,)
        Length, width and height by class [m]; if empty, `USUAL_EXTENTS`.

    Returns
    -------
    found : Fitted
        Box in the frame of the points, class and number of points.

    Raises
    ------
    RecordingError
        If there is no point of an object at the place.

    """
    near = points[(np.abs(points[:, :2] - place) < FIT_REACH).all(1)].astype(np.float64)
    road = _road_below(near)
    height = near[:, 2] - road
    near, road = (a[(height > FIT_CLEARANCE) & (height < MAX_HEIGHT)] for a in (near, road))
    own = _touching(near[:, :2], place)
    if not own.any():
        raise RecordingError(
            f'place: expected points of an object above the road, got none within '
            f'{MAX_AWAY:g} m of it; point at its points, or drag from its rear to its front'
        )
    cluster, bottom = near[own], float(np.median(road[own]))
    if len(cluster) < MIN_POINTS:
        class_name, usual = next(iter((extents or USUAL_EXTENTS).items()))
        center = cluster[:, :2].mean(0)
        pose = [*center, bottom + usual[2] / 2, *usual, 0, 0, heading]
        return Fitted(np.array(pose), class_name, len(cluster))
    yaw, class_name, usual = _shape(cluster, bottom, extents or USUAL_EXTENTS)
    if np.cos(yaw - heading) < 0:
        yaw += np.pi
    center, sides = completed(cluster[:, :2], yaw, sensor, usual[:2])
    height = max(cluster[:, 2].max() - bottom, usual[2])
    angle = float(np.arctan2(np.sin(yaw), np.cos(yaw)))
    box = np.array([*center, bottom + height / 2, *sides, height, 0, 0, angle])
    return Fitted(box, class_name, int(own.sum()))


def drawn(
    points: NDArray[np.floating],
    rear: Floats,
    front: Floats,
    extents: Mapping[str, Floats],
) -> Fitted:
    """
    Return the box that a person draws from the middle of its rear to that of its front.

    The class is that whose length and height are nearest. Width and height are those of the
    points inside, within `DRAWN_RANGE` of the class; of fewer than `MIN_POINTS` the width is that
    of the class.

    Parameters
    ----------
    points : array, shape (M, 3)
        Of a sweep, z up [m].
    rear, front : array, shape (2,)
        x and y, in the frame of the points [m].
    extents : mapping of str to array, shape (3,)
        Length, width and height by class [m]; at least one class.

    Returns
    -------
    found : Fitted
        Box in the frame of the points, class and number of points.

    """
    along = front - rear
    length, yaw = float(np.linalg.norm(along)), float(np.arctan2(along[1], along[0]))
    middle = (rear + front) / 2
    is_near = (np.abs(points[:, :2] - middle) < FIT_REACH + length / 2).all(1)
    near = points[is_near].astype(np.float64)
    road = _road_below(near)
    local = turned(near[:, :2] - middle, -yaw)
    beside = np.hypot(*(np.abs(local) - [length / 2, 0]).clip(0).T)
    bottom = float(road[beside.argmin()]) if len(near) else 0.0
    height = near[:, 2] - road
    is_object = (height > FIT_CLEARANCE) & (height < MAX_HEIGHT)
    is_along = is_object & (np.abs(local[:, 0]) < length / 2)
    strip = np.clip(length / 2, *DRAWN_STRIP)
    top = _top_of(height[is_along & (np.abs(local[:, 1]) < strip)])

    def cost(usual: Floats) -> float:
        ratios = np.log([length / usual[0], (top or usual[2]) / usual[2]])
        return float(np.abs(ratios).sum())

    class_name, usual = min(extents.items(), key=lambda one: cost(one[1]))
    (narrow, wide), (low, high) = (np.array(DRAWN_RANGE).T * usual[1:, None]).tolist()
    is_inside = is_along & (np.abs(local[:, 1]) < wide / 2)
    own = np.abs(local[is_inside, 1])
    width = usual[1]
    if len(own) >= MIN_POINTS:
        width = np.clip(2 * np.quantile(own, DRAWN_QUANTILE), narrow, wide)
    tall = min(top, high) if top > low else usual[2]  # the top of others is not seen
    box = np.array([*middle, bottom + tall / 2, length, width, tall, 0, 0, yaw])
    return Fitted(box, class_name, int(is_inside.sum()))


def _top_of(heights: Floats) -> float:
    """Return the height of an object by those of its points (M,) [m]; 0 for too few of them."""
    return float(np.quantile(heights, DRAWN_QUANTILE)) if len(heights) >= MIN_POINTS else 0.0


def _road_below(points: Floats) -> Floats:
    """
    Return the height of the road below each point (M,).

    It is the lowest point of the cells around, or the plane of the lowest points of all cells
    where that is clearly lower: beside the sensor the road below an object is not seen.

    """
    if not len(points):
        return np.zeros(0)
    cells = ((points[:, :2] - points[:, :2].min(0)) / ROAD_CELL).astype(int)
    lowest = np.full(cells.max(0) + 1, np.inf)
    np.minimum.at(lowest, tuple(cells.T), points[:, 2])
    around = ndimage.minimum_filter(lowest, 3, mode='nearest')[tuple(cells.T)]
    plane = _plane(lowest, cells)
    return np.where(around - plane > FIT_CLEARANCE, plane, around)


def _plane(lowest: Floats, cells: NDArray[np.int64]) -> Floats:
    """Return the height at cells (M, 2) of the plane of the road, by the lowest points (n, m)."""
    known = np.argwhere(np.isfinite(lowest))
    heights = lowest[tuple(known.T)]
    is_road = np.ones(len(heights), bool)
    design = np.column_stack([known, np.ones(len(known))])
    plane = np.array([0, 0, heights.min()])
    for _ in range(PLANE_STEPS):
        if is_road.sum() < MIN_ROAD_CELLS:
            break
        plane = np.linalg.lstsq(design[is_road], heights[is_road], rcond=None)[0]
        is_road = heights - design @ plane < FIT_CLEARANCE
    return np.asarray(cells @ plane[:2] + plane[2])


def _touching(points: Floats, place: Floats) -> NDArray[np.bool_]:
    """Return which points (M, 2) are of the object nearest to a place."""
    if not len(points):
        return np.zeros(0, bool)
    cells = ((points - points.min(0)) / FIT_CELL).astype(int)
    is_filled = np.zeros(cells.max(0) + 1, bool)
    is_filled[tuple(cells.T)] = True
    labels, _ = ndimage.label(is_filled, np.ones((3, 3)))
    label = labels[tuple(cells.T)]
    away = np.linalg.norm(points - place, axis=1)
    nearest = int(away.argmin())
    return np.asarray((label == label[nearest]) & (away[nearest] < MAX_AWAY))


def _shape(
    cluster: Floats, bottom: float, extents: Mapping[str, Floats]
) -> tuple[float, str, Floats]:
    """
    Return heading, class and usual extents (3,) that agree best with the points (M, 3).

    What is seen beyond the size of a class speaks against it; that less is seen hardly does, but
    the height, and one of length and width, are nearly always seen.

    """
    found = []
    first = closest_heading(cluster[:, :2], ANGLES)
    for yaw in (first, first + np.pi / 2):
        low, high = span(cluster[:, :2], yaw)
        size = np.append(high - low, cluster[:, 2].max() - bottom)
        for name, usual in extents.items():
            ratio = np.log(size.clip(0.1) / usual)
            cost = (np.maximum(ratio, 0) * 2 - np.minimum(ratio, 0) * MISSING).sum()
            found.append((float(cost), yaw, name, usual))
    _, yaw, name, usual = min(found, key=lambda one: one[0])
    return yaw, name, usual
