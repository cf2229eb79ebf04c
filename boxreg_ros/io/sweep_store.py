"""The points of all sweeps of a drive, in a temporary file."""

from __future__ import annotations

import mmap
from tempfile import TemporaryFile

from boxreg_ros.core.following.sweeps import ascending
from boxreg_ros.structures import Floats, Sweep
import numpy as np
from numpy.typing import NDArray

POINT = np.dtype((np.float32, 3))


class SweepStore:
    """The points of sweeps in a temporary file, in float32 relative to `origin` (3,) [m]."""

    def __init__(self) -> None:
        self.stamps_ns: list[int] = []
        self.origin: Floats | None = None
        self._origins: list[Floats] = []
        self._file = TemporaryFile()  # noqa: SIM115  closed with the store
        self._ends = [0]
        self._map: mmap.mmap | None = None

    def add(self, sweep: Sweep) -> None:
        """Add a sweep in the fixed frame that is later than those before."""
        if self.stamps_ns and sweep.stamp_ns <= self.stamps_ns[-1]:
            return
        points = sweep.in_frame().points
        if self.origin is None:
            self.origin = np.round(points[0]).astype(float) if len(points) else np.zeros(3)
        self.stamps_ns.append(sweep.stamp_ns)
        origin = sweep.origin if sweep.origins is None else np.full(3, np.nan)
        self._origins.append(origin - self.origin)
        relative = ascending((points - self.origin).astype(np.float32))
        self._file.write(relative.tobytes())
        self._ends.append(self._ends[-1] + len(relative))

    @property
    def sensor_origins(self) -> Floats:
        """Return the position of the sensor of each sweep, as the points; NaN for several."""
        return np.array(self._origins).reshape(-1, 3)

    def __len__(self) -> int:
        """Return the number of sweeps."""
        return len(self.stamps_ns)

    def __getitem__(self, row: int, /) -> NDArray[np.float32]:
        """Return the points (M, 3) of a sweep, ascending by x."""
        first, last = self._ends[row], self._ends[row + 1]
        if first == last:
            return np.zeros((0, 3), np.float32)
        if self._map is None or len(self._map) < last * POINT.itemsize:
            self._file.flush()
            self._map = mmap.mmap(self._file.fileno(), 0)
        return np.frombuffer(self._map, POINT, last - first, first * POINT.itemsize)
