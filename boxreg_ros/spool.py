"""Clouds on their way to label files, on disk: the boxes of a cloud may be ready much later."""

from __future__ import annotations

from bisect import bisect_left, insort
from pathlib import Path

from boxreg_ros.structures import Floats, Sweep
from boxreg_ros.transforms import inverse, sweep_to_frame
import numpy as np


class Spool:
    """
    Sweeps in the sensor's frame, each a file until nothing can ask for it any more.

    Parameters
    ----------
    folder : Path
        Made here; what is left in it is the caller's to remove.
    tolerance_ns : int
        A cloud belongs to boxes within this [ns].

    """

    def __init__(self, folder: Path, tolerance_ns: int) -> None:
        self._folder = folder
        self._tolerance_ns = tolerance_ns
        self._poses: dict[int, Floats] = {}
        self._stamps: list[int] = []
        folder.mkdir()

    def add(self, sweep: Sweep, T_fixed_sensor: Floats) -> None:
        """Store a sweep with the pose of its sensor; of one stamp, the first."""
        if sweep.stamp_ns not in self._poses:
            insort(self._stamps, sweep.stamp_ns)
            self._poses[sweep.stamp_ns] = T_fixed_sensor
            np.save(self._file(sweep.stamp_ns), sweep.points)

    def take(self, stamp_ns: int, frame_id: str, T_fixed_sensor: Floats) -> Sweep | None:
        """
        Return the cloud nearest to a stamp, as seen from where the sensor was at that stamp.

        Clouds that are older are removed. None if there is none within the tolerance.

        """
        first = bisect_left(self._stamps, stamp_ns - self._tolerance_ns)
        for old in self._stamps[:first]:
            self._file(old).unlink()
            del self._poses[old]
        del self._stamps[:first]
        nearest = min(self._stamps, key=lambda stamp: abs(stamp - stamp_ns), default=None)
        if nearest is None or abs(nearest - stamp_ns) > self._tolerance_ns:
            return None
        sweep = Sweep(nearest, frame_id, np.load(self._file(nearest)))
        if nearest == stamp_ns:
            return sweep
        return sweep_to_frame(sweep, inverse(T_fixed_sensor) @ self._poses[nearest], frame_id)

    def _file(self, stamp_ns: int) -> Path:
        return self._folder / f'{stamp_ns}.npy'
