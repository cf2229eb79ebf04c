"""
nuScenes: the thirteen tables, one scene, boxes in the global frame; and T4, which is nearly that.

The sensor's frame stands for the ego vehicle's, so that its calibration is the identity;
``--label-frame`` takes another. A sample is a frame of boxes whose pose is known. Beside the
columns of the data set, annotations have status, reason, score, covariance and the stamp in
nanoseconds, instances the name of the track. A track of several classes is as many instances.

"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict
import hashlib
from pathlib import Path
import struct
from typing import Any
import zlib

from boxreg_ros.errors import RecordingError
from boxreg_ros.io.transforms import matrix
from boxreg_ros.labels import absolute, Format, LabelFrame, Options, Provenance
from boxreg_ros.labels.clouds import write_cloud
from boxreg_ros.labels.files import (
    boxes_from,
    frame_names,
    from_json,
    JsonList,
    refined_boxes,
    the_one,
    write_origin,
)
from boxreg_ros.rotations import quaternion_from_matrix
from boxreg_ros.structures import Floats, HEIGHT, LENGTH, WIDTH, X, Z
from msg_adapters.poses import quaternions_of
import numpy as np

FORMAT = Format(
    name='nuscenes',
    title='nuScenes',
    frame='fixed (global)',
    reference='centre',
    sizes='width length height',
    rotation='quaternion w x y z',
    files='v1.0-boxreg/, samples/, maps/',
    options=('with_points',),
)
STREAMED = ('sample', 'sample_data', 'sample_annotation', 'ego_pose')
EMPTY_MAP = 'maps/empty.png'
EVIDENCE = ('status', 'reason', 'score', 'covariance', 'stamp_ns')


class Writer:
    """
    Write samples, data and poses as they come, annotations one step later, the rest at the end.

    An annotation waits for the next of its track, to name it.

    """

    version, channel, clouds = 'v1.0-boxreg', 'LIDAR_TOP', 'samples/LIDAR_TOP'
    captured = 'date_captured'

    def __init__(self, folder: Path, provenance: Provenance, options: Options) -> None:
        self.dropped: Counter[str] = Counter()
        self._folder = folder
        self._tables = folder / self.version
        self._tables.mkdir()
        if options.with_points:
            (folder / self.clouds).mkdir(parents=True)
        self._origin = asdict(provenance)
        self._lists = {name: JsonList(self._tables / f'{name}.json') for name in STREAMED}
        self._held: dict[str, dict[str, Any]] = {}
        self._instances: dict[str, dict[str, Any]] = {}
        self._categories: dict[str, str] = {}
        self._samples = self._nameless = 0
        self._first: str = ''

    def write(self, frame: LabelFrame) -> None:
        """Add a sample with its annotations."""
        rows, boxes = frame.placed('fixed', self.dropped)
        T = frame.T_fixed_sensor
        if T is None:
            self.dropped['no_transform'] += len(rows)
            return
        self._origin |= {'fixed_frame': frame.fixed_frame, 'sensor_frame': frame.sensor_frame}
        number = self._samples
        self._samples += 1
        stamp = round(frame.refined.boxes.stamp_ns / 1000)
        sample, data = self._token('sample', number), self._token('sample_data', number)
        pose = self._token('ego_pose', number)
        self._first = self._first or sample
        self._append('sample', {
            'token': sample, 'timestamp': stamp, 'prev': '', 'next': '',
            'scene_token': self._token('scene'),
        })  # fmt: skip
        file = f'{self.clouds}/{number:05d}.pcd.bin'
        self._append('sample_data', {
            'token': data, 'sample_token': sample, 'ego_pose_token': pose,
            'calibrated_sensor_token': self._token('calibrated_sensor'), 'timestamp': stamp,
            'fileformat': 'pcd.bin', 'is_key_frame': True, 'height': 0, 'width': 0,
            'filename': file, 'prev': '', 'next': '', 'is_valid': True,
        })  # fmt: skip
        qx, qy, qz, qw = quaternion_from_matrix(T[:3, :3]).tolist()
        self._lists['ego_pose'].append({
            'token': pose, 'timestamp': stamp, 'rotation': [qw, qx, qy, qz],
            'translation': T[:3, 3].tolist(),
        })  # fmt: skip
        if frame.sweep is not None:
            write_cloud(self._folder / file, frame.sweep.points, frame.intensities)
        self._annotate(frame, sample, rows.tolist(), boxes)

    def close(self) -> None:
        """Write what is still held, and the tables of what there is only one of."""
        for name, held in self._held.items():
            self._lists[name if name in STREAMED else 'sample_annotation'].append(held)
        for streamed in self._lists.values():
            streamed.close()
        sensor, log = self._token('sensor'), self._token('log')
        last = self._token('sample', self._samples - 1) if self._samples else ''
        recordings = ', '.join(self._origin['recordings'])
        tables: dict[str, list[dict[str, Any]]] = {
            'category': [
                {'token': token, 'name': name, 'description': ''}
                for name, token in self._categories.items()
            ],
            'attribute': [],
            'visibility': [{'token': 'unavailable', 'level': 'unavailable', 'description': ''}],
            'instance': list(self._instances.values()),
            'sensor': [{'token': sensor, 'channel': self.channel, 'modality': 'lidar'}],
            'calibrated_sensor': [{
                'token': self._token('calibrated_sensor'), 'sensor_token': sensor,
                'translation': [0.0, 0.0, 0.0], 'rotation': [1.0, 0.0, 0.0, 0.0],
                'camera_intrinsic': [], 'camera_distortion': [],
            }],
            'log': [{
                'token': log, 'logfile': recordings, 'vehicle': '', self.captured: '',
                'location': '',
            }],
            'scene': [{
                'token': self._token('scene'), 'log_token': log, 'nbr_samples': self._samples,
                'first_sample_token': self._first, 'last_sample_token': last,
                'name': 'scene-0001',
                'description': f'{self._origin["tool"]} {self._origin["version"]}: {recordings}',
            }],
            'map': [{
                'token': self._token('map'), 'log_tokens': [log], 'category': '',
                'filename': EMPTY_MAP,
            }],
        }  # fmt: skip
        for name, rows in tables.items():
            table = JsonList(self._tables / f'{name}.json')
            for row in rows:
                table.append(row)
            table.close()
        # The devkit wants a map to be there.
        (self._folder / EMPTY_MAP).parent.mkdir()
        (self._folder / EMPTY_MAP).write_bytes(_black_pixel())
        write_origin(self._folder, self._origin)

    def _annotate(self, frame: LabelFrame, sample: str, rows: list[int], boxes: Floats) -> None:
        refined, given = frame.refined, frame.refined.boxes
        turns = quaternions_of(boxes)[:, [3, 0, 1, 2]].tolist()
        seen = set()
        for row, box, turn in zip(rows, boxes, turns, strict=True):
            name = given.track_ids[row]
            key = f'{name}\0{given.class_names[row]}'  # the class is the instance's
            if not name or key in seen:  # without an identity: an instance of its own
                self._nameless += 1
                key = f'\0{self._nameless}'
            seen.add(key)
            token = self._token('annotation', f'{sample} {key}')
            score = float(given.scores[row])
            self._append('sample_annotation', {
                'token': token, 'sample_token': sample,
                'instance_token': self._instance(key, name, given.class_names[row], token),
                'attribute_tokens': [], 'visibility_token': 'unavailable',
                'translation': box[X : Z + 1].tolist(),
                'size': box[[WIDTH, LENGTH, HEIGHT]].tolist(), 'rotation': turn,
                'num_lidar_pts': int(refined.num_points[row]), 'num_radar_pts': 0,
                'prev': '', 'next': '', 'status': refined.status[row],
                'reason': refined.reasons[row], 'score': score if np.isfinite(score) else None,
                'covariance': refined.covariances[row].ravel().tolist(),
                'stamp_ns': given.stamp_ns,
            }, key)  # fmt: skip

    def _instance(self, key: str, name: str, class_name: str, annotation: str) -> str:
        """Return the token of a track's instance, and count the annotation."""
        item = self._instances.setdefault(key, {
            'token': self._token('instance', key), 'instance_name': name,
            'category_token': self._categories.setdefault(
                class_name, self._token('category', class_name)
            ),
            'nbr_annotations': 0, 'first_annotation_token': annotation,
        })  # fmt: skip
        item['nbr_annotations'] += 1
        item['last_annotation_token'] = annotation
        return str(item['token'])

    def _append(self, table: str, item: dict[str, Any], track: str = '') -> None:
        """Write the item before of this table, or of this track, and hold this one."""
        if track.startswith('\0'):  # one of its kind
            self._lists[table].append(item)
            return
        name = f'\1{track}' if track else table
        before = self._held.get(name)
        if before is not None:
            before['next'], item['prev'] = item['token'], before['token']
            self._lists[table].append(before)
        self._held[name] = item

    def _token(self, kind: str, key: object = '') -> str:
        """Return 32 digits that stay the same for the same recording."""
        text = f'{self._origin["recordings"]} {self._origin["config_hash"]} {kind} {key}'
        return hashlib.md5(text.encode(), usedforsecurity=False).hexdigest()


def read(path: Path) -> Iterator[LabelFrame]:
    """
    Yield the samples of all scenes, by time.

    `path` is the folder of the tables, or one that holds it. Tracks are instances, by name where
    they have one; stamps are whole microseconds unless our own column has them.

    """
    path = absolute(path)
    found = [path] if (path / 'sample.json').exists() else sorted(
        file.parent for file in path.glob('*/sample.json')
    )  # fmt: skip
    tables = the_one(found, path, 'folder with the tables of nuScenes')
    folder = tables.parent
    try:
        category = {item['token']: item['name'] for item in from_json(tables / 'category.json')}
        instance = {item['token']: item for item in from_json(tables / 'instance.json')}
        poses = _poses(tables)
        annotations: dict[str, list[dict[str, Any]]] = {}
        for item in from_json(tables / 'sample_annotation.json'):
            annotations.setdefault(item['sample_token'], []).append(item)
        samples = sorted(from_json(tables / 'sample.json'), key=lambda item: item['timestamp'])
        fixed, sensor = frame_names(folder)
        for sample in samples:
            items = annotations.get(sample['token'], [])
            of_track = [instance[item['instance_token']] for item in items]
            stamp_ns = next((i['stamp_ns'] for i in items if 'stamp_ns' in i), None)
            numbers = np.array(
                [[*item['translation'], *item['size'], *item['rotation']] for item in items]
            ).reshape(-1, 10)
            evidence = {name: [item.get(name) for item in items] for name in EVIDENCE}
            refined = refined_boxes(
                sample['timestamp'] * 1000 if stamp_ns is None else stamp_ns,
                fixed,
                [item.get('instance_name') or item['token'] for item in of_track],
                [category[item['category_token']] for item in of_track],
                boxes_from(numbers[:, :3], numbers[:, [4, 3, 5]], numbers[:, [7, 8, 9, 6]]),
                evidence['score'],
                evidence['status'],
                [item['num_lidar_pts'] for item in items],
                evidence['covariance'],
                evidence['reason'],
            )
            yield LabelFrame(refined, fixed, sensor, poses.get(sample['token']))
    except (KeyError, TypeError, ValueError) as error:
        raise RecordingError(
            f'{tables}: expected the tables of nuScenes: {type(error).__name__} {error}'
        ) from None


def _poses(tables: Path) -> dict[str, Floats]:
    """Return the global pose (4, 4) of the LiDAR by sample."""
    lidars = {s['token'] for s in from_json(tables / 'sensor.json') if s['modality'] == 'lidar'}
    mounts = {
        item['token']: _matrix(item)
        for item in from_json(tables / 'calibrated_sensor.json')
        if item['sensor_token'] in lidars
    }
    ego = {item['token']: item for item in from_json(tables / 'ego_pose.json')}
    return {
        item['sample_token']: _matrix(ego[item['ego_pose_token']])
        @ mounts[item['calibrated_sensor_token']]
        for item in from_json(tables / 'sample_data.json')
        if item['is_key_frame'] and item['calibrated_sensor_token'] in mounts
    }


def _matrix(item: dict[str, list[float]]) -> Floats:
    w, *xyz = item['rotation']
    return matrix(np.array([*item['translation'], *xyz, w]))


def _black_pixel() -> bytes:
    """Return a PNG of one black pixel."""
    parts = [
        (b'IHDR', struct.pack('>IIBBBBB', 1, 1, 8, 0, 0, 0, 0)),
        (b'IDAT', zlib.compress(b'\0\0')),
        (b'IEND', b''),
    ]
    return b'\x89PNG\r\n\x1a\n' + b''.join(
        struct.pack('>I', len(data)) + kind + data + struct.pack('>I', zlib.crc32(kind + data))
        for kind, data in parts
    )
