"""
Parquet: the columns of ``boxes.csv`` and what that has no room for.

Beyond them the reason of kept boxes, the covariance (36 numbers, of x y z roll pitch yaw in the
axes of the row's frame), and the pose ``T_fixed_sensor`` (16 numbers, row by row) with the names
of its frames. Provenance is in the file's own metadata.

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
from boxreg_ros.labels import Format, LabelFrame, Options, Provenance
from boxreg_ros.labels.arrow import read_table, Table
from boxreg_ros.labels.files import boxes_from, refined_boxes, to_json
from boxreg_ros.structures import HEIGHT, LENGTH, X, Z
from msg_adapters.poses import quaternions_of
import numpy as np

FORMAT = Format(
    name='parquet',
    title='Parquet',
    frame='fixed, named in each row',
    reference='centre',
    sizes='length width height',
    rotation='quaternion x y z w',
    files='boxes.parquet',
    packages=('pyarrow',),
)
TEXTS, COUNTS = {'frame_id', 'track_id', 'class_name', 'status'}, {'stamp_ns', 'num_points'}
TYPES = {
    name: 'string' if name in TEXTS else 'int64' if name in COUNTS else 'double'
    for name in COLUMNS
} | {
    'reason': 'string',
    'covariance': 'double[]',
    'fixed_frame': 'string',
    'sensor_frame': 'string',
    'T_fixed_sensor': 'double[]',
}
EMPTY = {'string': '', 'int64': 0, 'double': np.nan}
"""What stands for null."""


class Writer:
    """Write boxes.parquet; what is not finite becomes null."""

    def __init__(self, folder: Path, provenance: Provenance, options: Options) -> None:
        self.dropped: Counter[str] = Counter()
        self._table = Table(folder / 'boxes.parquet', TYPES, to_json(asdict(provenance)))

    def write(self, frame: LabelFrame) -> None:
        """Add one row per box."""
        refined, boxes = frame.refined, frame.refined.boxes
        values = boxes.boxes
        numbers = np.hstack([
            boxes.scores[:, None], values[:, X : Z + 1],
            quaternions_of(values), values[:, LENGTH : HEIGHT + 1],
        ])  # fmt: skip
        T = frame.T_fixed_sensor
        pose = (frame.fixed_frame, frame.sensor_frame, None if T is None else T.ravel().tolist())
        for i, row in enumerate(numbers.tolist()):
            self._table.add(
                boxes.stamp_ns, boxes.frame_id, boxes.track_ids[i], boxes.class_names[i],
                *(value if np.isfinite(value) else None for value in row),
                refined.status[i], int(refined.num_points[i]), refined.reasons[i],
                refined.covariances[i].ravel().tolist(), *pose,
            )  # fmt: skip

    def close(self) -> None:
        """Complete the file."""
        self._table.close()


def read(path: Path) -> Iterator[LabelFrame]:
    """Yield the boxes of each stamp and frame; only the columns of boxes.csv have to be there."""
    if path.is_dir():
        path = path / 'boxes.parquet'
    rows = _rows(path)
    rows.sort(key=lambda row: row['stamp_ns'])
    for (stamp_ns, frame_id), part in groupby(rows, lambda r: (r['stamp_ns'], r['frame_id'])):
        items = list(part)
        numbers = np.array([[item[name] for name in COLUMNS[4:15]] for item in items], np.float64)
        refined = refined_boxes(
            stamp_ns,
            frame_id,
            [item['track_id'] for item in items],
            [item['class_name'] for item in items],
            boxes_from(numbers[:, 1:4], numbers[:, 8:], numbers[:, 4:8]),
            numbers[:, 0],
            [item['status'] for item in items],
            [item['num_points'] for item in items],
            [item.get('covariance') for item in items],
            [item.get('reason') for item in items],
        )
        T = items[0].get('T_fixed_sensor')
        yield LabelFrame(
            refined,
            items[0].get('fixed_frame') or frame_id,
            items[0].get('sensor_frame') or '',
            None if T is None else np.array(T).reshape(4, 4),
        )


def _rows(path: Path) -> list[dict[str, Any]]:
    """
    Return the rows of a file, whatever types whoever wrote it gave the columns.

    Texts may be numbers (of pandas, ids are) and timestamps of any unit stand for their
    nanoseconds; where there is none, a text is '' and a count 0.

    """
    from pyarrow import ArrowException, timestamp, types

    table = read_table(path)
    missing = [name for name in COLUMNS if name not in table.column_names]
    if missing:
        raise RecordingError(f'{path}: columns missing: {", ".join(missing)}')
    for i, name in enumerate(table.column_names):
        column, kind = table[name], TYPES.get(name)
        if kind not in EMPTY:
            continue
        try:
            if name == 'stamp_ns':
                is_timestamp = types.is_timestamp(column.type)
                if not (is_timestamp or types.is_integer(column.type)) or column.null_count:
                    raise RecordingError(
                        f'{path}: column stamp_ns: expected whole nanoseconds (int64) in every '
                        f'row, got {column.type}, {column.null_count} of {len(column)} empty; '
                        f'write them as integers'
                    )
                if is_timestamp:
                    column = column.cast(timestamp('ns', column.type.tz))
            column = column.cast(kind).fill_null(EMPTY[kind])
        except ArrowException as error:
            raise RecordingError(
                f'{path}: column {name}: expected {kind}, got {column.type}: {error}'
            ) from None
        table = table.set_column(i, name, column)
    return list(table.to_pylist())
