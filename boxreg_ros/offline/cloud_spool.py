"""Clouds on their way to label files, on disk: the boxes of a cloud may be ready much later."""

from __future__ import annotations

from bisect import bisect_left, insort
from pathlib import Path
import shutil

from boxreg_ros.config import Config
from boxreg_ros.io.transforms import inverse, sweep_to_frame
from boxreg_ros.structures import Floats, Sweep
import numpy as np


class Spool:
    """
    Sweeps in their own frame, each a file until nothing can ask for it any more.

    Parameters
    ----------
    folder : Path
        Of results; the clouds are in a folder of their own in it, until `remove`.
    config : Config
        Tells how far off boxes a cloud may be that is theirs, as for the registrar.

    """

    def __init__(self, folder: Path, config: Config) -> None:
        self._folder = folder / '.clouds'
        self._reach_ns = round(max(config.reach, config.tolerance) * 1e9)
        self._poses: dict[int, tuple[str, Floats]] = {}
        self._stamps: list[int] = []
        self._folder.mkdir()

    def add(self, sweep: Sweep, T_fixed_sweep: Floats, intensities: Floats | None = None) -> None:
        """Store a sweep with the pose of its frame; of one stamp, the first."""
        if sweep.stamp_ns not in self._poses:
            insort(self._stamps, sweep.stamp_ns)
            self._poses[sweep.stamp_ns] = sweep.frame_id, T_fixed_sweep
            columns = [sweep.points]
            if intensities is not None:
                columns.append(intensities[:, None])
            table = np.hstack(columns, dtype=sweep.points.dtype, casting='same_kind')
            np.save(self._file(sweep.stamp_ns), table)

    def take(
        self, stamp_ns: int, frame_id: str, T_fixed_frame: Floats
    ) -> tuple[Sweep | None, Floats | None]:
        """
        Return the cloud nearest to a stamp, in a frame as that was at the stamp.

        Its intensities come with it. Clouds that are older are removed. None if there is none
        within reach.

        """
        first = bisect_left(self._stamps, stamp_ns - self._reach_ns)
        for old in self._stamps[:first]:
            self._file(old).unlink()
            del self._poses[old]
        del self._stamps[:first]
        nearest = min(self._stamps, key=lambda stamp: abs(stamp - stamp_ns), default=None)
        if nearest is None or abs(nearest - stamp_ns) > self._reach_ns:
            return None, None
        own_frame, T_fixed_sweep = self._poses[nearest]
        table = np.load(self._file(nearest))
        intensities = table[:, 3] if table.shape[1] > 3 else None
        sweep = Sweep(nearest, own_frame, table[:, :3])
        if (nearest, own_frame) != (stamp_ns, frame_id):
            sweep = sweep_to_frame(sweep, inverse(T_fixed_frame) @ T_fixed_sweep, frame_id)
        return sweep, intensities

    def remove(self) -> None:
        """Remove all that is left."""
        shutil.rmtree(self._folder)

    def _file(self, stamp_ns: int) -> Path:
        return self._folder / f'{stamp_ns}.npy'
