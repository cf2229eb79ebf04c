"""
KITTI tracking, as its archives are unpacked: velodyne, oxts, calib and label_02 of a split.

The data set has no stamps: frames are 0.1 s apart, the rate of its LiDAR. Labels are those of the
left colour camera's view, so vehicles outside of it have none.

"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

from boxreg_ros.datasets import kitti
from boxreg_ros.datasets.files import require
from boxreg_ros.datasets.protocol import Dataset, Scene
from boxreg_ros.errors import RecordingError
from boxreg_ros.labels import frames_of, SceneFrames
from boxreg_ros.labels.camera import Camera
from boxreg_ros.labels.files import frame_names, visible
from boxreg_ros.structures import Floats, Ints
import numpy as np

DATASET = Dataset(
    name='kitti-tracking',
    title='KITTI tracking',
    folder='velodyne/0000/, oxts/, calib/, label_02/ (of training/, unless the folder is named)',
    scene='0000',
    labels='kitti',
    remedy='unpack its archives into one folder',
    lidars=('velodyne',),
    reads='clouds, OXTS, labels',
    leaves_out='cameras, regions DontCare',
    read_back='pykitti 0.3.1',
)
PERIOD_NS = 100_000_000
"""Time between two frames [ns]: the LiDAR turns ten times a second."""
TRACKING_DIGITS = 6


def scene_names(root: Path) -> list[str]:
    """Return the names of the sequences with clouds."""
    return [path.name for path in visible(_split(root) / DATASET.lidar, '*') if path.is_dir()]


def inputs(root: Path, name: str) -> tuple[Path, ...]:
    """Return the files and folders of a sequence."""
    split = _split(root)
    files = (split / folder / f'{name}.txt' for folder in ('label_02', 'oxts', 'calib'))
    return (split / DATASET.lidar / name, *files)


def open_scene(root: Path, name: str, lidars: Sequence[str]) -> Scene:
    """Return a sequence; see `protocol.DatasetModule`."""
    split = _split(root)
    clouds = split / DATASET.lidar / name
    numbers = [int(path.stem) for path in visible(clouds, '*.bin') if path.stem.isdigit()]
    if not numbers:
        raise RecordingError(
            f'{clouds}: expected sweeps {0:0{TRACKING_DIGITS}d}.bin and so on, got none; unpack '
            f'data_tracking_velodyne.zip into the same folder'
        )
    calibration = require(
        split / 'calib' / f'{name}.txt', 'the calibration', 'unpack data_tracking_calib.zip'
    )
    stamps_ns, poses = _poses(split, name, calibration, 1 + max(numbers))
    names = {str(number): stamp_ns for number, stamp_ns in enumerate(stamps_ns.tolist())}
    camera = Camera.read(calibration)
    frames = SceneFrames(name, names, *frame_names(split, 'map', DATASET.lidar), camera)
    labels = split / 'label_02' / f'{name}.txt'
    return Scene(
        frames,
        DATASET.lidar,
        stamps_ns,
        partial(kitti.sweep_files, clouds, TRACKING_DIGITS, stamps_ns.tolist()),
        stamps_ns,
        poses,
        partial(frames_of, 'kitti', labels, frames) if labels.is_file() else None,
        without_boxes=str(labels),
    )


def _poses(split: Path, name: str, calibration: Path, count: int) -> tuple[Ints, Floats]:
    """Return stamps (n,) and poses (n, 7) of the LiDAR, one per frame."""
    exported = kitti.exported_poses(split, count)
    if exported is not None:
        return exported
    path = require(split / 'oxts' / f'{name}.txt', 'the poses', 'unpack data_tracking_oxts.zip')
    rows = kitti.oxts_rows(path)
    if len(rows) < count:
        raise RecordingError(
            f'{path}: expected poses of {count} frames, got {len(rows)}; unpack it again'
        )
    values = kitti.calibration_lines(calibration, 'data_tracking_calib.zip')
    T_velo_imu = kitti.rigid_transform(values.get('Tr_imu_velo', []), calibration)
    # The first stamp is not 0, which stands for a header without one.
    stamps_ns = (1 + np.arange(len(rows), dtype=np.int64)) * PERIOD_NS
    return stamps_ns, kitti.oxts_poses(rows, T_velo_imu)


def _split(root: Path) -> Path:
    """Return the folder of a split: the root itself, or ``training`` in it."""
    return root if (root / DATASET.lidar).is_dir() else root / 'training'
