"""``velocities.csv``: how each refined box of ``boxes.csv`` moves, one row per known velocity."""

from __future__ import annotations

import csv
from itertools import combinations_with_replacement
from pathlib import Path

from boxreg_ros.errors import RecordingError, unreadable
from boxreg_ros.io.box_table import cell, unprotected
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
    found: dict[tuple[int, str], NDArray[np.void]] = {}
    try:
        with path.open(newline='', encoding='utf-8-sig') as file:
            for row in csv.DictReader(file):
                texts = [row[name] for name in VELOCITY_COLUMNS[2:]]
                numbers = np.array([float(text or 'nan') for text in texts])
                key = int(row['stamp_ns']), unprotected(row['track_id'])
                found.setdefault(key, _record(numbers))
    except OSError as error:
        raise RecordingError(unreadable(path, error)) from None
    except (KeyError, TypeError, ValueError, csv.Error) as error:
        raise RecordingError(
            f'{path}: expected the columns of velocities.csv with a number in each cell, got '
            f'{error}; relabel again, or delete the file'
        ) from None
    return found


def _record(numbers: NDArray[np.float64]) -> NDArray[np.void]:
    """Return the record of a row (23,) without its keys."""
    record = np.zeros((), KINEMATICS)
    for name, size, begin in (('velocity', 4, 0), ('acceleration', 3, 14)):
        if not np.isfinite(numbers[begin]):
            continue
        middle = begin + size
        upper = np.zeros((size, size))
        upper[np.triu_indices(size)] = numbers[middle : middle + size * (size + 1) // 2]
        record[name] = numbers[begin:middle]
        record[f'{name}_covariance'] = upper + np.triu(upper, 1).T
        record[f'has_{name}'] = True
    return record
