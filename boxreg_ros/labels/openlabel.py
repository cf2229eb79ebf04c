"""
ASAM OpenLABEL 1.0: ``openlabel/labels.json``.

A frame per box array, an object per track, and in each frame a cuboid per object: its ten values
are x y z, qx qy qz qw, and the extents along the box's own x, y and z. Objects are numbered, as
the format wants it, and carry the track id as their name.

"""

from __future__ import annotations

from itertools import count
import json
from pathlib import Path
from typing import Any

from boxreg_ros.structures import HEIGHT, LENGTH, RefinedBoxes, X, Z
from msg_adapters.poses import quaternions_of
import numpy as np

SCHEMA_VERSION = '1.0.0'
POINTER = {
    'type': 'cuboid',
    'attribute_pointers': {
        'status': 'text',
        'reason': 'text',
        'num_points': 'num',
        'score': 'num',
    },
}


class Writer:
    """
    Write frames as they come, and the objects with their intervals at the end.

    A box without a track id, or with one that its frame already has, is an object of its own.
    Invalid boxes have no place in the format and are left out; ``boxes.csv`` has them.

    """

    def __init__(self, folder: Path) -> None:
        path = folder / 'openlabel'
        path.mkdir()
        self._file = (path / 'labels.json').open('w', encoding='utf-8')
        self._file.write('{"openlabel": {\n"metadata": ')
        self._file.write(_json({'schema_version': SCHEMA_VERSION, 'annotator': 'boxreg_ros'}))
        self._file.write(',\n"frames": {')
        self._frames = 0
        self._numbers = count()
        self._tracks: dict[str, int] = {}
        self._objects: dict[int, dict[str, Any]] = {}
        self._frame_ids: set[str] = set()

    def write(self, refined: RefinedBoxes) -> None:
        """Add a frame."""
        boxes = refined.boxes
        values = np.hstack(
            [
                boxes.boxes[:, X : Z + 1],
                quaternions_of(boxes.boxes),
                boxes.boxes[:, LENGTH : HEIGHT + 1],
            ]
        )
        is_valid = np.isfinite(values).all(axis=1) & (values[:, 7:] > 0).all(axis=1)
        self._frame_ids.add(boxes.frame_id)
        objects: dict[int, Any] = {}
        for i in np.flatnonzero(is_valid):
            number = self._number(boxes.track_ids[i], boxes.class_names[i], objects)
            numbers = {'num_points': int(refined.num_points[i]), 'score': float(boxes.scores[i])}
            attributes = {
                'text': [
                    {'name': 'status', 'val': refined.status[i]},
                    {'name': 'reason', 'val': refined.reasons[i]},
                ],
                'num': [
                    {'name': name, 'val': value}
                    for name, value in numbers.items()
                    if np.isfinite(value)
                ],
            }
            cuboid = {
                'name': 'box',
                'coordinate_system': boxes.frame_id,
                'val': values[i].tolist(),
                'attributes': attributes,
            }
            objects[number] = {'object_data': {'cuboid': [cuboid]}}
        properties = {'timestamp': boxes.stamp_ns / 1e9, 'stamp_ns': boxes.stamp_ns}
        frame = {'frame_properties': properties, 'objects': objects}
        self._file.write(f'{"," if self._frames else ""}\n"{self._frames}": {_json(frame)}')
        self._frames += 1

    def close(self) -> None:
        """Write what is known only at the end, and close the file."""
        rest = {
            'objects': self._objects,
            'frame_intervals': _intervals(self._frames),
            'coordinate_systems': {
                name: {'type': 'scene_cs', 'parent': '', 'children': []}
                for name in sorted(self._frame_ids)
            },
        }
        self._file.write('\n}')
        for name, value in rest.items():
            self._file.write(f',\n"{name}": {_json(value)}')
        self._file.write('\n}}\n')
        self._file.close()

    def _number(self, track_id: str, class_name: str, taken: dict[int, Any]) -> int:
        """Return the object's number, and note that it is in this frame."""
        number = self._tracks.get(track_id) if track_id else None
        if number is None or number in taken:
            number = next(self._numbers)
            if track_id:
                self._tracks.setdefault(track_id, number)
            intervals: list[dict[str, int]] = []
            self._objects[number] = {
                'name': track_id,
                'type': class_name,
                'frame_intervals': intervals,
                'object_data_pointers': {'box': POINTER | {'frame_intervals': intervals}},
            }
        intervals = self._objects[number]['frame_intervals']
        if intervals and intervals[-1]['frame_end'] == self._frames - 1:
            intervals[-1]['frame_end'] = self._frames
        else:
            intervals.append({'frame_start': self._frames, 'frame_end': self._frames})
        return number


def _intervals(frames: int) -> list[dict[str, int]]:
    return [{'frame_start': 0, 'frame_end': frames - 1}] if frames else []


def _json(value: Any) -> str:
    return json.dumps(value, allow_nan=False, ensure_ascii=False)
