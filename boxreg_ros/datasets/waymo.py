"""
Waymo (perception data set, version 2), as it is downloaded: one folder per component.

Clouds are both returns of the LiDAR on the roof, and on request of the others, at the front, the
sides and the rear. Range images become points by the inclination of each row, the azimuth of each
column and, for the LiDAR on the roof alone, the pose of the vehicle at each pixel. Points are in
the frame of the vehicle at the stamp. Rows may be in any order. Those in the order of time are
streamed; others are copied to a temporary file first, which is mapped: one sweep is in memory.

"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

from boxreg_ros.datasets.files import pose_rows, require
from boxreg_ros.datasets.protocol import Cloud, Dataset, Scene, SweepFile
from boxreg_ros.errors import one_line, RecordingError, UnsupportedMessage
from boxreg_ros.io.transforms import inverse
from boxreg_ros.labels import frames_of, SceneFrames
from boxreg_ros.labels.arrow import read_rows
from boxreg_ros.labels.files import frame_names, visible
from boxreg_ros.labels.waymo import MICROSECONDS, VEHICLE_POSE
from boxreg_ros.rotations import matrix_from_rpy
from boxreg_ros.structures import Floats
import numpy as np

DATASET = Dataset(
    name='waymo',
    title='Waymo (version 2)',
    folder='lidar/SEGMENT.parquet, lidar_pose/, lidar_calibration/, vehicle_pose/, lidar_box/ '
    '(of training/, unless the folder is named)',
    scene='SEGMENT',
    labels='waymo',
    remedy='download it again',
    lidars=('TOP', 'FRONT', 'SIDE_LEFT', 'SIDE_RIGHT', 'REAR'),
    packages=('pyarrow',),
    reads='range images of the LiDARs asked for, both returns, rows in any order',
    leaves_out='cameras, segmentation, version 1',
    read_back='waymo-open-dataset 1.6.7 (columns)',
)
LASERS = {name: number for number, name in enumerate(DATASET.lidars, 1)}
"""LiDAR -> value of the column `LASER`."""
TOP_LASER = LASERS[DATASET.lidar]
LASER = 'key.laser_name'
RETURNS = [f'[LiDARComponent].range_image_return{i}' for i in (1, 2)]
PIXEL_POSE = '[LiDARPoseComponent].range_image_return1'
CALIBRATION = '[LiDARCalibrationComponent].'
RANGE, INTENSITY = 0, 1
"""Channels of a range image [m, without unit]."""
READ_AHEAD_BYTES = 1 << 20
"""Bytes of a column that are read at once; a whole column of a segment has some 100 MB."""


def scene_names(root: Path) -> list[str]:
    """Return the names of the segments with clouds."""
    return [path.stem for path in visible(_split(root) / 'lidar', '*.parquet')]


def inputs(root: Path, name: str) -> tuple[Path, ...]:
    """Return the files of a segment."""
    parts = ('lidar', 'lidar_pose', 'lidar_calibration', 'vehicle_pose', 'lidar_box')
    return tuple(_file(root, part, name) for part in parts)


def open_scene(root: Path, name: str, lidars: Sequence[str]) -> Scene:
    """Return a segment; see `protocol.DatasetModule`."""
    clouds = _component(root, 'lidar', name)
    pixel_poses = _component(root, 'lidar_pose', name) if DATASET.lidar in lidars else None
    calibrations = _calibrations(_component(root, 'lidar_calibration', name), lidars)
    rows = read_rows(_component(root, 'vehicle_pose', name))
    T_world_vehicle = {
        row[MICROSECONDS] * 1000: np.reshape(row[VEHICLE_POSE], (4, 4)) for row in rows
    }
    stamps_ns = [micros * 1000 for micros, _ in _by_time(clouds, [], calibrations)]
    if not stamps_ns:
        raise RecordingError(
            f'{clouds}: expected sweeps of {", ".join(lidars)}, got none; {DATASET.remedy}'
        )
    missing = set(stamps_ns) - T_world_vehicle.keys()
    if missing:
        raise RecordingError(
            f'{_file(root, "vehicle_pose", name)}: expected a pose at each of {len(stamps_ns)} '
            f'sweeps, got none at {min(missing)} ns; {DATASET.remedy}'
        )
    frames = SceneFrames(
        name,
        {str(stamp_ns // 1000): stamp_ns for stamp_ns in stamps_ns},
        *frame_names(_split(root), 'world', 'vehicle'),
    )
    boxes = _file(root, 'lidar_box', name)
    pose_stamps_ns = sorted(T_world_vehicle)
    return Scene(
        frames,
        ', '.join(lidars),
        np.array(stamps_ns, np.int64),
        partial(_sweeps, clouds, pixel_poses, calibrations, T_world_vehicle),
        np.array(pose_stamps_ns, np.int64),
        pose_rows([T_world_vehicle[stamp_ns] for stamp_ns in pose_stamps_ns]),
        partial(frames_of, 'waymo', boxes, frames) if boxes.is_file() else None,
        without_boxes=str(boxes),
    )


class _Calibration(NamedTuple):
    """Name of a LiDAR, its pose (4, 4) in the vehicle, and its inclinations [rad]."""

    name: str
    T_vehicle_lidar: Floats
    inclinations: Floats | None
    min_inclination: float
    max_inclination: float

    def rows(self, height: int) -> Floats:
        """Return the inclination of each row of a range image, the highest first."""
        if self.inclinations is not None:
            return self.inclinations[::-1]
        shares = (np.arange(height) + 0.5) / height
        return (self.min_inclination + shares * (self.max_inclination - self.min_inclination))[
            ::-1
        ]


def _calibrations(path: Path, names: Sequence[str]) -> dict[int, _Calibration]:
    """Return the calibration of each LiDAR, by its value of the column `LASER`."""
    rows = {row[LASER]: row for row in read_rows(path)}
    found = {}
    for name in names:
        row = rows.get(LASERS[name])
        if row is None:
            raise RecordingError(
                f'{path}: expected the LiDAR {name}, got others; {DATASET.remedy}'
            )
        values = row[f'{CALIBRATION}beam_inclination.values']
        found[LASERS[name]] = _Calibration(
            name,
            np.reshape(row[f'{CALIBRATION}extrinsic.transform'], (4, 4)),
            np.array(values) if values else None,
            row[f'{CALIBRATION}beam_inclination.min'],
            row[f'{CALIBRATION}beam_inclination.max'],
        )
    return found


def _by_time(
    path: Path, columns: Sequence[str], lasers: Collection[int]
) -> Iterator[tuple[int, dict[int, dict[str, Any]]]]:
    """Yield the time [us] of each sweep and its rows by LiDAR, in the order of time."""
    keys = list(_streamed(path, [MICROSECONDS, LASER]))
    wanted = [number for number, key in enumerate(keys) if key[LASER] in lasers]
    order = sorted(wanted, key=lambda number: keys[number][MICROSECONDS])
    with TemporaryDirectory(prefix='boxreg_') as folder:
        for micros, rows in groupby(
            _rows_in_order(path, [MICROSECONDS, LASER, *columns], order, Path(folder)),
            itemgetter(MICROSECONDS),
        ):
            yield micros, {row[LASER]: row for row in rows}


def _rows_in_order(
    path: Path, columns: list[str], order: Sequence[int], folder: Path
) -> Iterator[dict[str, Any]]:
    """
    Yield rows of a Parquet file by their numbers.

    Ascending numbers are streamed. For others the rows are copied to a file in `folder`, since
    the pages of a Parquet file are only read from their begin.

    """
    wanted = set(order)
    if list(order) == sorted(order):
        for number, row in enumerate(_streamed(path, columns)):
            if number in wanted:
                yield row
        return
    import pyarrow
    from pyarrow import ipc

    copy = folder / 'rows.arrow'
    with _reading(path), pyarrow.OSFile(str(copy), 'wb') as sink:
        writer = None
        for number, batch in enumerate(_batches(path, columns)):
            writer = writer or ipc.new_file(sink, batch.schema)
            if number in wanted:
                writer.write_batch(batch)
        if writer is not None:
            writer.close()
    place = {number: row for row, number in enumerate(sorted(wanted))}
    with pyarrow.memory_map(str(copy)) as source:
        rows = ipc.open_file(source)
        for number in order:
            yield _row(rows.get_batch(place[number]), columns)


def _sweeps(
    clouds: Path,
    pixel_poses: Path | None,
    calibrations: dict[int, _Calibration],
    T_world_vehicle: dict[int, Floats],
) -> Iterator[SweepFile]:
    """Yield the sweeps in the order of time, with the poses of the same stamps."""
    columns = [f'{image}.{part}' for image in RETURNS for part in ('values', 'shape')]
    poses: Iterator[tuple[int, dict[int, dict[str, Any]]]] = iter(())
    if pixel_poses is not None:
        pose_columns = [f'{PIXEL_POSE}.values', f'{PIXEL_POSE}.shape']
        poses = _by_time(pixel_poses, pose_columns, [TOP_LASER])
    after_all: tuple[int, dict[int, dict[str, Any]]] = (1 << 62, {})
    pose_micros, pose = -1, after_all[1]
    for micros, rows in _by_time(clouds, columns, calibrations):
        while pose_micros < micros:
            pose_micros, pose = next(poses, after_all)
        T_world_pixel = pose if pose_micros == micros else {}
        stamp_ns = micros * 1000
        T = T_world_vehicle[stamp_ns]
        yield SweepFile(stamp_ns, partial(_cloud, rows, T_world_pixel, calibrations, T, clouds))


def _cloud(
    rows: dict[int, dict[str, Any]],
    pixel_poses: dict[int, dict[str, Any]],
    calibrations: dict[int, _Calibration],
    T_world_vehicle: Floats,
    clouds: Path,
) -> Cloud:
    """Return the points of both returns of the LiDARs in the frame of the vehicle at the stamp."""
    points = [np.zeros((0, 3))]
    intensities = [np.zeros(0)]
    sensors = [np.zeros(0, np.uint8)]
    for number, (laser, calibration) in enumerate(calibrations.items()):
        if laser not in rows or (laser == TOP_LASER and laser not in pixel_poses):
            what, part = ('poses', 'lidar_pose') if laser in rows else ('points', 'lidar')
            raise UnsupportedMessage(
                f'{clouds.parents[1] / part / clouds.name}: expected the {what} of the LiDAR '
                f'{calibration.name} in a sweep, got none; {DATASET.remedy}'
            )
        T_world_pixel = None
        if laser == TOP_LASER:
            T_world_pixel = _image(pixel_poses[laser], PIXEL_POSE)
        for name in RETURNS:
            image = _image(rows[laser], name)
            if image is None:
                continue
            at = np.nonzero(image[..., RANGE] > 0)
            local = _rays(calibration, image.shape, *at) * image[at][:, RANGE, None]
            T = calibration.T_vehicle_lidar
            found = local @ T[:3, :3].T + T[:3, 3]  # in the vehicle when each was measured
            if T_world_pixel is not None:
                found = _at_stamp(found, T_world_pixel[at], T_world_vehicle)
            points.append(found)
            intensities.append(image[at][:, INTENSITY])
            sensors.append(np.full(len(found), number, np.uint8))
    return Cloud(
        np.concatenate(points).astype(np.float32),
        np.concatenate(intensities),
        origins=np.array([one.T_vehicle_lidar[:3, 3] for one in calibrations.values()]),
        sensors=np.concatenate(sensors) if len(calibrations) > 1 else None,
    ).finite()


def _rays(calibration: _Calibration, shape: tuple[int, ...], rows: Any, columns: Any) -> Floats:
    """Return the unit vectors (M, 3) of pixels in the frame of the LiDAR."""
    height, width = shape[:2]
    T = calibration.T_vehicle_lidar
    inclination = calibration.rows(height)[rows]
    # The first column looks backward in the vehicle; the azimuth descends over the columns.
    correction = np.arctan2(T[1, 0], T[0, 0])
    azimuth = (2 * (width - columns - 0.5) / width - 1) * np.pi - correction
    across = np.cos(inclination)
    return np.stack(
        [np.cos(azimuth) * across, np.sin(azimuth) * across, np.sin(inclination)], axis=1
    )


def _at_stamp(points: Floats, pixel_poses: Floats, T_world_vehicle: Floats) -> Floats:
    """Return points (M, 3) moved to the stamp; each has a pose (M, 6) roll pitch yaw x y z."""
    R = matrix_from_rpy(pixel_poses[:, :3])
    world = np.einsum('mij,mj->mi', R, points) + pixel_poses[:, 3:]
    T = inverse(T_world_vehicle)
    return np.asarray(world @ T[:3, :3].T + T[:3, 3])


def _image(row: dict[str, Any], name: str) -> Floats | None:
    """Return an image (height, width, channel) of a row; None if it has none."""
    values, shape = row[f'{name}.values'], row[f'{name}.shape']
    if values is None or not len(values):
        return None
    return np.reshape(np.asarray(values, np.float64), shape)


def _streamed(path: Path, columns: list[str]) -> Iterator[dict[str, Any]]:
    """Yield the rows of a Parquet file one by one, lists as arrays."""
    with _reading(path):
        for batch in _batches(path, columns):
            yield _row(batch, columns)


def _batches(path: Path, columns: list[str]) -> Iterator[Any]:
    """Yield the rows of a Parquet file as batches of one row."""
    from pyarrow import parquet

    with parquet.ParquetFile(path, buffer_size=READ_AHEAD_BYTES, pre_buffer=False) as file:
        yield from file.iter_batches(1, columns=columns, use_threads=False)


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Raise errors of pyarrow as RecordingError."""
    import pyarrow

    try:
        yield
    except (OSError, KeyError, pyarrow.ArrowException) as error:
        reason = f'cannot be read: {one_line(error)}'
        raise RecordingError(f'{path}: {reason}; {DATASET.remedy}') from None


def _row(batch: Any, columns: list[str]) -> dict[str, Any]:
    """Return the only row of a batch."""
    return {name: _value(batch.column(name)) for name in columns}


def _value(column: Any) -> Any:
    """Return the only value of a column of a batch; a list as an array, without copying."""
    value = column[0]
    if not value.is_valid:
        return None
    return value.values.to_numpy() if hasattr(value, 'values') else value.as_py()


def _component(root: Path, part: str, name: str) -> Path:
    return require(
        _file(root, part, name), f'the component {part}', f'download {part}/ of this split'
    )


def _file(root: Path, part: str, name: str) -> Path:
    return _split(root) / part / f'{name}.parquet'


def _split(root: Path) -> Path:
    """Return the folder of a split: the root itself, or ``training`` in it."""
    return root if (root / 'lidar').is_dir() else root / 'training'
