"""
SUSTechPOINTS: a scene folder with ``label/FRAME.json`` and ``lidar/FRAME.pcd``.

Copy or link the folder into the ``data`` folder of the tool. Boxes have an ``annotator``: the tool
distinguishes them from boxes that a person drew or edited, and does not learn from them.

"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from boxreg_ros.labels import cuboids
from boxreg_ros.labels.attributes import is_set, PARTLY, TRUE
from boxreg_ros.labels.cameras import LabelCamera
from boxreg_ros.labels.files import at, following, from_json, visible, write_json
from boxreg_ros.labels.protocol import (
    AUTOMATIC_STATUS,
    INPUT_STATUS,
    LabelFrame,
)
from boxreg_ros.labels.records import FrameBoxes, ReadBox
from boxreg_ros.labels.sidecar import named_frames
from boxreg_ros.structures import INTERPOLATED

FORMAT = replace(
    cuboids.CUBOID_FORMAT,
    name='sustechpoints',
    title='SUSTechPOINTS',
    files='label/STAMP.json, lidar/STAMP.pcd, desc.json',
    reads='labels of a scene; what the tool interpolated or a model made is marked',
)


STATUS_OF = {'i': INTERPOLATED, 'I': INTERPOLATED}
"""Status by `annotator`; the others are trackers, models and static objects."""


class Writer(cuboids.CuboidWriter):
    """Write one file of labels per frame, and one of points if they are requested."""

    folders = ('label', 'lidar')
    cloud_file = 'lidar/{name}.pcd'
    image_file = 'camera/{camera}/{name}.{suffix}'

    def begin(self) -> None:
        """Open the files."""
        write_json(self.folder / 'desc.json', self.about)

    def add(self, frame: LabelFrame) -> None:
        """Write the file of a frame."""
        items = [_item(cuboid) for cuboid in self.cuboids(frame)]
        write_json(self.folder / 'label' / f'{self.name}.json', items)

    def add_camera(self, camera: LabelCamera) -> None:
        """Write the calibration, from the LiDAR to the camera, row by row."""
        path = self.folder / 'calib' / 'camera' / f'{camera.name}.json'
        path.parent.mkdir(parents=True, exist_ok=True)
        content = {
            'extrinsic': camera.T_camera_sensor.ravel().tolist(),
            'intrinsic': camera.intrinsics.ravel().tolist(),
        }
        write_json(path, content)


def read(path: Path) -> Iterator[LabelFrame]:
    """
    Yield the frames of a scene.

    Their stamps [ns] are those of ``timestamps.txt``, one per label file, or their names. The tool
    names the algorithm that made a box, or interpolated it, as its ``annotator``; boxes that a
    person drew or edited have none.

    Parameters
    ----------
    path : Path
        Folder of the scene, with ``label/``.

    Yields
    ------
    frame : LabelFrame
        One per label file, in the order of the stamps.

    Raises
    ------
    RecordingError
        If a file is missing or does not follow the format.

    """

    def boxes_of(name: str) -> FrameBoxes:
        file = path / 'label' / f'{name}.json'
        content = from_json(file)
        with following(file, 'boxes of SUSTechPOINTS'):
            return _cuboids(content), {}

    names = named_frames(path, [file.stem for file in visible(path, 'label/*.json')])
    yield from cuboids.read_frames(path, names, boxes_of)


def _item(cuboid: cuboids.Cuboid) -> dict[str, Any]:
    return {
        'psr': {
            'position': cuboid.position,
            'scale': cuboid.extent,
            'rotation': cuboid.angles,
        },
        'obj_type': cuboid.class_name,
        'obj_id': cuboid.track_id,
        'obj_attr': ','.join(_words(cuboid.evidence.get('attributes', {}))),
        'annotator': cuboids.EVIDENCE_KEY,
        cuboids.EVIDENCE_KEY: cuboid.evidence,
    }


def _words(attributes: Mapping[str, str]) -> Iterator[str]:
    """Yield attributes as the tool has them: words, with commas between them."""
    for name, value in attributes.items():
        if is_set(value):
            yield name if value in (TRUE, PARTLY) else f'{name} {value}'


def _cuboids(content: Any) -> list[ReadBox]:
    boxes = []
    for number, item in enumerate(content['objs'] if isinstance(content, dict) else content):
        with at(f'box {number}'):
            boxes.append(_cuboid(item))
    return boxes


def _cuboid(item: dict[str, Any]) -> ReadBox:
    psr = item['psr']
    box = cuboids.box_from_xyz(psr['position'], psr['rotation'], psr['scale'])
    annotator = item.get('annotator')
    status = STATUS_OF.get(annotator, AUTOMATIC_STATUS) if annotator else INPUT_STATUS
    words = str(item.get('obj_attr') or '').split(',')
    attributes = {word.strip(): TRUE for word in words if word.strip()}
    evidence = {'status': status, 'attributes': attributes} | item.get(cuboids.EVIDENCE_KEY, {})
    track_id = item.get('obj_id')
    class_name = str(item.get('obj_type') or '')
    return ReadBox('' if track_id is None else str(track_id), class_name, box, evidence)
