"""
Datumaro, which CVAT imports and exports: ``annotations/default.json`` with ``point_clouds``.

Datumaro rounds positions [m] and angles [rad] to 2 digits when it reads them: write a second
format if the precision matters.

"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from boxreg_ros.io.images import Image
from boxreg_ros.labels import cuboids
from boxreg_ros.labels.attributes import (
    attributes_from,
    FALSE,
    is_set,
    OCCLUDED,
    plain,
    TRUE,
)
from boxreg_ros.labels.cameras import LabelCamera
from boxreg_ros.labels.cuboids import EVIDENCE_KEY
from boxreg_ros.labels.files import at, following, from_json, JsonList, require_single, visible
from boxreg_ros.labels.protocol import absolute, LabelFrame
from boxreg_ros.labels.records import FrameBoxes, ReadBox, TrackNumbers
from boxreg_ros.labels.sidecar import named_frames
from boxreg_ros.reasons import Reason
from boxreg_ros.structures import INTERPOLATED

FORMAT = replace(
    cuboids.CUBOID_FORMAT,
    name='datumaro',
    title='Datumaro, CVAT',
    files='annotations/default.json, point_clouds/default/STAMP.pcd',
    sizes='length width height (x y z); height width length with --swap-axes',
    options=('with_points', 'with_images', 'swap_axes'),
    leaves_out='annotations that are no cuboids, objects outside (counted)',
    read_back='datumaro 1.13.12',
    reads='cuboids; keyframes and tracks of CVAT',
)
ANNOTATIONS_FILE = 'annotations/default.json'
POINT_CLOUD_MEDIA = 6
"""Number of the media type in Datumaro."""
IMAGE_FOLDER = 'images/default'
OWN_ATTRIBUTE = 'extent_covariance'
"""Attribute of the boxes that we write, and no other program."""
ANNOTATION_FIELDS = (
    'track_id', 'track', OCCLUDED, 'outside', 'keyframe', 'score',
    'status', 'reason', 'num_points', 'covariance', 'extent_covariance',
)  # fmt: skip
"""Names among the attributes of a box that are none of the object."""
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
    image_file = f'{IMAGE_FOLDER}/{{name}}/{{camera}}.{{suffix}}'

    def begin(self) -> None:
        """Open the files."""
        self._axes = 'zyx' if self.options.swap_axes else 'xyz'
        self._tracks = TrackNumbers()
        self._labels: dict[str, int] = {}
        self._attributes: set[str] = set()
        self._images: list[dict[str, Any]] = []  # of the current frame
        infos = self.about | {SWAPPED_KEY: self.options.swap_axes}
        head = {'dm_format_version': '1.0', 'media_type': POINT_CLOUD_MEDIA, 'infos': infos}
        self._items = JsonList(self.folder / ANNOTATIONS_FILE, head, 'items')

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
                **({'related_images': self._images} if self._images else {}),
            }
        )

    def add_images(self, images: Sequence[tuple[LabelCamera, Image, str]]) -> None:
        """Hold the images of the next item; Datumaro has no place for their calibration."""
        self._images = [
            {
                'path': path.removeprefix(f'{IMAGE_FOLDER}/'),
                'size': list(camera.image.size[::-1]),  # height, width
                EVIDENCE_KEY: {
                    'camera': camera.name,
                    'extrinsic': camera.T_camera_sensor[:3].ravel().tolist(),
                    'intrinsic': camera.intrinsics.ravel().tolist(),
                },
            }
            for camera, _, path in images
        ]

    def finish(self) -> None:
        """Write the classes."""
        names = sorted(self._attributes)  # CVAT takes those alone that the labels declare
        labels = [{'name': name, 'parent': '', 'attributes': names} for name in self._labels]
        self._items.close({'categories': {'label': {'labels': labels, 'attributes': []}}})

    def _annotation(self, index: int, track_number: int, cuboid: cuboids.Cuboid) -> dict[str, Any]:
        """Return the annotation of a cuboid; its class is added to the labels."""
        label_id = self._labels.setdefault(cuboid.class_name, len(self._labels))
        # CVAT imports as tracks only what has keyframes, and interpolates between them.
        evidence = dict(cuboid.evidence)
        given = evidence.pop('attributes', {})
        others = {name: plain(value) for name, value in given.items() if name != OCCLUDED}
        self._attributes |= others.keys()
        attributes = {
            **others,
            'track_id': track_number,
            'track': cuboid.track_id,
            'occluded': is_set(given.get(OCCLUDED, FALSE)),
            'keyframe': True,
        }
        return {
            'id': index,
            'type': 'cuboid_3d',
            'label_id': label_id,
            'group': 0,
            'position': list(cuboid.position.values()),
            'rotation': list(cuboid.angles.values()),
            'scale': [cuboid.extent[axis] for axis in self._axes],
            'attributes': attributes | evidence,
        }


def read(path: Path) -> Iterator[LabelFrame]:
    """
    Yield the items of a data set.

    Their stamps [ns] are those of ``timestamps.txt``, one per item, or their ids. CVAT marks the
    boxes that it interpolated as no keyframes.

    Parameters
    ----------
    path : Path
        Folder of the data set, or its file of annotations.

    Yields
    ------
    frame : LabelFrame
        One per item, in the order of the stamps.

    Raises
    ------
    RecordingError
        If a file is missing or does not follow the format.

    """
    file = path
    if path.is_dir():
        files = visible((path / ANNOTATIONS_FILE).parent, '*.json')
        file = require_single(files, path, f'file of annotations, such as {ANNOTATIONS_FILE}')
    folder = absolute(file).parent.parent
    content = from_json(file)
    with following(file, 'cuboids of Datumaro'):
        label_category = content.get('categories', {}).get('label', {})
        labels = [str(label['name'] or '') for label in label_category.get('labels', ())]
        is_swapped = bool(content.get('infos', {}).get(SWAPPED_KEY))
        items: dict[str, FrameBoxes] = {}
        numbers: dict[str, int] = {}
        for item in sorted(content['items'], key=_order):
            name = str(item['id'])
            with at(f'item {name!r}'):
                items[name] = _cuboids(item.get('annotations') or (), labels, is_swapped)
                numbers[name] = _order(item)[0]
    is_counted = len({*numbers.values()}) == len(items)
    names = list(items) if is_counted else named_frames(folder, items)
    yield from cuboids.read_frames(folder, names, items.__getitem__, numbers)


def _order(item: dict[str, Any]) -> tuple[int, str]:
    """Return the sort key of an item: its frame number, then its name."""
    return int((item.get('attr') or {}).get('frame') or 0), str(item['id'])


def _cuboids(
    annotations: Sequence[dict[str, Any]], labels: list[str], is_swapped: bool
) -> FrameBoxes:
    """Return the cuboids among the annotations of an item, and the number without a box."""
    found: list[ReadBox] = []
    outside = 0
    for number, annotation in enumerate(annotations):
        if annotation['type'] != 'cuboid_3d':
            continue
        if _is_set((annotation.get('attributes') or {}).get('outside')):
            outside += 1  # CVAT: the object has left
            continue
        with at(f'annotation {number}'):
            found.append(_cuboid(annotation, labels, is_swapped))
    return found, {Reason.NO_BOX.value: outside} if outside else {}


def _is_set(attribute: object) -> bool:
    """Return whether an attribute is true; some versions write it as text."""
    return str(attribute).lower() == 'true'


def _cuboid(annotation: dict[str, Any], labels: list[str], is_swapped: bool) -> ReadBox:
    attributes = annotation.get('attributes') or {}
    scale = annotation['scale']
    extent = scale[::-1] if is_swapped else scale
    box = cuboids.box_from_cuboid(annotation['position'], annotation['rotation'], extent)
    track = attributes.get('track_id')
    label_id = annotation.get('label_id')
    if label_id is not None and not 0 <= label_id < len(labels):
        raise ValueError(f'expected a label_id of {len(labels)} labels, got {label_id}')
    class_name = '' if label_id is None else labels[label_id]
    evidence: dict[str, Any] = {'score': _score(attributes)}
    if str(attributes.get('keyframe', '')).lower() == 'false':
        evidence['status'] = INTERPOLATED
    if OWN_ATTRIBUTE in attributes:  # those of others may have another meaning
        evidence = dict(attributes)
        track = attributes.get('track', track)
    evidence['attributes'] = attributes_from(attributes, ANNOTATION_FIELDS)
    if _is_set(attributes.get(OCCLUDED)):  # CVAT states the other value of every box
        evidence['attributes'][OCCLUDED] = TRUE
    return ReadBox('' if track is None else str(track), class_name, box, evidence)


def _score(attributes: dict[str, Any]) -> float | None:
    """Return the score of a detection, which Datumaro has among its attributes."""
    score = attributes.get('score')
    return score if isinstance(score, int | float) else None
