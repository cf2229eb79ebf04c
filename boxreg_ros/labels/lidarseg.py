"""
nuScenes-lidarseg and Panoptic nuScenes: the tables of nuScenes with labels of points.

Each sweep is a sample. Its ``.bin`` has one byte per point, the index of its category: ``noise``
for points that cannot be known, ``static.other`` for points on no object. Its ``.npz`` has 1000
times the category plus the number of the instance in its category.

"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, TYPE_CHECKING

from boxreg_ros.labels import nuscenes
from boxreg_ros.labels.class_names import NUSCENES, official
from boxreg_ros.labels.protocol import LabelFrame
from boxreg_ros.structures import Ints, RefinedBoxes
import numpy as np

if TYPE_CHECKING:
    from boxreg_ros.core.point_labels import ObjectTrack

FORMAT = replace(
    nuscenes.FORMAT,
    name='lidarseg',
    title='nuScenes lidarseg and panoptic (labels of points)',
    files='v1.0-boxreg/, lidarseg/, panoptic/, samples/, maps/',
    options=(),
    has_points=True,
    read_back='nuscenes-devkit 1.2.0',
)
UNKNOWN_CATEGORY = NUSCENES.index('noise')
BACKGROUND_CATEGORY = NUSCENES.index('static.other')
OTHER_CATEGORY = 'vehicle.car'
"""Other class names are those of vehicles, as everywhere in the package."""
MAX_PANOPTIC_INSTANCE = 999
"""Of the three digits below the category."""


class Writer(nuscenes.Writer):
    """Write the tables of nuScenes, and two files of labels per sweep."""

    def begin(self) -> None:
        """Open the files."""
        super().begin()
        self._rows: dict[str, list[dict[str, str]]] = {'lidarseg': [], 'panoptic': []}
        for name in self._rows:
            (self.folder / name / self.version).mkdir(parents=True)
        for name in NUSCENES:
            self._categories[name] = self._token('category', name)
        self._codes: Ints | None = None

    def add(self, frame: LabelFrame) -> None:
        """Add a sample with its annotations and the labels of its points."""
        super().add(frame)
        assert frame.points is not None
        if self._codes is None:
            self._codes = codes_of(frame.points.tracks)
            self._category_numbers = (self._codes // 1000).astype(np.uint8)
        track = frame.points.track
        sweep = self._token('sample_data', self.number)
        for kind, suffix in (('lidarseg', 'bin'), ('panoptic', 'npz')):
            token = self._token(kind, self.number)
            path = f'{kind}/{self.version}/{token}_{kind}.{suffix}'
            row = {'token': token, 'sample_data_token': sweep, 'filename': path}
            self._rows[kind].append(row)
            if kind == 'lidarseg':
                self._category_numbers[track].tofile(self.folder / path)
            else:
                np.savez(self.folder / path, data=self._codes[track])

    @property
    def notes(self) -> list[str]:
        """Return none: classes that the devkit lacks are those of vehicles."""
        return []

    def _evidence(self, refined: RefinedBoxes, row: int) -> dict[str, Any]:
        """Return the status: the covariance of a box between two stamps is not known."""
        return {'status': refined.status[row]}

    def _instance(self, key: str, track_id: str, class_name: str, annotation: str) -> str:
        """Return the token of an instance, of a category that the devkit knows."""
        return super()._instance(key, track_id, category_of(class_name), annotation)

    def _closing_tables(self) -> dict[str, list[dict[str, Any]]]:
        """Return the tables of nuScenes, with the index of each category, and those of labels."""
        tables = super()._closing_tables()
        for index, row in enumerate(tables['category']):
            row['index'] = index
        return tables | self._rows


def codes_of(tracks: Sequence[ObjectTrack]) -> Ints:
    """Return 1000 times the category plus the instance of the points of each track."""
    from boxreg_ros.core.point_labels import BACKGROUND, UNKNOWN  # numba, which reading needs not

    counts: Counter[str] = Counter()
    codes = []
    for track in tracks:
        name = category_of(track.class_name)
        counts[name] += 1
        instance = counts[name] if counts[name] <= MAX_PANOPTIC_INSTANCE else 0
        codes.append(1000 * NUSCENES.index(name) + instance)
    # The last two entries are those of the track numbers -2 and -1.
    assert (UNKNOWN, BACKGROUND) == (-2, -1)
    ends = [1000 * UNKNOWN_CATEGORY, 1000 * BACKGROUND_CATEGORY]
    return np.array([*codes, *ends], np.uint16)


def category_of(class_name: str) -> str:
    """Return the category of objects with a class name."""
    return official(class_name, NUSCENES, OTHER_CATEGORY)
