"""``velocities.csv``: how each refined box of ``boxes.csv`` moves, one row per known velocity."""

from __future__ import annotations

from itertools import combinations_with_replacement
from pathlib import Path

from boxreg_ros.io.box_table import cell, number_cells, read_by_box, single_precision
from boxreg_ros.io.covariance_table import symmetric
from boxreg_ros.structures import BoxArray, KINEMATICS
import numpy as np
from numpy.typing import NDArray

VELOCITIES = 'velocities.csv'
RATE_NAMES = ('vx', 'vy', 'vz', 'yaw_rate')
ACCELERATION_NAMES = ('ax', 'ay', 'az')
VELOCITY_COLUMNS = (
    *('stamp_ns', 'track_id'),
    *RATE_NAMES,
    *(f'{a}_{b}' for a, b in combinations_with_replacement(RATE_NAMES, 2)),
    *ACCELERATION_NAMES,
    *(f'{a}_{b}' for a, b in combinations_with_replacement(ACCELERATION_NAMES, 2)),
)
"""Over ground, in the axes of ``boxes.csv`` [m/s, rad/s, m/s^2]; then the upper triangle of the
covariance of each, row by row."""
RATES_TRIANGLE = np.triu_indices(len(RATE_NAMES))
ACCELERATION_TRIANGLE = np.triu_indices(len(ACCELERATION_NAMES))


def velocity_lines(boxes: BoxArray) -> list[str]:
    """
    Return the line of each box with a velocity, in single precision.

    An unknown acceleration is empty cells.

    """
    found = boxes.known_kinematics
    cells = []
    for name, triangle in (('velocity', RATES_TRIANGLE), ('acceleration', ACCELERATION_TRIANGLE)):
        numbers = np.hstack([found[name], found[f'{name}_covariance'][:, *triangle]])
        cells.append(number_cells(single_precision(numbers), 'nan'))
    is_known = found['has_velocity'].tolist(), found['has_acceleration'].tolist()
    return [
        f'{boxes.stamp_ns},{cell(track_id)},{rates},{acceleration if accelerates else "," * 8}\n'
        for track_id, moves, accelerates, rates, acceleration in zip(
            boxes.track_ids, *is_known, *cells, strict=True
        )
        if moves
    ]


def read_velocities(path: Path) -> dict[tuple[int, str], NDArray[np.void]]:
    """
    Return the record `KINEMATICS` of each stamp and id, the first where there are several.

    Raises RecordingError if the table is damaged.

    """
    return read_by_box(path, _record)


def _record(row: dict[str, str]) -> NDArray[np.void]:
    """Return the record of a row."""
    numbers = np.array([float(row[name] or 'nan') for name in VELOCITY_COLUMNS[2:]])
    record = np.zeros((), KINEMATICS)
    for name, size, begin in (('velocity', 4, 0), ('acceleration', 3, 14)):
        if not np.isfinite(numbers[begin]):
            continue
        middle = begin + size
        upper = numbers[middle : middle + size * (size + 1) // 2]
        record[name] = numbers[begin:middle]
        record[f'{name}_covariance'] = symmetric(upper, size)
        record[f'has_{name}'] = True
    return record
