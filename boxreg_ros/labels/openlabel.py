"""
ASAM OpenLABEL 1.0: ``openlabel/labels.json``.

One frame per box array, one object per track and class, and in each frame one cuboid per object.
Its ten values are x y z, qx qy qz qw, and the extents along x, y and z of the box. Objects are
numbered, as the format requires, and have the track id as their name.

"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict
from itertools import count
from math import isfinite
from pathlib import Path
from typing import Any

from boxreg_ros.labels.files import following, from_json, to_json
from boxreg_ros.labels.protocol import Format, LabelFrame, Options, Provenance
from boxreg_ros.labels.records import refined_boxes
from boxreg_ros.reasons import Reason
from boxreg_ros.rotations import rpy_from_quaternion
from boxreg_ros.structures import BOX_CENTER, BOX_EXTENT, Floats, is_valid_box, RefinedBoxes
from msg_adapters.poses import quaternions_of
import numpy as np

FORMAT = Format(
    name='openlabel',
    title='ASAM OpenLABEL 1.0',
    frame='fixed, named with each cuboid',
    reference='centre',
    sizes='length width height',
    rotation='quaternion x y z w',
    files='labels.json',
)
SCHEMA_VERSION = '1.0.0'
COVARIANCE_DIGITS = 9
"""Decimals of covariances: a standard deviation of 0.03 mm. Full precision doubles the file."""
OBJECT_DATA_POINTER = {
    'type': 'cuboid',
    'attribute_pointers': {
        'status': 'text',
        'reason': 'text',
        'num_points': 'num',
        'score': 'num',
        'covariance': 'vec',
        'extent_covariance': 'vec',
    },
}


class Writer:
    """
    Write one frame per box array, and the objects with their intervals when closed.

    A box without a track id, or with one that its frame already contains, is an object of its
    own. The format cannot represent invalid boxes; they are left out and are in ``boxes.csv``.

    """

    def __init__(self, folder: Path, provenance: Provenance, options: Options) -> None:
        self.dropped: Counter[str] = Counter()
        self._file = (folder / 'labels.json').open('w', encoding='utf-8')
        self._file.write('{"openlabel": {\n"metadata": ')
        metadata = {'schema_version': SCHEMA_VERSION, 'annotator': provenance.tool}
        self._file.write(to_json(metadata | asdict(provenance)))
        self._file.write(',\n"frames": {')
        self._frames = 0
        self._numbers = count()
        self._number_of_track: dict[tuple[str, str], int] = {}
        self._objects: dict[int, dict[str, Any]] = {}
        self._frame_ids: set[str] = set()
        self._parents: dict[str, str] = {}  # sensor frame -> fixed frame

    def write(self, frame: LabelFrame) -> None:
        """Add a frame."""
        rows = np.flatnonzero(is_valid_box(frame.refined.boxes.boxes)).tolist()
        self.dropped[Reason.INVALID_BOX] += len(frame.refined.status) - len(rows)
        refined = frame.refined.take(rows)
        boxes = refined.boxes
        self._frame_ids.add(boxes.frame_id)
        objects: dict[int, Any] = {}
        names = zip(boxes.track_ids, boxes.class_names, strict=True)
        for name, cuboid in zip(names, _cuboids(refined), strict=True):
            number = self._number(*name, objects)
            objects[number] = {'object_data': {'cuboid': [cuboid]}}
        properties: dict[str, Any] = {
            'timestamp': boxes.stamp_ns / 1e9,
            'stamp_ns': boxes.stamp_ns,
        }
        if frame.T_fixed_sensor is not None and frame.sensor_frame != frame.fixed_frame:
            self._frame_ids |= {frame.sensor_frame, frame.fixed_frame}
            self._parents[frame.sensor_frame] = frame.fixed_frame
            properties['transforms'] = _transforms(frame, frame.T_fixed_sensor)
        content = to_json({'frame_properties': properties, 'objects': objects})
        separator = ',' if self._frames else ''
        self._file.write(f'{separator}\n"{self._frames}": {content}')
        self._frames += 1

    def close(self) -> None:
        """Write objects, intervals and coordinate systems, and close the file."""
        intervals = []
        if self._frames:
            intervals.append({'frame_start': 0, 'frame_end': self._frames - 1})
        sections = {
            'objects': self._objects,
            'frame_intervals': intervals,
            'coordinate_systems': {
                name: self._coordinate_system(name) for name in sorted(self._frame_ids)
            },
        }
        self._file.write('\n}')
        for name, section in sections.items():
            self._file.write(f',\n"{name}": {to_json(section)}')
        self._file.write('\n}}\n')
        self._file.close()

    def _coordinate_system(self, name: str) -> dict[str, Any]:
        return {
            'type': 'sensor_cs' if name in self._parents else 'scene_cs',
            'parent': self._parents.get(name, ''),
            'children': [child for child, parent in self._parents.items() if parent == name],
        }

    def _number(self, track_id: str, class_name: str, in_frame: dict[int, Any]) -> int:
        """Return the number of the object, and add the current frame to its intervals."""
        track = (track_id, class_name)  # a track that changes its class is several objects
        number = self._number_of_track.get(track) if track_id else None
        if number is None or number in in_frame:
            number = self._new_object(track_id, class_name)
        intervals = self._objects[number]['frame_intervals']
        if intervals and intervals[-1]['frame_end'] == self._frames - 1:
            intervals[-1]['frame_end'] = self._frames
        else:
            intervals.append({'frame_start': self._frames, 'frame_end': self._frames})
        return number

    def _new_object(self, track_id: str, class_name: str) -> int:
        """Add an object and return its number; the first of a track stands for the track."""
        number = next(self._numbers)
        if track_id:
            self._number_of_track.setdefault((track_id, class_name), number)
        intervals: list[dict[str, int]] = []
        pointer = OBJECT_DATA_POINTER | {'frame_intervals': intervals}
        self._objects[number] = {
            'name': track_id,
            'type': class_name,
            'frame_intervals': intervals,
            'object_data_pointers': {'box': pointer},
        }
        return number


def _cuboids(refined: RefinedBoxes) -> Iterator[dict[str, Any]]:
    """Yield boxes with their evidence as attributes."""
    boxes = refined.boxes
    position = boxes.boxes[:, BOX_CENTER]
    extent = boxes.boxes[:, BOX_EXTENT]
    values = np.hstack([position, quaternions_of(boxes.boxes), extent])
    covariances = refined.covariances.reshape(-1, 36).round(COVARIANCE_DIGITS)
    extents = refined.extent_covariances.reshape(-1, 9).round(COVARIANCE_DIGITS)
    columns = (values, refined.num_points, boxes.scores, covariances, extents)
    rows = zip(refined.status, refined.reasons, *(c.tolist() for c in columns), strict=True)
    for status, reason, value, num_points, score, covariance, extent_covariance in rows:
        numbers = [{'name': 'num_points', 'val': num_points}]
        if isfinite(score):
            numbers.append({'name': 'score', 'val': score})
        attributes = {
            'text': [{'name': 'status', 'val': status}, {'name': 'reason', 'val': reason}],
            'num': numbers,
            'vec': [
                {'name': 'covariance', 'val': covariance},
                {'name': 'extent_covariance', 'val': extent_covariance},
            ],
        }
        yield {
            'name': 'box',
            'coordinate_system': boxes.frame_id,
            'val': value,
            'attributes': attributes,
        }


def _transforms(frame: LabelFrame, T_fixed_sensor: Floats) -> dict[str, Any]:
    """Return the pose of the sensor as the transform of a frame."""
    return {
        f'{frame.sensor_frame}_to_{frame.fixed_frame}': {
            'src': frame.sensor_frame,
            'dst': frame.fixed_frame,
            'transform_src_to_dst': {'matrix4x4': T_fixed_sensor.ravel().tolist()},
        }
    }


def read(path: Path) -> Iterator[LabelFrame]:
    """
    Yield the cuboids of each frame and coordinate system.

    The track id is the uid of the object, in files written by `Writer` its name. Rotations of
    three values are read as roll, pitch and yaw, as defined in `structures`.

    """
    if path.is_dir():
        path = path / 'labels.json'
    content = from_json(path)
    with following(path, 'frames with stamps and cuboids as in ASAM OpenLABEL 1.0'):
        label = content['openlabel']
        has_names = label.get('metadata', {}).get('annotator') == Provenance().tool
        objects = label.get('objects', {})
        names = {uid: item['name'] if has_names else uid for uid, item in objects.items()}
        classes = {uid: str(item.get('type', '')) for uid, item in objects.items()}
        for _, frame in sorted(label.get('frames', {}).items(), key=lambda item: int(item[0])):
            yield from _read_frame(frame, names, classes)


def _read_frame(
    frame: dict[str, Any], names: dict[str, str], classes: dict[str, str]
) -> Iterator[LabelFrame]:
    """Yield the content of one frame, one `LabelFrame` per coordinate system."""
    properties = frame['frame_properties']
    stamp_ns = properties.get('stamp_ns')
    if stamp_ns is None:
        stamp_ns = round(float(properties['timestamp']) * 1e9)
    transforms = list(properties.get('transforms', {}).values())
    without: dict[str, list[Any]] = {item['dst']: [] for item in transforms[:1]}  # no object
    for system, items in (_cuboids_by_system(frame) or without).items():
        refined = refined_boxes(
            int(stamp_ns),
            system,
            [names[uid] for uid, _ in items],
            [classes[uid] for uid, _ in items],
            [_box(cuboid['val']) for _, cuboid in items],
            [_attributes(cuboid) for _, cuboid in items],
        )
        fixed_frame, sensor_frame, T_fixed_sensor = _pose(system, transforms)
        yield LabelFrame(refined, fixed_frame, sensor_frame, T_fixed_sensor)


def _cuboids_by_system(frame: dict[str, Any]) -> dict[str, list[tuple[str, dict[str, Any]]]]:
    """Return pairs of object uid and cuboid by coordinate system; null values are skipped."""
    found: dict[str, list[tuple[str, dict[str, Any]]]] = {}
    for uid, item in frame.get('objects', {}).items():
        for cuboid in item.get('object_data', {}).get('cuboid', ()):
            if cuboid['val'] is not None:
                system = cuboid.get('coordinate_system', '')
                found.setdefault(system, []).append((uid, cuboid))
    return found


def _pose(system: str, transforms: list[dict[str, Any]]) -> tuple[str, str, Floats | None]:
    """Return fixed frame, sensor frame and T_fixed_sensor of the transform of a system."""
    found: tuple[str, str, Floats | None] = (system, '', None)
    for item in transforms:
        matrix = item['transform_src_to_dst'].get('matrix4x4')
        if system in (item['src'], item['dst']) and matrix is not None:
            T_fixed_sensor = np.array(matrix, np.float64).reshape(4, 4)
            found = (item['dst'], item['src'], T_fixed_sensor)
    return found


def _attributes(cuboid: dict[str, Any]) -> dict[str, Any]:
    """Return the attributes of a cuboid by name."""
    groups = cuboid.get('attributes', {}).values()
    return {item['name']: item['val'] for group in groups for item in group}


def _box(values: list[float]) -> Floats:
    """Return a box (9,) from nine or ten values of a cuboid."""
    if len(values) == 9:
        return np.array([*values[:3], *values[6:], *values[3:6]])
    return np.array([*values[:3], *values[7:], *rpy_from_quaternion(values[3:7])])
