"""Sweeps that objects are followed through."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple, Protocol

from boxreg_ros.core.method.follow_numbers import FOLLOW
from boxreg_ros.structures import finite_points, Floats, Ints
import numpy as np
from numpy.typing import NDArray

USUAL_PERIOD_NS = 1e8
"""Period of a single sweep [ns]; that of most LiDARs."""


class Points(Protocol):
    """The points (M, 3) of each sweep, ascending by x."""

    def __getitem__(self, row: int, /) -> NDArray[np.floating]:
        """Return the points of a sweep."""


Times = Floats | dict[int, float]
"""Times of sweeps by their rows [s]."""


class SightLimits:
    """
    How far up the sensor sees in each sweep: by its steepest point.

    `origins` (n, 3) are its positions in the frame of the points, NaN if unknown [m].

    """

    def __init__(self, points: Points, origins: Floats) -> None:
        self._points = points
        self._origins = origins
        self._slopes: dict[int, float] = {}

    def height(self, row: int, place: Floats, radius: float) -> float:
        """Return how high it sees all around a place (3,), NaN without its position [m]."""
        origin = self._origins[row]
        if row not in self._slopes:
            steps = self._points[row] - origin
            away = np.hypot(steps[:, 0], steps[:, 1])
            slopes = steps[away > FOLLOW.min_distance, 2] / away[away > FOLLOW.min_distance]
            self._slopes[row] = float(slopes.max(initial=-np.inf))
        away = float(np.hypot(*(place[:2] - origin[:2])))
        slope = self._slopes[row]
        return float(origin[2] + slope * (away - radius if slope > 0 else away + radius))


class Sweeps(NamedTuple):
    """Times of sweeps [s], and their points, all in one frame; rows `first` to `stop` - 1."""

    times: Times
    points: Points
    stop: int
    first: int = 0
    sight_limits: SightLimits | None = None
    """None where it is not known how far up the sensor sees."""

    def has(self, row: int) -> bool:
        """Return whether there is such a row."""
        return self.first <= row < self.stop


def ascending(points: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return finite points (M, 3), ascending by x."""
    points = finite_points(points)
    return points.take(np.argsort(points[:, 0]), 0)


def nearest(stamps_ns: Ints, stamp_ns: int) -> tuple[int, int, float]:
    """Return the row of the nearest stamp, its distance, and the period there [ns]."""
    if not len(stamps_ns):
        return 0, 1, 0.0
    away = np.abs(stamps_ns - stamp_ns)
    row = int(away.argmin())
    steps = [later - at for at, later in pairwise(stamps_ns[max(0, row - 1) : row + 2].tolist())]
    return row, int(away[row]), float(max(steps, default=0)) or USUAL_PERIOD_NS
