"""
KITTI raw, synchronised and rectified, as its archives are unpacked: one folder per day.

Sweeps have the stamp at which the LiDAR faces forward; poses are interpolated between those of
the GPS/IMU unit. The LiDAR turns while the vehicle moves, which is not compensated. Some drives
lack sweeps, and have blank lines for their stamps: these frames keep their number.

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
from boxreg_ros.labels.files import frame_names, visible
from boxreg_ros.labels.sidecar import filled_stamps, read_stamps, STAMPS_FILE
from boxreg_ros.labels.tracklets import FILE
from boxreg_ros.structures import Floats, Ints
import numpy as np

DATASET = Dataset(
    name='kitti-raw',
    title='KITTI raw',
    folder='DATE/DATE_drive_0001_sync/velodyne_points/, DATE/calib_imu_to_velo.txt',
    scene='2011_09_26_drive_0001',
    labels='tracklets',
    remedy='unpack its archives into one folder',
    lidars=('velodyne_points',),
    reads='synchronised clouds, OXTS, tracklets',
    leaves_out='cameras, unsynchronised drives',
    read_back='pykitti 0.3.1',
)
DRIVE_SUFFIX = '_sync'
RAW_DIGITS = 10
IMU_CALIBRATION_FILE = 'calib_imu_to_velo.txt'


def scene_names(root: Path) -> list[str]:
    """Return the names of the synchronised drives."""
    return sorted(_drives(root))


def inputs(root: Path, name: str) -> tuple[Path, ...]:
    """Return the files and folders of a drive."""
    drive = _drives(root)[name]
    parts = (DATASET.lidar, FILE, 'oxts')
    return (*(drive / part for part in parts), drive.parent / IMU_CALIBRATION_FILE)


def open_scene(root: Path, name: str, lidars: Sequence[str]) -> Scene:
    """Return a drive; see `protocol.DatasetModule`."""
    drive = _drives(root)[name]
    exported = kitti.exported_poses(drive, 1)
    if exported is None:
        given_ns = _stamps(drive / DATASET.lidar / STAMPS_FILE, f'{name}{DRIVE_SUFFIX}.zip')
        pose_stamps_ns, poses = _oxts(drive, name)
    else:
        pose_stamps_ns, poses = exported
        given_ns = _stamps(drive / STAMPS_FILE, 'the export')
    stamps_ns = filled_stamps(given_ns, len(given_ns))
    without_stamp = {number for number, stamp_ns in enumerate(given_ns) if stamp_ns is None}
    clouds = drive / DATASET.lidar / 'data'
    sweeps = partial(kitti.sweep_files, clouds, RAW_DIGITS, stamps_ns, without_stamp)
    names = {str(number): stamp_ns for number, stamp_ns in enumerate(stamps_ns)}
    frames = SceneFrames(name, names, *frame_names(drive, 'map', DATASET.lidar))
    labels = drive / FILE
    return Scene(
        frames,
        DATASET.lidar,
        np.array([sweep.stamp_ns for sweep in sweeps()], np.int64),
        sweeps,
        pose_stamps_ns,
        poses,
        partial(frames_of, 'tracklets', labels, frames) if labels.is_file() else None,
        without_boxes=f'{labels} (from {name}_tracklets.zip)',
    )


def _oxts(drive: Path, name: str) -> tuple[Ints, Floats]:
    """Return stamps (n,) and poses (n, 7) of the LiDAR at the stamps of the GPS/IMU unit."""
    archive = f'{name}{DRIVE_SUFFIX}.zip'
    stamps = enumerate(_stamps(drive / 'oxts' / STAMPS_FILE, archive))
    stamp_of = {number: stamp_ns for number, stamp_ns in stamps if stamp_ns is not None}
    folder = require(drive / 'oxts' / 'data', 'the poses', f'unpack {archive}')
    files = {int(path.stem): path for path in visible(folder, '*.txt') if path.stem.isdigit()}
    if files.keys() != stamp_of.keys():
        first = min(files.keys() ^ stamp_of.keys())
        raise RecordingError(
            f'{folder}: expected a pose for each of {len(stamp_of)} stamps, got {len(files)} '
            f'poses, the first difference is at frame {first}; unpack {archive} again'
        )
    stamps_ns = np.array([stamp_of[number] for number in sorted(files)], np.int64)
    rows = [kitti.oxts_rows(files[number]) for number in sorted(files)]
    calibration = drive.parent / IMU_CALIBRATION_FILE
    values = kitti.calibration_lines(calibration, f'{drive.parent.name}_calib.zip')
    R, t = values.get('R', []), values.get('T', [])
    if (len(R), len(t)) != (9, 3):
        raise RecordingError(
            f'{calibration}: expected lines R and T of 9 and 3 numbers, got {len(R)} and '
            f'{len(t)}; unpack it again'
        )
    T_velo_imu = kitti.rigid_transform([*R[:3], t[0], *R[3:6], t[1], *R[6:], t[2]], calibration)
    # Some drives have stamps of the unit that go back for a moment.
    stamps_ns, order = np.unique(stamps_ns, return_index=True)
    return stamps_ns, kitti.oxts_poses(np.concatenate(rows), T_velo_imu)[order]


def _stamps(path: Path, archive: str) -> list[int | None]:
    """Return the stamps of a file [ns]; None where a line is blank."""
    stamps_ns = read_stamps(require(path, 'the stamps', f'unpack {archive}'))
    if not any(stamps_ns):
        raise RecordingError(f'{path}: expected stamps, got none; unpack {archive} again')
    return stamps_ns


def _drives(root: Path) -> dict[str, Path]:
    """Return the folders of all drives by name: of all days, of one day, or one export."""
    found = [*visible(root, f'*{DRIVE_SUFFIX}'), *visible(root, f'*/*{DRIVE_SUFFIX}')]
    found += [root.absolute()] if (root / DATASET.lidar).is_dir() else []
    return {path.name.removesuffix(DRIVE_SUFFIX): path for path in found}
