"""
Parquet: the columns of ``boxes.csv`` and more.

Additional columns: the reason of kept boxes; the covariance (36 numbers, of x y z roll pitch yaw
in the frame of the row); and the pose ``T_fixed_sensor`` (16 numbers, row by row) with the names
of its frames. The provenance is in the metadata of the file.

"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict
from itertools import groupby
from pathlib import Path
from typing import Any

from boxreg_ros.errors import RecordingError
from boxreg_ros.io.box_table import COLUMNS
from boxreg_ros.labels.arrow import read_table, Table
from boxreg_ros.labels.files import to_json
from boxreg_ros.labels.protocol import Format, LabelFrame, Options, Provenance
from boxreg_ros.labels.records import finite_or_none, numbers_of, ReadBox, refined_of
from boxreg_ros.rotations import boxes_from_quaternions
import numpy as np

FORMAT = Format(
    name='parquet',
    title='Parquet',
    frame='fixed, named in each row',
    rotation='quaternion x y z w',
    files='boxes.parquet',
    packages=('pyarrow',),
    reads='as `csv`',
    read_back='pandas 3.1.1',
)
TEXT_COLUMNS = ('frame_id', 'track_id', 'class_name', 'status')
INTEGER_COLUMNS = ('stamp_ns', 'num_points')
COLUMN_TYPES = {
    **dict.fromkeys(COLUMNS, 'double'),
    **dict.fromkeys(TEXT_COLUMNS, 'string'),
    **dict.fromkeys(INTEGER_COLUMNS, 'int64'),
    'reason': 'string',
    'covariance': 'double[]',
    'extent_covariance': 'double[]',
    'fixed_frame': 'string',
    'sensor_frame': 'string',
    'T_fixed_sensor': 'double[]',
}
"""Type of each column; the order is that of ``boxes.csv``, then the additional columns."""
NULL_VALUES = {'string': '', 'int64': 0, 'double': np.nan}
"""Values that replace null when reading, by type."""


class Writer:
    """Write boxes.parquet; numbers that are not finite become null."""

    def __init__(self, folder: Path, provenance: Provenance, options: Options) -> None:
        self.dropped: Counter[str] = Counter()
        self._table = Table(folder / 'boxes.parquet', COLUMN_TYPES, to_json(asdict(provenance)))

    def write(self, frame: LabelFrame) -> None:
        """Add one row per box."""
        refined = frame.refined
        boxes = refined.boxes
        T = frame.T_fixed_sensor
        pose = None if T is None else T.ravel().tolist()
        for i, row in enumerate(numbers_of(boxes).tolist()):
            self._table.add(
                boxes.stamp_ns,
                boxes.frame_id,
                boxes.track_ids[i],
                boxes.class_names[i],
                *map(finite_or_none, row),
                refined.status[i],
                int(refined.num_points[i]),
                refined.reasons[i],
                refined.covariances[i].ravel().tolist(),
                refined.extent_covariances[i].ravel().tolist(),
                frame.fixed_frame,
                frame.sensor_frame,
                pose,
            )

    def close(self) -> None:
        """Complete the file."""
        self._table.close()


def read(path: Path) -> Iterator[LabelFrame]:
    """Yield the boxes of each stamp and frame; only the columns of boxes.csv are required."""
    if path.is_dir():
        path = path / 'boxes.parquet'
    rows = _rows(path)
    rows.sort(key=lambda row: row['stamp_ns'])
    for (stamp_ns, frame_id), group in groupby(rows, lambda r: (r['stamp_ns'], r['frame_id'])):
        items = list(group)
        # score, x y z, qx qy qz qw, length width height
        numbers = np.array([[item[name] for name in COLUMNS[4:15]] for item in items], np.float64)
        boxes = boxes_from_quaternions(numbers[:, 1:4], numbers[:, 8:], numbers[:, 4:8])
        found = [
            ReadBox(item['track_id'], item['class_name'], box, item)
            for item, box in zip(items, boxes, strict=True)
        ]
        T = items[0].get('T_fixed_sensor')
        yield LabelFrame(
            refined_of(stamp_ns, frame_id, found),
            items[0].get('fixed_frame') or frame_id,
            items[0].get('sensor_frame') or '',
            None if T is None else np.array(T).reshape(4, 4),
        )


def _rows(path: Path) -> list[dict[str, Any]]:
    """
    Return the rows of a file, with columns converted to `COLUMN_TYPES`.

    Other writers use other types: pandas stores ids as numbers, and stamps may be timestamps of
    any unit. Null becomes '' in text and 0 in integers.

    """
    from pyarrow import ArrowException

    table = read_table(path, COLUMNS, 'boxes.parquet')
    for i, name in enumerate(table.column_names):
        kind = COLUMN_TYPES.get(name)
        if kind not in NULL_VALUES:
            continue
        column = table[name]
        try:
            if name == 'stamp_ns':
                column = _stamps(path, column)
            column = column.cast(kind).fill_null(NULL_VALUES[kind])
        except ArrowException as error:
            raise RecordingError(
                f'{path}: column {name}: expected {kind}, got {column.type}: {error}'
            ) from None
        table = table.set_column(i, name, column)
    return list(table.to_pylist())


def _stamps(path: Path, column: Any) -> Any:
    """Return a column of integers or timestamps as integers or nanoseconds, without null."""
    from pyarrow import timestamp, types

    is_timestamp = types.is_timestamp(column.type)
    is_number = is_timestamp or types.is_integer(column.type)
    if not is_number or column.null_count:
        raise RecordingError(
            f'{path}: column stamp_ns: expected whole nanoseconds (int64) in every row, got '
            f'{column.type}, {column.null_count} of {len(column)} empty; write them as integers'
        )
    return column.cast(timestamp('ns', column.type.tz)) if is_timestamp else column
