"""
``boxes.csv``: one row per box, with its frame; beside it covariances and velocities.

``attributes.csv`` has a row per box and attribute, where boxes have any: the columns of
``boxes.csv`` are the same for all.

"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
import csv
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import IO

from boxreg_ros.io.box_table import (
    box_of,
    BoxTable,
    cell,
    COLUMNS,
    csv_row,
    number_cells,
    parsed_rows,
    protected,
    unprotected,
)
from boxreg_ros.io.covariance_table import COVARIANCE_COLUMNS, covariance_lines, COVARIANCES
from boxreg_ros.io.velocity_table import VELOCITIES, VELOCITY_COLUMNS, velocity_lines
from boxreg_ros.labels.protocol import Format, LabelFrame, Options, Provenance
from boxreg_ros.labels.records import numbers_of, ReadBox, refined_of
from boxreg_ros.structures import BoxArray, PROPOSED
import numpy as np

ATTRIBUTES = 'attributes.csv'
ATTRIBUTE_COLUMNS = ('stamp_ns', 'track_id', 'name', 'value')

FORMAT = Format(
    name='csv',
    title='CSV',
    frame='fixed, named in each row',
    rotation='quaternion x y z w',
    files='boxes.csv, covariances.csv, velocities.csv, attributes.csv',
    reads='one row per box',
    leaves_out='covariances.csv, velocities.csv, proposals',
    read_back='pandas 3.1.1',
)


class Writer:
    """
    Write boxes.csv with numbers in full precision; values that are not finite are empty cells.

    Rows are sorted by stamp. If boxes arrive after those of a later stamp, the file is read and
    sorted when it is closed.

    """

    def __init__(self, folder: Path, provenance: Provenance, options: Options) -> None:
        self.dropped: Counter[str] = Counter()
        self._folder = folder
        self._files = ExitStack()
        self._boxes = self._begun('boxes.csv', COLUMNS)
        self._covariances = self._begun(COVARIANCES, COVARIANCE_COLUMNS)
        self._velocities = self._begun(VELOCITIES, VELOCITY_COLUMNS)
        self._attributes: IO[str] | None = None
        self._newest_ns: int | None = None
        self._is_sorted = True

    def _begun(self, name: str, columns: Sequence[str]) -> IO[str]:
        """Open a table and write its header."""
        path = self._folder / name
        file = self._files.enter_context(path.open('w', newline='', encoding='utf-8'))
        file.write(csv_row(columns))
        return file

    def write(self, frame: LabelFrame) -> None:
        """Add one row per box."""
        refined = frame.refined
        self._covariances.write(''.join(covariance_lines(refined, frame.T_fixed_sensor)))
        self._velocities.write(''.join(velocity_lines(refined.boxes)))
        boxes = refined.boxes
        stamp_ns = boxes.stamp_ns
        if self._newest_ns is not None and stamp_ns < self._newest_ns:
            self._is_sorted = False
        self._newest_ns = stamp_ns
        begin = f'{stamp_ns},{cell(boxes.frame_id)}'
        names = boxes.track_ids, boxes.class_names
        numbers = number_cells(numbers_of(boxes), ''), refined.num_points.tolist()
        rows = zip(*names, *numbers, refined.status, strict=True)
        lines = [
            f'{begin},{cell(track_id)},{cell(class_name)},{texts},{cell(status)},{num_points}\n'
            for track_id, class_name, texts, num_points, status in rows
        ]
        self._boxes.write(''.join(lines))
        self._write_attributes(boxes)

    def _write_attributes(self, boxes: BoxArray) -> None:
        if not any(boxes.attributes):
            return
        if self._attributes is None:
            self._attributes = self._begun(ATTRIBUTES, ATTRIBUTE_COLUMNS)
        for track_id, attributes in zip(boxes.track_ids, boxes.attributes, strict=True):
            for name, value in attributes.items():
                words = map(protected, (track_id, name, value))
                self._attributes.write(csv_row((str(boxes.stamp_ns), *words)))

    def close(self) -> None:
        """Close the files; sort that of the boxes if some arrived late."""
        self._files.close()
        if self._is_sorted:
            return
        path = self._folder / 'boxes.csv'
        with path.open(newline='', encoding='utf-8') as file:
            header, *rows = csv.reader(file)
        rows.sort(key=lambda row: int(row[0]))
        with path.open('w', newline='', encoding='utf-8') as file:
            file.writelines(map(csv_row, [header, *rows]))


def read(path: Path) -> Iterator[LabelFrame]:
    """
    Yield the boxes of each stamp and frame.

    The frame of most boxes is used as the fixed frame. Proposals are left out: they are no labels.

    """
    if path.is_dir():
        path = path / 'boxes.csv'
    tables = {
        name: table.rows(np.array(table.status) != PROPOSED)
        for name, table in BoxTable.read_frames(path).items()
    }
    attributes = _read_attributes(path.with_name(ATTRIBUTES)) if path.name == 'boxes.csv' else {}
    fixed_frame = max(tables, key=lambda name: len(tables[name].boxes), default='')
    found = [
        (stamp_ns, name, row)
        for name, table in tables.items()
        for row, stamp_ns in enumerate(table.stamps_ns.tolist())
    ]
    found.sort(key=itemgetter(0))
    for (stamp_ns, name), group in groupby(found, itemgetter(0, 1)):
        table = tables[name]
        boxes = []
        for *_, row in group:
            evidence = {
                'score': table.scores[row],
                'status': table.status[row],
                'num_points': table.num_points[row],
                'attributes': attributes.get((stamp_ns, table.track_ids[row])),
            }
            names = table.track_ids[row], table.class_names[row]
            boxes.append(ReadBox(*names, table.boxes[row], evidence))
        yield LabelFrame(refined_of(stamp_ns, name, boxes), fixed_frame, '')


def _read_attributes(path: Path) -> dict[tuple[int, str], dict[str, str]]:
    """Return the attributes of each box by stamp and track id; empty without the file."""
    found: dict[tuple[int, str], dict[str, str]] = {}
    if path.exists():
        for box, name, value in parsed_rows(path, _attribute):
            found.setdefault(box, {})[name] = value
    return found


def _attribute(row: dict[str, str]) -> tuple[tuple[int, str], str, str]:
    """Return box, name and value of a row."""
    return box_of(row), unprotected(row['name']), unprotected(row['value'])
