"""
Argoverse 2: Feather tables of one log, boxes in the frame of the ego vehicle.

The sensor frame is written as the ego vehicle frame, with an identity calibration;
``--label-frame`` chooses another frame. Status, reason, score, covariance and the class name as
given are additional columns.

"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import Any

from boxreg_ros.errors import RecordingError
from boxreg_ros.io.transforms import matrix
from boxreg_ros.labels.arrow import read_rows, read_table
from boxreg_ros.labels.files import frame_names, read_provenance, to_json
from boxreg_ros.labels.folder import FolderWriter
from boxreg_ros.labels.protocol import Format, LabelFrame, SceneFrames
from boxreg_ros.labels.records import EVIDENCE_COLUMNS, evidence_of, refined_boxes, refined_of
from boxreg_ros.rotations import boxes_from_quaternions, quaternion_from_matrix
from boxreg_ros.structures import BOX_CENTER, BOX_EXTENT, Floats, RefinedBoxes, Sweep
from msg_adapters.poses import quaternions_of
import numpy as np

FORMAT = Format(
    name='argoverse2',
    title='Argoverse 2',
    frame='ego vehicle, that is the sensor or `--label-frame`',
    rotation='quaternion w x y z',
    files='annotations.feather, city_SE3_egovehicle.feather, calibration/, sensors/',
    packages=('pyarrow',),
    options=('with_points', 'class_map'),
    reads='annotations of a log; detections of many logs',
    read_back='av2 0.3.6',
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
GIVEN_CLASS = 'class_name'
"""Column with the name of which `category` is the translation."""
POINT_COLUMNS = {'intensity': 'uint8', 'laser_number': 'uint8', 'offset_ns': 'int32'}
NEEDED_COLUMNS = sorted(ANNOTATION_COLUMNS.keys() - {'track_uuid', 'num_interior_pts'})
"""Detections that are submitted lack the others."""
ROW_STAMP = itemgetter('timestamp_ns')
LOG_COLUMN = 'log_id'
CITY_FRAME, EGO_FRAME = 'city', 'egovehicle'
FEATHER_FILE = 'annotations.feather'
EGO_POSES_FILE = 'city_SE3_egovehicle.feather'
CALIBRATION_FILE = 'calibration/egovehicle_SE3_sensor.feather'
LIDAR_NAME = 'up_lidar'


class Writer(FolderWriter):
    """Write annotations and poses in batches."""

    form = 'argoverse2'
    folders = ('calibration',)
    cloud_file = 'sensors/lidar/{name}.feather'

    def begin(self) -> None:
        """Open the files."""
        columns = ANNOTATION_COLUMNS | EVIDENCE_COLUMNS | {GIVEN_CLASS: 'string'}
        self._annotations = self.table(FEATHER_FILE, columns, to_json(self.about))
        self._poses = self.table(EGO_POSES_FILE, {'timestamp_ns': 'int64'} | POSE_COLUMNS)
        calibration = self.table(CALIBRATION_FILE, {'sensor_name': 'string'} | POSE_COLUMNS)
        calibration.add(LIDAR_NAME, *_pose_values(np.eye(4)))

    def add(self, frame: LabelFrame) -> None:
        """Add a row per box, and the pose."""
        rows, boxes = frame.boxes_in('sensor', self.dropped)
        refined = frame.refined
        array = refined.boxes
        quaternions_wxyz = quaternions_of(boxes)[:, [3, 0, 1, 2]].tolist()
        for row, box, quaternion in zip(rows, boxes.tolist(), quaternions_wxyz, strict=True):
            self._annotations.add(
                array.stamp_ns,
                array.track_ids[row],
                self.class_names.of(array.class_names[row]),
                *box[BOX_EXTENT],
                *quaternion,
                *box[BOX_CENTER],
                int(refined.num_points[row]),
                *evidence_of(refined, row).values(),
                array.class_names[row],
            )
        if frame.T_fixed_sensor is not None:
            self._poses.add(array.stamp_ns, *_pose_values(frame.T_fixed_sensor))

    def add_cloud(self, path: Path, frame: LabelFrame) -> None:
        """Write a sweep as a table; `path` is by its stamp, as the kit needs it."""
        assert frame.sweep is not None
        stamp_ns = frame.refined.boxes.stamp_ns
        path = path.with_name(f'{stamp_ns}.feather')
        _write_cloud(path, stamp_ns, frame.sweep, frame.intensities)


def read(path: Path) -> Iterator[LabelFrame]:
    """
    Yield the annotated stamps of a log, with the poses of its pose file.

    Files of `Writer` have the poses of all frames, also without boxes; those of a log are of all
    sensors.

    """
    if path.is_dir():
        path = path / FEATHER_FILE
    folder = path.parent
    pose_file = folder / EGO_POSES_FILE
    poses = read_rows(pose_file) if pose_file.exists() else []
    T_city_ego = {row['timestamp_ns']: matrix(xyz_xyzw(row)) for row in poses}
    fixed_frame, sensor_frame = frame_names(folder, CITY_FRAME, EGO_FRAME)
    by_stamp = {one.boxes.stamp_ns: one for one in _refined(_annotations(path), sensor_frame)}
    empty = T_city_ego if read_provenance(folder) else {}
    for stamp_ns in sorted({*by_stamp, *empty}):
        refined = by_stamp.get(stamp_ns) or refined_of(stamp_ns, sensor_frame, ())
        yield LabelFrame(refined, fixed_frame, sensor_frame, T_city_ego.get(stamp_ns))


def read_scene(path: Path, scene: SceneFrames) -> Iterator[LabelFrame]:
    """
    Yield the frames of one log.

    Parameters
    ----------
    path : Path
        Annotations of the log, or the folder that has them; or detections of many logs as they are
        submitted, with the column ``log_id``.
    scene : SceneFrames
        Its name is the id of the log.

    Yields
    ------
    frame : LabelFrame
        One per stamp with boxes, ascending; boxes in the frame of the ego vehicle, which is the
        sensor frame.

    Raises
    ------
    RecordingError
        If the table cannot be read, lacks columns, or has boxes of other logs only.

    """
    from pyarrow import compute

    if path.is_dir():
        path = path / FEATHER_FILE
    table = _annotations(path)
    if LOG_COLUMN in table.column_names:
        logs = table.column(LOG_COLUMN)
        mine = table.filter(compute.equal(logs, scene.name))
        if not mine.num_rows:
            raise RecordingError(
                f'{path}: expected boxes of log {scene.name}, got {table.num_rows} boxes of '
                f'{len(logs.unique())} other logs; name the file with this log'
            )
        table = mine
    for refined in _refined(table, scene.sensor_frame):
        yield LabelFrame(refined, scene.fixed_frame, scene.sensor_frame)


def _annotations(path: Path) -> Any:
    return read_table(path, NEEDED_COLUMNS, 'annotations of Argoverse 2')


def _refined(table: Any, frame_id: str) -> Iterator[RefinedBoxes]:
    """Yield the boxes of each stamp of a table, in the frame of the ego vehicle."""
    rows = sorted(table.to_pylist(), key=ROW_STAMP)
    for stamp_ns, group in groupby(rows, ROW_STAMP):
        items = list(group)
        poses_xyz_xyzw = np.array([xyz_xyzw(item) for item in items])
        extents = np.array([[item[name] for name in EXTENT_COLUMNS] for item in items])
        yield refined_boxes(
            stamp_ns,
            frame_id,
            [item.get('track_uuid') or '' for item in items],
            [item.get(GIVEN_CLASS) or item['category'] for item in items],
            boxes_from_quaternions(poses_xyz_xyzw[:, :3], extents, poses_xyz_xyzw[:, 3:]),
            [item | {'num_points': item.get('num_interior_pts')} for item in items],
        )


def _pose_values(T: Floats) -> list[float]:
    """Return qw qx qy qz x y z of a pose (4, 4)."""
    qx, qy, qz, qw = quaternion_from_matrix(T[:3, :3]).tolist()
    return [qw, qx, qy, qz, *T[:3, 3].tolist()]


def xyz_xyzw(row: dict[str, float]) -> Floats:
    """Return x y z qx qy qz qw of a row with a pose."""
    names = ('tx_m', 'ty_m', 'tz_m', 'qx', 'qy', 'qz', 'qw')
    return np.array([row[name] for name in names])


def _write_cloud(path: Path, stamp_ns: int, sweep: Sweep, intensities: Floats | None) -> None:
    """
    Write a sweep as a table; fields that are not known are 0.

    Intensities are bytes. Some sensors give them as 0 to 1, which is scaled to 0 to 255.

    """
    import pyarrow
    from pyarrow import feather

    n = len(sweep.points)
    columns = dict(zip('xyz', sweep.points.T.astype(np.float32), strict=True))
    for name, dtype in POINT_COLUMNS.items():
        columns[name] = np.zeros(n, dtype)
    if sweep.times is not None:
        delays_ns = np.rint(sweep.times * 1e9) + (sweep.stamp_ns - stamp_ns)
        columns['offset_ns'] = delays_ns.astype(np.int32)
    if intensities is not None:
        scale = 255 if intensities.max(initial=0) <= 1 else 1
        columns['intensity'] = (intensities * scale).clip(0, 255).astype(np.uint8)
    with path.open('wb') as file:
        feather.write_feather(pyarrow.table(columns), file)
