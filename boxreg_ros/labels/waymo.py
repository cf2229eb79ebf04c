"""
Waymo: the tables ``lidar_box`` and ``vehicle_pose`` of the perception data set, version 2.

The sensor's frame stands for the vehicle's; ``--label-frame`` takes another. What the tables have
no column for stands in columns of our own.

"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict
from functools import lru_cache
from itertools import groupby
from pathlib import Path

from boxreg_ros.config import Config, words_of
from boxreg_ros.errors import RecordingError
from boxreg_ros.labels import absolute, Format, LabelFrame, Options, Provenance
from boxreg_ros.labels.arrow import read_rows, Table
from boxreg_ros.labels.files import frame_names, refined_boxes, the_one, to_json, write_origin
from boxreg_ros.structures import HEIGHT, LENGTH, X, YAW, Z
import numpy as np

FORMAT = Format(
    name='waymo',
    title='Waymo (Parquet of version 2)',
    frame='vehicle, that is the sensor or `--label-frame`',
    reference='centre',
    sizes='length width height',
    rotation='heading about z; roll and pitch are lost',
    files='lidar_box/, vehicle_pose/',
    packages=('pyarrow',),
)
SEGMENT, MICROS = 'key.segment_context_name', 'key.frame_timestamp_micros'
OBJECT = 'key.laser_object_id'
BOX = '[LiDARBoxComponent].'
CENTER = [f'{BOX}box.center.{axis}' for axis in 'xyz']
SIZE = [f'{BOX}box.size.{axis}' for axis in 'xyz']
HEADING, TYPE = f'{BOX}box.heading', f'{BOX}type'
COUNT = f'{BOX}num_lidar_points_in_box'
UNKNOWN = {
    f'{BOX}num_top_lidar_points_in_box': 'int64',
    **{f'{BOX}{name}.{axis}': 'double' for name in ('speed', 'acceleration') for axis in 'xyz'},
    **{f'{BOX}difficulty_level.{name}': 'int8' for name in ('detection', 'tracking')},
}
"""Columns that we have nothing for."""
OURS = {
    'boxreg.stamp_ns': 'int64',
    'boxreg.class_name': 'string',
    'boxreg.status': 'string',
    'boxreg.reason': 'string',
    'boxreg.score': 'double',
    'boxreg.covariance': 'double[]',
}
KEY = {SEGMENT: 'string', MICROS: 'int64'}
COLUMNS = (
    KEY
    | {OBJECT: 'string'}
    | dict.fromkeys([*CENTER, *SIZE, HEADING], 'double')
    | {TYPE: 'int8', COUNT: 'int64'}
    | UNKNOWN
    | OURS
)
POSE = '[VehiclePoseComponent].world_from_vehicle.transform'
TYPES = ('', 'vehicle', 'pedestrian', 'sign', 'cyclist')


class Writer:
    """Write boxes and poses as they come, in batches."""

    def __init__(self, folder: Path, provenance: Provenance, options: Options) -> None:
        self.dropped: Counter[str] = Counter()
        self._folder = folder
        self._origin = asdict(provenance)
        self._segment = Path(provenance.recordings[0]).stem if provenance.recordings else 'boxreg'
        origin, file = to_json(self._origin), f'{self._segment}.parquet'
        for name in ('lidar_box', 'vehicle_pose'):
            (folder / name).mkdir()
        self._boxes = Table(folder / 'lidar_box' / file, COLUMNS, origin)
        self._poses = Table(folder / 'vehicle_pose' / file, KEY | {POSE: 'double[16]'})

    def write(self, frame: LabelFrame) -> None:
        """Add a row per box, and the pose."""
        rows, boxes = frame.placed('sensor', self.dropped)
        refined, given = frame.refined, frame.refined.boxes
        key = (self._segment, round(given.stamp_ns / 1000))
        for row, box in zip(rows, boxes.tolist(), strict=True):
            score = float(given.scores[row])
            heading = (box[YAW] + np.pi) % (2 * np.pi) - np.pi
            self._boxes.add(
                *key, given.track_ids[row], *box[X : Z + 1], *box[LENGTH : HEIGHT + 1], heading,
                _type(given.class_names[row]), int(refined.num_points[row]),
                *[None] * len(UNKNOWN),
                given.stamp_ns, given.class_names[row], refined.status[row], refined.reasons[row],
                score if np.isfinite(score) else None, refined.covariances[row].ravel().tolist(),
            )  # fmt: skip
        if frame.T_fixed_sensor is not None:
            self._poses.add(*key, frame.T_fixed_sensor.ravel().tolist())
        self._origin |= {'fixed_frame': frame.fixed_frame, 'sensor_frame': frame.sensor_frame}

    def close(self) -> None:
        """Complete the files."""
        self._boxes.close()
        self._poses.close()
        write_origin(self._folder, self._origin)


def read(path: Path) -> Iterator[LabelFrame]:
    """
    Yield the boxes of one segment: a file of ``lidar_box``, or the only one in a folder.

    Stamps are whole microseconds unless our own column has them.

    """
    if path.is_dir():
        found = sorted((path / 'lidar_box').glob('*.parquet'))
        path = the_one(found, path, 'segment, lidar_box/NAME.parquet')
    folder = absolute(path).parent.parent
    rows = read_rows(path)
    missing = [name for name in COLUMNS if rows and name not in (*rows[0], *UNKNOWN, *OURS)]
    if missing:
        raise RecordingError(f'{path}: columns missing: {", ".join(missing)}')
    pose_file = folder / 'vehicle_pose' / path.name
    poses = read_rows(pose_file) if pose_file.exists() else []
    T_world_vehicle = {row[MICROS]: np.array(row[POSE]).reshape(4, 4) for row in poses}
    fixed, sensor = frame_names(folder, 'world', 'vehicle')

    def stamp(row: dict[str, int]) -> int:
        return row.get('boxreg.stamp_ns') or row[MICROS] * 1000

    for stamp_ns, part in groupby(sorted(rows, key=stamp), stamp):
        items = list(part)
        boxes = np.zeros((len(items), 9))
        boxes[:, : HEIGHT + 1] = [[item[name] for name in (*CENTER, *SIZE)] for item in items]
        boxes[:, YAW] = [item[HEADING] for item in items]
        refined = refined_boxes(
            stamp_ns,
            sensor,
            [item[OBJECT] for item in items],
            [item.get('boxreg.class_name') or TYPES[item[TYPE]] for item in items],
            boxes,
            [item.get('boxreg.score') for item in items],
            [item.get('boxreg.status') for item in items],
            [item[COUNT] for item in items],
            [item.get('boxreg.covariance') for item in items],
            [item.get('boxreg.reason') for item in items],
        )
        yield LabelFrame(refined, fixed, sensor, T_world_vehicle.get(items[0][MICROS]))


@lru_cache
def _type(class_name: str) -> int:
    """Return the number of the data set's class that the words of a name tell."""
    words, kinds = words_of(class_name), Config()
    known = {
        'vehicle': kinds.vehicle.names,
        'cyclist': kinds.cyclist.names,
        'pedestrian': kinds.pedestrian.names,
        'sign': ('sign',),
    }
    return next((TYPES.index(k) for k, names in known.items() if {*names} & words), 0)
