"""
Datumaro, which CVAT imports and exports: ``annotations/default.json`` with ``point_clouds``.

Datumaro rounds positions [m] and angles [rad] to 2 digits when it reads them: write a second
format if the precision matters.

"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from boxreg_ros.labels import cuboids
from boxreg_ros.labels.files import following, from_json, JsonList
from boxreg_ros.labels.protocol import LabelFrame, Options, Provenance
from boxreg_ros.labels.records import ReadBox, TrackNumbers

FORMAT = replace(
    cuboids.cuboid_format(
        name='datumaro',
        title='Datumaro, CVAT',
        files='annotations/default.json, point_clouds/default/STAMP.pcd',
    ),
    sizes='length width height (x y z); height width length with --swap-axes',
    options=('with_points', 'swap_axes'),
)
ANNOTATIONS_FILE = 'annotations/default.json'
POINT_CLOUD_MEDIA = 6
"""Number of the media type in Datumaro."""
SWAPPED_KEY = 'scale_is_height_width_length'
"""Key of the header that states `Options.swap_axes`."""


class Writer(cuboids.CuboidWriter):
    """
    Write one item per frame, and the classes when closed.

    `Options.swap_axes` writes the scale as height, width, length, the order that Datumaro
    assumes when it exports KITTI raw tracklets. Without the option, boxes look right in CVAT,
    but tracklets exported from there have length and height swapped.

    """

    folders = ('annotations',)
    cloud_file = 'point_clouds/default/{name}.pcd'

    def __init__(self, folder: Path, provenance: Provenance, options: Options) -> None:
        super().__init__(folder, provenance, options)
        self._axes = 'zyx' if options.swap_axes else 'xyz'
        self._tracks = TrackNumbers()
        self._labels: dict[str, int] = {}
        infos = self.about | {SWAPPED_KEY: options.swap_axes}
        head = {'dm_format_version': '1.0', 'media_type': POINT_CLOUD_MEDIA, 'infos': infos}
        self._items = JsonList(folder / ANNOTATIONS_FILE, head, 'items')

    def add(self, frame: LabelFrame) -> None:
        """Add an item."""
        seen: set[str] = set()
        annotations: list[dict[str, Any]] = []
        for cuboid in self.cuboids(frame):
            # A track occurs once per frame: a repeated track id gets a number of its own.
            is_repeated = cuboid.track_id in seen
            number = self._tracks.of('' if is_repeated else cuboid.track_id)
            seen.add(cuboid.track_id)
            annotations.append(self._annotation(len(annotations), number, cuboid))
        self._items.append(
            {
                'id': self.name,
                'annotations': annotations,
                'attr': {'frame': self.number},
                'point_cloud': {'path': f'{self.name}.pcd'},
            }
        )

    def finish(self) -> None:
        """Write the classes."""
        labels = [{'name': name, 'parent': '', 'attributes': []} for name in self._labels]
        self._items.close({'categories': {'label': {'labels': labels, 'attributes': []}}})

    def _annotation(self, index: int, track_number: int, cuboid: cuboids.Cuboid) -> dict[str, Any]:
        """Return the annotation of a cuboid; its class is added to the labels."""
        label_id = self._labels.setdefault(cuboid.class_name, len(self._labels))
        attributes = {'track_id': track_number, 'track': cuboid.track_id, 'occluded': False}
        return {
            'id': index,
            'type': 'cuboid_3d',
            'label_id': label_id,
            'group': 0,
            'position': list(cuboid.position.values()),
            'rotation': list(cuboid.angles.values()),
            'scale': [cuboid.extent[axis] for axis in self._axes],
            'attributes': attributes | cuboid.evidence,
        }


def read(path: Path) -> Iterator[LabelFrame]:
    """Yield the items of a data set with one stamp [ns] per item in its ``timestamps.txt``."""
    file = path / ANNOTATIONS_FILE
    content = from_json(file)
    with following(file, 'cuboids of Datumaro'):
        labels = [label['name'] for label in content['categories']['label']['labels']]
        is_swapped = bool(content.get('infos', {}).get(SWAPPED_KEY))
        items = {
            str(item['id']): [
                _cuboid(annotation, labels, is_swapped)
                for annotation in item['annotations']
                if annotation['type'] == 'cuboid_3d'
            ]
            for item in sorted(content['items'], key=_order)
        }
    yield from cuboids.read_frames(path, list(items), items.__getitem__)


def _order(item: dict[str, Any]) -> tuple[int, str]:
    """Return the sort key of an item: its frame number, then its name."""
    return int(item.get('attr', {}).get('frame', 0)), str(item['id'])


def _cuboid(annotation: dict[str, Any], labels: list[str], is_swapped: bool) -> ReadBox:
    attributes = annotation.get('attributes', {})
    scale = annotation['scale']
    extent = scale[::-1] if is_swapped else scale
    box = cuboids.box_from_cuboid(annotation['position'], annotation['rotation'], extent)
    track = attributes.get('track', attributes.get('track_id', ''))
    return ReadBox(str(track), labels[annotation['label_id']], box, attributes)
