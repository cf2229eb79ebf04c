"""``boxes.csv``: one row per box, in the frame its row names."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
import csv
from pathlib import Path

from boxreg_ros.io.box_table import BoxTable, COLUMNS
from boxreg_ros.labels import Format, LabelFrame, Options, Provenance
from boxreg_ros.labels.files import refined_boxes
from boxreg_ros.structures import HEIGHT, LENGTH, X, Z
from msg_adapters.poses import quaternions_of
import numpy as np

FORMAT = Format(
    name='csv',
    title='CSV',
    frame='fixed, named in each row',
    reference='centre',
    sizes='length width height',
    rotation='quaternion x y z w',
    files='boxes.csv',
)


class Writer:
    """
    Write boxes.csv, numbers in full precision; what is not finite becomes an empty cell.

    Rows are sorted by stamp. Boxes of an earlier stamp than the last written are put in their
    place on closing, which reads the whole file once.

    """

    def __init__(self, folder: Path, provenance: Provenance, options: Options) -> None:
        self.dropped: Counter[str] = Counter()
        self._path = folder / 'boxes.csv'
        self._file = self._path.open('w', newline='', encoding='utf-8')
        self._table = csv.writer(self._file, lineterminator='\n')
        self._table.writerow(COLUMNS)
        self._newest_ns: int | None = None
        self._is_sorted = True

    def write(self, frame: LabelFrame) -> None:
        """Add one row per box."""
        refined = frame.refined
        boxes = refined.boxes
        stamp_ns = boxes.stamp_ns
        if self._newest_ns is not None and stamp_ns < self._newest_ns:
            self._is_sorted = False
        self._newest_ns = stamp_ns
        values = boxes.boxes
        poses = np.hstack(
            [
                boxes.scores[:, None],
                values[:, X : Z + 1],
                quaternions_of(values),
                values[:, LENGTH : HEIGHT + 1],
            ]
        )
        cells = poses.astype(object)
        cells[~np.isfinite(poses)] = ''
        for i, row in enumerate(cells.tolist()):
            self._table.writerow(
                [
                    stamp_ns,
                    boxes.frame_id,
                    boxes.track_ids[i],
                    boxes.class_names[i],
                    *row,
                    refined.status[i],
                    int(refined.num_points[i]),
                ]
            )

    def close(self) -> None:
        """Close the file, sorted."""
        self._file.close()
        if not self._is_sorted:
            with self._path.open(newline='', encoding='utf-8') as file:
                header, *rows = csv.reader(file)
            rows.sort(key=lambda row: int(row[0]))
            with self._path.open('w', newline='', encoding='utf-8') as file:
                csv.writer(file, lineterminator='\n').writerows([header, *rows])


def read(path: Path) -> Iterator[LabelFrame]:
    """
    Yield the boxes of each stamp and frame of reference.

    The frame that most boxes are in is taken for the fixed frame.

    """
    if path.is_dir():
        path = path / 'boxes.csv'
    tables = BoxTable.read_frames(path)
    fixed_frame = max(tables, key=lambda name: len(tables[name].boxes), default='')
    parts = []
    for name, table in tables.items():
        order = np.argsort(table.stamps_ns, kind='stable')
        begins = np.flatnonzero(np.diff(table.stamps_ns[order])) + 1
        parts += [(int(table.stamps_ns[rows[0]]), name, rows) for rows in np.split(order, begins)]
    for stamp_ns, name, rows in sorted(parts, key=lambda part: part[0]):
        table = tables[name]
        refined = refined_boxes(
            stamp_ns,
            name,
            [table.track_ids[i] for i in rows],
            [table.class_names[i] for i in rows],
            table.boxes[rows],
            table.scores[rows],
            [table.status[i] for i in rows],
            table.num_points[rows],
        )
        yield LabelFrame(refined, fixed_frame, '')
