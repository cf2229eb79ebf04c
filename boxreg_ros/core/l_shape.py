"""
The rectangle of an object by its points, which lie on two of its sides.

Zhang et al., Efficient L-Shape Fitting for Vehicle Detection Using Laser Scanners, IV 2017: the
rectangle whose sides are nearest to the points (closeness criterion).

"""

from boxreg_ros.structures import Floats
import numpy as np

LEAST_DISTANCE = 0.05
"""Distances to a side below this count the same [m]: range noise."""


def closest_heading(points: Floats, yaws: Floats) -> float:
    """
    Return the heading whose rectangle has its sides nearest to the points.

    Parameters
    ----------
    points : array, shape (M, 2)
        At least one, from above [m].
    yaws : array, shape (n,)
        Headings that are tried, of a quarter turn [rad].

    Returns
    -------
    yaw : float
        One of them.

    """
    cos, sin = np.cos(yaws), np.sin(yaws)
    along, across = points @ np.stack([cos, sin]), points @ np.stack([-sin, cos])  # (M, n)
    to_sides = np.minimum.reduce(
        [
            along - along.min(0),
            along.max(0) - along,
            across - across.min(0),
            across.max(0) - across,
        ]
    )
    return float(yaws[(1 / np.maximum(to_sides, LEAST_DISTANCE)).sum(0).argmax()])


def turned(points: Floats, yaw: float) -> Floats:
    """Return points (..., 2) turned by an angle [rad]."""
    cos, sin = np.cos(yaw), np.sin(yaw)
    return np.asarray(points @ np.array([[cos, sin], [-sin, cos]]))


def span(points: Floats, yaw: float) -> tuple[Floats, Floats]:
    """Return the least and the largest coordinates (2,) of points along the axes of a heading."""
    local = turned(points, -yaw)
    return local.min(0), local.max(0)


def completed(points: Floats, yaw: float, sensor: Floats, usual: Floats) -> tuple[Floats, Floats]:
    """
    Return the rectangle of points along the axes of a heading.

    Parameters
    ----------
    points : array, shape (M, 2)
        M > 0 [m].
    yaw : float
        The heading [rad].
    sensor : array, shape (2,)
        Its position [m].
    usual : array, shape (2,)
        Usual length and width [m]. Sides that are shorter grow away from the sensor.

    Returns
    -------
    center : array, shape (2,)
        [m].
    sides : array, shape (2,)
        Along the heading and across it [m].

    """
    low, high = span(points, yaw)
    sides = np.maximum(high - low, usual)
    # Of each axis, the side on the side of the sensor is seen.
    is_low_seen = turned(sensor, -yaw) < (low + high) / 2
    low = np.where(is_low_seen, low, high - sides)
    return turned(low + sides / 2, yaw), sides
