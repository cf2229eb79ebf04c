"""Helpers of several data sets: clouds, poses, and checks for missing files and LiDARs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from boxreg_ros.datasets.protocol import Cloud
from boxreg_ros.errors import RecordingError, UnsupportedMessage
from boxreg_ros.io.transforms import inverse
from boxreg_ros.labels.clouds import BIN_COLUMNS, read_pcd, SUFFIXES
from boxreg_ros.rotations import matrix_from_rpy, quaternion_from_matrix, rpy_from_matrix
from boxreg_ros.structures import Floats, Ints, on_lines
from msg_adapters import pointcloud
from msg_adapters.clouds import cloud_of_columns
import numpy as np
from numpy.typing import NDArray

MISSING_SWEEP = ': expected a sweep, got: '
"""Words of an error behind the path of a cloud that is not there."""


def read_cloud(path: Path, stamp_ns: int, kind: str = '', columns: int = 5) -> Cloud:
    """
    Return the cloud of a file, in the format of its name.

    Parameters
    ----------
    path : Path
        Its name ends in ``.pcd``, ``.pcd.bin`` or ``.bin``.
    stamp_ns : int
        Stamp of the sweep [ns]; times of points are relative to it.
    kind : str
        Format of files with another name: ``pcd``, ``pcd.bin`` or ``bin``.
    columns : int
        Numbers per point of ``.bin`` and ``.pcd.bin``.

    Returns
    -------
    cloud : Cloud
        Of the finite points. PCD files may have times, and intensities by the names that messages
        use.

    Raises
    ------
    UnsupportedMessage
        If the file is missing, damaged, or of another format.

    """
    suffix = next((suffix for suffix in SUFFIXES if path.name.endswith(suffix)), f'.{kind}')
    if suffix == '.pcd':
        return _read_pcd_cloud(path, stamp_ns)
    if suffix in BIN_COLUMNS:
        return read_bin(path, columns)
    raise UnsupportedMessage(
        f'{path}: expected a cloud in .pcd, .pcd.bin or .bin, got the format {kind!r}; write it '
        f'as PCD'
    )


def _read_pcd_cloud(path: Path, stamp_ns: int) -> Cloud:
    """Return the cloud of a PCD file, whose fields are read as those of a PointCloud2."""
    try:
        table = read_pcd(path)
    except OSError as error:
        raise missing_sweep(path, error) from None
    message = _as_message(table, stamp_ns)
    try:
        sweep = pointcloud.from_msg(message)
        intensities = pointcloud.intensities(message)
    except UnsupportedMessage as error:
        raise UnsupportedMessage(f'{path}: {error}') from None
    return Cloud(sweep.points, intensities, sweep.times)


def _as_message(table: NDArray[Any], stamp_ns: int) -> Any:
    """Return the points of a PCD file (M,) with the attributes of a PointCloud2."""
    names = [name for name in table.dtype.names or () if not table.dtype[name].shape]
    stamp = SimpleNamespace(sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    header = SimpleNamespace(stamp=stamp, frame_id='')
    return cloud_of_columns(header, [(name, table[name]) for name in names])


def read_bin(path: Path, columns: int) -> Cloud:
    """
    Return the cloud of a BIN file: rows of little-endian float32 that begin x y z intensity.

    Parameters
    ----------
    path : Path
        The file.
    columns : int
        Numbers per point, at least 4.

    Raises
    ------
    UnsupportedMessage
        If the file is missing or is not a whole number of rows.

    """
    try:
        numbers = np.fromfile(path, '<f4')
    except OSError as error:
        raise missing_sweep(path, error) from None
    if numbers.size % columns:
        raise UnsupportedMessage(
            f'{path}: expected rows of {columns} float32, got {path.stat().st_size} bytes; '
            f'download it again'
        )
    rows = numbers.reshape(-1, columns)
    return Cloud(rows[:, :3], rows[:, 3].astype(np.float64)).finite()


def at_stamp(
    points: Floats, times: Floats, stamp_ns: int, pose_stamps_ns: Ints, T_fixed_frame: Floats
) -> Floats:
    """
    Return points in a moving frame at one stamp.

    Parameters
    ----------
    points : array, shape (M, 3)
        In the frame, each when it was measured [m].
    times : array, shape (M,)
        Of measurement relative to the stamp [s].
    stamp_ns : int
        Stamp of the result [ns].
    pose_stamps_ns : array, shape (P,)
        Stamps of the poses, ascending [ns].
    T_fixed_frame : array, shape (P, 4, 4)
        Poses of the frame in a fixed one; interpolated, and held before the first and after the
        last.

    Returns
    -------
    points : array, shape (M, 3)
        In the frame at the stamp [m].

    """
    after = (pose_stamps_ns - stamp_ns) * 1e-9  # (P,) [s]
    first = max(int(np.searchsorted(after, min(times.min(), 0.0), side='right')) - 1, 0)
    last = min(int(np.searchsorted(after, max(times.max(), 0.0))) + 1, len(after))
    knots = inverse(T_fixed_frame[first]) @ T_fixed_frame[first:last]  # (K, 4, 4), small motions
    motion = np.hstack([knots[:, :3, 3], rpy_from_matrix(knots[:, :3, :3])])  # (K, 6)
    at = np.append(times, 0.0)
    moved = on_lines(after[first:last], motion, at)
    R = matrix_from_rpy(moved[:, 3:])  # (M + 1, 3, 3), the last is at the stamp
    placed = np.einsum('mij,mj->mi', R[:-1], points) + moved[:-1, :3]
    return np.asarray((placed - moved[-1, :3]) @ R[-1])


def missing_sweep(path: Path, error: OSError) -> UnsupportedMessage:
    """Return the error of a sweep whose file cannot be read."""
    return UnsupportedMessage(
        f'{path}{MISSING_SWEEP}{error.strerror}; download the archive that has it'
    )


def require(path: Path, what: str, remedy: str) -> Path:
    """Return a file or folder of a data set; RecordingError with `what` it is and the remedy."""
    if not path.exists():
        raise RecordingError(f'{path}: expected {what}, got no such file; {remedy}')
    return path


def require_lidars(asked: Sequence[str], names: Sequence[str]) -> tuple[str, ...]:
    """
    Return the LiDARs to read.

    Parameters
    ----------
    asked : sequence of str
        Names that are asked for; none for the only one.
    names : sequence of str
        Those of the data set or scene.

    Returns
    -------
    lidars : tuple of str
        One or more of `names`, each once, in the order in which they are asked for.

    Raises
    ------
    RecordingError
        If a name is none of `names`, or none is asked for and there are several.

    """
    found = tuple(dict.fromkeys(asked or names[: len(names) == 1]))
    unknown = [name for name in found if name not in names]
    if found and not unknown:
        return found
    raise RecordingError(
        f'points: expected one of the LiDARs {", ".join(names) or "(none)"}, got '
        f'{", ".join(map(repr, unknown)) or "none"}; choose one with --points'
    )


def pose_rows(transforms: Sequence[Floats] | Floats) -> Floats:
    """Return poses x y z qx qy qz qw, shape (P, 7), of P matrices (4, 4)."""
    T = np.reshape(transforms, (-1, 4, 4))
    return np.hstack([T[:, :3, 3], quaternion_from_matrix(T[:, :3, :3])])
