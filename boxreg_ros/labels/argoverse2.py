"""
Argoverse 2: Feather tables of one log, boxes in the frame of the ego vehicle.

The sensor's frame stands for the ego vehicle's, and its calibration says so; ``--label-frame``
takes another. Beside the columns of the data set are status, reason, score and covariance.

"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict
from itertools import groupby
from pathlib import Path

from boxreg_ros.errors import RecordingError
from boxreg_ros.io.transforms import matrix
from boxreg_ros.labels import Format, LabelFrame, Options, Provenance
from boxreg_ros.labels.arrow import read_rows, Table
from boxreg_ros.labels.files import (
    boxes_from,
    frame_names,
    refined_boxes,
    to_json,
    write_origin,
)
from boxreg_ros.rotations import quaternion_from_matrix
from boxreg_ros.structures import Floats, HEIGHT, LENGTH, X, Z
from msg_adapters.poses import quaternions_of
import numpy as np

FORMAT = Format(
    name='argoverse2',
    title='Argoverse 2',
    frame='ego vehicle, that is the sensor or `--label-frame`',
    reference='centre',
    sizes='length width height',
    rotation='quaternion w x y z',
    files='annotations.feather, city_SE3_egovehicle.feather, calibration/, sensors/',
    packages=('pyarrow',),
    options=('with_points',),
)
POSE = dict.fromkeys(('qw', 'qx', 'qy', 'qz', 'tx_m', 'ty_m', 'tz_m'), 'double')
EXTENT = dict.fromkeys(('length_m', 'width_m', 'height_m'), 'double')
ANNOTATION = {
    'timestamp_ns': 'int64', 'track_uuid': 'string', 'category': 'string', **EXTENT, **POSE,
    'num_interior_pts': 'int64',
}  # fmt: skip
EVIDENCE = {
    'status': 'string', 'reason': 'string', 'score': 'double', 'covariance': 'double[]',
}  # fmt: skip
POINT = {'intensity': 'uint8', 'laser_number': 'uint8', 'offset_ns': 'int32'}
ANNOTATIONS, POSES = 'annotations.feather', 'city_SE3_egovehicle.feather'
LIDAR = 'up_lidar'


class Writer:
    """Write annotations and poses as they come, in batches."""

    def __init__(self, folder: Path, provenance: Provenance, options: Options) -> None:
        self.dropped: Counter[str] = Counter()
        self._folder = folder
        self._origin = asdict(provenance)
        self._clouds = folder / 'sensors' / 'lidar'
        if options.with_points:
            self._clouds.mkdir(parents=True)
        origin = to_json(self._origin)
        self._annotations = Table(folder / ANNOTATIONS, ANNOTATION | EVIDENCE, origin)
        self._poses = Table(folder / POSES, {'timestamp_ns': 'int64'} | POSE)
        (folder / 'calibration').mkdir()
        path = folder / 'calibration' / 'egovehicle_SE3_sensor.feather'
        calibration = Table(path, {'sensor_name': 'string'} | POSE)
        calibration.add(LIDAR, *_pose(np.eye(4)))
        calibration.close()

    def write(self, frame: LabelFrame) -> None:
        """Add a row per box, and the pose."""
        rows, boxes = frame.placed('sensor', self.dropped)
        refined, given = frame.refined, frame.refined.boxes
        turns = quaternions_of(boxes)[:, [3, 0, 1, 2]].tolist()
        for row, box, turn in zip(rows, boxes.tolist(), turns, strict=True):
            score = float(given.scores[row])
            self._annotations.add(
                given.stamp_ns, given.track_ids[row], given.class_names[row],
                *box[LENGTH : HEIGHT + 1], *turn, *box[X : Z + 1], int(refined.num_points[row]),
                refined.status[row], refined.reasons[row], score if np.isfinite(score) else None,
                refined.covariances[row].ravel().tolist(),
            )  # fmt: skip
        if frame.T_fixed_sensor is not None:
            self._poses.add(given.stamp_ns, *_pose(frame.T_fixed_sensor))
        if frame.sweep is not None:
            _write_cloud(
                self._clouds / f'{given.stamp_ns}.feather', frame.sweep.points, frame.intensities
            )
        self._origin |= {'fixed_frame': frame.fixed_frame, 'sensor_frame': frame.sensor_frame}

    def close(self) -> None:
        """Complete the files."""
        self._annotations.close()
        self._poses.close()
        write_origin(self._folder, self._origin)


def read(path: Path) -> Iterator[LabelFrame]:
    """Yield the annotated stamps of a log, with the poses beside them."""
    if path.is_dir():
        path = path / ANNOTATIONS
    folder = path.parent
    rows = read_rows(path)
    missing = [name for name in ANNOTATION if rows and name not in rows[0]]
    if missing:
        raise RecordingError(f'{path}: columns missing: {", ".join(missing)}')
    poses = read_rows(folder / POSES) if (folder / POSES).exists() else []
    T_city_ego = {row['timestamp_ns']: matrix(_xyz_xyzw(row)) for row in poses}
    fixed, sensor = frame_names(folder, 'city', 'egovehicle')
    rows.sort(key=lambda row: row['timestamp_ns'])
    for stamp_ns, part in groupby(rows, lambda row: row['timestamp_ns']):
        items = list(part)
        placed = np.array([_xyz_xyzw(item) for item in items])
        extents = np.array([[item[name] for name in EXTENT] for item in items])
        refined = refined_boxes(
            stamp_ns,
            sensor,
            [item['track_uuid'] for item in items],
            [item['category'] for item in items],
            boxes_from(placed[:, :3], extents, placed[:, 3:]),
            [item.get('score') for item in items],
            [item.get('status') for item in items],
            [item['num_interior_pts'] for item in items],
            [item.get('covariance') for item in items],
            [item.get('reason') for item in items],
        )
        yield LabelFrame(refined, fixed, sensor, T_city_ego.get(stamp_ns))


def _pose(T: Floats) -> list[float]:
    """Return qw qx qy qz x y z of a pose (4, 4)."""
    qx, qy, qz, qw = quaternion_from_matrix(T[:3, :3]).tolist()
    return [qw, qx, qy, qz, *T[:3, 3].tolist()]


def _xyz_xyzw(row: dict[str, float]) -> Floats:
    names = ('tx_m', 'ty_m', 'tz_m', 'qx', 'qy', 'qz', 'qw')
    return np.array([row[name] for name in names])


def _write_cloud(path: Path, points: np.ndarray, intensities: Floats | None) -> None:
    """Write a sweep as the data set has it; what a cloud does not tell is 0."""
    import pyarrow
    from pyarrow import feather

    n = len(points)
    columns = dict(zip('xyz', points.T.astype(np.float32), strict=True))
    zeros = {name: np.zeros(n, kind) for name, kind in POINT.items()}
    if intensities is not None:
        full = 255 if intensities.max(initial=0) <= 1 else 1  # some sensors give parts of one
        zeros['intensity'] = (intensities * full).clip(0, 255).astype(np.uint8)
    with path.open('wb') as file:
        feather.write_feather(pyarrow.table(columns | zeros), file)
