"""Sweeps that objects are followed through."""

from __future__ import annotations

from typing import NamedTuple, Protocol

from boxreg_ros.structures import Ints
import numpy as np
from numpy.typing import NDArray


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
