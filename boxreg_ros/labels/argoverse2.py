"""
Argoverse 2: Feather tables of one log, boxes in the frame of the ego vehicle.

The sensor frame is written as the ego vehicle frame, with an identity calibration;
``--label-frame`` chooses another frame. Status, reason, score and covariance are additional
columns.

"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict
from itertools import groupby
from pathlib import Path

from boxreg_ros.errors import RecordingError
from boxreg_ros.io.transforms import matrix
from boxreg_ros.labels.arrow import read_rows, Table
from boxreg_ros.labels.files import frame_names, to_json, write_provenance
from boxreg_ros.labels.protocol import Format, LabelFrame, Options, Provenance
from boxreg_ros.labels.records import boxes_from_quaternions, finite_or_none, refined_boxes
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
POSE_COLUMNS = dict.fromkeys(('qw', 'qx', 'qy', 'qz', 'tx_m', 'ty_m', 'tz_m'), 'double')
EXTENT_COLUMNS = dict.fromkeys(('length_m', 'width_m', 'height_m'), 'double')
ANNOTATION_COLUMNS = {
    'timestamp_ns': 'int64',
    'track_uuid': 'string',
    'category': 'string',
    **EXTENT_COLUMNS,
    **POSE_COLUMNS,
    'num_interior_pts': 'int64',
}
STATUS_COLUMNS = {
    'status': 'string',
    'reason': 'string',
    'score': 'double',
    'covariance': 'double[]',
    'extent_covariance': 'double[]',
}
"""Additional columns; the devkit ignores them."""
POINT_COLUMNS = {'intensity': 'uint8', 'laser_number': 'uint8', 'offset_ns': 'int32'}
ANNOTATIONS_FILE = 'annotations.feather'
EGO_POSES_FILE = 'city_SE3_egovehicle.feather'
LIDAR_NAME = 'up_lidar'


class Writer:
    """Write annotations and poses in batches."""

    def __init__(self, folder: Path, provenance: Provenance, options: Options) -> None:
        self.dropped: Counter[str] = Counter()
        self._folder = folder
        self._provenance = asdict(provenance)
        self._clouds = folder / 'sensors' / 'lidar'
        if options.with_points:
            self._clouds.mkdir(parents=True)
        self._annotations = Table(
            folder / ANNOTATIONS_FILE,
            ANNOTATION_COLUMNS | STATUS_COLUMNS,
            to_json(self._provenance),
        )
        self._poses = Table(folder / EGO_POSES_FILE, {'timestamp_ns': 'int64'} | POSE_COLUMNS)
        (folder / 'calibration').mkdir()
        path = folder / 'calibration' / 'egovehicle_SE3_sensor.feather'
        calibration = Table(path, {'sensor_name': 'string'} | POSE_COLUMNS)
        calibration.add(LIDAR_NAME, *_pose_values(np.eye(4)))
        calibration.close()

    def write(self, frame: LabelFrame) -> None:
        """Add a row per box, the pose and the cloud."""
        rows, boxes = frame.boxes_in('sensor', self.dropped)
        refined = frame.refined
        array = refined.boxes
        quaternions_wxyz = quaternions_of(boxes)[:, [3, 0, 1, 2]].tolist()
        for row, box, quaternion in zip(rows, boxes.tolist(), quaternions_wxyz, strict=True):
            self._annotations.add(
                array.stamp_ns,
                array.track_ids[row],
                array.class_names[row],
                *box[LENGTH : HEIGHT + 1],
                *quaternion,
                *box[X : Z + 1],
                int(refined.num_points[row]),
                refined.status[row],
                refined.reasons[row],
                finite_or_none(array.scores[row]),
                refined.covariances[row].ravel().tolist(),
                refined.extent_covariances[row].ravel().tolist(),
            )
        if frame.T_fixed_sensor is not None:
            self._poses.add(array.stamp_ns, *_pose_values(frame.T_fixed_sensor))
        if frame.sweep is not None:
            path = self._clouds / f'{array.stamp_ns}.feather'
            _write_cloud(path, frame.sweep.points, frame.intensities)
        self._provenance['fixed_frame'] = frame.fixed_frame
        self._provenance['sensor_frame'] = frame.sensor_frame

    def close(self) -> None:
        """Complete the files."""
        self._annotations.close()
        self._poses.close()
        write_provenance(self._folder, self._provenance)


def read(path: Path) -> Iterator[LabelFrame]:
    """Yield the annotated stamps of a log, with the poses of its pose file."""
    if path.is_dir():
        path = path / ANNOTATIONS_FILE
    folder = path.parent
    rows = read_rows(path)
    missing = [name for name in ANNOTATION_COLUMNS if rows and name not in rows[0]]
    if missing:
        raise RecordingError(f'{path}: columns missing: {", ".join(missing)}')
    pose_file = folder / EGO_POSES_FILE
    poses = read_rows(pose_file) if pose_file.exists() else []
    T_city_ego = {row['timestamp_ns']: matrix(_xyz_xyzw(row)) for row in poses}
    fixed_frame, sensor_frame = frame_names(folder, 'city', 'egovehicle')
    rows.sort(key=lambda row: row['timestamp_ns'])
    for stamp_ns, group in groupby(rows, lambda row: row['timestamp_ns']):
        items = list(group)
        poses_xyz_xyzw = np.array([_xyz_xyzw(item) for item in items])
        extents = np.array([[item[name] for name in EXTENT_COLUMNS] for item in items])
        refined = refined_boxes(
            stamp_ns,
            sensor_frame,
            [item['track_uuid'] for item in items],
            [item['category'] for item in items],
            boxes_from_quaternions(poses_xyz_xyzw[:, :3], extents, poses_xyz_xyzw[:, 3:]),
            [item.get('score') for item in items],
            [item.get('status') for item in items],
            [item['num_interior_pts'] for item in items],
            [item.get('covariance') for item in items],
            [item.get('reason') for item in items],
            [item.get('extent_covariance') for item in items],
        )
        yield LabelFrame(refined, fixed_frame, sensor_frame, T_city_ego.get(stamp_ns))


def _pose_values(T: Floats) -> list[float]:
    """Return qw qx qy qz x y z of a pose (4, 4)."""
    qx, qy, qz, qw = quaternion_from_matrix(T[:3, :3]).tolist()
    return [qw, qx, qy, qz, *T[:3, 3].tolist()]


def _xyz_xyzw(row: dict[str, float]) -> Floats:
    names = ('tx_m', 'ty_m', 'tz_m', 'qx', 'qy', 'qz', 'qw')
    return np.array([row[name] for name in names])


def _write_cloud(path: Path, points: np.ndarray, intensities: Floats | None) -> None:
    """
    Write a sweep as a table; fields that are not known are 0.

    Intensities are bytes. Some sensors give them as 0 to 1, which is scaled to 0 to 255.

    """
    import pyarrow
    from pyarrow import feather

    n = len(points)
    columns = dict(zip('xyz', points.T.astype(np.float32), strict=True))
    for name, dtype in POINT_COLUMNS.items():
        columns[name] = np.zeros(n, dtype)
    if intensities is not None:
        scale = 255 if intensities.max(initial=0) <= 1 else 1
        columns['intensity'] = (intensities * scale).clip(0, 255).astype(np.uint8)
    with path.open('wb') as file:
        feather.write_feather(pyarrow.table(columns), file)
