"""``boxes.csv``: one row per box, in the frame its row names."""

from __future__ import annotations

import csv
from pathlib import Path

from boxreg_ros.boxtable import COLUMNS
from boxreg_ros.structures import HEIGHT, LENGTH, RefinedBoxes, X, Z
from msg_adapters.poses import quaternions_of
import numpy as np


class Writer:
    """
    Write boxes.csv, numbers in full precision; what is not finite becomes an empty cell.

    Rows are sorted by stamp. Boxes of an earlier stamp than the last written are put in their
    place on closing, which reads the whole file once.

    """

    def __init__(self, folder: Path) -> None:
        self._path = folder / 'boxes.csv'
        self._file = self._path.open('w', newline='', encoding='utf-8')
        self._table = csv.writer(self._file, lineterminator='\n')
        self._table.writerow(COLUMNS)
        self._newest_ns: int | None = None
        self._is_sorted = True

    def write(self, refined: RefinedBoxes) -> None:
        """Add one row per box."""
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
