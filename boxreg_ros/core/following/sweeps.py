"""Sweeps that objects are followed through."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple, Protocol, Self

from boxreg_ros.core.following.kernels import free_space
from boxreg_ros.structures import Floats, Ints
import numpy as np
from numpy.typing import NDArray

KEPT_SWEEPS = 64
"""Sweeps whose order by azimuth is kept; chosen: 50 MB for clouds of 200,000 points."""


class Points(Protocol):
    """The points (M, 3) of each sweep, ascending by x."""

    def __getitem__(self, row: int, /) -> NDArray[np.floating]:
        """Return the points of a sweep."""


class Times(Protocol):
    """Times of sweeps."""

    def __getitem__(self, row: int, /) -> float:
        """Return that of a sweep [s]."""


class Sweeps(NamedTuple):
    """Times of sweeps [s], and their points, all in one frame; rows `first` to `stop` - 1."""

    times: Times
    points: Points
    stop: int
    first: int = 0
    origins: Floats | None = None
    """Positions of the sensor by row (S, 3), NaN if unknown [m]."""
    by_azimuth: Callable[[int], tuple[Ints, Ints]] | None = None
    """As of `free_space.by_azimuth`, of a sweep by its row; None without positions."""

    @classmethod
    def of_drive(cls, times: Floats, points: Points, origins: Floats | None) -> Self:
        """Return all sweeps of a drive."""
        if origins is None:
            return cls(times, points, len(times))

        @lru_cache(KEPT_SWEEPS)
        def by_azimuth(row: int) -> tuple[Ints, Ints]:
            found: tuple[Ints, Ints] = free_space.by_azimuth(points[row], origins[row])
            return found

        return cls(times, points, len(times), 0, origins, by_azimuth)

    def has(self, row: int) -> bool:
        """Return whether there is such a row."""
        return self.first <= row < self.stop


def ascending(points: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return finite points (M, 3), ascending by x."""
    points = points[np.isfinite(points).all(1)]
    return np.ascontiguousarray(points[np.argsort(points[:, 0])])


def nearest(stamps_ns: Ints, stamp_ns: int) -> tuple[int, int, float]:
    """Return the row of the nearest stamp, its distance, and the period there [ns]."""
    if not len(stamps_ns):
        return 0, 1, 0.0
    away = np.abs(stamps_ns - stamp_ns)
    row = int(away.argmin())
    steps = np.diff(stamps_ns[max(0, row - 1) : row + 2])
    return row, int(away[row]), float(steps.max(initial=0)) or 1e8
