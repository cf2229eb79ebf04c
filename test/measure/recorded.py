"""Labels that the node records during `measure node`: checked, counted, and deleted."""

from collections import deque
import csv
import shutil

from boxreg_ros.labels.clouds import SUFFIXES
from boxreg_ros.labels.segments import IndexRow, read_index

XYZ_BYTES = 12
"""Least size of a point in a file: x, y and z as float32."""


class RecordedLabels:
    """
    Count the labels of each whole segment; delete the oldest segments beyond a size [bytes].

    A robot uploads its segments and deletes them: a long run needs no larger disk than a short
    one. `stamps` are those of the box arrays, `cloud_files` whole clouds, `rows` the segments.

    """

    def __init__(self, folder, kept, points):
        self.stamps = set()
        self.cloud_files = 0
        self.rows = []
        self._folder = folder
        self._kept = kept
        self._cloud_bytes = XYZ_BYTES * points
        self._on_disk = deque[IndexRow]()

    def update(self):
        """Count the segments that are new in the index, and delete the oldest."""
        for row in read_index(self._folder)[len(self.rows) :]:
            self._count(self._folder / row.segment)
            self.rows.append(row)
            self._on_disk.append(row)
        while sum(row.size for row in self._on_disk) > self._kept:
            shutil.rmtree(self._folder / self._on_disk.popleft().segment)

    @property
    def has_open_segment(self):
        """Return whether a segment is not whole yet."""
        return any(self._folder.glob('.segment_*'))

    def _count(self, segment):
        with (segment / 'boxes.csv').open(newline='', encoding='utf-8') as file:
            self.stamps.update(int(cells['stamp_ns']) for cells in csv.DictReader(file))
        self.cloud_files += sum(
            path.name.endswith(SUFFIXES) and path.stat().st_size >= self._cloud_bytes
            for path in segment.rglob('*')
        )
