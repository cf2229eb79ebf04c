"""``covariances.csv``: how certain each box of ``boxes.csv`` is, one row per refined box."""

from __future__ import annotations

from itertools import combinations_with_replacement
from pathlib import Path
from typing import NamedTuple

from boxreg_ros.io.box_table import cell, number_cells, read_by_box, single_precision
from boxreg_ros.structures import Floats, RefinedBoxes, X, Y
import numpy as np

COVARIANCES = 'covariances.csv'
POSE_NAMES = ('x', 'y', 'z', 'roll', 'pitch', 'yaw')
EXTENT_NAMES = ('length', 'width', 'height')
COVARIANCE_NUMBERS = tuple(
    f'{a}_{b}'
    for names in (POSE_NAMES, EXTENT_NAMES)
    for a, b in combinations_with_replacement(names, 2)
)
"""Upper triangles of the two matrices, row by row [m^2, m rad, rad^2]."""
COVARIANCE_COLUMNS = ('stamp_ns', 'track_id', 'range', *COVARIANCE_NUMBERS)
POSE_TRIANGLE = np.triu_indices(6)
EXTENT_TRIANGLE = np.triu_indices(3)
NUM_POSE = len(POSE_TRIANGLE[0])
UNIT_ROUNDING = 1e-9
"""Largest deviation from the unit matrix of one that was moved to another frame; chosen."""


class BoxCovariance(NamedTuple):
    """The row of one box."""

    distance: float
    """Horizontal, from the sensor [m]; NaN if unknown."""
    pose: Floats
    """(6, 6), of x y z roll pitch yaw in the frame of the row in ``boxes.csv`` [m, rad]."""
    extent: Floats
    """(3, 3), of length, width and height [m]."""


def covariance_lines(refined: RefinedBoxes, T_fixed_sensor: Floats | None) -> list[str]:
    """
    Return the lines of ``covariances.csv``, in single precision.

    Parameters
    ----------
    refined : RefinedBoxes
        Boxes and covariances in the fixed frame [m, rad].
    T_fixed_sensor : array, shape (4, 4), or None
        Pose of the sensor, for the horizontal distance of each box; None leaves it empty.

    Returns
    -------
    list of str
        One line per box with a covariance, with its end. Kept and rejected boxes, and those of
        label files that state none, have the unit matrix, and no line.

    """
    boxes = refined.boxes
    is_known = np.abs(refined.covariances - np.eye(6)).max(axis=(1, 2)) > UNIT_ROUNDING
    distances = [''] * len(refined.status)
    if T_fixed_sensor is not None:
        offset = boxes.boxes[:, [X, Y]] - T_fixed_sensor[:2, 3]
        distances = [f'{distance:.3f}' for distance in np.hypot(*offset.T).tolist()]
    triangles = (
        refined.covariances[:, *POSE_TRIANGLE],
        refined.extent_covariances[:, *EXTENT_TRIANGLE],
    )
    numbers = number_cells(single_precision(np.hstack(triangles)), 'nan')
    columns = boxes.track_ids, is_known.tolist(), distances, numbers
    return [
        f'{boxes.stamp_ns},{cell(track_id)},{distance},{cells}\n'
        for track_id, has_covariance, distance, cells in zip(*columns, strict=True)
        if has_covariance
    ]


def read_covariances(path: Path) -> dict[tuple[int, str], BoxCovariance]:
    """Read a table of covariances, the first row of a stamp and id; RecordingError if damaged."""
    return read_by_box(path, _covariance)


def _covariance(row: dict[str, str]) -> BoxCovariance:
    """Return the covariances of a row."""
    numbers = np.array([float(row[name]) for name in COVARIANCE_NUMBERS])
    pose = symmetric(numbers[:NUM_POSE], 6)
    extent = symmetric(numbers[NUM_POSE:], 3)
    return BoxCovariance(float(row['range'] or 'nan'), pose, extent)


def symmetric(upper: Floats, size: int) -> Floats:
    """Return the symmetric matrix (size, size) of its upper triangle, row by row."""
    matrix = np.zeros((size, size))
    matrix[np.triu_indices(size)] = upper
    return matrix + np.triu(matrix, 1).T
