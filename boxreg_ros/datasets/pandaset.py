"""
PandaSet, as it is unpacked: one folder per sequence.

Clouds and boxes are in the world frame. Of the two LiDARs the mechanical one, with 360 degrees, is
read, and the boxes that were drawn for it: the other LiDAR sees moving objects at other times, and
is read where it is asked for. The pose of a sweep is that of the vehicle: x is right, y is ahead.

Tables are pickles of pandas, which can hold programs: read only those from the publisher.

"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
import pickle
from typing import Any
import zlib

from boxreg_ros.datasets.files import missing_sweep, require
from boxreg_ros.datasets.protocol import Cloud, Dataset, Scene, SweepFile
from boxreg_ros.errors import RecordingError, UnsupportedMessage
from boxreg_ros.io.transforms import inverse, matrix
from boxreg_ros.labels import LabelFrame, SceneFrames
from boxreg_ros.labels.files import from_json, visible
from boxreg_ros.labels.records import refined_boxes
from boxreg_ros.rotations import wrap_angle
from boxreg_ros.structures import Floats, YAW
import numpy as np

DATASET = Dataset(
    name='pandaset',
    title='PandaSet',
    folder='001/lidar/poses.json, 001/annotations/cuboids/',
    scene='001',
    labels='',
    remedy='unpack the archive of this part again',
    lidars=('pandar64', 'pandarGT'),
    packages=('pandas',),
    reads='clouds of both LiDARs, cuboids',
    leaves_out='cameras, semantic segmentation',
)
SENSOR_IDS = {'pandar64': 0, 'pandarGT': 1}
"""LiDAR -> value of ``d`` of points and of ``cuboids.sensor_id``, which may be -1: for both."""
POSITIONS = {'pandar64': (0.0, 0.80, 1.85), 'pandarGT': (-0.02, 1.41, 1.55)}
"""
Positions in the frame of ``poses.json`` [m], which the data set does not state.

Derived: that of the first is the pose of a camera times its static calibration by the publisher,
equal within 2 cm for the front, left and back cameras of sequence 002. The second is 0.61 m ahead
of it; the 0.30 m of the calibration are taken as below it, where it is under its field of view.

"""
CUBOID_CENTRE = [f'position.{axis}' for axis in 'xyz']
CUBOID_EXTENT = [f'dimensions.{axis}' for axis in 'yxz']
"""Length, width and height: y of a cuboid is its forward axis."""
DAMAGE = (
    *(OSError, EOFError, zlib.error, pickle.UnpicklingError),
    *(AttributeError, ImportError, ValueError),
)
"""Errors of a pickle that is cut short, or of other versions of pandas."""


def scene_names(root: Path) -> list[str]:
    """Return the names of the sequences with clouds."""
    return [path.parents[1].name for path in visible(root, '*/lidar/poses.json')]


def inputs(root: Path, name: str) -> tuple[Path, ...]:
    """Return the folders of a sequence."""
    return root / name / 'lidar', root / name / 'annotations' / 'cuboids'


def open_scene(root: Path, name: str, lidars: Sequence[str]) -> Scene:
    """Return a sequence; see `protocol.DatasetModule`."""
    folder = root / name / 'lidar'
    path = require(folder / 'timestamps.json', 'the stamps', DATASET.remedy)
    try:
        stamps_ns = np.rint(np.array(from_json(path), np.float64) * 1e9).astype(np.int64)
        poses = np.array([_pose(item) for item in from_json(folder / 'poses.json')])
    except (KeyError, TypeError, ValueError) as error:
        raise RecordingError(
            f'{folder}: expected stamps and poses of PandaSet: {type(error).__name__} {error}'
        ) from None
    if len(poses) != len(stamps_ns) or not len(stamps_ns):
        raise RecordingError(
            f'{folder}: expected a pose per stamp, got {len(poses)} poses and {len(stamps_ns)} '
            f'stamps; {DATASET.remedy}'
        )
    names = {str(number): stamp_ns for number, stamp_ns in enumerate(stamps_ns.tolist())}
    frames = SceneFrames(name, names, 'world', DATASET.lidar)
    cuboids = root / name / 'annotations' / 'cuboids'
    return Scene(
        frames,
        ', '.join(lidars),
        stamps_ns,
        partial(_sweep_files, folder, stamps_ns.tolist(), poses, lidars),
        stamps_ns,
        poses,
        partial(_boxes, cuboids, frames, lidars) if cuboids.is_dir() else None,
        without_boxes=str(cuboids),
    )


def _pose(item: dict[str, dict[str, float]]) -> list[float]:
    """Return x y z qx qy qz qw of an item of ``poses.json``."""
    position, heading = item['position'], item['heading']
    return [*(position[axis] for axis in 'xyz'), *(heading[axis] for axis in 'xyzw')]


def _sweep_files(
    folder: Path, stamps_ns: list[int], poses: Floats, lidars: Sequence[str]
) -> Iterator[SweepFile]:
    for number, (stamp_ns, pose) in enumerate(zip(stamps_ns, poses, strict=True)):
        path = folder / f'{number:02d}.pkl.gz'
        yield SweepFile(stamp_ns, partial(_cloud, path, stamp_ns, matrix(pose), lidars))


def _cloud(path: Path, stamp_ns: int, T_world_vehicle: Floats, lidars: Sequence[str]) -> Cloud:
    """Return the points of some LiDARs in the frame of the vehicle."""
    numbers = [SENSOR_IDS[name] for name in lidars]
    try:
        table = _table(path)
        table = table[table['d'].isin(numbers)]
        measured_by = table['d'].to_numpy()
        world = table[['x', 'y', 'z']].to_numpy(np.float64)
        intensities = table['i'].to_numpy(np.float64)
        times = table['t'].to_numpy(np.float64) - stamp_ns * 1e-9
    except FileNotFoundError as error:
        raise missing_sweep(path, error) from None
    except (RecordingError, KeyError) as error:
        raise UnsupportedMessage(f'{error}; download it again') from None
    T = inverse(T_world_vehicle)
    points = world @ T[:3, :3].T + T[:3, 3]
    sensors = None
    if len(lidars) > 1:
        sensors = (measured_by == numbers[1]).astype(np.uint8)
    origins = np.array([POSITIONS[name] for name in lidars])
    return Cloud(points.astype(np.float32), intensities, times, origins, sensors).finite()


def _boxes(folder: Path, scene: SceneFrames, lidars: Sequence[str]) -> Iterator[LabelFrame]:
    """Yield the cuboids of each frame, but for those that were drawn for another LiDAR."""
    others = [number for name, number in SENSOR_IDS.items() if name != lidars[0]]
    for number, stamp_ns in scene.stamps_ns.items():
        path = folder / f'{int(number):02d}.pkl.gz'
        try:
            table = _table(path)
            table = table[~table['cuboids.sensor_id'].isin(others)]
            boxes = np.zeros((len(table), 9))
            boxes[:, :6] = table[CUBOID_CENTRE + CUBOID_EXTENT].to_numpy(np.float64)
            # A yaw of 0 points along y.
            boxes[:, YAW] = wrap_angle(table['yaw'].to_numpy(np.float64) + np.pi / 2)
        except (FileNotFoundError, KeyError) as error:
            raise RecordingError(
                f'{path}: expected cuboids of PandaSet: {type(error).__name__} {error}; '
                f'{DATASET.remedy}'
            ) from None
        refined = refined_boxes(
            stamp_ns, scene.fixed_frame, table['uuid'].tolist(), table['label'].tolist(), boxes
        )
        yield LabelFrame(refined, scene.fixed_frame, scene.sensor_frame)


def _table(path: Path) -> Any:
    """Return a table; FileNotFoundError without a file, RecordingError for a damaged one."""
    import pandas as pd

    try:
        return pd.read_pickle(path)
    except FileNotFoundError:
        raise
    except DAMAGE as error:
        raise RecordingError(f'{path}: not a table of pandas: {error}') from None
