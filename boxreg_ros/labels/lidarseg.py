"""
nuScenes-lidarseg and Panoptic nuScenes: the tables of nuScenes with labels of points.

Each sweep is a sample. Its ``.bin`` has one byte per point, the index of its category: 0 is
``noise`` for points that cannot be known, 1 is ``static.other`` for points on no object. Its
``.npz`` has 1000 times the category plus the number of the instance in its category.

"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

from boxreg_ros.core.point_labels import BACKGROUND, PointLabels, UNKNOWN
from boxreg_ros.labels import nuscenes
from boxreg_ros.labels.protocol import LabelFrame, Options, Provenance
import numpy as np

FORMAT = replace(
    nuscenes.FORMAT,
    name='lidarseg',
    title='nuScenes lidarseg and panoptic (labels of points)',
    files='v1.0-boxreg/, lidarseg/, panoptic/, samples/, maps/',
    options=(),
    has_points=True,
)
UNKNOWN_CATEGORY, BACKGROUND_CATEGORY = 'noise', 'static.other'
MAX_CATEGORIES, MAX_INSTANCES = 65, 999
"""Of 1000 times the category in 16 bits, and of the three digits below it."""


class Writer(nuscenes.Writer):
    """Write the tables of nuScenes, and two files of labels per sweep."""

    def __init__(self, folder: Path, provenance: Provenance, options: Options) -> None:
        super().__init__(folder, provenance, options)
        self._rows: dict[str, list[dict[str, str]]] = {'lidarseg': [], 'panoptic': []}
        for name in self._rows:
            (folder / name / self.version).mkdir(parents=True)
        for name in (UNKNOWN_CATEGORY, BACKGROUND_CATEGORY):
            self._categories[name] = self._token('category', name)
        self._of_tracks: tuple[list[int], list[int]] | None = None

    def add(self, frame: LabelFrame) -> None:
        """Add a sample with its annotations and the labels of its points."""
        super().add(frame)
        assert frame.points is not None
        categories, instances = self._numbers(frame.points)
        sweep = self._token('sample_data', self.number)
        for kind, suffix in (('lidarseg', 'bin'), ('panoptic', 'npz')):
            token = self._token(kind, self.number)
            path = f'{kind}/{self.version}/{token}_{kind}.{suffix}'
            row = {'token': token, 'sample_data_token': sweep, 'filename': path}
            self._rows[kind].append(row)
            if kind == 'lidarseg':
                categories.astype(np.uint8).tofile(self.folder / path)
            else:
                codes = (1000 * categories + instances).astype(np.uint16)
                np.savez_compressed(self.folder / path, data=codes)

    def _numbers(self, points: PointLabels) -> tuple[Any, Any]:
        """Return the category and the instance of each point; the same over all sweeps."""
        if self._of_tracks is None:
            counts: Counter[str] = Counter()
            categories, instances = [], []
            for track in points.tracks:
                name = track.class_name
                self._categories.setdefault(name, self._token('category', name))
                counts[name] += 1
                index = list(self._categories).index(name)
                categories.append(index if index < MAX_CATEGORIES else 0)
                instances.append(counts[name] if counts[name] <= MAX_INSTANCES else 0)
            assert (UNKNOWN, BACKGROUND) == (-2, -1)  # the last two entries
            self._of_tracks = [*categories, 0, 1], [*instances, 0, 0]
        of_categories, of_instances = (np.array(numbers) for numbers in self._of_tracks)
        return of_categories[points.track], of_instances[points.track]

    def _closing_tables(self) -> dict[str, list[dict[str, Any]]]:
        """Return the tables of nuScenes, with the index of each category, and those of labels."""
        tables = super()._closing_tables()
        for index, row in enumerate(tables['category']):
            row['index'] = index
        return tables | self._rows
