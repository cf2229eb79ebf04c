"""
Waymo: the tables ``lidar_box`` and ``vehicle_pose`` of the perception data set, version 2.

The sensor frame is written as the vehicle frame; ``--label-frame`` chooses another frame. Values
without a column in the tables are in additional columns named ``boxreg``.

"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from itertools import groupby
from operator import itemgetter
from pathlib import Path

from boxreg_ros.config import Config, words_of
from boxreg_ros.labels.arrow import read_rows, read_table
from boxreg_ros.labels.files import frame_names, require_single, to_json, visible
from boxreg_ros.labels.folder import FolderWriter
from boxreg_ros.labels.protocol import absolute, Format, LabelFrame
from boxreg_ros.labels.records import EVIDENCE_COLUMNS, evidence_of, refined_boxes
from boxreg_ros.rotations import wrap_angle
from boxreg_ros.structures import BOX_CENTER, BOX_EXTENT, HEIGHT, YAW
import numpy as np

FORMAT = Format(
    name='waymo',
    title='Waymo (Parquet of version 2)',
    frame='vehicle, that is the sensor or `--label-frame`',
    rotation='heading about z; roll and pitch are lost',
    files='lidar_box/, vehicle_pose/',
    packages=('pyarrow',),
    options=('class_map',),
    reads='lidar_box of a segment, rows in any order',
    leaves_out='speed, acceleration, difficulty, camera boxes',
    read_back='waymo-open-dataset 1.6.7',
)
SEGMENT = 'key.segment_context_name'
MICROSECONDS = 'key.frame_timestamp_micros'
OBJECT = 'key.laser_object_id'
BOX_COMPONENT = '[LiDARBoxComponent].'
CENTER = [f'{BOX_COMPONENT}box.center.{axis}' for axis in 'xyz']
SIZE = [f'{BOX_COMPONENT}box.size.{axis}' for axis in 'xyz']
HEADING = f'{BOX_COMPONENT}box.heading'
TYPE = f'{BOX_COMPONENT}type'
NUM_POINTS = f'{BOX_COMPONENT}num_lidar_points_in_box'
UNUSED_COLUMNS = {
    f'{BOX_COMPONENT}num_top_lidar_points_in_box': 'int64',
    **{
        f'{BOX_COMPONENT}{name}.{axis}': 'double'
        for name in ('speed', 'acceleration')
        for axis in 'xyz'
    },
    **{f'{BOX_COMPONENT}difficulty_level.{name}': 'int8' for name in ('detection', 'tracking')},
}
"""Columns of the data set that are written as null."""
BOXREG_COLUMNS = {
    'boxreg.stamp_ns': 'int64',
    'boxreg.class_name': 'string',
    **{f'boxreg.{name}': kind for name, kind in EVIDENCE_COLUMNS.items()},
}
KEY_COLUMNS = {SEGMENT: 'string', MICROSECONDS: 'int64'}
BOX_COLUMNS = (
    KEY_COLUMNS
    | {OBJECT: 'string'}
    | dict.fromkeys([*CENTER, *SIZE, HEADING], 'double')
    | {TYPE: 'int8', NUM_POINTS: 'int64'}
    | UNUSED_COLUMNS
    | BOXREG_COLUMNS
)
REQUIRED = [name for name in BOX_COLUMNS if name not in UNUSED_COLUMNS | BOXREG_COLUMNS]
VEHICLE_POSE = '[VehiclePoseComponent].world_from_vehicle.transform'
VEHICLE_POSE_COLUMNS = KEY_COLUMNS | {VEHICLE_POSE: 'double[16]', 'boxreg.stamp_ns': 'int64'}
TYPE_NAMES = ('', 'vehicle', 'pedestrian', 'sign', 'cyclist')
"""Names of the values of the type column; '' is unknown."""


class Writer(FolderWriter):
    """Write boxes and poses in batches."""

    form = 'waymo'
    folders = ('lidar_box', 'vehicle_pose')

    def begin(self) -> None:
        """Open the files."""
        self._segment = Path((*self.provenance.recordings, 'boxreg')[0]).stem
        file = f'{self._segment}.parquet'
        origin = to_json(self.about)
        self._boxes = self.table(f'lidar_box/{file}', BOX_COLUMNS, origin)
        self._poses = self.table(f'vehicle_pose/{file}', VEHICLE_POSE_COLUMNS)

    def add(self, frame: LabelFrame) -> None:
        """Add a row per box, and the pose."""
        rows, boxes = frame.boxes_in('sensor', self.dropped)
        refined = frame.refined
        array = refined.boxes
        key = (self._segment, round(array.stamp_ns / 1000))
        for row, box in zip(rows, boxes.tolist(), strict=True):
            class_name = self.class_names.of(array.class_names[row])
            type_number = _type(class_name)
            if not type_number:
                self.class_names.uncounted[class_name] += 1
            self._boxes.add(
                *key,
                array.track_ids[row],
                *box[BOX_CENTER],
                *box[BOX_EXTENT],
                float(wrap_angle(box[YAW])),
                type_number,
                int(refined.num_points[row]),
                *[None] * len(UNUSED_COLUMNS),
                array.stamp_ns,
                array.class_names[row],
                *evidence_of(refined, row).values(),
            )
        if frame.T_fixed_sensor is not None:
            self._poses.add(*key, frame.T_fixed_sensor.ravel().tolist(), array.stamp_ns)


def read(path: Path) -> Iterator[LabelFrame]:
    """
    Yield the boxes of one segment: a file of ``lidar_box``, or the only one in a folder.

    Stamps are whole microseconds, unless the column ``boxreg.stamp_ns`` has nanoseconds. A frame
    with a pose and no row is one without boxes: all frames of a segment are labelled.

    """
    if path.is_dir():
        files = visible(path, 'lidar_box/*.parquet')
        path = require_single(files, path, 'segment, lidar_box/NAME.parquet')
    folder = absolute(path).parent.parent
    rows = read_table(path, REQUIRED, 'lidar_box of Waymo').to_pylist()
    pose_file = folder / 'vehicle_pose' / path.name
    poses = read_rows(pose_file) if pose_file.exists() else []
    T_world_vehicle = {
        row[MICROSECONDS]: np.array(row[VEHICLE_POSE]).reshape(4, 4) for row in poses
    }
    fixed_frame, sensor_frame = frame_names(folder, 'world', 'vehicle')
    rows.sort(key=_stamp_ns)
    found = [(stamp_ns, list(group)) for stamp_ns, group in groupby(rows, _stamp_ns)]
    micros_of = {stamp_ns: items[0][MICROSECONDS] for stamp_ns, items in found}
    empty = T_world_vehicle.keys() - micros_of.values()
    for row in poses:
        if row[MICROSECONDS] in empty:
            micros_of[_stamp_ns(row)] = row[MICROSECONDS]
            found.append((_stamp_ns(row), []))
    for stamp_ns, items in sorted(found, key=itemgetter(0)):
        boxes = np.zeros((len(items), 9))
        for box, item in zip(boxes, items, strict=True):
            box[: HEIGHT + 1] = [item[name] for name in (*CENTER, *SIZE)]
        boxes[:, YAW] = [item[HEADING] for item in items]
        refined = refined_boxes(
            stamp_ns,
            sensor_frame,
            [item[OBJECT] for item in items],
            [item.get('boxreg.class_name') or TYPE_NAMES[item[TYPE]] for item in items],
            boxes,
            [
                {name: item.get(f'boxreg.{name}') for name in EVIDENCE_COLUMNS}
                | {'num_points': item[NUM_POINTS]}
                for item in items
            ],
        )
        yield LabelFrame(
            refined, fixed_frame, sensor_frame, T_world_vehicle.get(micros_of[stamp_ns])
        )


def _stamp_ns(row: dict[str, int]) -> int:
    return row.get('boxreg.stamp_ns') or row[MICROSECONDS] * 1000


@lru_cache
def _type(class_name: str) -> int:
    """Return the number of the type of objects with a class name; 0 if it is unknown."""
    if not words_of(class_name).isdisjoint(('sign', 'signs')):
        return TYPE_NAMES.index('sign')
    config = Config()
    return TYPE_NAMES.index(config.kind(class_name)) if config.knows_class(class_name) else 0
