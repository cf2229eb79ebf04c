"""
Datumaro, which CVAT imports and exports: ``annotations/default.json`` with ``point_clouds``.

Datumaro rounds positions [m] and angles [rad] to 2 digits when it reads them: write a second
format if the precision matters.

"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

from boxreg_ros.errors import RecordingError
from boxreg_ros.labels.cuboids import (
    box_from_cuboid,
    Cuboid,
    cuboids_of,
    FrameNames,
    read_frames,
    ReadCuboid,
    write_points,
)
from boxreg_ros.labels.files import from_json, to_json
from boxreg_ros.labels.protocol import Format, LabelFrame, Options, Provenance
from boxreg_ros.labels.records import TrackNumbers
from boxreg_ros.labels.sidecar import SidecarWriter

FORMAT = Format(
    name='datumaro',
    title='Datumaro, CVAT',
    frame='sensor',
    reference='centre',
    sizes='length width height (x y z); height width length with --swap-axes',
    rotation='angles x y z, R = Rx Ry Rz',
    files='annotations/default.json, point_clouds/default/STAMP.pcd',
    options=('with_points', 'swap_axes'),
)
SUBSET = 'default'
POINT_CLOUD_MEDIA = 6
"""Number of the media type in Datumaro."""
SWAPPED_KEY = 'scale_is_height_width_length'
"""Key of the header that states `Options.swap_axes`."""


class Writer:
    """
    Write one item per frame, and the classes when closed.

    `Options.swap_axes` writes the scale as height, width, length, the order that Datumaro
    assumes when it exports KITTI raw tracklets. Without the option, boxes look right in CVAT,
    but tracklets exported from there have length and height swapped.

    """

    def __init__(self, folder: Path, provenance: Provenance, options: Options) -> None:
        self.dropped: Counter[str] = Counter()
        self._axes = 'zyx' if options.swap_axes else 'xyz'
        self._names = FrameNames()
        self._tracks = TrackNumbers()
        self._sidecar = SidecarWriter(folder, provenance)
        self._labels: dict[str, int] = {}
        self._clouds = folder / 'point_clouds' / SUBSET
        self._with_points = options.with_points
        if self._with_points:
            self._clouds.mkdir(parents=True)
        (folder / 'annotations').mkdir()
        self._file = (folder / 'annotations' / f'{SUBSET}.json').open('w', encoding='utf-8')
        infos = asdict(provenance) | {SWAPPED_KEY: options.swap_axes}
        head = {'dm_format_version': '1.0', 'media_type': POINT_CLOUD_MEDIA, 'infos': infos}
        self._file.write(to_json(head)[:-1] + ',\n"items": [')
        self._frames = 0

    def write(self, frame: LabelFrame) -> None:
        """Add an item."""
        name = self._names.of(frame.refined.boxes.stamp_ns)
        seen: set[str] = set()
        annotations: list[dict[str, Any]] = []
        for cuboid in cuboids_of(frame, self.dropped):
            # A track occurs once per frame: a repeated track id gets a number of its own.
            is_repeated = cuboid.track_id in seen
            number = self._tracks.of('' if is_repeated else cuboid.track_id)
            seen.add(cuboid.track_id)
            annotations.append(self._annotation(len(annotations), number, cuboid))
        item = {
            'id': name,
            'annotations': annotations,
            'attr': {'frame': self._frames},
            'point_cloud': {'path': f'{name}.pcd'},
        }
        separator = ',' if self._frames else ''
        self._file.write(f'{separator}\n{to_json(item)}')
        self._frames += 1
        if self._with_points:
            write_points(frame, self._clouds / f'{name}.pcd')
        self._sidecar.add(frame)

    def close(self) -> None:
        """Write the classes and close the files."""
        labels = [{'name': name, 'parent': '', 'attributes': []} for name in self._labels]
        categories = {'label': {'labels': labels, 'attributes': []}}
        self._file.write(f'\n],\n"categories": {to_json(categories)}}}\n')
        self._file.close()
        self._sidecar.close()

    def _annotation(self, index: int, track_number: int, cuboid: Cuboid) -> dict[str, Any]:
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
    """
    Yield the items of a data set with one stamp [ns] per item in its ``timestamps.txt``.

    Raises
    ------
    RecordingError
        If a file is missing or does not hold cuboids of Datumaro.

    """
    file = path / 'annotations' / f'{SUBSET}.json'
    content = from_json(file)
    try:
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
    except (KeyError, TypeError, ValueError, IndexError, AttributeError) as error:
        raise RecordingError(f'{file}: expected cuboids of Datumaro: {error!r}') from None
    yield from read_frames(path, list(items), items.__getitem__)


def _order(item: dict[str, Any]) -> tuple[int, str]:
    """Return the sort key of an item: its frame number, then its name."""
    return int(item.get('attr', {}).get('frame', 0)), str(item['id'])


def _cuboid(annotation: dict[str, Any], labels: list[str], is_swapped: bool) -> ReadCuboid:
    attributes = annotation.get('attributes', {})
    scale = annotation['scale']
    extent = scale[::-1] if is_swapped else scale
    box = box_from_cuboid(annotation['position'], annotation['rotation'], extent)
    track = attributes.get('track', attributes.get('track_id', ''))
    return ReadCuboid(str(track), labels[annotation['label_id']], box, attributes)
