"""Helpers of several data sets: clouds, poses, and checks for missing files and LiDARs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from boxreg_ros.datasets.protocol import Cloud
from boxreg_ros.errors import RecordingError, UnsupportedMessage
from boxreg_ros.labels.clouds import BIN_COLUMNS
from boxreg_ros.rotations import quaternion_from_matrix
from boxreg_ros.structures import Floats
import numpy as np
from numpy.typing import NDArray


def read_bin(path: Path, suffix: str) -> Cloud:
    """
    Return the cloud of a BIN file: rows of little-endian float32 that begin x y z intensity.

    Their number of columns is that of `suffix` in `BIN_COLUMNS`. Raises UnsupportedMessage if
    the file is missing or is not a whole number of rows.

    """
    columns = BIN_COLUMNS[suffix]
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
    return finite_cloud(rows[:, :3], rows[:, 3].astype(np.float64))


def finite_cloud(
    points: np.ndarray,
    intensities: Floats | None = None,
    times: Floats | None = None,
    origins: Floats | None = None,
    sensors: NDArray[np.uint8] | None = None,
) -> Cloud:
    """Return a cloud without the points that are not finite."""
    is_finite = np.isfinite(points).all(axis=1)
    if not is_finite.all():
        points = points[is_finite]
        intensities = None if intensities is None else intensities[is_finite]
        times = None if times is None else times[is_finite]
        sensors = None if sensors is None else sensors[is_finite]
    return Cloud(
        points, intensities, times, np.zeros((1, 3)) if origins is None else origins, sensors
    )


def missing_sweep(path: Path, error: OSError) -> UnsupportedMessage:
    """Return the error of a sweep whose file cannot be read."""
    return UnsupportedMessage(
        f'{path}: expected a sweep, got: {error.strerror}; download the archive that has it'
    )


def require(path: Path, what: str, remedy: str) -> Path:
    """Return a file or folder of a data set; RecordingError with `what` it is and the remedy."""
    if not path.exists():
        raise RecordingError(f'{path}: expected {what}, got no such file; {remedy}')
    return path


def require_lidars(asked: Sequence[str], names: Sequence[str], main: str = '') -> list[str]:
    """Return the LiDARs that are asked for, else the main one, else the only one, or refuse."""
    default = [main] if main else list(names)[: len(names) == 1]
    found = list(asked) or default
    unknown = [name for name in found if name not in names]
    if found and not unknown:
        return found
    raise RecordingError(
        f'points: expected one of the LiDARs {", ".join(names) or "(none)"}, got '
        f'{", ".join(map(repr, unknown)) or "none"}; choose one with --points'
    )


def require_lidar(asked: Sequence[str], names: Sequence[str], main: str = '') -> str:
    """Return the only LiDAR as `require_lidars`; RecordingError if several are asked for."""
    found = require_lidars(asked, names, main)
    if len(found) > 1:
        raise RecordingError(
            f'points: expected one of the LiDARs {", ".join(names)}, got {", ".join(found)}; '
            f'leave out all but one --points'
        )
    return found[0]


def pose_rows(transforms: Sequence[Floats]) -> Floats:
    """Return poses x y z qx qy qz qw, shape (P, 7), of P matrices (4, 4)."""
    poses = np.zeros((len(transforms), 7))
    for pose, T in zip(poses, transforms, strict=True):
        pose[:3] = T[:3, 3]
        pose[3:] = quaternion_from_matrix(T[:3, :3])
    return poses
