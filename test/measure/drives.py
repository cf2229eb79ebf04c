"""Drives with known truth, simulated or read from a folder, and their refined boxes in memory."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from boxreg_ros.config import Config
from boxreg_ros.core.refine import Track
from boxreg_ros.core.registrar import BoxRegistrar
from boxreg_ros.errors import RecordingError
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.io.lidars import Lidars, SINGLE_LIDAR
from boxreg_ros.io.recording import Recording
from boxreg_ros.io.session import hand_to_registrar
from boxreg_ros.io.transforms import sweep_to_frame
from boxreg_ros.offline import drive
from boxreg_ros.rotations import matrix_from_rpy
from boxreg_ros.simulation.noise import detector_noise
from boxreg_ros.simulation.scene import is_near, SimulatedScene
from boxreg_ros.structures import (
    BOX_CENTER,
    BOX_EXTENT,
    BoxArray,
    Floats,
    Ints,
    LENGTH,
    RefinedBoxes,
    ROLL,
    Sweep,
    WIDTH,
    YAW,
    Z,
)
import numpy as np

NEARBY_MARGIN = 1.0
"""Points up to this distance outside of a box are passed to the baselines [m]."""
CLUSTER_MARGIN, CLUSTER_CLEARANCE = 0.15, 0.2
"""Points of clusters are so far outside of a true box at most, and above its bottom [m]."""
FEWEST_CLUSTERED = 8
"""Fewer points are no cluster."""
SHORTEST_SIDE = 0.1
"""Of the box of a cluster [m]."""
CLUSTER_YAW_ERROR = 3.0
"""Standard deviation of its yaw [deg]."""


class Drive(drive.Drive):
    """A drive that is registered in memory, as no command does."""

    __slots__ = ()

    @classmethod
    def from_scene(cls, scene: SimulatedScene) -> Drive:
        """Return a simulated drive."""
        sweeps = zip(scene.sweeps, scene.T_fixed_sensor, strict=True)
        moved = tuple(sweep_to_frame(sweep, T, 'odom') for sweep, T in sweeps)
        return cls(moved, tuple(scene.fixed_detections()), scene.truth)

    @classmethod
    def read(cls, folder: Path, lidars: Lidars = SINGLE_LIDAR) -> Drive:
        """Read the recording of these LiDARs in a folder, and the ``truth.csv`` beside it."""
        if not folder.is_dir():
            raise RecordingError(f'{folder}: expected a folder with a recording and truth.csv')
        truth = BoxTable.read(folder / 'truth.csv')
        found = [p for p in sorted(folder.iterdir()) if p.suffix in ('.mcap', '.bag', '.db3')]
        found = found or [p.parent for p in sorted(folder.glob('*/metadata.yaml'))]
        if len(found) != 1:
            raise RecordingError(f'{folder}: expected one recording in it, got {len(found)}')
        return cls.of(Recording(found, lidars), truth)

    def redrawn(self, seed: int) -> Drive:
        """Return the drive with true boxes with the simulated errors of a detector, by a seed."""
        truth, rng = self.truth, np.random.default_rng(seed)
        boxes, ids = truth.boxes.copy(), np.array(truth.track_ids)
        for name in dict.fromkeys(truth.track_ids):
            rows = np.flatnonzero(ids == name)
            rows = rows[np.argsort(truth.stamps_ns[rows], kind='stable')]
            sweeps = self.sweeps_at(truth.stamps_ns[rows])
            origins = np.array([sweep.origin for sweep in sweeps])
            boxes[rows] = detector_noise(truth.boxes[rows], origins, rng)
        arrays = []
        for stamp_ns in np.unique(truth.stamps_ns).tolist():
            at = np.flatnonzero(truth.stamps_ns == stamp_ns)
            names = tuple(truth.class_names[row] for row in at)
            columns = tuple(ids[at].tolist()), names, np.ones(len(at)), boxes[at]
            arrays.append(BoxArray(stamp_ns, truth.frame_id, *columns))
        return replace(self, boxes=tuple(arrays))

    def clustered(self, seed: int = 0) -> Drive:
        """Return the drive with boxes of clusters: each around the points in a true one."""
        truth, rng = self.truth, np.random.default_rng(seed)
        boxes, arrays = truth.boxes.copy(), []
        boxes[:, YAW] += np.radians(CLUSTER_YAW_ERROR) * rng.standard_normal(len(boxes))
        for sweep in self.sweeps:
            points = sweep.in_frame().points
            at = np.flatnonzero(truth.stamps_ns == sweep.stamp_ns).tolist()
            found = {row: _cluster(points, truth.boxes[row], boxes[row]) for row in at}
            at = [row for row in at if found[row] is not None]
            names = tuple(truth.track_ids[row] for row in at)
            columns = names, tuple(truth.class_names[row] for row in at), np.ones(len(at))
            of_sweep = np.reshape([found[row] for row in at], (-1, 9))
            arrays.append(BoxArray(sweep.stamp_ns, truth.frame_id, *columns, of_sweep))
        return replace(self, boxes=tuple(arrays))

    def registered(self, config: Config) -> dict[str, BoxTable]:
        """Return refined boxes by estimate: 'early' and that of `config`, from one run."""
        return {
            name: BoxTable.from_arrays([result.boxes for result in results])
            for name, results in self.refined(config).items()
        }

    def items(self) -> list[Sweep | BoxArray]:
        """Return sweeps and boxes in the order of their stamps, each sweep before its boxes."""
        items: list[Sweep | BoxArray] = [*self.sweeps, *self.boxes]
        return sorted(items, key=lambda item: item.stamp_ns)

    def refined(self, config: Config) -> dict[str, list[RefinedBoxes]]:
        """Return the same with covariances and status, one result for each box array."""
        registrar = BoxRegistrar(config)
        results: list[RefinedBoxes] = []
        for item in self.items():
            results += hand_to_registrar(registrar, item, restarts=False)
        results += registrar.flush()
        found: dict[str, list[RefinedBoxes]] = {}
        for result in results:
            estimate = config.estimate if result.is_final else 'early'
            found.setdefault(estimate, []).append(result)
        return dict(sorted(found.items()))

    def tracks(self) -> list[Track]:
        """Return the boxes as tracks, with the points around each."""
        moved = replace(self, sweeps=tuple(sweep.in_frame() for sweep in self.sweeps))
        rows: dict[str, list[tuple[BoxArray, int]]] = {}
        for array in self.boxes:
            for i, track_id in enumerate(array.track_ids):
                rows.setdefault(track_id, []).append((array, i))
        tracks = []
        for track_id, places in rows.items():
            boxes = np.array([array.boxes[i] for array, i in places])
            stamps = np.array([array.stamp_ns for array, _ in places])
            near = moved.sweeps_at(stamps)
            rows_near = [_nearby(sweep, box) for sweep, box in zip(near, boxes, strict=True)]
            pairs = list(zip(near, rows_near, strict=True))
            points = [sweep.points[nearby] for sweep, nearby in pairs]
            origins = np.array([_main_origin(sweep, nearby) for sweep, nearby in pairs])
            array, i = places[0]
            tracks.append(Track(track_id, array.class_names[i], stamps, boxes, points, origins))
        return tracks

    def ranges(self, rows: Ints) -> Floats:
        """Return the horizontal distance (n,) of the true boxes in `rows` to a sensor [m]."""
        near = self.sweeps_at(self.truth.stamps_ns[rows])
        centers = self.truth.boxes[rows, :2]
        return np.array(
            [
                np.linalg.norm(center - _origins(sweep)[:, :2], axis=1).min()
                for sweep, center in zip(near, centers, strict=True)
            ]
        )


def _cluster(points: Floats, truth: Floats, axes: Floats) -> Floats | None:
    """Return the box (9,) on the road around the points in a true one, by the axes of another."""
    half = truth[BOX_EXTENT] / 2
    local = (points - truth[BOX_CENTER]) @ matrix_from_rpy(truth[ROLL:])
    inside = (np.abs(local) <= half + CLUSTER_MARGIN).all(1)
    of_object = points[inside & (local[:, Z] > CLUSTER_CLEARANCE - half[Z])]
    if len(of_object) < FEWEST_CLUSTERED:
        return None
    R = matrix_from_rpy(axes[ROLL:])
    local = (of_object - truth[BOX_CENTER]) @ R
    low, high = local.min(0), local.max(0)
    low[Z] = -half[Z]
    box = axes.copy()
    box[BOX_CENTER] = truth[BOX_CENTER] + R @ ((low + high) / 2)
    box[BOX_EXTENT] = (high - low).clip(SHORTEST_SIDE)
    return box


def _nearby(sweep: Sweep, box: Floats) -> Ints:
    """Return the rows of the points within `NEARBY_MARGIN` of a box."""
    reach = np.hypot(box[LENGTH], box[WIDTH]) / 2 + 2 * NEARBY_MARGIN
    near = np.flatnonzero((np.abs(sweep.points[:, :2] - box[:2]) < reach).all(axis=1))
    local = (sweep.points[near] - box[:3]) @ matrix_from_rpy(box[ROLL:])
    return near[(np.abs(local) < box[BOX_EXTENT] / 2 + NEARBY_MARGIN).all(axis=1)]


def _origins(sweep: Sweep) -> Floats:
    """Return the positions (K, 3) of the sensors of a sweep [m]."""
    return sweep.origin[None] if sweep.origins is None else sweep.origins


def _main_origin(sweep: Sweep, rows: Ints) -> Floats:
    """Return the position (3,) of the sensor that measured most of some points [m]."""
    if sweep.sensors is None or not len(rows):
        return sweep.origin
    row = int(np.bincount(sweep.sensors[rows]).argmax())
    return np.asarray(_origins(sweep)[row])


def tracks_of(scene: SimulatedScene, margin: float = 1.5) -> list[Track]:
    """Return the noisy boxes of a scene as tracks, with the points within `margin` [m] of each."""
    arrays = scene.fixed_detections()
    rows: dict[str, list[tuple[int, int]]] = {}  # sweep and row of each box of a track
    for i, array in enumerate(arrays):
        for j, track_id in enumerate(array.track_ids):
            rows.setdefault(track_id, []).append((i, j))
    points = [
        sweep.points @ T[:3, :3].T + T[:3, 3]
        for sweep, T in zip(scene.sweeps, scene.T_fixed_sensor, strict=True)
    ]
    tracks = []
    for track_id, places in rows.items():
        first, row = places[0]
        boxes = np.array([arrays[i].boxes[j] for i, j in places])
        near = [
            points[i][is_near(points[i], box, margin)]
            for (i, _), box in zip(places, boxes, strict=True)
        ]
        tracks.append(
            Track(
                track_id,
                arrays[first].class_names[row],
                np.array([arrays[i].stamp_ns for i, _ in places]),
                boxes,
                near,
                np.array([scene.T_fixed_sensor[i, :3, 3] for i, _ in places]),
                np.array([arrays[i].scores[j] for i, j in places]),
            )
        )
    return tracks
