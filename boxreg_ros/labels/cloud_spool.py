"""Clouds kept on disk until the boxes of their stamp are final and their files are written."""

from __future__ import annotations

from bisect import bisect_left, insort
from dataclasses import replace
from pathlib import Path
import pickle
import shutil

from boxreg_ros.config import Config
from boxreg_ros.io.transforms import inverse, sweep_to_frame
from boxreg_ros.labels.protocol import LabelFrame
from boxreg_ros.structures import Floats, Sweep

FOLDER = '.clouds'


class Spool:
    """
    Store sweeps in their own frame, one file each, until no box array can need them.

    They lie in a hidden folder inside the folder of results until `remove`. `config` gives the
    maximum time offset between boxes and their cloud, as for the registrar.

    """

    def __init__(self, folder: Path, config: Config) -> None:
        self._folder = folder / FOLDER
        self._max_offset_ns = round(config.reach * 1e9)
        self._stamps: list[int] = []  # ascending
        self._folder.mkdir()

    def add(self, sweep: Sweep, T_fixed_sweep: Floats, intensities: Floats | None = None) -> None:
        """
        Store a sweep; a second one of the same stamp is ignored.

        Parameters
        ----------
        sweep : Sweep
            In its own frame.
        T_fixed_sweep : array, shape (4, 4)
            Pose of that frame at the stamp of the sweep.
        intensities : array, shape (M,), or None
            Of its points, in the unit of the sensor.

        """
        stamp_ns = sweep.stamp_ns
        if stamp_ns in self._stamps:
            return
        insort(self._stamps, stamp_ns)
        own = Sweep(stamp_ns, sweep.frame_id, sweep.points, sweep.times)
        self._file(stamp_ns).write_bytes(pickle.dumps((own, T_fixed_sweep, intensities), 5))

    def with_cloud(self, frame: LabelFrame) -> LabelFrame:
        """
        Return a frame with the cloud nearest to its stamp, and delete those too old for it.

        Parameters
        ----------
        frame : LabelFrame
            Of a stamp that is not smaller than in the call before.

        Returns
        -------
        frame : LabelFrame
            Itself if the pose of its sensor is not known, or no cloud lies within the maximum time
            offset. The cloud keeps its own stamp, and is in the frame of the sensor at that of
            the boxes.

        """
        if frame.T_fixed_sensor is None:
            return frame
        stamp_ns = frame.refined.boxes.stamp_ns
        self._delete_before(stamp_ns)
        nearest = min(self._stamps, key=lambda stamp: abs(stamp - stamp_ns), default=None)
        if nearest is None or abs(nearest - stamp_ns) > self._max_offset_ns:
            return frame
        sweep, T_fixed_sweep, intensities = pickle.loads(self._file(nearest).read_bytes())
        if (nearest, sweep.frame_id) != (stamp_ns, frame.sensor_frame):
            T_frame_sweep = inverse(frame.T_fixed_sensor) @ T_fixed_sweep
            sweep = sweep_to_frame(sweep, T_frame_sweep, frame.sensor_frame).in_frame()
        return replace(frame, sweep=sweep, intensities=intensities)

    def remove(self) -> None:
        """Delete the folder with the clouds that are left."""
        shutil.rmtree(self._folder)

    def _delete_before(self, stamp_ns: int) -> None:
        """Delete the clouds that are too old for boxes of a stamp [ns] and of all later ones."""
        first = bisect_left(self._stamps, stamp_ns - self._max_offset_ns)
        for stamp_ns in self._stamps[:first]:
            self._file(stamp_ns).unlink()
        del self._stamps[:first]

    def _file(self, stamp_ns: int) -> Path:
        return self._folder / str(stamp_ns)
