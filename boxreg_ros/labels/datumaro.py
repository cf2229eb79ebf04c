"""
Datumaro, which CVAT imports and exports: ``annotations/default.json`` with ``point_clouds``.

Datumaro rounds to 2 digits on reading, [m] as well as [rad]: keep other formats beside it.

"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from boxreg_ros.errors import RecordingError
from boxreg_ros.labels import Format, LabelFrame, Options, Provenance
from boxreg_ros.labels.cuboids import box_of, cuboids_of, FrameNames, frames_in, write_points
from boxreg_ros.labels.files import from_json, Timeline, to_json, TrackNumbers
from boxreg_ros.structures import Floats

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
POINT_CLOUD = 6
"""Number of Datumaro's media type."""
SWAPPED = 'scale_is_height_width_length'


class Writer:
    """
    Write items as they come, and the classes at the end.

    `Options.swap_axes` writes the scale as height, width, length: as Datumaro takes it apart
    when it turns such labels into KITTI raw tracklets. Without the option, boxes look right in
    CVAT, but tracklets exported from there have length and height swapped.

    """

    def __init__(self, folder: Path, provenance: Provenance, options: Options) -> None:
        self.dropped: Counter[str] = Counter()
        self._axes = 'zyx' if options.swap_axes else 'xyz'
        self._names, self._tracks = FrameNames(), TrackNumbers()
        self._timeline = Timeline(folder, provenance)
        self._labels: dict[str, int] = {}
        self._clouds = folder / 'point_clouds' / SUBSET
        self._with_points = options.with_points
        if self._with_points:
            self._clouds.mkdir(parents=True)
        (folder / 'annotations').mkdir()
        self._file = (folder / 'annotations' / f'{SUBSET}.json').open('w', encoding='utf-8')
        infos = asdict(provenance) | {SWAPPED: options.swap_axes}
        head = {'dm_format_version': '1.0', 'media_type': POINT_CLOUD, 'infos': infos}
        self._file.write(to_json(head)[:-1] + ',\n"items": [')
        self._frames = 0

    def write(self, frame: LabelFrame) -> None:
        """Add an item."""
        name = self._names.of(frame.refined.boxes.stamp_ns)
        seen: set[str] = set()
        annotations: list[dict[str, Any]] = []
        for c in cuboids_of(frame, self.dropped):
            # A track is in a frame once: what has no name, or a name that is taken, stands alone.
            number = self._tracks.of('' if c.track_id in seen else c.track_id)
            seen.add(c.track_id)
            attributes = {'track_id': number, 'track': c.track_id, 'occluded': False}
            annotations.append(
                {
                    'id': len(annotations),
                    'type': 'cuboid_3d',
                    'label_id': self._labels.setdefault(c.class_name, len(self._labels)),
                    'group': 0,
                    'position': list(c.position.values()),
                    'rotation': list(c.angles.values()),
                    'scale': [c.extent[axis] for axis in self._axes],
                    'attributes': attributes | c.evidence,
                }
            )
        item = {
            'id': name,
            'annotations': annotations,
            'attr': {'frame': self._frames},
            'point_cloud': {'path': f'{name}.pcd'},
        }
        self._file.write(f'{"," if self._frames else ""}\n{to_json(item)}')
        self._frames += 1
        if self._with_points:
            write_points(frame, self._clouds / f'{name}.pcd')
        self._timeline.add(frame)

    def close(self) -> None:
        """Write the classes and close the files."""
        labels = [{'name': name, 'parent': '', 'attributes': []} for name in self._labels]
        categories = {'label': {'labels': labels, 'attributes': []}}
        self._file.write(f'\n],\n"categories": {to_json(categories)}}}\n')
        self._file.close()
        self._timeline.close()


def read(path: Path) -> Iterator[LabelFrame]:
    """
    Yield the items of a data set; ``timestamps.txt`` in it has a stamp [ns] per item.

    Raises
    ------
    RecordingError
        If a file is missing or does not hold cuboids of Datumaro.

    """
    file = path / 'annotations' / f'{SUBSET}.json'
    content = from_json(file)
    try:
        labels = [label['name'] for label in content['categories']['label']['labels']]
        axes = slice(None, None, -1 if content.get('infos', {}).get(SWAPPED) else 1)
        items = {
            str(item['id']): [
                _item(a, labels, axes) for a in item['annotations'] if a['type'] == 'cuboid_3d'
            ]
            for item in sorted(content['items'], key=_place)
        }
    except (KeyError, TypeError, ValueError, IndexError, AttributeError) as error:
        raise RecordingError(f'{file}: expected cuboids as Datumaro has them: {error!r}') from None
    yield from frames_in(path, list(items), items.__getitem__)


def _place(item: dict[str, Any]) -> tuple[int, str]:
    """Return where an item comes: by its number, or else by its name."""
    return int(item.get('attr', {}).get('frame', 0)), str(item['id'])


def _item(
    annotation: dict[str, Any], labels: list[str], axes: slice
) -> tuple[str, str, Floats, Mapping[str, Any]]:
    attributes = annotation.get('attributes', {})
    box = box_of(annotation['position'], annotation['rotation'], annotation['scale'][axes])
    track = attributes.get('track', attributes.get('track_id', ''))
    return str(track), labels[annotation['label_id']], box, attributes
