"""
Helpers of both data sets of KITTI: poses of the GPS/IMU unit (OXTS), clouds, exported poses.

OXTS states latitude and longitude [degrees], altitude [m], roll, pitch and yaw [rad] in the first
six of its 30 columns. They become metres by a Mercator projection about the first latitude.

"""

from __future__ import annotations

from collections.abc import Container, Iterator, Sequence
from functools import partial
from pathlib import Path

from boxreg_ros.datasets.files import pose_rows, read_bin, require
from boxreg_ros.datasets.protocol import Cloud, SweepFile
from boxreg_ros.errors import RecordingError, UnsupportedMessage
from boxreg_ros.io.transforms import inverse
from boxreg_ros.labels.clouds import BIN_COLUMNS
from boxreg_ros.labels.files import following
from boxreg_ros.labels.sidecar import POSES_FILE, read_poses, STAMPS_FILE, whole_stamps
from boxreg_ros.rotations import matrix_from_rpy
from boxreg_ros.structures import Floats, Ints
import numpy as np

EARTH_RADIUS = 6378137.0
"""Radius of the Mercator projection [m]: that of the development kit of KITTI, of WGS 84."""
OXTS_COLUMNS = 30


def oxts_rows(path: Path) -> Floats:
    """
    Return the rows of a file of OXTS.

    Parameters
    ----------
    path : Path
        A line of 30 numbers per frame.

    Returns
    -------
    rows : array, shape (n, 30)
        Their first six columns are finite: see the docstring of the module.

    Raises
    ------
    RecordingError
        If the file cannot be read, or has other lines.

    """
    with following(path, f'{OXTS_COLUMNS} numbers a line'):
        rows = np.loadtxt(path, ndmin=2)
    if rows.shape[1] != OXTS_COLUMNS or not np.isfinite(rows[:, :6]).all():
        raise RecordingError(
            f'{path}: expected {OXTS_COLUMNS} numbers a line, got {rows.shape[1]}, or NaN; '
            f'download it again'
        )
    return rows


def oxts_poses(rows: Floats, T_velo_imu: Floats) -> Floats:
    """
    Return the poses of the LiDAR in a map whose origin is the first position of the GPS/IMU unit.

    Parameters
    ----------
    rows : array, shape (n, 30)
        As of `oxts_rows`; at least one.
    T_velo_imu : array, shape (4, 4)
        Pose of the GPS/IMU unit in the frame of the LiDAR [m].

    Returns
    -------
    poses : array, shape (n, 7)
        x y z qx qy qz qw [m]; x is east, y is north, z is up.

    """
    latitude, longitude = np.radians(rows[:, 0]), np.radians(rows[:, 1])
    scale = EARTH_RADIUS * np.cos(latitude[0])
    north = scale * np.log(np.tan(np.pi / 4 + latitude / 2))
    positions = np.stack([scale * longitude, north, rows[:, 2]], axis=1)
    T_map_imu = np.tile(np.eye(4), (len(rows), 1, 1))  # (n, row, column)
    T_map_imu[:, :3, :3] = matrix_from_rpy(rows[:, 3:6])
    T_map_imu[:, :3, 3] = positions - positions[0]
    return pose_rows(T_map_imu @ inverse(T_velo_imu))


def exported_poses(folder: Path, count: int) -> tuple[Ints, Floats] | None:
    """
    Return the poses of our own exports, which have no OXTS.

    Parameters
    ----------
    folder : Path
        Of the sequence or drive.
    count : int
        Number of frames that need a stamp.

    Returns
    -------
    stamps_ns : array, shape (P,)
        Of the known poses [ns].
    poses : array, shape (P, 7)
        x y z qx qy qz qw of the LiDAR in the fixed frame [m]. None instead of both if the folder
        is no export.

    Raises
    ------
    RecordingError
        If a file does not follow its format, no pose is known, or there are less than `count`
        stamps.

    """
    if not (folder / POSES_FILE).is_file():
        return None
    stamps_ns = np.array(whole_stamps(folder / STAMPS_FILE), np.int64)
    poses = read_poses(folder / POSES_FILE, len(stamps_ns))
    known = [i for i, pose in enumerate(poses) if pose is not None]
    if not known or len(stamps_ns) < count:
        raise RecordingError(
            f'{folder / POSES_FILE}: expected poses of {count} frames, got {len(known)} and '
            f'{len(stamps_ns)} stamps; export again'
        )
    return stamps_ns[known], pose_rows([pose for pose in poses if pose is not None])


def sweep_files(
    folder: Path, digits: int, stamps_ns: Sequence[int], without_stamp: Container[int] = ()
) -> Iterator[SweepFile]:
    """
    Yield the sweeps of a folder; the file name is the number of the frame.

    Parameters
    ----------
    folder : Path
        Of the ``.bin`` files.
    digits : int
        Of the numbers in their names, with leading zeros.
    stamps_ns : sequence of int
        Of each frame [ns].
    without_stamp : container of int
        Frames that have no stamp in the data set, which left them out; theirs are interpolated.
        One that has a file is yielded, and its `read` raises UnsupportedMessage.

    Yields
    ------
    sweep : SweepFile
        One per frame, in the order of the numbers; missing files are noticed on reading.

    """
    for number, stamp_ns in enumerate(stamps_ns):
        path = folder / f'{number:0{digits}d}.bin'
        if number not in without_stamp:
            yield SweepFile(stamp_ns, partial(read_bin, path, BIN_COLUMNS['.bin']))
        elif path.is_file():
            yield SweepFile(stamp_ns, partial(_refuse_unstamped, path))


def _refuse_unstamped(path: Path) -> Cloud:
    raise UnsupportedMessage(
        f'{path}: expected a stamp in line {1 + int(path.stem)} of timestamps.txt, got a blank '
        f'line; write it there, or remove the sweep'
    )


def rigid_transform(numbers: Sequence[float], path: Path) -> Floats:
    """Return T (4, 4) of the twelve numbers of its upper three rows."""
    if len(numbers) != 12:
        raise RecordingError(f'{path}: expected 12 numbers of a pose, got {len(numbers)}')
    T = np.eye(4)
    T[:3] = np.reshape(numbers, (3, 4))
    return T


def calibration_lines(path: Path, archive: str) -> dict[str, list[float]]:
    """
    Return the numbers of each line of a calibration.

    Parameters
    ----------
    path : Path
        Lines of a name, with or without a colon, and numbers.
    archive : str
        Name of the archive that has the file, for the error.

    Returns
    -------
    values : dict of str to list of float
        By the name. Lines with words that are no numbers, as the date, are left out.

    Raises
    ------
    RecordingError
        If there is no such file.

    """
    require(path, 'the calibration', f'unpack {archive}')
    values = {}
    for line in path.read_text(encoding='utf-8', errors='replace').splitlines():
        name, *words = line.replace(':', ' ', 1).split() or ['']
        try:
            values[name] = [float(word) for word in words]
        except ValueError:
            continue  # the date of the calibration
    return values
