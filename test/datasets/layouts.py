"""
Folders of public data sets as their documentation describes them, with one small drive.

A car drives ahead of the ego vehicle, which heads north (yaw 90 degrees in the map) at 5 m/s. In
frame i, 0.1 s apart, the car's centre is 10 + 0.2 i ahead and 1 m to the left of the ego frame,
0.8 m above its ground. Only the rear face of the car has points.

The LiDAR of nuScenes looks to the right (its x axis is the right of the vehicle, yaw -90 degrees),
so its axes are those of the map, and clouds are map coordinates minus its position.

"""

import json

import numpy as np
import pyarrow
from pyarrow import feather

FRAMES = 12
STEP_NS = 100_000_000
START_NS = 1_600_000_000_000_000_000
LENGTH, WIDTH, HEIGHT = 4.0, 2.0, 1.6
HALF = 0.5**0.5
"""Cosine and sine of 45 degrees: qw and qz of a yaw of 90 degrees."""
LIDAR_IN_EGO = (1.0, 0.0, 1.8)


def stamps_ns():
    return [START_NS + i * STEP_NS for i in range(FRAMES)]


def ego_position(i):
    """Position of the ego vehicle in the map."""
    return np.array([100.0, 200.0 + 0.5 * i, 0.0])


def lidar_position(i):
    """Position of the LiDAR in the map: 1 m ahead is 1 m north."""
    return ego_position(i) + np.array([0.0, 1.0, 1.8])


def car_in_ego(i):
    """Centre of the car in the ego frame."""
    return np.array([10.0 + 0.2 * i, 1.0, 0.8])


def car_in_map(i):
    """Box (9,) of the car in the map: ahead is north, left is west."""
    x, y, z = car_in_ego(i)
    centre = ego_position(i) + np.array([-y, x, z])
    return np.array([*centre, LENGTH, WIDTH, HEIGHT, 0.0, 0.0, np.pi / 2])


def face_in_ego(i):
    """Points (M, 3) of the rear face of the car in the ego frame, in a grid."""
    across, up = np.meshgrid(np.linspace(-0.9, 0.9, 13), np.linspace(-0.7, 0.7, 11))
    x, y, z = car_in_ego(i)
    rear = np.full(across.size, x - LENGTH / 2)
    return np.stack([rear, y + across.ravel(), z + up.ravel()], axis=1)


def face_in_map(i):
    """The same points in the map."""
    x, y, z = face_in_ego(i).T
    return ego_position(i) + np.stack([-y, x, z], axis=1)


def write_json(path, content):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=0))


def write_bin(path, points, columns):
    table = np.zeros((len(points), columns), '<f4')
    table[:, :3] = points
    table[:, 3] = 7.0
    path.parent.mkdir(parents=True, exist_ok=True)
    table.tofile(path)


def nuscenes(root, version='v1.0-mini', scene='scene-0061', with_annotations=True):
    """Write nuScenes: 10 Hz sweeps, every second one a sample; rows of another scene beside."""
    tables = root / version
    yaw_90 = [HALF, 0.0, 0.0, HALF]  # w x y z
    samples, sweeps, poses, annotations = [], [], [], []
    for i, stamp_ns in enumerate(stamps_ns()):
        micros = stamp_ns // 1000
        is_key = i % 2 == 0
        folder = 'samples' if is_key else 'sweeps'
        name = f'{folder}/LIDAR_TOP/n015-2018__LIDAR_TOP__{micros}.pcd.bin'
        write_bin(root / name, face_in_map(i) - lidar_position(i), 5)
        if is_key:
            samples.append({
                'token': f'sample{i}', 'timestamp': micros, 'prev': '', 'next': '',
                'scene_token': 'scene-a',
            })  # fmt: skip
            box = car_in_map(i)
            annotations.append({
                'token': f'annotation{i}', 'sample_token': f'sample{i}',
                'instance_token': 'car', 'visibility_token': '4', 'attribute_tokens': [],
                'translation': box[:3].tolist(), 'size': [WIDTH, LENGTH, HEIGHT],
                'rotation': yaw_90, 'prev': '', 'next': '', 'num_lidar_pts': 143,
                'num_radar_pts': 0,
            })  # fmt: skip
        sample = f'sample{i - i % 2}'
        poses.append({
            'token': f'pose{i}', 'timestamp': micros, 'rotation': yaw_90,
            'translation': ego_position(i).tolist(),
        })  # fmt: skip
        sweeps.append({
            'token': f'sweep{i}', 'sample_token': sample, 'ego_pose_token': f'pose{i}',
            'calibrated_sensor_token': 'top-a', 'timestamp': micros, 'fileformat': 'pcd',
            'is_key_frame': is_key, 'height': 0, 'width': 0, 'filename': name,
            'prev': '', 'next': '',
        })  # fmt: skip
        sweeps.append(sweeps[-1] | {
            'token': f'image{i}', 'calibrated_sensor_token': 'camera-a',
            'filename': f'{folder}/CAM_FRONT/{i}.jpg',
        })  # fmt: skip
    other = {'token': 'other', 'timestamp': 1, 'prev': '', 'next': '', 'scene_token': 'scene-b'}
    wrong = annotations[0] | {'token': 'wrong', 'sample_token': 'other', 'size': [9, 9, 9]}
    lidar = {
        'token': 'top-a', 'sensor_token': 'top', 'translation': list(LIDAR_IN_EGO),
        'rotation': [HALF, 0.0, 0.0, -HALF], 'camera_intrinsic': [],
    }  # fmt: skip
    camera = lidar | {'token': 'camera-a', 'sensor_token': 'camera'}
    scenes = [
        {
            'token': token, 'log_token': 'log', 'nbr_samples': 1, 'first_sample_token': first,
            'last_sample_token': first, 'name': name, 'description': '',
        }
        for token, name, first in (
            ('scene-a', scene, 'sample0'), ('scene-b', 'scene-0103', 'other')
        )
    ]  # fmt: skip
    content = {
        'scene': scenes,
        'sample': [other, *samples],
        'sample_data': sweeps,
        'ego_pose': poses,
        'sample_annotation': [wrong, *annotations] if with_annotations else [],
        'instance': [{
            'token': 'car', 'category_token': 'vehicle.car', 'nbr_annotations': 6,
            'first_annotation_token': 'annotation0', 'last_annotation_token': 'annotation10',
        }],
        'category': [{'token': 'vehicle.car', 'name': 'vehicle.car', 'description': ''}],
        'sensor': [
            {'token': 'top', 'channel': 'LIDAR_TOP', 'modality': 'lidar'},
            {'token': 'camera', 'channel': 'CAM_FRONT', 'modality': 'camera'},
        ],
        'calibrated_sensor': [lidar, camera],
        'log': [{
            'token': 'log', 'logfile': '', 'vehicle': '', 'date_captured': '', 'location': ''
        }],
        'visibility': [{'token': '4', 'level': 'v80-100', 'description': ''}],
        'attribute': [],
        'map': [],
    }  # fmt: skip
    for name, rows in content.items():
        write_json(tables / f'{name}.json', rows)
    return root


def nuscenes_results(path, task, shift=0.0):
    """Write results of the detection or the tracking task, with a sample of another scene."""
    results = {'elsewhere': []}
    for i in range(0, FRAMES, 2):
        box = car_in_map(i)
        item = {
            'sample_token': f'sample{i}', 'translation': [box[0], box[1] + shift, box[2]],
            'size': [WIDTH, LENGTH, HEIGHT], 'rotation': [HALF, 0.0, 0.0, HALF],
            'velocity': [0.0, 7.0], f'{task}_name': 'car', f'{task}_score': 0.75,
        }  # fmt: skip
        if task == 'tracking':
            item['tracking_id'] = '5'
        results[f'sample{i}'] = [item]
    write_json(path, {'meta': {'use_lidar': True}, 'results': results})
    return path


KITTI_LATITUDE = 60.0
"""Its cosine is 1/2, which halves the radius of the Mercator projection."""
KITTI_STEP = 0.5 / np.radians(1.0) / (6378137.0 * 0.5)
"""Degrees of longitude of 0.5 m to the east at this latitude."""
VELO_IN_IMU = (0.8, -0.3, 0.9)
"""Position of the LiDAR in the frame of the GPS/IMU unit, with the same axes."""


def oxts_line(i):
    """Heading east (yaw 0), 0.5 m per frame."""
    start = [KITTI_LATITUDE, 8.0 + i * KITTI_STEP, 110.0, 0.0, 0.0, 0.0]
    return ' '.join(f'{value:.15f}' for value in [*start, *[0.0] * 24])


def car_in_velo(i):
    """Box of the car in the LiDAR frame of KITTI: as in the ego frame, 1.7 m higher."""
    x, y, z = car_in_ego(i)
    return np.array([x, y, z - 1.7, LENGTH, WIDTH, HEIGHT, 0.0, 0.0, 0.0])


def kitti_position(i):
    """Position of the LiDAR in the frame of the first pose of the GPS/IMU unit."""
    return np.array([0.5 * i, 0.0, 0.0]) + VELO_IN_IMU


def kitti_tracking(root, name='0004', labels=True):
    """Write a sequence of KITTI tracking."""
    split = root / 'training'
    for folder in ('calib', 'oxts', 'label_02'):
        (split / folder).mkdir(parents=True)
    projection = '721.5 0 609.5 44.8 0 721.5 172.8 0.2 0 0 1 0.003'
    lines = [f'P{i}: {projection}' for i in range(4)]
    lines += [
        'R_rect 1 0 0 0 1 0 0 0 1',
        # x of the camera is right, y is down, z is forward
        'Tr_velo_cam 0 -1 0 0 0 0 -1 0 1 0 0 0',
        'Tr_imu_velo 1 0 0 -0.8 0 1 0 0.3 0 0 1 -0.9',
    ]
    (split / 'calib' / f'{name}.txt').write_text('\n'.join(lines) + '\n')
    (split / 'oxts' / f'{name}.txt').write_text(
        '\n'.join(oxts_line(i) for i in range(FRAMES)) + '\n'
    )
    rows = []
    for i in range(FRAMES):
        points = face_in_ego(i) - [0, 0, 1.7]
        write_bin(split / 'velodyne' / name / f'{i:06d}.bin', points, 4)
        rows.append(kitti_line(i))
        rows.append(f'{i} -1 DontCare -1 -1 -10 0 0 10 10 -1 -1 -1 -1000 -1000 -1000 -10')
    if labels:
        (split / 'label_02' / f'{name}.txt').write_text('\n'.join(rows) + '\n')
    return root


def kitti_line(i, score=''):
    """Return the line of the car: bottom centre in the camera, heading z is -90 degrees."""
    x, y, z = car_in_velo(i)[:3]
    location = f'{-y:.6f} {-(z - HEIGHT / 2):.6f} {x:.6f}'
    angle = f'{-np.pi / 2:.9f}'
    return f'{i} 3 Car 0 0 -1.5 0 0 9 9 {HEIGHT} {WIDTH} {LENGTH} {location} {angle} {score}'


def pose_columns(rotation, positions):
    columns = {name: [value] * len(positions) for name, value in zip(
        ('qw', 'qx', 'qy', 'qz'), rotation, strict=True
    )}  # fmt: skip
    columns |= dict(zip(('tx_m', 'ty_m', 'tz_m'), np.array(positions).T.tolist(), strict=True))
    return columns


def write_feather(path, columns):
    path.parent.mkdir(parents=True, exist_ok=True)
    feather.write_feather(pyarrow.table(columns), str(path))


LOG = '0aa4e8f5-2f9a-39a1-8f80-c2fdde4405a2'


def argoverse2(root, log=LOG, annotations=True):
    """Write a log of Argoverse 2 in the folder of a split."""
    folder = root / 'val' / log
    stamps = stamps_ns()
    write_feather(
        folder / 'city_SE3_egovehicle.feather',
        {'timestamp_ns': stamps}
        | pose_columns((HALF, 0, 0, HALF), [ego_position(i) for i in range(FRAMES)]),
    )
    write_feather(
        folder / 'calibration' / 'egovehicle_SE3_sensor.feather',
        {'sensor_name': ['ring_front_center', 'up_lidar', 'down_lidar']}
        | pose_columns((1, 0, 0, 0), [(1.6, 0, 1.4), (1.35, 0, 1.7), (1.35, 0, 1.5)]),
    )
    for i, stamp_ns in enumerate(stamps):
        points = face_in_ego(i).astype(np.float32)
        n = len(points)
        columns = dict(zip('xyz', points.T, strict=True))
        columns['intensity'] = np.full(n, 7, np.uint8)
        columns['laser_number'] = np.arange(n, dtype=np.uint8) % 64
        columns['offset_ns'] = np.linspace(0, 99_000_000, n).astype(np.int32)
        write_feather(folder / 'sensors' / 'lidar' / f'{stamp_ns}.feather', columns)
    if annotations:
        boxes = argoverse2_boxes()
        write_feather(
            folder / 'annotations.feather',
            boxes | {'track_uuid': ['car-1'] * FRAMES, 'num_interior_pts': [143] * FRAMES},
        )
    return root


def argoverse2_boxes():
    """Return the columns of the boxes of the car, in the frame of the ego vehicle."""
    n = FRAMES
    return {
        'timestamp_ns': stamps_ns(),
        'category': ['REGULAR_VEHICLE'] * n,
        'length_m': [LENGTH] * n,
        'width_m': [WIDTH] * n,
        'height_m': [HEIGHT] * n,
    } | pose_columns((1.0, 0.0, 0.0, 0.0), [car_in_ego(i) for i in range(n)])


def argoverse2_detections(path):
    """Write detections of two logs as they are submitted."""
    boxes = argoverse2_boxes() | {'score': [0.75] * FRAMES, 'log_id': [LOG] * FRAMES}
    for values in boxes.values():
        values.append(values[0])
    boxes['log_id'][-1] = 'another-log'
    write_feather(path, boxes)
    return path
