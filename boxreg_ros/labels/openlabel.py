"""
ASAM OpenLABEL 1.0: ``openlabel/labels.json``.

One frame per box array, one object per track and class, and in each frame one cuboid per object.
Its ten values are x y z, qx qy qz qw, and the extents along x, y and z of the box. Objects are
numbered, as the format requires, and have the track id as their name.

"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from dataclasses import asdict, replace
from decimal import Decimal
from itertools import count
from pathlib import Path
from typing import Any

from boxreg_ros.core.metrics import iou_3d
from boxreg_ros.io.box_table import number_cells
from boxreg_ros.io.checks.twice import SAME_OBJECT_IOU
from boxreg_ros.io.transforms import inverse, moved_boxes
from boxreg_ros.labels.attributes import attributes_from, plain
from boxreg_ros.labels.files import at, following, from_json, to_json
from boxreg_ros.labels.protocol import Format, INPUT_STATUS, LabelFrame, Options, Provenance
from boxreg_ros.labels.records import ReadBox, refined_of, require_radians
from boxreg_ros.labels.sidecar import STAMPS_FILE, whole_stamps
from boxreg_ros.labels.stamps import read_stamp_values, Stamps
from boxreg_ros.reasons import Reason
from boxreg_ros.rotations import matrix_from_quaternion, matrix_from_rpy, rpy_from_quaternion
from boxreg_ros.structures import (
    BOX_CENTER,
    BOX_EXTENT,
    Floats,
    INTERPOLATED,
    is_valid_box,
    RefinedBoxes,
)
from msg_adapters.poses import quaternions_of
import numpy as np

FORMAT = Format(
    name='openlabel',
    title='ASAM OpenLABEL 1.0',
    frame='fixed, named with each cuboid',
    rotation='quaternion x y z w',
    files='labels.json',
    leaves_out='boxes of images, and all objects without a cuboid',
    read_back='vcd 6.0.3',
    reads='cuboids of frames and of objects, poses, stamps in any unit or ISO 8601',
)
SCHEMA_VERSION = '1.0.0'
COVARIANCE_DIGITS = 9
"""Decimals of covariances: a standard deviation of 0.03 mm. Full precision doubles the file."""
FIXED_TYPES = ('scene_cs', 'geo_cs', 'geo_utm', 'geo_wgs84')
"""Types of coordinate systems that do not move with a sensor or a vehicle."""
OBJECT_DATA_POINTER: dict[str, Any] = {
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

CUBOID_FIELDS = (
    *OBJECT_DATA_POINTER['attribute_pointers'], 'confidence', 'interpolated', 'keyframe',
)  # fmt: skip
"""Names among the attributes of a cuboid that are none of the object."""


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
        refined = frame.refined
        if len(rows) < len(refined.status):
            refined = refined.take(rows)
        boxes = refined.boxes
        self._frame_ids.add(boxes.frame_id)
        objects: dict[int, str] = {}
        # A track that changes its class is several objects.
        tracks = zip(boxes.track_ids, boxes.class_names, strict=True)
        for row, (track, cuboid) in enumerate(zip(tracks, _cuboids(refined), strict=True)):
            number = self._number_of_track.get(track)
            if number is None or number in objects:
                number = self._new_object(*track)
            objects[number] = f'"{number}":{{"object_data":{{"cuboid":[{cuboid}]}}}}'
            self._prolong(self._objects[number], boxes.attributes_of(row))
        properties: dict[str, Any] = {
            'timestamp': boxes.stamp_ns / 1e9,
            'stamp_ns': boxes.stamp_ns,
        }
        if frame.T_fixed_sensor is not None and frame.sensor_frame != frame.fixed_frame:
            self._frame_ids |= {frame.sensor_frame, frame.fixed_frame}
            self._parents[frame.sensor_frame] = frame.fixed_frame
            properties['transforms'] = {
                f'{frame.sensor_frame}_to_{frame.fixed_frame}': {
                    'src': frame.sensor_frame,
                    'dst': frame.fixed_frame,
                    'transform_src_to_dst': {'matrix4x4': frame.T_fixed_sensor.ravel().tolist()},
                }
            }
        separator = ',' if self._frames else ''
        self._file.write(
            f'{separator}\n"{self._frames}": {{"frame_properties":{to_json(properties)},'
            f'"objects":{{{",".join(objects.values())}}}}}'
        )
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

    def _prolong(self, item: dict[str, Any], attributes: Mapping[str, str]) -> None:
        """Add the current frame and the attributes of its box to an object."""
        intervals = item['frame_intervals']
        if intervals and intervals[-1]['frame_end'] == self._frames - 1:
            intervals[-1]['frame_end'] = self._frames
        else:
            intervals.append({'frame_start': self._frames, 'frame_end': self._frames})
        if attributes:
            pointers = item['object_data_pointers']['box']['attribute_pointers']
            for kind, named in _by_kind(attributes).items():
                for one in named:
                    pointers.setdefault(one['name'], kind)

    def _new_object(self, track_id: str, class_name: str) -> int:
        """Add an object and return its number; the first of a track stands for the track."""
        number = next(self._numbers)
        if track_id:
            self._number_of_track.setdefault((track_id, class_name), number)
        intervals: list[dict[str, int]] = []
        pointers = dict(OBJECT_DATA_POINTER['attribute_pointers'])
        pointer = OBJECT_DATA_POINTER | {
            'attribute_pointers': pointers,
            'frame_intervals': intervals,
        }
        self._objects[number] = {
            'name': track_id,
            'type': class_name,
            'frame_intervals': intervals,
            'object_data_pointers': {'box': pointer},
        }
        return number


def _cuboids(refined: RefinedBoxes) -> Iterator[str]:
    """Yield boxes with their evidence as attributes, as JSON: a dict of each takes three times."""
    boxes = refined.boxes
    count = len(refined.status)
    if not count:
        return
    frame = to_json(boxes.frame_id)
    words = {word: to_json(word) for word in {*refined.status, *refined.reasons}}
    places = boxes.boxes[:, BOX_CENTER], quaternions_of(boxes.boxes), boxes.boxes[:, BOX_EXTENT]
    numbers = (
        np.hstack(places),
        refined.covariances.reshape(count, 36).round(COVARIANCE_DIGITS),
        refined.extent_covariances.reshape(count, 9).round(COVARIANCE_DIGITS),
        refined.num_points[:, None],
        boxes.scores[:, None],
    )
    texts = zip(*(number_cells(of_boxes, 'null') for of_boxes in numbers), strict=True)
    for row, (values, covariance, extent_covariance, num_points, score) in enumerate(texts):
        more, booleans = '', ''
        if boxes.attributes:
            own = _by_kind(boxes.attributes[row])
            more = ''.join(f',{to_json(one)}' for one in own['text'])
            booleans = f',"boolean":{to_json(own["boolean"])}' if own['boolean'] else ''
        known = '' if score == 'null' else f',{{"name":"score","val":{score}}}'
        yield (
            f'{{"name":"box","coordinate_system":{frame},"val":[{values}],"attributes":{{'
            f'"text":[{{"name":"status","val":{words[refined.status[row]]}}},'
            f'{{"name":"reason","val":{words[refined.reasons[row]]}}}{more}],'
            f'"num":[{{"name":"num_points","val":{num_points}}}{known}],'
            f'"vec":[{{"name":"covariance","val":[{covariance}]}},'
            f'{{"name":"extent_covariance","val":[{extent_covariance}]}}]{booleans}}}}}'
        )


def _by_kind(attributes: Mapping[str, str]) -> dict[str, list[dict[str, Any]]]:
    """Return the attributes of an object, true and false apart from texts."""
    found: dict[str, list[dict[str, Any]]] = {'boolean': [], 'text': []}
    for name, word in attributes.items():
        kind = 'boolean' if isinstance(plain(word), bool) else 'text'
        found[kind].append({'name': name, 'val': plain(word)})
    return found


def read(path: Path) -> Iterator[LabelFrame]:
    """
    Yield the cuboids of each frame, in one coordinate system where transforms connect theirs.

    The track id is the uid of the object, in files written by `Writer` its name; more cuboids of
    an object in a frame are tracks of their own, ``uid/name``, but for those that lie on another
    one, as with and without an open door, which are left out. Cuboids of an object itself are in
    all frames of its intervals, or in every frame. Rotations of three values are roll, pitch and
    yaw, as defined in `structures`. Poses are those of the frame, else ``pose_wrt_parent``.

    Parameters
    ----------
    path : Path
        File, or the folder with ``labels.json``. Stamps are numbers or decimals in one unit, see
        `stamps.stamps_ns`, or moments as in ISO 8601.

    Yields
    ------
    frame : LabelFrame
        One per frame, more where the transforms between coordinate systems are not known. Fixed is
        the system that the one of the cuboids moves in, or the topmost.

    Raises
    ------
    RecordingError
        If the file cannot be read or does not follow the format.

    """
    if path.is_dir():
        path = path / 'labels.json'
    content = from_json(path, parse_float=Decimal)
    with following(path, 'frames with stamps and cuboids as in ASAM OpenLABEL 1.0'):
        label = content['openlabel']
        objects = _Objects(label)
        systems = label.get('coordinate_systems') or {}
        frames = sorted(
            ((int(number), frame or {}) for number, frame in _items(label, 'frames')),
            key=lambda item: item[0],
        )
        stamps = _stamps(path, frames)
        objects.require_frames(len(frames))
        in_time = sorted(zip(stamps.stamps_ns, frames, strict=True), key=lambda item: item[0])
        note = '; '.join(filter(None, (stamps.note, objects.note(frames))))
        for stamp_ns, (number, frame) in in_time:
            with at(f'frame {number}'):
                found = list(_read_frame(number, frame, stamp_ns, objects, systems))
            for one in found:
                yield replace(one, note=note) if note else one
                note = ''


def _items(parent: dict[str, Any], name: str) -> list[tuple[str, Any]]:
    """Return the members of an object of JSON that may be missing or null."""
    return list((parent.get(name) or {}).items())


def _stamps(path: Path, frames: list[tuple[int, Any]]) -> Stamps:
    """Return the stamp of each frame [ns]; those of ``timestamps.txt`` where one has none."""
    properties = [frame.get('frame_properties') or {} for _, frame in frames]
    if properties and all('stamp_ns' in one for one in properties):  # files of `Writer`
        return Stamps([int(one['stamp_ns']) for one in properties], '')
    values = [one.get('timestamp') for one in properties]
    if None not in values:
        return read_stamp_values(values)
    file = path.with_name(STAMPS_FILE)
    number, _ = frames[values.index(None)]
    if not file.exists():
        raise ValueError(
            f"frame {number}: lacks 'timestamp' in its frame_properties; or create {file} with "
            f'one stamp per frame, as whole nanoseconds'
        )
    stamps = whole_stamps(file, len(frames))
    if len(stamps) != len(frames):
        raise ValueError(f'{file}: expected {len(frames)} stamps, got {len(stamps)}')
    return Stamps(stamps, '')


class _Objects:
    """The objects of a file: their names, classes, and cuboids that are in several frames."""

    def __init__(self, label: dict[str, Any]) -> None:
        self._are_own = (label.get('metadata') or {}).get('annotator') == Provenance().tool
        self._names: dict[str, str] = {}
        self._classes: dict[str, str] = {}
        self._systems: dict[str, str] = {}
        self._static: list[tuple[str, list[dict[str, Any]], list[tuple[int, int]]]] = []
        for uid, item in _items(label, 'objects'):
            with at(f'object {uid}'):
                self._names[uid] = item['name'] if self._are_own else uid
                self._classes[uid] = str(item.get('type') or '')
                self._systems[uid] = str(item.get('coordinate_system') or '')
                cuboids = (item.get('object_data') or {}).get('cuboid') or []
                intervals = [
                    (int(one['frame_start']), int(one['frame_end']))
                    for one in item.get('frame_intervals') or ()
                ]
                if cuboids:
                    self._static.append((uid, cuboids, intervals))

    def cuboids_in(self, number: int, frame: dict[str, Any]) -> Iterator[tuple[str, Any]]:
        """Yield the cuboids of a frame with the uids of their objects."""
        own = set()
        for uid, item in _items(frame, 'objects'):
            if (item or {}).get('type') and not self._classes.get(uid):
                self._classes[uid] = str(item['type'])  # some programs state it in frames alone
            for cuboid in ((item or {}).get('object_data') or {}).get('cuboid') or ():
                own.add((uid, cuboid.get('name')))
                yield uid, cuboid
        for uid, cuboids, intervals in self._static:
            if not intervals or any(first <= number <= last for first, last in intervals):
                for cuboid in cuboids:
                    if (uid, cuboid.get('name')) not in own:
                        yield uid, cuboid

    def note(self, frames: list[tuple[int, dict[str, Any]]]) -> str:
        """Return how many objects have several cuboids in a frame; empty for none."""
        several = 0
        for number, frame in frames:
            of_objects = Counter(
                (uid, self.system_of(uid, cuboid))
                for uid, cuboid in self.cuboids_in(number, frame)
                if cuboid['val'] is not None
            )
            several += sum(one > 1 for one in of_objects.values())
        if not several:
            return ''
        return (
            f'objects: expected one cuboid in each frame, got several, {several} times: those '
            f'after the first are tracks of their own, ID/NAME'
        )

    def system_of(self, uid: str, cuboid: dict[str, Any]) -> str:
        """Return the coordinate system of a cuboid, by default that of its object."""
        return str(cuboid.get('coordinate_system') or self._systems.get(uid, ''))

    def read_box(self, uid: str, cuboid: dict[str, Any], others: Collection[str]) -> ReadBox:
        """Return the box of a cuboid; `others` are track ids of its frame."""
        track_id = self._names.get(uid, uid)
        if track_id and track_id in others:
            track_id = f'{track_id}/{cuboid.get("name", len(others))}'
        class_name = self._classes.get(uid, '')
        values = _attributes(cuboid)
        evidence = dict(values) if self._are_own else _of_others(values)
        evidence['attributes'] = attributes_from(values, CUBOID_FIELDS)
        return ReadBox(track_id, class_name, _box(cuboid['val']), evidence)

    def require_frames(self, count: int) -> None:
        """Raise ValueError for cuboids of objects in a file with a `count` of frames of zero."""
        if self._static and not count:
            raise ValueError(f'got cuboids of {len(self._static)} objects, and no frames')


def _read_frame(
    number: int,
    frame: dict[str, Any],
    stamp_ns: int,
    objects: _Objects,
    systems: dict[str, Any],
) -> Iterator[LabelFrame]:
    """Yield the content of one frame, one `LabelFrame` per unconnected coordinate system."""
    boxes: dict[str, list[ReadBox]] = {}
    of_object: dict[tuple[str, str], list[Floats]] = {}
    left_out: Counter[str] = Counter()
    for uid, cuboid in objects.cuboids_in(number, frame):
        with at(f'object {uid}'):
            if cuboid['val'] is None:
                left_out[Reason.NO_BOX] += 1
                continue
            system = objects.system_of(uid, cuboid)
            found = boxes.setdefault(system, [])
            box = objects.read_box(uid, cuboid, {box.track_id for box in found})
            others = of_object.setdefault((uid, system), [])
            values = np.asarray(box.box)[None]
            if any(iou_3d(values, other)[0] >= SAME_OBJECT_IOU for other in others):
                left_out[Reason.DUPLICATE_TRACK_ID] += 1
                continue
            others.append(values)
            found.append(box)
    poses = _Poses(frame.get('frame_properties') or {}, systems)
    if not boxes:
        boxes[poses.first()] = []
    for system, items in poses.joined(boxes).items():
        fixed_frame, sensor_frame, T_fixed_sensor = poses.of(system)
        refined = refined_of(stamp_ns, system, items)
        yield LabelFrame(refined, fixed_frame, sensor_frame, T_fixed_sensor, left_out=left_out)
        left_out = Counter()


class _Poses:
    """
    The transforms of a frame: ``X_dst = T X_src``.

    Those of the frame itself have precedence over the poses of the coordinate systems.

    """

    def __init__(self, properties: dict[str, Any], systems: dict[str, Any]) -> None:
        self._types = {name: str((one or {}).get('type') or '') for name, one in systems.items()}
        self._moving: list[tuple[str, str]] = []
        self._edges: dict[tuple[str, str], Floats] = {}
        for name, one in systems.items():
            if (one or {}).get('parent') and one.get('pose_wrt_parent'):
                with at(f'coordinate system {name!r}'):
                    self._add(name, one['parent'], one['pose_wrt_parent'])
        for name, one in _items(properties, 'transforms'):
            with at(f'transform {name!r}'):
                transform = one.get('transform_src_to_dst', one)
                self._add(one['src'], one['dst'], transform)
                self._moving.append((one['src'], one['dst']))

    def _add(self, source: str, target: str, transform: dict[str, Any]) -> None:
        T = _matrix(transform)
        if T is not None:
            self._edges[target, source] = T
            self._edges[source, target] = inverse(T)

    def first(self) -> str:
        """Return the coordinate system of a frame without cuboids."""
        return self._moving[0][1] if self._moving else ''

    def joined(self, boxes: dict[str, list[ReadBox]]) -> dict[str, list[ReadBox]]:
        """Return boxes with those of connected systems in the first of these."""
        joined: dict[str, list[ReadBox]] = {}
        for system, items in boxes.items():
            reached = self._reached(system)
            target = next((name for name in joined if name in reached), None)
            if target is None:
                joined[system] = items
                continue
            known = {box.track_id for box in joined[target]}
            moved = moved_boxes(np.reshape([box.box for box in items], (-1, 9)), reached[target])
            joined[target] += [
                box._replace(box=row)
                for box, row in zip(items, moved, strict=True)
                if not box.track_id or box.track_id not in known  # the same one, stated twice
            ]
        return joined

    def of(self, system: str) -> tuple[str, str, Floats | None]:
        """Return fixed frame, sensor frame and T_fixed_sensor for boxes of a system."""
        connected = {name: T for name, T in self._reached(system).items() if name != system}
        is_fixed = self._types.get(system, '') in FIXED_TYPES
        fixed = [name for name in connected if self._types.get(name, '') in FIXED_TYPES]
        if not is_fixed and not fixed:  # without types, a system is fixed if another moves in it
            targets = {target for _, target in self._moving}
            is_fixed = system in targets
            fixed = [name for name in connected if name in targets]
        if is_fixed:
            sources = [source for source, _ in self._moving if source in connected]
            sensors = [name for name in sources if self._types.get(name) == 'sensor_cs'] or sources
            if not sensors:
                return system, '', None
            return system, sensors[0], inverse(connected[sensors[0]])
        if not fixed:
            return system, '', None
        return fixed[-1], system, connected[fixed[-1]]

    def _reached(self, source: str) -> dict[str, Floats]:
        """Return T_name_source (4, 4) of all connected systems, the nearest first."""
        reached = {source: np.eye(4)}
        queue = [source]
        for here in queue:  # grows
            for (target, start), T in self._edges.items():
                if start == here and target not in reached:
                    reached[target] = T @ reached[here]
                    queue.append(target)
        return reached


def _matrix(transform: dict[str, Any]) -> Floats | None:
    """Return the matrix (4, 4) of a transform; None for one of another kind."""
    for name in ('matrix4x4', 'transform_src_to_dst_4x4'):
        if name in transform:
            return np.array(transform[name], np.float64).reshape(4, 4)
    T = np.eye(4)
    if 'quaternion' in transform:
        T[:3, :3] = matrix_from_quaternion(np.array(transform['quaternion'], np.float64))
    elif 'euler_angles' in transform:
        T[:3, :3] = _euler_matrix(transform['euler_angles'], transform.get('sequence') or 'ZYX')
    else:
        return None
    T[:3, 3] = np.array(transform['translation'], np.float64).reshape(3)
    return T


def _euler_matrix(angles: list[float], sequence: str) -> Floats:
    """Return R (3, 3), the product of the rotations about the axes of a sequence, in its order."""
    R = np.eye(3)
    for angle, axis in zip(np.array(angles, np.float64), sequence.upper(), strict=True):
        rpy = np.zeros(3)
        rpy['XYZ'.index(axis)] = angle
        R = R @ matrix_from_rpy(rpy)
    return R


def _attributes(cuboid: dict[str, Any]) -> dict[str, Any]:
    """Return the attributes of a cuboid by name."""
    groups = (cuboid.get('attributes') or {}).values()
    return {item['name']: item.get('val') for group in groups for item in group if 'name' in item}


def _of_others(attributes: dict[str, Any]) -> dict[str, Any]:
    """Return the evidence among the attributes of another program, whose words are its own."""
    score = attributes.get('score', attributes.get('confidence'))
    flags = {name: str(attributes.get(name)).lower() for name in ('interpolated', 'keyframe')}
    is_interpolated = flags['interpolated'] == 'true' or flags['keyframe'] == 'false'
    return {
        'score': score if isinstance(score, int | Decimal) else None,
        'status': INTERPOLATED if is_interpolated else INPUT_STATUS,
    }


def _box(values: list[float]) -> Floats:
    """Return a box (9,) from nine or ten values of a cuboid."""
    numbers = np.array(values, np.float64)
    if numbers.shape not in ((9,), (10,)):
        raise ValueError(f'expected 9 or 10 values of a cuboid, got {values!r}')
    is_euler = len(numbers) == 9
    rpy = require_radians(numbers[3:6]) if is_euler else rpy_from_quaternion(numbers[3:7])
    return np.concatenate([numbers[:3], numbers[-3:], rpy])
