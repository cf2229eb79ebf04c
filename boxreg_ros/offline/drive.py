"""Sweeps, noisy boxes and true boxes of one drive, in memory and in one frame."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from boxreg_ros.config import Config
from boxreg_ros.core.metrics import EXTENT
from boxreg_ros.core.refine import Track
from boxreg_ros.core.registrar import BoxRegistrar
from boxreg_ros.errors import RecordingError, TransformUnavailable, UnsupportedMessage
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.io.recording import Recording
from boxreg_ros.io.transforms import sweep_to_frame, to_fixed_frame, TransformTree
from boxreg_ros.rotations import matrix_from_rpy
from boxreg_ros.simulation.scene import Scene
from boxreg_ros.structures import (
    BoxArray,
    Floats,
    Ints,
    LENGTH,
    RefinedBoxes,
    ROLL,
    Sweep,
    WIDTH,
)
import numpy as np
from numpy.typing import NDArray

MARGIN = 1.0  # [m], points this far outside a box are handed to the baselines


@dataclass(frozen=True, slots=True)
class Drive:
    """
    Sweeps and noisy boxes of one drive, in time order, in the frame of its true boxes.

    Attributes
    ----------
    sweeps, boxes, truth
        What there is.
    left_out : str
        How many messages of a recording are not among these, and why; '' if all are.

    """

    sweeps: tuple[Sweep, ...]
    boxes: tuple[BoxArray, ...]
    truth: BoxTable
    left_out: str = ''

    @classmethod
    def from_scene(cls, scene: Scene) -> Drive:
        """Return what was simulated."""
        sweeps = zip(scene.sweeps, scene.T_fixed_sensor, strict=True)
        moved = tuple(sweep_to_frame(sweep, T, 'odom') for sweep, T in sweeps)
        return cls(moved, tuple(scene.fixed_detections()), scene.truth)

    @classmethod
    def read(cls, folder: Path) -> Drive:
        """
        Read the one recording in a folder and the ``truth.csv`` beside it.

        Raises
        ------
        RecordingError
            If they are not there, or cannot be read.

        """
        if not folder.is_dir():
            raise RecordingError(f'{folder}: expected a folder with a recording and truth.csv')
        truth = BoxTable.read(folder / 'truth.csv')
        found = [p for p in sorted(folder.iterdir()) if p.suffix in ('.mcap', '.bag', '.db3')]
        found = found or [p.parent for p in sorted(folder.glob('*/metadata.yaml'))]
        if len(found) != 1:
            raise RecordingError(f'{folder}: expected one recording in it, got {len(found)}')
        return cls.of(Recording(found), truth)

    @classmethod
    def of(cls, recording: Recording, truth: BoxTable, within: float | None = None) -> Drive:
        """
        Read a recording that is not open yet, in the frame of its true boxes.

        Messages that cannot be read or have no transform are passed over. All sweeps are held in
        memory, or those no further from the stamp of a true box than `within` [s].

        Raises
        ------
        RecordingError
            If it has no sweeps, cannot be read, or nothing connects it with that frame.

        """
        tree = TransformTree()
        sweeps, boxes, unmoved = [], [], []
        has_sweeps = False
        with recording:
            fixed_frame = recording.choose_fixed_frame(tree, truth.frame_id)
            for record in recording.records(tree):
                try:
                    item = to_fixed_frame(recording.decode(record), tree, fixed_frame)
                except UnsupportedMessage as error:
                    recording.pass_over(record, error)
                except TransformUnavailable as error:
                    unmoved.append(str(error))
                else:
                    if isinstance(item, BoxArray):
                        boxes.append(item)
                        continue
                    has_sweeps = True
                    off_ns = np.abs(truth.stamps_ns - item.stamp_ns)
                    if within is None or (off_ns <= within * 1e9).any():
                        sweeps.append(item)
        left_out = recording.left_out(unmoved)
        if not has_sweeps:
            reason = f': {left_out}' if left_out else ''
            raise RecordingError(f'{recording}: expected sweeps, got none{reason}')
        return cls(
            tuple(sorted(sweeps, key=lambda sweep: sweep.stamp_ns)),
            tuple(sorted(boxes, key=lambda array: array.stamp_ns)),
            truth,
            left_out,
        )

    def registered(self, config: Config) -> dict[str, BoxTable]:
        """Return boxes by estimate: 'early' and 'final' come from one run, 'track' of another."""
        registrar = BoxRegistrar(config)
        results: list[RefinedBoxes] = []
        items: list[Sweep | BoxArray] = [*self.sweeps, *self.boxes]
        for item in sorted(items, key=lambda item: item.stamp_ns):
            if isinstance(item, Sweep):
                results += registrar.add_sweep(item)
            else:
                results += registrar.add_boxes(item)
        results += registrar.flush()
        found: dict[str, list[BoxArray]] = {}
        for result in results:
            estimate = config.estimate if result.is_final else 'early'
            found.setdefault(estimate, []).append(result.boxes)
        return {name: BoxTable.from_arrays(arrays) for name, arrays in sorted(found.items())}

    def tracks(self) -> list[Track]:
        """Return the boxes as tracks, with the points around each."""
        rows: dict[str, list[tuple[BoxArray, int]]] = {}
        for array in self.boxes:
            for i, track_id in enumerate(array.track_ids):
                rows.setdefault(track_id, []).append((array, i))
        tracks = []
        for track_id, places in rows.items():
            boxes = np.array([array.boxes[i] for array, i in places])
            stamps = np.array([array.stamp_ns for array, _ in places])
            near = self.sweeps_at(stamps)
            points = [_crop(sweep.points, box) for sweep, box in zip(near, boxes, strict=True)]
            origins = np.array([sweep.origin for sweep in near])
            array, i = places[0]
            tracks.append(Track(track_id, array.class_names[i], stamps, boxes, points, origins))
        return tracks

    def ranges(self, rows: Ints) -> Floats:
        """Return how far the true boxes in `rows` are from the sensor, in the plane [m]."""
        near = self.sweeps_at(self.truth.stamps_ns[rows])
        origins = np.array([sweep.origin for sweep in near]).reshape(-1, 3)
        apart: Floats = np.linalg.norm((self.truth.boxes[rows, :3] - origins)[:, :2], axis=1)
        return apart

    def sweeps_at(self, stamps_ns: Ints) -> list[Sweep]:
        """Return the sweep nearest in time to each stamp."""
        own = np.array([sweep.stamp_ns for sweep in self.sweeps])
        after = np.searchsorted(own, stamps_ns).clip(0, len(own) - 1)
        before = (after - 1).clip(0)
        rows = np.where(stamps_ns - own[before] < own[after] - stamps_ns, before, after)
        return [self.sweeps[row] for row in rows]


def _crop(points: NDArray[Any], box: Floats) -> NDArray[Any]:
    """Return the points within `MARGIN` of a box."""
    reach = np.hypot(box[LENGTH], box[WIDTH]) / 2 + 2 * MARGIN
    near = points[(np.abs(points[:, :2] - box[:2]) < reach).all(axis=1)]
    R = matrix_from_rpy(box[ROLL:])
    inside = (np.abs((near - box[:3]) @ R) < box[EXTENT] / 2 + MARGIN).all(axis=1)
    cropped: NDArray[Any] = near[inside]
    return cropped
