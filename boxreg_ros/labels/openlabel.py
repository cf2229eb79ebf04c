"""
ASAM OpenLABEL 1.0: ``openlabel/labels.json``.

A frame per box array, an object per track and class, and in each frame a cuboid per object: its
ten values are x y z, qx qy qz qw, and the extents along the box's own x, y and z. Objects are
numbered, as the format wants it, and carry the track id as their name.

"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict
from itertools import count
from pathlib import Path
from typing import Any

from boxreg_ros.errors import RecordingError
from boxreg_ros.labels import Format, LabelFrame, Options, Provenance
from boxreg_ros.labels.files import from_json, refined_boxes, to_json
from boxreg_ros.rotations import rpy_from_quaternion
from boxreg_ros.structures import Floats, HEIGHT, is_valid_box, LENGTH, X, Z
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
COVARIANCE_DIGITS = 9  # a deviation of 0.03 mm; all of them would double the file
POINTER = {
    'type': 'cuboid',
    'attribute_pointers': {
        'status': 'text',
        'reason': 'text',
        'num_points': 'num',
        'score': 'num',
        'covariance': 'vec',
    },
}


class Writer:
    """
    Write frames as they come, and the objects with their intervals at the end.

    A box without a track id, or with one that its frame already has, is an object of its own.
    Invalid boxes have no place in the format and are left out; ``boxes.csv`` has them.

    """

    def __init__(self, folder: Path, provenance: Provenance, options: Options) -> None:
        self.dropped: Counter[str] = Counter()
        self._file = (folder / 'labels.json').open('w', encoding='utf-8')
        self._file.write('{"openlabel": {\n"metadata": ')
        origin = asdict(provenance)
        metadata = {'schema_version': SCHEMA_VERSION, 'annotator': origin['tool'], **origin}
        self._file.write(to_json(metadata))
        self._file.write(',\n"frames": {')
        self._frames = 0
        self._numbers = count()
        self._tracks: dict[tuple[str, str], int] = {}
        self._objects: dict[int, dict[str, Any]] = {}
        self._frame_ids: set[str] = set()
        self._sensors: dict[str, str] = {}

    def write(self, frame: LabelFrame) -> None:
        """Add a frame."""
        refined = frame.refined
        boxes = refined.boxes
        values = np.hstack(
            [
                boxes.boxes[:, X : Z + 1],
                quaternions_of(boxes.boxes),
                boxes.boxes[:, LENGTH : HEIGHT + 1],
            ]
        )
        is_valid = is_valid_box(boxes.boxes)
        self.dropped['invalid_box'] += int((~is_valid).sum())
        self._frame_ids.add(boxes.frame_id)
        covariances = refined.covariances.reshape(-1, 36).round(COVARIANCE_DIGITS).tolist()
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
                'vec': [{'name': 'covariance', 'val': covariances[i]}],
            }
            cuboid = {
                'name': 'box',
                'coordinate_system': boxes.frame_id,
                'val': values[i].tolist(),
                'attributes': attributes,
            }
            objects[number] = {'object_data': {'cuboid': [cuboid]}}
        properties: dict[str, Any] = {
            'timestamp': boxes.stamp_ns / 1e9,
            'stamp_ns': boxes.stamp_ns,
        }
        if frame.T_fixed_sensor is not None and frame.sensor_frame != frame.fixed_frame:
            self._frame_ids |= {frame.sensor_frame, frame.fixed_frame}
            self._sensors[frame.sensor_frame] = frame.fixed_frame
            properties['transforms'] = {
                f'{frame.sensor_frame}_to_{frame.fixed_frame}': {
                    'src': frame.sensor_frame,
                    'dst': frame.fixed_frame,
                    'transform_src_to_dst': {'matrix4x4': frame.T_fixed_sensor.ravel().tolist()},
                }
            }
        content = to_json({'frame_properties': properties, 'objects': objects})
        self._file.write(f'{"," if self._frames else ""}\n"{self._frames}": {content}')
        self._frames += 1

    def close(self) -> None:
        """Write what is known only at the end, and close the file."""
        rest = {
            'objects': self._objects,
            'frame_intervals': _intervals(self._frames),
            'coordinate_systems': {
                name: {
                    'type': 'sensor_cs' if name in self._sensors else 'scene_cs',
                    'parent': self._sensors.get(name, ''),
                    'children': [k for k, parent in self._sensors.items() if parent == name],
                }
                for name in sorted(self._frame_ids)
            },
        }
        self._file.write('\n}')
        for name, value in rest.items():
            self._file.write(f',\n"{name}": {to_json(value)}')
        self._file.write('\n}}\n')
        self._file.close()

    def _number(self, track_id: str, class_name: str, taken: dict[int, Any]) -> int:
        """Return the object's number, and note that it is in this frame."""
        track = track_id, class_name  # the class is the object's: a track may have several
        number = self._tracks.get(track) if track_id else None
        if number is None or number in taken:
            number = next(self._numbers)
            if track_id:
                self._tracks.setdefault(track, number)
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


def read(path: Path) -> Iterator[LabelFrame]:
    """
    Yield the cuboids of each frame and coordinate system.

    The track is the object's uid, in our own files its name. Rotations of three values are
    taken as roll, pitch and yaw about the axes of `structures`.

    """
    if path.is_dir():
        path = path / 'labels.json'
    content = from_json(path)
    try:
        label = content['openlabel']
        is_ours = label.get('metadata', {}).get('annotator') == Provenance().tool
        objects = label.get('objects', {})
        names = {uid: item['name'] if is_ours else uid for uid, item in objects.items()}
        classes = {uid: str(item.get('type', '')) for uid, item in objects.items()}
        for _, frame in sorted(label.get('frames', {}).items(), key=lambda item: int(item[0])):
            yield from _frames(frame, names, classes)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise RecordingError(
            f'{path}: expected frames with stamps and cuboids as in ASAM OpenLABEL 1.0: '
            f'{type(error).__name__} {error}'
        ) from None


def _frames(
    frame: dict[str, Any], names: dict[str, str], classes: dict[str, str]
) -> Iterator[LabelFrame]:
    """Yield the content of one frame, a `LabelFrame` for each coordinate system."""
    properties = frame['frame_properties']
    stamp_ns = properties.get('stamp_ns')
    stamp_ns = round(float(properties['timestamp']) * 1e9) if stamp_ns is None else int(stamp_ns)
    transforms = list(properties.get('transforms', {}).values())
    of_system: dict[str, list[tuple[str, dict[str, Any]]]] = {}
    for uid, item in frame.get('objects', {}).items():
        for cuboid in item.get('object_data', {}).get('cuboid', ()):
            if cuboid['val'] is not None:
                system = cuboid.get('coordinate_system', '')
                of_system.setdefault(system, []).append((uid, cuboid))
    for system, items in of_system.items():
        attributes = [_attributes(cuboid) for _, cuboid in items]
        refined = refined_boxes(
            stamp_ns,
            system,
            [names[uid] for uid, _ in items],
            [classes[uid] for uid, _ in items],
            [_box(cuboid['val']) for _, cuboid in items],
            [found.get('score') for found in attributes],
            [found.get('status') for found in attributes],
            [found.get('num_points', 0) for found in attributes],
            [found.get('covariance') for found in attributes],
            [found.get('reason') for found in attributes],
        )
        T_fixed_sensor, fixed, sensor = None, system, ''
        for item in transforms:
            if (
                system in (item['src'], item['dst'])
                and 'matrix4x4' in item['transform_src_to_dst']
            ):
                fixed, sensor = item['dst'], item['src']
                matrix = item['transform_src_to_dst']['matrix4x4']
                T_fixed_sensor = np.array(matrix, np.float64).reshape(4, 4)
        yield LabelFrame(refined, fixed, sensor, T_fixed_sensor)


def _attributes(cuboid: dict[str, Any]) -> dict[str, Any]:
    """Return the attributes of a cuboid by name."""
    groups = cuboid.get('attributes', {}).values()
    return {item['name']: item['val'] for group in groups for item in group}


def _box(values: list[float]) -> Floats:
    """Return a box (9,) from nine or ten values of a cuboid."""
    if len(values) == 9:
        return np.array([*values[:3], *values[6:], *values[3:6]])
    return np.array([*values[:3], *values[7:], *rpy_from_quaternion(values[3:7])])
