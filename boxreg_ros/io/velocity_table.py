"""``velocities.csv``: how each refined box of ``boxes.csv`` moves, one row per known velocity."""

from __future__ import annotations

from itertools import combinations_with_replacement
from pathlib import Path

from boxreg_ros.io.box_table import cell, read_by_box
from boxreg_ros.io.covariance_table import symmetric
from boxreg_ros.structures import KINEMATICS, RefinedBoxes
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
RATES_FORMAT = ','.join(['%.7g'] * 14)
ACCELERATION_FORMAT = ','.join(['%.7g'] * 9)


class VelocityWriter:
    """Write velocities and accelerations with seven significant digits."""

    def __init__(self, path: Path) -> None:
        self._file = path.open('w', newline='', encoding='utf-8')
        self._file.write(','.join(VELOCITY_COLUMNS) + '\n')

    def write(self, refined: RefinedBoxes) -> None:
        """Add a row for each box with a velocity; an unknown acceleration is empty cells."""
        found = refined.boxes.known_kinematics
        four, three = np.triu_indices(4), np.triu_indices(3)
        rates = np.hstack([found['velocity'], found['velocity_covariance'][:, *four]])
        others = np.hstack([found['acceleration'], found['acceleration_covariance'][:, *three]])
        columns = (refined.boxes.track_ids, rates.tolist(), others.tolist())
        rows = zip(found['has_velocity'], found['has_acceleration'], *columns, strict=True)
        lines = []
        for has_velocity, has_acceleration, track_id, numbers, accelerations in rows:
            if has_velocity:
                text = ACCELERATION_FORMAT % tuple(accelerations) if has_acceleration else ',' * 8
                begin = f'{refined.boxes.stamp_ns},{cell(track_id)}'
                lines.append(f'{begin},{RATES_FORMAT % tuple(numbers)},{text}\n')
        self._file.write(''.join(lines))

    def close(self) -> None:
        """Close the file."""
        self._file.close()


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
