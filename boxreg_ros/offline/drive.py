"""Sweeps, noisy boxes and true boxes of one drive, in memory and in one frame."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from boxreg_ros.config import Config
from boxreg_ros.core.refine import Track
from boxreg_ros.core.registrar import BoxRegistrar
from boxreg_ros.datasets import SceneRecording
from boxreg_ros.errors import RecordingError, TransformUnavailable
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.io.items import left_out
from boxreg_ros.io.recording import Recording
from boxreg_ros.io.session import register
from boxreg_ros.io.transforms import sweep_to_frame, to_fixed_frame, TransformTree
from boxreg_ros.rotations import matrix_from_rpy
from boxreg_ros.simulation.scene import Scene
from boxreg_ros.structures import (
    BOX_EXTENT,
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

NEARBY_MARGIN = 1.0
"""Points up to this distance outside of a box are passed to the baselines [m]."""


@dataclass(frozen=True, slots=True)
class Drive:
    """
    Sweeps and noisy boxes of one drive, in time order, in the frame of its true boxes.

    Attributes
    ----------
    sweeps : tuple of Sweep
    boxes : tuple of BoxArray
        Noisy boxes.
    truth : BoxTable
        True boxes; all are in their frame.
    left_out : str
        Number of messages of the recording that are not used, and why; empty if all are.

    """

    sweeps: tuple[Sweep, ...]
    boxes: tuple[BoxArray, ...]
    truth: BoxTable
    left_out: str = ''

    @classmethod
    def from_scene(cls, scene: Scene) -> Drive:
        """Return a simulated drive."""
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
            If they do not exist, or cannot be read.

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
    def of(
        cls,
        recording: Recording | SceneRecording,
        truth: BoxTable,
        within: float | None = None,
    ) -> Drive:
        """
        Read a recording that is not open yet, in the frame of its true boxes.

        Messages that cannot be decoded or have no transform are left out. Sweeps are held in
        memory: all of them, or those within `within` [s] of the stamp of a true box.

        Raises
        ------
        RecordingError
            If it has no sweeps, cannot be read, or no transforms connect it with that frame.

        """
        tree = TransformTree()
        sweeps: list[Sweep] = []
        boxes: list[BoxArray] = []
        missing_transforms: list[str] = []
        has_sweeps = False
        with recording:
            fixed_frame = recording.choose_fixed_frame(tree, truth.frame_id)
            for item in recording.items(tree):
                try:
                    moved = to_fixed_frame(item.content, tree, fixed_frame)
                except TransformUnavailable as error:
                    missing_transforms.append(str(error))
                    continue
                if isinstance(moved, BoxArray):
                    boxes.append(moved)
                    continue
                has_sweeps = True
                away_ns = np.abs(truth.stamps_ns - moved.stamp_ns)
                if within is None or (away_ns <= within * 1e9).any():
                    sweeps.append(moved)
        others = left_out(recording, missing_transforms)
        if not has_sweeps:
            reason = f': {others}' if others else ''
            raise RecordingError(f'{recording}: expected sweeps, got none{reason}')
        return cls(
            tuple(sorted(sweeps, key=lambda sweep: sweep.stamp_ns)),
            tuple(sorted(boxes, key=lambda array: array.stamp_ns)),
            truth,
            others,
        )

    def registered(self, config: Config) -> dict[str, BoxTable]:
        """Return refined boxes by estimate: 'early' and that of `config`, from one run."""
        return {
            name: BoxTable.from_arrays([result.boxes for result in results])
            for name, results in self.refined(config).items()
        }

    def refined(self, config: Config) -> dict[str, list[RefinedBoxes]]:
        """Return the same with covariances and status, one result for each box array."""
        registrar = BoxRegistrar(config)
        results: list[RefinedBoxes] = []
        items: list[Sweep | BoxArray] = [*self.sweeps, *self.boxes]
        for item in sorted(items, key=lambda item: item.stamp_ns):
            results += register(registrar, item, restarts=False)
        results += registrar.flush()
        found: dict[str, list[RefinedBoxes]] = {}
        for result in results:
            estimate = config.estimate if result.is_final else 'early'
            found.setdefault(estimate, []).append(result)
        return dict(sorted(found.items()))

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
        """Return the horizontal distance (n,) of the true boxes in `rows` to the sensor [m]."""
        near = self.sweeps_at(self.truth.stamps_ns[rows])
        origins = np.array([sweep.origin for sweep in near]).reshape(-1, 3)
        ranges: Floats = np.linalg.norm((self.truth.boxes[rows, :3] - origins)[:, :2], axis=1)
        return ranges

    def sweeps_at(self, stamps_ns: Ints) -> list[Sweep]:
        """Return the sweep nearest in time to each stamp."""
        own = np.array([sweep.stamp_ns for sweep in self.sweeps])
        after = np.searchsorted(own, stamps_ns).clip(0, len(own) - 1)
        before = (after - 1).clip(0)
        rows = np.where(stamps_ns - own[before] < own[after] - stamps_ns, before, after)
        return [self.sweeps[row] for row in rows]


def _crop(points: NDArray[Any], box: Floats) -> NDArray[Any]:
    """Return the points within `NEARBY_MARGIN` of a box."""
    reach = np.hypot(box[LENGTH], box[WIDTH]) / 2 + 2 * NEARBY_MARGIN
    near = points[(np.abs(points[:, :2] - box[:2]) < reach).all(axis=1)]
    R = matrix_from_rpy(box[ROLL:])
    inside = (np.abs((near - box[:3]) @ R) < box[BOX_EXTENT] / 2 + NEARBY_MARGIN).all(axis=1)
    cropped: NDArray[Any] = near[inside]
    return cropped
