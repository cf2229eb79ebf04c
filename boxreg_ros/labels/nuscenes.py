"""
nuScenes: its thirteen tables with one scene, boxes in the global frame. T4 is a variant.

The sensor frame is written as the ego vehicle frame, with an identity calibration;
``--label-frame`` chooses another frame. A sample is a box array with a known pose. Additional
columns of annotations are status, reason, score, covariance, the class name as given and the stamp
in nanoseconds, of sweeps the stamp, of instances the track id. A track that changes its class is
several instances. T4 has these values in a file beside its tables.

"""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
import hashlib
from pathlib import Path
from typing import Any, TypeVar

from boxreg_ros.errors import RecordingError
from boxreg_ros.io.images import Image
from boxreg_ros.io.transforms import inverse, matrix
from boxreg_ros.labels import files
from boxreg_ros.labels.attributes import of_nuscenes, to_nuscenes
from boxreg_ros.labels.cameras import black_png, LabelCamera
from boxreg_ros.labels.folder import FolderWriter
from boxreg_ros.labels.protocol import (
    absolute,
    AUTOMATIC_STATUS,
    Format,
    LabelFrame,
    SceneFrames,
)
from boxreg_ros.labels.records import evidence_of, ReadBox, refined_of
from boxreg_ros.rotations import boxes_from_quaternions, quaternion_from_matrix
from boxreg_ros.structures import BOX_CENTER, Floats, HEIGHT, LENGTH, RefinedBoxes, WIDTH
from msg_adapters.poses import quaternions_of
import numpy as np

_T = TypeVar('_T')

FORMAT = Format(
    name='nuscenes',
    title='nuScenes',
    frame='fixed (global)',
    sizes='width length height',
    rotation='quaternion w x y z',
    files='v1.0-boxreg/, samples/, maps/',
    options=('with_points', 'with_images', 'class_map'),
    reads='annotations of all scenes; results of the detection and the tracking task',
    leaves_out='visibility, velocities, radar',
    read_back='nuscenes-devkit 1.2.0',
)
STREAMED_TABLES = ('sample', 'sample_data', 'sample_annotation', 'ego_pose')
"""Tables that grow with the recording; their rows are written one by one."""
OWN_VALUES = 'boxreg_values.json'
"""Values without a column in the tables of T4, by the token of their row."""
DISTORTIONS = (4, 5, 8, 12, 14)
"""Numbers of coefficients that T4 takes, those of OpenCV."""
ATTRIBUTE_GROUPS = ('vehicle', 'cycle', 'pedestrian')
"""First words of the attributes of nuScenes."""
EMPTY_MAP = 'maps/empty.png'


class Writer(FolderWriter):
    """
    Write the rows of each sample; the tables of one row or one per track when closed.

    A row names the next of its table, an annotation the next of its track. So each is held until
    the next is known.

    """

    form = 'nuscenes'
    version = 'v1.0-boxreg'
    channel = 'LIDAR_TOP'
    cloud_file = 'samples/LIDAR_TOP/{number:05d}.pcd.bin'
    image_file = 'samples/{channel}/{number:05d}.{suffix}'
    date_key = 'date_captured'
    needs_pose = True

    def begin(self) -> None:
        """Open the files."""
        self._tables = self.folder / self.version
        self._tables.mkdir()
        self._streams = {
            name: files.JsonList(self._tables / f'{name}.json') for name in STREAMED_TABLES
        }
        self._held_rows: dict[str, dict[str, Any]] = {}  # by table
        self._held_annotations: dict[str, dict[str, Any]] = {}  # by instance key
        self._instances: dict[str, dict[str, Any]] = {}
        self._sensors: list[dict[str, Any]] = []  # the cameras
        self._calibrations: list[dict[str, Any]] = []
        self._categories: dict[str, str] = {}
        self._attributes: dict[str, str] = {}
        self._drive = f'{self.about["recordings"]} {self.about["config_hash"]}'
        self._num_single = 0  # annotations that are an instance of their own

    def add(self, frame: LabelFrame) -> None:
        """Add a sample with its annotations."""
        assert frame.T_fixed_sensor is not None  # of `needs_pose`
        rows, boxes = frame.boxes_in('fixed', self.dropped)
        self._add_sample(frame.refined.boxes.stamp_ns, frame.T_fixed_sensor)
        self._add_annotations(frame, self._token('sample', self.number), rows.tolist(), boxes)

    def finish(self) -> None:
        """Write the rows still held and the remaining tables."""
        for chain, row in self._held_rows.items():
            self._streams[chain.partition(' ')[0]].append(row)
        for row in self._held_annotations.values():
            self._streams['sample_annotation'].append(row)
        for stream in self._streams.values():
            stream.close()
        for name, rows in self._closing_tables().items():
            rows_file = files.JsonList(self._tables / f'{name}.json')
            for row in rows:
                rows_file.append(row)
            rows_file.close()
        # The devkit requires a map.
        (self.folder / EMPTY_MAP).parent.mkdir()
        (self.folder / EMPTY_MAP).write_bytes(black_png(1, 1))

    def _add_sample(self, stamp_ns: int, T_fixed_sensor: Floats) -> None:
        """Add the rows of a sample: itself, its sweep and the pose of the ego vehicle."""
        timestamp = round(stamp_ns / 1000)
        self._link(
            'sample',
            {
                'token': self._token('sample', self.number),
                'timestamp': timestamp,
                'prev': '',
                'next': '',
                'scene_token': self._token('scene'),
            },
        )
        self._add_sample_data(self.cloud_file.format(number=self.number), stamp_ns)
        self._streams['ego_pose'].append(
            {
                'token': self._token('ego_pose', self.number),
                'timestamp': timestamp,
                'rotation': _rotation(T_fixed_sensor),
                'translation': T_fixed_sensor[:3, 3].tolist(),
            }
        )

    def _add_sample_data(
        self, path: str, stamp_ns: int, camera: str = '', size: tuple[int, int] = (0, 0)
    ) -> None:
        """Add the row of a file of a sample: its sweep, or the image of a camera."""
        token = self._token('sample_data', f'{self.number} {camera}'.rstrip())
        width, height = size
        row = {
            'token': token,
            'sample_token': self._token('sample', self.number),
            'ego_pose_token': self._token('ego_pose', self.number),
            'calibrated_sensor_token': self._token('calibrated_sensor', camera),
            'timestamp': round(stamp_ns / 1000),
            'fileformat': Path(path).name.partition('.')[2],
            'is_key_frame': True,
            'height': height,
            'width': width,
            'filename': path,
            'prev': '',
            'next': '',
            'is_valid': True,
            **self._own_columns(token, {'stamp_ns': stamp_ns}),
        }
        self._link('sample_data', row, camera=camera)

    def add_camera(self, camera: LabelCamera) -> None:
        """Hold the rows of a camera, whose pose is that in the LiDAR."""
        sensor = self._token('sensor', camera.name)
        T_sensor_camera = inverse(camera.T_camera_sensor)
        distortion = camera.image.distortion.tolist()
        self._sensors.append(
            {'token': sensor, 'channel': f'CAM_{camera.name.upper()}', 'modality': 'camera'}
        )
        self._calibrations.append(
            {
                'token': self._token('calibrated_sensor', camera.name),
                'sensor_token': sensor,
                'translation': T_sensor_camera[:3, 3].tolist(),
                'rotation': _rotation(T_sensor_camera),
                'camera_intrinsic': camera.intrinsics.tolist(),
                'camera_distortion': distortion if len(distortion) in DISTORTIONS else [],
            }
        )

    def add_images(self, images: Sequence[tuple[LabelCamera, Image, str]]) -> None:
        """Add a row for each image of a sample, which has the pose of the sample."""
        for camera, image, path in images:
            self._add_sample_data(path, image.stamp_ns, camera.name, camera.image.size)

    def _add_annotations(
        self, frame: LabelFrame, sample: str, rows: list[int], boxes: Floats
    ) -> None:
        refined = frame.refined
        array = refined.boxes
        num_points = refined.num_points.tolist()
        places = zip(
            rows,
            boxes[:, BOX_CENTER].tolist(),
            boxes[:, [WIDTH, LENGTH, HEIGHT]].tolist(),
            quaternions_of(boxes)[:, [3, 0, 1, 2]].tolist(),
            strict=True,
        )
        keys_in_sample: set[str] = set()
        for row, centre, size, quaternion in places:
            track_id = array.track_ids[row]
            class_name = self.class_names.of(array.class_names[row])
            key = f'{track_id}\0{class_name}'
            is_single = not track_id or key in keys_in_sample  # no identity
            if is_single:
                self._num_single += 1
                key = f'\0{self._num_single}'
            keys_in_sample.add(key)
            token = self._token('annotation', f'{sample} {key}')
            own = self._evidence(refined, row) | {
                'stamp_ns': array.stamp_ns,
                'class_name': array.class_names[row],
            }
            attributes = array.attributes_of(row)
            if attributes:
                own['attributes'] = dict(attributes)
            annotation = {
                'token': token,
                'sample_token': sample,
                'instance_token': self._instance(key, track_id, class_name, token),
                'attribute_tokens': [
                    self._attributes.setdefault(name, self._token('attribute', name))
                    for name in self.attribute_names(attributes)
                ],
                'visibility_token': 'unavailable',
                'translation': centre,
                'size': size,
                'rotation': quaternion,
                'num_lidar_pts': num_points[row],
                'num_radar_pts': 0,
                'prev': '',
                'next': '',
                **self._own_columns(token, own),
            }
            if is_single:
                self._streams['sample_annotation'].append(annotation)
            else:
                self._link('sample_annotation', annotation, key)

    def _own_columns(self, token: str, values: dict[str, Any]) -> dict[str, Any]:
        """Return the columns for values that the devkit does not know; it ignores them."""
        return values

    def attribute_names(self, attributes: Mapping[str, str]) -> list[str]:
        """Return the one attribute that the evaluation of nuScenes allows, of its own groups."""
        names = to_nuscenes(attributes, 'vehicle.parked')
        return [name for name in names if name.partition('.')[0] in ATTRIBUTE_GROUPS][:1]

    def _evidence(self, refined: RefinedBoxes, row: int) -> dict[str, Any]:
        """Return what an annotation states beside the columns of the devkit."""
        return evidence_of(refined, row)

    def _instance(self, key: str, track_id: str, class_name: str, annotation: str) -> str:
        """Return the token of an instance, and count the annotation."""
        token = self._token('category', class_name)
        category = self._categories.setdefault(class_name, token)
        if key not in self._instances:
            self._instances[key] = {
                'token': self._token('instance', key),
                'instance_name': track_id,
                'category_token': category,
                'nbr_annotations': 0,
                'first_annotation_token': annotation,
            }
        instance = self._instances[key]
        instance['nbr_annotations'] += 1
        instance['last_annotation_token'] = annotation
        return str(instance['token'])

    def _link(self, table: str, row: dict[str, Any], instance: str = '', camera: str = '') -> None:
        """Hold a row, and write the one before it of the same table and instance or camera."""
        held = self._held_annotations if instance else self._held_rows
        key = instance or f'{table} {camera}'
        before = held.get(key)
        if before is not None:
            before['next'] = row['token']
            row['prev'] = before['token']
            self._streams[table].append(before)
        held[key] = row

    def _closing_tables(self) -> dict[str, list[dict[str, Any]]]:
        """Return the tables written at the end: one LiDAR, log and scene, and an empty map."""
        sensor, log = self._token('sensor'), self._token('log')
        recordings = ', '.join(self.about['recordings'])
        samples = [self._token('sample', number) for number in (0, self.number - 1)]
        first, last = samples if self.number else ('', '')
        calibrated_sensor = {
            'token': self._token('calibrated_sensor'),
            'sensor_token': sensor,
            'translation': [0.0, 0.0, 0.0],  # its frame is written as that of the vehicle
            'rotation': [1.0, 0.0, 0.0, 0.0],
            'camera_intrinsic': [],
            'camera_distortion': [],
        }
        drive = {'logfile': recordings, 'vehicle': '', self.date_key: '', 'location': ''}
        scene = {
            'token': self._token('scene'),
            'log_token': log,
            'nbr_samples': self.number,
            'first_sample_token': first,
            'last_sample_token': last,
            'name': 'scene-0001',
            'description': f'{self.about["tool"]} {self.about["version"]}: {recordings}',
        }
        area = {'log_tokens': [log], 'category': '', 'filename': EMPTY_MAP}
        return {
            'category': _named(self._categories),
            'attribute': _named(self._attributes),
            'visibility': [{'token': 'unavailable', 'level': 'unavailable', 'description': ''}],
            'instance': list(self._instances.values()),
            'sensor': [
                {'token': sensor, 'channel': self.channel, 'modality': 'lidar'},
                *self._sensors,
            ],
            'calibrated_sensor': [calibrated_sensor, *self._calibrations],
            'log': [{'token': log, **drive}],
            'scene': [scene],
            'map': [{'token': self._token('map'), **area}],
        }

    def _token(self, kind: str, key: object = '') -> str:
        """Return 32 digits that are the same in every run over the same recording."""
        text = f'{self._drive} {kind} {key}'
        return hashlib.md5(text.encode(), usedforsecurity=False).hexdigest()


def _named(tokens: Mapping[str, str]) -> list[dict[str, Any]]:
    """Return the rows of a table of names."""
    return [{'token': token, 'name': name, 'description': ''} for name, token in tokens.items()]


def _rotation(T: Floats) -> list[float]:
    """Return qw qx qy qz of a pose (4, 4)."""
    qx, qy, qz, qw = quaternion_from_matrix(T[:3, :3]).tolist()
    return [qw, qx, qy, qz]


def read(path: Path) -> Iterator[LabelFrame]:
    """
    Yield the samples of all scenes in order of time.

    `path` is the folder of the tables, or the folder that contains it. Tracks are instances,
    named by ``instance_name`` where they have one, else by token. Stamps are whole microseconds,
    unless the annotations have the column ``stamp_ns``.

    """
    tables = _tables_in(absolute(path))
    with files.following(tables, 'the tables of nuScenes'):
        yield from _read_tables(tables)


def _tables_in(path: Path) -> Path:
    """Return the folder of the tables, which is `path` or in it."""
    found = [path]
    if not (path / 'sample.json').exists():
        found = [file.parent for file in files.visible(path, '*/sample.json')]
    return files.require_single(found, path, 'folder with the tables of nuScenes')


def _read_tables(tables: Path) -> Iterator[LabelFrame]:
    boxes = _annotations(tables, files.from_json)
    poses = _poses(tables)
    fixed_frame, sensor_frame = files.frame_names(tables.parent)
    samples = sorted(files.from_json(tables / 'sample.json'), key=lambda item: item['timestamp'])
    for sample in samples:
        found = boxes.get(sample['token'], [])
        own_ns = (int(box.evidence['stamp_ns']) for box in found if 'stamp_ns' in box.evidence)
        refined = refined_of(next(own_ns, int(sample['timestamp'] * 1000)), fixed_frame, found)
        yield LabelFrame(refined, fixed_frame, sensor_frame, poses.get(sample['token']))


def read_scene(path: Path, scene: SceneFrames) -> Iterator[LabelFrame]:
    """
    Yield the samples of one scene; memory does not grow with the other scenes.

    Parameters
    ----------
    path : Path
        The folder of the tables, or that which contains it; or results of the detection or the
        tracking task as they are submitted:
        ``{"meta": ..., "results": {sample_token: [...]}}``.
    scene : SceneFrames
        Its `stamps_ns` are by the token of the sample.

    Yields
    ------
    frame : LabelFrame
        One per sample of the scene, with or without boxes; boxes in the fixed frame.

    Raises
    ------
    RecordingError
        If a file is missing or does not follow the format.

    """
    with files.following(path, 'the tables or results of nuScenes'):
        if path.is_dir():
            boxes = _annotations(_tables_in(path), files.json_items, scene.stamps_ns)
        else:
            boxes = _results(path, scene)
        for token, stamp_ns in scene.stamps_ns.items():
            refined = refined_of(stamp_ns, scene.fixed_frame, boxes.get(token, []))
            yield LabelFrame(refined, scene.fixed_frame, scene.sensor_frame)


def _annotations(
    tables: Path,
    rows_of: Callable[[Path], Iterable[dict[str, Any]]],
    samples: Container[str] | None = None,
) -> dict[str, list[ReadBox]]:
    """Return the annotations of samples, by default of all, by the tokens of these."""
    own = own_values(tables.parent)
    items = [
        item | own.get(item['token'], {})
        for item in rows_of(tables / 'sample_annotation.json')
        if samples is None or item['sample_token'] in samples
    ]
    used = {item['instance_token'] for item in items}
    instances = {
        row['token']: row for row in rows_of(tables / 'instance.json') if row['token'] in used
    }
    categories = _names(tables / 'category.json')
    path = tables / 'attribute.json'
    attributes = _names(path) if path.exists() else {}
    found: dict[str, list[ReadBox]] = {}
    for item, box in zip(items, _boxes_of(items), strict=True):
        track = _row_of(instances, item['instance_token'], 'instance')
        tokens = item.get('attribute_tokens') or ()
        names = [attributes[token] for token in tokens if token in attributes]
        read_box = ReadBox(
            track.get('instance_name') or track['token'],
            item.get('class_name') or _row_of(categories, track['category_token'], 'category'),
            box,
            {'attributes': of_nuscenes(names)} | _evidence_of(item),
        )
        found.setdefault(item['sample_token'], []).append(read_box)
    return found


def _results(path: Path, scene: SceneFrames) -> dict[str, list[ReadBox]]:
    """Return the detections or tracked boxes of a scene by sample."""
    found: dict[str, list[ReadBox]] = {}
    others = 0
    for token, items in files.json_members(path, 'results'):
        if token not in scene.stamps_ns:
            others += 1
            continue
        task = 'tracking' if items and 'tracking_name' in items[0] else 'detection'
        found[token] = [
            ReadBox(
                str(item.get('tracking_id', '')),
                item[f'{task}_name'],
                box,
                {'score': item[f'{task}_score']},
            )
            for item, box in zip(items, _boxes_of(items), strict=True)
        ]
    if not found:
        raise RecordingError(
            f'{path}: expected results of the {len(scene.stamps_ns)} samples of {scene.name}, '
            f'got those of {others} other samples; name the results of the split of this scene'
        )
    return found


def own_values(folder: Path) -> dict[str, dict[str, Any]]:
    """Return what our exports of T4 state beside the tables, by token; empty for others."""
    path = folder / OWN_VALUES
    return {item['token']: item for item in files.json_items(path)} if path.is_file() else {}


def _names(table: Path) -> dict[str, str]:
    """Return the names of a table by their tokens."""
    return {item['token']: item['name'] for item in files.from_json(table)}


def _evidence_of(item: dict[str, Any]) -> dict[str, Any]:
    """Return what an annotation states of its box; T4 marks those that no person has made."""
    evidence = item | {'num_points': item['num_lidar_pts']}
    if item.get('automatic_annotation') is True:
        evidence.setdefault('status', AUTOMATIC_STATUS)  # our files state another one
    return evidence


def _row_of(rows: Mapping[str, _T], token: str, table: str) -> _T:
    """Return the row of a token; RecordingError if the table lacks it."""
    if token not in rows:
        raise RecordingError(
            f'{table}.json of nuScenes: expected a row with the token {token!r}, got none among '
            f'{len(rows)}; unpack the archive of its metadata again'
        )
    return rows[token]


def _boxes_of(items: list[dict[str, Any]]) -> Floats:
    """Return the boxes (n, 9) of annotations or results."""
    # x y z, width length height, qw qx qy qz
    numbers = np.array(
        [[*item['translation'], *item['size'], *item['rotation']] for item in items], np.float64
    ).reshape(-1, 10)
    return boxes_from_quaternions(numbers[:, :3], numbers[:, [4, 3, 5]], numbers[:, [7, 8, 9, 6]])


def _poses(tables: Path) -> dict[str, Floats]:
    """Return the global pose (4, 4) of the LiDAR by sample; none where there are several."""
    mounts = lidar_mounts(tables)
    ego_poses = {item['token']: item for item in files.from_json(tables / 'ego_pose.json')}
    poses = {}
    used = set()
    for item in files.from_json(tables / 'sample_data.json'):
        if item['is_key_frame'] and item['calibrated_sensor_token'] in mounts:
            channel, T_ego_lidar = mounts[item['calibrated_sensor_token']]
            used.add(channel)
            T_global_ego = pose_matrix(_row_of(ego_poses, item['ego_pose_token'], 'ego_pose'))
            poses[item['sample_token']] = T_global_ego @ T_ego_lidar
    return poses if len(used) == 1 else {}


def lidar_mounts(tables: Path) -> dict[str, tuple[str, Floats]]:
    """Return channel and pose (4, 4) in the vehicle of each LiDAR by its calibration's token."""
    channels = {
        row['token']: row['channel']
        for row in files.from_json(tables / 'sensor.json')
        if row['modality'] == 'lidar'
    }
    return {
        row['token']: (channels[row['sensor_token']], pose_matrix(row))
        for row in files.from_json(tables / 'calibrated_sensor.json')
        if row['sensor_token'] in channels
    }


def pose_matrix(item: dict[str, Any]) -> Floats:
    """Return the pose (4, 4) of a row of ``ego_pose`` or ``calibrated_sensor``."""
    qw, *qxyz = item['rotation']
    return matrix(np.array([*item['translation'], *qxyz, qw]))
