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
import pytest

pyarrow = pytest.importorskip('pyarrow', reason='pyarrow is not installed')
feather = pytest.importorskip('pyarrow.feather')

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
    """Return the points of `face_in_ego` in the map."""
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
        'map': [
            {
                'token': 'map', 'log_tokens': ['log'], 'category': 'semantic_prior',
                'filename': 'maps/map.png',
            }
        ],
    }  # fmt: skip
    (root / 'maps').mkdir(parents=True)
    (root / 'maps' / 'map.png').touch()
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


TRUCK_LIDARS = {
    'LIDAR_TOP_FRONT': (0.0, (1.0, 0.0, 3.0), (1.0, 0.0, 0.0, 0.0)),
    'LIDAR_LEFT': (0.03, (2.0, 1.2, 2.0), (HALF, 0.0, 0.0, HALF)),
}
"""Delay after the frame [s], position in the ego frame and rotation w x y z; yaw 0 and 90."""
SWEEP_TIMES = (-0.04, 0.04)
"""The first and the last point of a sweep, relative to its stamp [s]."""


def write_pcd(path, columns, encoding='binary'):
    """Write a PCD file of columns of numbers by name, without other fields."""
    kinds = {name: values.dtype for name, values in columns.items()}
    table = np.zeros(len(next(iter(columns.values()))), list(kinds.items()))
    for name, values in columns.items():
        table[name] = values
    lines = [
        '# .PCD v0.7 - Point Cloud Data file format', 'VERSION 0.7',
        'FIELDS ' + ' '.join(kinds),
        'SIZE ' + ' '.join(str(kind.itemsize) for kind in kinds.values()),
        'TYPE ' + ' '.join(kind.kind.upper() for kind in kinds.values()),
        'COUNT ' + ' '.join('1' for _ in kinds), f'WIDTH {len(table)}', 'HEIGHT 1',
        'VIEWPOINT 0 0 0 1 0 0 0', f'POINTS {len(table)}', f'DATA {encoding}', '',
    ]  # fmt: skip
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes('\n'.join(lines).encode() + table.tobytes())


def truck_points(channel, i):
    """Return when each point of the face is measured, counted in frames (M,), and its half."""
    delay = TRUCK_LIDARS[channel][0]
    across, _ = np.meshgrid(np.linspace(-0.9, 0.9, 13), np.linspace(-0.7, 0.7, 11))
    half = (across.ravel() > 0) == (channel == 'LIDAR_LEFT')
    seconds = delay + np.linspace(*SWEEP_TIMES, across.size)
    return i + seconds / 0.1, half


def truckscenes(root, split='v1.2-mini', scene='scene-a-1'):
    """Write TruckScenes: nuScenes with clouds of two LiDARs as PCD, whose points have times."""
    nuscenes(root, split, scene)
    tables = root / split
    rows = {
        name: json.loads((tables / f'{name}.json').read_text())
        for name in ('sample_data', 'sensor', 'calibrated_sensor')
    }
    sweeps = [row for row in rows['sample_data'] if 'LIDAR' not in row['filename']]
    for channel, (delay, position, rotation) in TRUCK_LIDARS.items():
        rows['sensor'].append({'token': channel, 'channel': channel, 'modality': 'lidar'})
        rows['calibrated_sensor'].append({
            'token': f'calibrated {channel}', 'sensor_token': channel,
            'translation': list(position), 'rotation': list(rotation), 'camera_intrinsic': [],
        })  # fmt: skip
        for i in range(FRAMES):
            micros = (START_NS + i * STEP_NS) // 1000 + round(delay * 1e6)
            name = f'samples/{channel}/{channel}_{micros}.pcd'
            frames, half = truck_points(channel, i)
            points = np.array([face_in_ego(f)[k] for k, f in enumerate(frames)]) - position
            if channel == 'LIDAR_LEFT':  # its x axis is y of the vehicle
                points = points[:, [1, 0, 2]] * [1, -1, 1]
            x, y, z = points[half].astype(np.float32).T
            times = START_NS // 1000 + np.rint(frames[half] * 1e5).astype(np.uint64)
            write_pcd(root / name, {
                'x': x, 'y': y, 'z': z, 'intensity': np.full_like(x, 7.0), 'timestamp': times,
            })  # fmt: skip
            sweeps.append({
                'token': f'{channel}{i}', 'sample_token': f'sample{i - i % 2}',
                'ego_pose_token': f'pose{i}', 'calibrated_sensor_token': f'calibrated {channel}',
                'timestamp': micros, 'fileformat': 'pcd', 'is_key_frame': i % 2 == 0,
                'height': 0, 'width': 0, 'filename': name, 'prev': '', 'next': '',
            })  # fmt: skip
    rows['sample_data'] = sweeps
    rows['sensor'] = [row for row in rows['sensor'] if row['channel'] != 'LIDAR_TOP']
    steps = np.arange(-10, 10 * FRAMES + 10)  # 100 Hz
    rows['ego_pose'] = [
        {
            'token': f'pose{k}', 'timestamp': START_NS // 1000 + int(k) * 10_000,
            'rotation': [HALF, 0.0, 0.0, HALF], 'translation': ego_position(k / 10).tolist(),
        }
        for k in steps
    ]  # fmt: skip
    for name in ('ego_motion_cabin', 'ego_motion_chassis', 'weather_annotation'):
        rows[name] = []
    for name, content in rows.items():
        write_json(tables / f'{name}.json', content)
    return root


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


DRIVE = '2011_09_26_drive_0001'
RAW_START_NS = 1_317_042_145_500_000_000
"""2011-09-26 13:02:25.5 UTC, as `date` prints it."""
OXTS_LATE_NS = 20_000_000
"""The GPS/IMU unit has its stamps after those of the LiDAR."""


def raw_stamps(start_ns):
    """Return lines of date and time, which count from 13:02:25."""
    nanoseconds = [start_ns - 1_317_042_145_000_000_000 + i * STEP_NS for i in range(FRAMES)]
    return '\n'.join(f'2011-09-26 13:02:{25 + n / 1e9:012.9f}' for n in nanoseconds) + '\n'


def kitti_raw(root, labels=True):
    """Write a drive of KITTI raw, synchronised and rectified."""
    day = root / '2011_09_26'
    drive = day / f'{DRIVE}_sync'
    for folder in ('velodyne_points/data', 'oxts/data'):
        (drive / folder).mkdir(parents=True)
    (day / 'calib_imu_to_velo.txt').write_text(
        'calib_time: 25-May-2012 16:47:16\nR: 1 0 0 0 1 0 0 0 1\nT: -0.8 0.3 -0.9\n'
    )
    stamps = raw_stamps(RAW_START_NS)
    (drive / 'velodyne_points' / 'timestamps.txt').write_text(stamps)
    (drive / 'oxts' / 'timestamps.txt').write_text(raw_stamps(RAW_START_NS + OXTS_LATE_NS))
    poses = ''
    for i in range(FRAMES):
        (drive / 'oxts' / 'data' / f'{i:010d}.txt').write_text(oxts_line(i) + '\n')
        points = face_in_ego(i) - [0, 0, 1.7]
        write_bin(drive / 'velodyne_points' / 'data' / f'{i:010d}.bin', points, 4)
        x, y, z = car_in_velo(i)[:3]
        poses += (
            f'<item><tx>{x}</tx><ty>{y}</ty><tz>{z - HEIGHT / 2}</tz><rx>0</rx><ry>0</ry>'
            f'<rz>0</rz><state>2</state></item>'
        )
    if labels:
        (drive / 'tracklet_labels.xml').write_text(
            '<?xml version="1.0" encoding="UTF-8" standalone="yes" ?>\n'
            '<!DOCTYPE boost_serialization>\n'
            '<boost_serialization signature="serialization::archive" version="9">'
            '<tracklets><count>1</count><item_version>1</item_version><item>'
            f'<objectType>Car</objectType><h>{HEIGHT}</h><w>{WIDTH}</w><l>{LENGTH}</l>'
            f'<first_frame>0</first_frame><poses><count>{FRAMES}</count>{poses}</poses>'
            '<finished>1</finished></item></tracklets></boost_serialization>\n'
        )
    return root


def pandaset_seconds():
    return [1_557_540_000.1 + 0.1 * i for i in range(FRAMES)]


def pandaset(root, labels=True):
    """Write a sequence of PandaSet: points and cuboids in the world, of two LiDARs."""
    import pandas as pd

    folder = root / '001'
    seconds = pandaset_seconds()
    write_json(folder / 'lidar' / 'timestamps.json', seconds)
    poses = [
        {
            'position': dict(zip('xyz', lidar_position(i).tolist(), strict=True)),
            'heading': {'w': HALF, 'x': 0.0, 'y': 0.0, 'z': HALF},
        }
        for i in range(FRAMES)
    ]
    write_json(folder / 'lidar' / 'poses.json', poses)
    (folder / 'annotations' / 'cuboids').mkdir(parents=True)
    for i in range(FRAMES):
        points = face_in_map(i)
        n = len(points)
        table = pd.DataFrame(np.vstack([points, points + 50]), columns=['x', 'y', 'z'])
        table['i'] = 7.0
        table['t'] = seconds[i] + np.tile(np.linspace(-0.05, 0.05, n), 2)
        table['d'] = np.repeat([0, 1], n)
        table.to_pickle(folder / 'lidar' / f'{i:02d}.pkl.gz')
        box = car_in_map(i)
        row = {
            'uuid': 'car-p', 'label': 'Car', 'yaw': 0.0, 'stationary': False, 'camera_used': 0,
            'position.x': box[0], 'position.y': box[1], 'position.z': box[2],
            'dimensions.x': WIDTH, 'dimensions.y': LENGTH, 'dimensions.z': HEIGHT,
            'attributes.object_motion': 'Moving', 'cuboids.sibling_id': 'other',
            'cuboids.sensor_id': 0,
        }  # fmt: skip
        sibling = row | {'uuid': 'other', 'cuboids.sensor_id': 1, 'position.x': 0.0}
        if labels:
            path = folder / 'annotations' / 'cuboids' / f'{i:02d}.pkl.gz'
            pd.DataFrame([row, sibling]).to_pickle(path)
    return root


SEGMENT = '10023947602400723454_1120_000_1140_000'
WAYMO_SHAPE = (16, 360)
TOP_IN_VEHICLE = (1.4, 0.0, 2.0)
FRONT_IN_VEHICLE = (3.8, 0.0, 0.8)
"""Its only pixel is 1 m ahead."""
INCLINATIONS = (-0.35, 0.05)


def waymo_advance():
    """Return how far north the vehicle is when each column is measured [m]."""
    return 0.4 * np.arange(WAYMO_SHAPE[1]) / WAYMO_SHAPE[1]


def waymo_hits(i):
    """
    Return the ranges (16, 360) of the rear face, 0 elsewhere, and its points (M, 3) in the map.

    Columns look backward first and turn clockwise; rows descend. The vehicle moves meanwhile.

    """
    height, width = WAYMO_SHAPE
    low, high = INCLINATIONS
    inclination = (high - (np.arange(height) + 0.5) / height * (high - low))[:, None]
    azimuth = (np.pi - 2 * np.pi * (np.arange(width) + 0.5) / width)[None]
    ray = np.stack(np.broadcast_arrays(
        np.cos(azimuth) * np.cos(inclination), np.sin(azimuth) * np.cos(inclination),
        np.sin(inclination) + 0 * azimuth,
    ), axis=-1)  # fmt: skip
    x, y, z = car_in_ego(i)
    ahead = x - LENGTH / 2 - TOP_IN_VEHICLE[0] - waymo_advance()[None]
    with np.errstate(divide='ignore'):
        ranges = np.where(ray[..., 0] > 0, ahead / ray[..., 0], 0.0)
    hit = ranges[..., None] * ray + TOP_IN_VEHICLE
    is_hit = (
        (ranges > 0) & (abs(hit[..., 1] - y) < WIDTH / 2) & (abs(hit[..., 2] - z) < HEIGHT / 2)
    )
    points = hit[is_hit]
    rear = np.full(len(points), x - LENGTH / 2)
    in_map = ego_position(i) + np.stack([-points[:, 1], rear, points[:, 2]], axis=1)
    return np.where(is_hit, ranges, 0.0), in_map


def waymo_points(i):
    return waymo_hits(i)[1]


def write_parquet(path, columns):
    from pyarrow import parquet

    path.parent.mkdir(parents=True, exist_ok=True)
    parquet.write_table(pyarrow.table(columns), str(path))


def waymo(root, labels=True):
    """Write a segment of Waymo, version 2; a front LiDAR has rows before the one on the roof."""
    split = root / 'training'
    file = f'{SEGMENT}.parquet'
    height, width = WAYMO_SHAPE
    micros = [stamp_ns // 1000 for stamp_ns in stamps_ns()]
    images, poses = [], []
    for i in range(FRAMES):
        image = np.zeros((height, width, 4), np.float32)
        image[..., 0] = waymo_hits(i)[0]
        image[..., 1] = 0.5
        images += [np.ones(4, np.float32), image.ravel()]
        pose = np.zeros((height, width, 6), np.float32)
        pose[..., 2:] = [np.pi / 2, *ego_position(i)]
        pose[..., 4] += waymo_advance()
        poses.append(pose.ravel())
    n = 2 * FRAMES
    floats = pyarrow.list_(pyarrow.float32())
    shape = pyarrow.list_(pyarrow.int32(), 3)
    keys = {
        'key.segment_context_name': [SEGMENT] * n,
        'key.frame_timestamp_micros': np.repeat(micros, 2),
        'key.laser_name': pyarrow.array([2, 1] * FRAMES, pyarrow.int8()),
    }
    name = '[LiDARComponent].range_image_return'
    write_parquet(split / 'lidar' / file, keys | {
        f'{name}1.values': pyarrow.array(images, floats),
        f'{name}1.shape': pyarrow.array([[1, 1, 4], [height, width, 4]] * FRAMES, shape),
        f'{name}2.values': pyarrow.array([None] * n, floats),
        f'{name}2.shape': pyarrow.array([None] * n, shape),
    })  # fmt: skip
    name = '[LiDARPoseComponent].range_image_return1'
    write_parquet(split / 'lidar_pose' / file, {
        'key.segment_context_name': [SEGMENT] * FRAMES,
        'key.frame_timestamp_micros': micros,
        'key.laser_name': pyarrow.array([1] * FRAMES, pyarrow.int8()),
        f'{name}.values': pyarrow.array(poses, floats),
        f'{name}.shape': pyarrow.array([[height, width, 6]] * FRAMES, shape),
    })  # fmt: skip
    # The LiDAR itself is turned by 90 degrees: columns begin at the rear of the vehicle anyway.
    extrinsic = [0, -1, 0, 1.4, 1, 0, 0, 0, 0, 0, 1, 2.0, 0, 0, 0, 1]
    front = [1, 0, 0, FRONT_IN_VEHICLE[0], 0, 1, 0, 0, 0, 0, 1, FRONT_IN_VEHICLE[2], 0, 0, 0, 1]
    name = '[LiDARCalibrationComponent].'
    write_parquet(split / 'lidar_calibration' / file, {
        'key.segment_context_name': [SEGMENT] * 2,
        'key.laser_name': pyarrow.array([1, 2], pyarrow.int8()),
        f'{name}extrinsic.transform': pyarrow.array(
            np.array([extrinsic, front], float).tolist(), pyarrow.list_(pyarrow.float64(), 16)
        ),
        f'{name}beam_inclination.min': [INCLINATIONS[0], -0.1],
        f'{name}beam_inclination.max': [INCLINATIONS[1], 0.1],
        f'{name}beam_inclination.values': pyarrow.array(
            [None] * 2, pyarrow.list_(pyarrow.float64())
        ),
    })  # fmt: skip
    transforms = []
    for i in range(FRAMES):
        x, y, z = ego_position(i)
        transforms.append([0.0, -1, 0, x, 1, 0, 0, y, 0, 0, 1, z, 0, 0, 0, 1])
    write_parquet(split / 'vehicle_pose' / file, {
        'key.segment_context_name': [SEGMENT] * FRAMES,
        'key.frame_timestamp_micros': micros,
        '[VehiclePoseComponent].world_from_vehicle.transform': pyarrow.array(
            transforms, pyarrow.list_(pyarrow.float64(), 16)
        ),
    })  # fmt: skip
    if labels:
        boxes = np.array([car_in_ego(i) for i in range(FRAMES)])
        name = '[LiDARBoxComponent].'
        columns = {f'{name}box.center.{axis}': boxes[:, k] for k, axis in enumerate('xyz')}
        for axis, size in zip('xyz', (LENGTH, WIDTH, HEIGHT), strict=True):
            columns[f'{name}box.size.{axis}'] = [size] * FRAMES
        write_parquet(split / 'lidar_box' / file, {
            'key.segment_context_name': [SEGMENT] * FRAMES,
            'key.frame_timestamp_micros': micros,
            'key.laser_object_id': ['car-w'] * FRAMES,
            **columns,
            f'{name}box.heading': [0.0] * FRAMES,
            f'{name}type': pyarrow.array([1] * FRAMES, pyarrow.int8()),
            f'{name}num_lidar_points_in_box': [143] * FRAMES,
        })  # fmt: skip
    return root
