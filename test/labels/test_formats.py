"""
Label formats: values of a tilted box derived by hand, round trips, and third-party readers.

The sensor is at (10, 2, 1) of the fixed frame with a yaw of 90 degrees. The box has its centre at
(13, 8, 2) and R = Rz(90) Ry(30) Rx(60). The vector from sensor to box is d = (3, 6, 1), and
Rz(-90) (x, y) = (y, -x): in the sensor frame the box is at (6, -3, 1), with R = Ry(30) Rx(60),
whose columns are

    heading  Ry(30) (1, 0, 0)                 = (cos30, 0, -sin30)
    left     Ry(30) (0, cos60, sin60)         = (sin30 sin60, cos60, cos30 sin60)
    up       Ry(30) (0, -sin60, cos60)        = (sin30 cos60, -sin60, cos30 cos60)

As a quaternion x y z w, a product of half angles: (c15 s30, s15 c30, -s15 s30, c15 c30). The yaw
of 90 degrees to the fixed frame gives sqrt(1/2) (x - y, y + x, z + w, w - z).
"""

from collections import Counter
from dataclasses import replace
import gc
from importlib import import_module
from itertools import product
import json
from math import atan2, cos, pi, radians, sin, sqrt
from pathlib import Path
import shutil
import sys
import tracemalloc
from xml.etree import ElementTree

from boxreg_ros import __version__
from boxreg_ros.errors import ConfigError, RecordingError
from boxreg_ros.io.box_table import COLUMNS
from boxreg_ros.io.transforms import inverse
from boxreg_ros.labels import (
    arrow,
    can_read,
    check_options,
    FORMATS,
    frames_of,
    LabelFrame,
    module_of,
    Options,
    Provenance,
    writer_for,
)
from boxreg_ros.labels.camera import Camera
from boxreg_ros.structures import BoxArray, KINEMATICS, RefinedBoxes, Sweep
from consumers import consumer
import numpy as np
import pytest

STAMP = 1_700_000_000_123_456_789
EXTENT = [4.0, 2.0, 1.6]
IN_FIXED = [13.0, 8.0, 2.0, *EXTENT, radians(60), radians(30), radians(90)]
IN_SENSOR = [6.0, -3.0, 1.0, *EXTENT, radians(60), radians(30), 0.0]
T_FIXED_SENSOR = np.array([[0, -1, 0, 10], [1, 0, 0, 2], [0, 0, 1, 1], [0, 0, 0, 1]], float)
C30, S30 = cos(radians(30)), sin(radians(30))
C60, S60 = cos(radians(60)), sin(radians(60))
C15, S15 = cos(radians(15)), sin(radians(15))
AXES = np.array([[C30, 0, -S30], [S30 * S60, C60, C30 * S60], [S30 * C60, -S60, C30 * C60]])
XYZW_SENSOR = (C15 * S30, S15 * C30, -S15 * S30, C15 * C30)
XYZW_FIXED = (sqrt(0.5) * S15, 0.5, 0.5, sqrt(0.5) * C15)
HALVES = [0.5 * np.array(EXTENT) * signs for signs in product((-1, 1), repeat=3)]
CORNERS = np.array([6.0, -3.0, 1.0]) + np.array(HALVES) @ AXES
COVARIANCE = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]) + 0.5
# x right, y down, z forward: p_camera = (-y, -z, x) + (0.1, -0.2, -0.5).
CALIBRATION = """P2: 200 0 600 0 0 200 180 0 0 0 1 0
R_rect 1 0 0 0 1 0 0 0 1
Tr_velo_cam 0 -1 0 0.1 0 0 -1 -0.2 1 0 0 -0.5
"""
READABLE_FORMATS = (
    'csv', 'parquet', 'openlabel', 'kitti', 'kitti_object', 'tracklets', 'nuscenes', 't4',
    'argoverse2', 'waymo', 'openpcdet', 'sustechpoints', 'datumaro', 'supervisely',
    'sly_pointcloud', 'xtreme1',
)  # fmt: skip
UPRIGHT_FORMATS = {'kitti', 'kitti_object', 'openpcdet', 'waymo'}
DECIMAL_FORMATS = {'kitti', 'kitti_object', 'openpcdet'}
POINTS = np.array([[1.0, 2.0, 3.0], [-4.0, 5.5, 0.25]], np.float32)


def require_packages(name):
    """Skip the test if a package that the format needs is not installed."""
    for package in import_module(FORMATS[name]).FORMAT.packages:
        pytest.importorskip(package)


def frame_of(
    boxes=(IN_FIXED,), tracks=('7',), stamp_ns=STAMP, frame_id='odom', class_name='Car', **changes
):
    n = len(tracks)
    refined = RefinedBoxes(
        BoxArray(
            stamp_ns, frame_id, tuple(tracks), (class_name,) * n, np.full(n, 0.75),
            np.array(boxes, float).reshape(n, 9),
        ),
        ('refined',) * n, ('',) * n, np.arange(n) + 42, np.tile(COVARIANCE, (n, 1, 1)),
    )  # fmt: skip
    fields = {'T_fixed_sensor': T_FIXED_SENSOR, 'sweep': None} | changes
    return LabelFrame(refined, 'odom', 'lidar', **fields)


def options_in(folder, **more):
    path = folder / 'camera.txt'
    path.write_text(CALIBRATION)
    return Options(camera=path, **more)


def sorted_by_track(frame):
    """Return a frame with its boxes in the fixed frame, sorted by track id."""
    refined = frame.moved('fixed').refined
    order = sorted(range(len(refined.status)), key=lambda i: refined.boxes.track_ids[i])
    places = frame.fixed_frame, frame.sensor_frame, frame.T_fixed_sensor
    return LabelFrame(refined.take(order), *places)


def written(name, folder, frames=None, **options):
    """Write `frames`; return the writer and the folder of the format."""
    require_packages(name)
    folder.mkdir(exist_ok=True)
    provenance = Provenance(('drive.mcap',), 'cafe')
    writer = writer_for(name, folder, provenance, options_in(folder, **options))
    for frame in [frame_of()] if frames is None else frames:
        writer.write(frame)
    writer.close()
    return writer, folder if name == 'csv' else folder / name


def test_box_in_sensor_frame_equals_the_derivation():
    _, boxes = frame_of().boxes_in('sensor', Counter())
    np.testing.assert_allclose(boxes, [IN_SENSOR], atol=1e-12)


# Values derived by hand --------------------------------------------------------------------------


def test_kitti(tmp_path):
    _, folder = written('kitti', tmp_path)
    words = (folder / 'label_02' / '0000.txt').read_text().split()
    assert words[:5] == ['0', '7', 'Car', '0', '3']
    alpha, left, top, right, bottom, *dimensions = map(float, words[5:13])
    location, turn, score = list(map(float, words[13:16])), *map(float, words[16:])
    assert dimensions == [1.6, 2.0, 4.0]
    # The centre (6, -3, 1) is (3, -1, 6) + (0.1, -0.2, -0.5) in the camera frame; the location is
    # half a height lower.
    np.testing.assert_allclose(location, [3.1, -1.2 + 0.8, 5.5], atol=1e-6)
    # rotation_y is -(yaw + 90 degrees) with yaw 0. The bearing of the box is atan(x / z).
    assert turn == pytest.approx(-pi / 2, abs=1e-6)
    assert alpha == pytest.approx(-pi / 2 - atan2(3.1, 5.5), abs=1e-6)
    assert score == 0.75
    x, y, z = np.c_[-CORNERS[:, 1] + 0.1, -CORNERS[:, 2] - 0.2, CORNERS[:, 0] - 0.5].T
    u, v = 200 * x / z + 600, 200 * y / z + 180
    expected = [u.min(), v.min(), u.max(), v.max()]
    np.testing.assert_allclose([left, top, right, bottom], expected, atol=1e-5)


@pytest.mark.parametrize('yaw', [-3.0, -1.2, 0.0, 0.4, 1.6, 3.1])
def test_kitti_rotation_y_is_minus_yaw_minus_90_degrees(tmp_path, yaw):
    box = [8.0, 1.0, 0.0, *EXTENT, 0.0, 0.0, yaw]
    _, folder = written('kitti', tmp_path, [frame_of([box], frame_id='lidar')])
    turn = float((folder / 'label_02' / '0000.txt').read_text().split()[16])
    assert -pi <= turn <= pi
    assert (turn + yaw + pi / 2 + pi) % (2 * pi) - pi == pytest.approx(0.0, abs=1e-6)


def test_kitti_centre_is_exact_for_a_tilted_camera():
    """Readers reconstruct the box upright along y of the camera: the centre must not change."""
    T = np.eye(4)
    tilt = np.array([[1, 0, 0], [0, C15, -S15], [0, S15, C15]])
    T[:3, :3] = tilt @ np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0]])
    camera = Camera(np.eye(4)[:3], np.eye(3), T)
    box = np.array([[8.0, 1.0, 0.5, *EXTENT, 0.0, 0.0, 0.3]])
    centres, turns = camera.to_upright(box)
    back = camera.from_upright(centres, turns, box[:, 3:6])
    np.testing.assert_allclose(back[:, :6], box[:, :6], atol=1e-12)


@pytest.mark.parametrize(
    ('center', 'truncated', 'is_visible'),
    [((8.0, 0.0, 0.0), 0, True), ((8.0, 24.0, 0.0), 1, True), ((8.0, 90.0, 0.0), 2, False),
     ((-8.0, 0.0, 0.0), 2, False), ((0.5, 0.0, 0.0), 1, True)],
)  # fmt: skip
def test_kitti_writes_boxes_outside_of_the_image(tmp_path, center, truncated, is_visible):
    box = [*center, *EXTENT, 0.0, 0.0, 0.0]
    writer, folder = written('kitti', tmp_path, [frame_of([box], frame_id='lidar')])
    words = (folder / 'label_02' / '0000.txt').read_text().split()
    left, top, right, bottom = map(float, words[6:10])
    assert int(words[3]) == truncated
    assert (left == top == right == bottom == -1) is not is_visible
    if is_visible:
        assert 0 <= left < right <= 1241
        assert 0 <= top < bottom <= 374
    assert not +writer.dropped


def test_tracklets(tmp_path):
    _, folder = written('tracklets', tmp_path)
    root = ElementTree.parse(folder / 'tracklet_labels.xml').getroot()
    (item,) = root.findall('tracklets/item')
    assert [float(item.findtext(name)) for name in 'hwl'] == [1.6, 2.0, 4.0]
    assert (item.findtext('objectType'), item.findtext('first_frame')) == ('Car', '0')
    (pose,) = item.findall('poses/item')
    # The bottom is half a height below the centre, along `up`.
    position = [float(pose.findtext(name)) for name in ('tx', 'ty', 'tz')]
    np.testing.assert_allclose(
        position, [6 - 0.8 * S30 * C60, -3 + 0.8 * S60, 1 - 0.8 * C30 * C60], atol=1e-9
    )
    angles = [float(pose.findtext(name)) for name in ('rx', 'ry', 'rz')]
    np.testing.assert_allclose(angles, [radians(60), radians(30), 0], atol=1e-9)
    assert root.findtext('tracklets/count') == '1'


def test_tracklets_with_swapped_axes_for_datumaro_and_cvat(tmp_path):
    _, folder = written('tracklets', tmp_path, swap_axes=True)
    (item,) = ElementTree.parse(folder / 'tracklet_labels.xml').findall('tracklets/item')
    # Datumaro reads the scale x, y, z from h, w, l, and the position as the centre.
    assert [float(item.findtext(name)) for name in 'hwl'] == EXTENT
    pose = item.find('poses/item')
    position = [float(pose.findtext(name)) for name in ('tx', 'ty', 'tz')]
    np.testing.assert_allclose(position, [6, -3, 1], atol=1e-9)
    (cuboid,) = consumer('datumaro', folder, 'kitti_raw')['cuboids']
    assert (cuboid['position'], cuboid['scale']) == ([6, -3, 1], EXTENT)
    (frame,) = frames_of('tracklets', folder)
    np.testing.assert_allclose(frame.refined.boxes.boxes, [IN_SENSOR], atol=1e-9)


def test_tracklets_are_gapless_and_have_one_extent(tmp_path):
    wide = [*IN_FIXED[:4], 3.0, *IN_FIXED[5:]]
    arrays = [(['a', 'b'], [IN_FIXED] * 2), (['a'], [IN_FIXED]), (['a', 'b'], [wide, IN_FIXED])]
    frames = [frame_of(boxes, names, STAMP + i) for i, (names, boxes) in enumerate(arrays)]
    _, folder = written('tracklets', tmp_path, frames)
    items = ElementTree.parse(folder / 'tracklet_labels.xml').findall('tracklets/item')
    tracklets = sorted(
        (int(item.findtext('first_frame')), len(item.findall('poses/item')), item.findtext('w'))
        for item in items
    )
    assert tracklets == [(0, 1, '2.0'), (0, 3, '2.0'), (2, 1, '2.0')]


@pytest.mark.parametrize(('name', 'version'), [('nuscenes', 'v1.0-boxreg'), ('t4', 'annotation')])
def test_nuscenes(tmp_path, name, version):
    _, folder = written(name, tmp_path)
    (row,) = json.loads((folder / version / 'sample_annotation.json').read_text())
    x, y, z, w = XYZW_FIXED
    assert row['translation'] == [13.0, 8.0, 2.0]
    assert row['size'] == [2.0, 4.0, 1.6]
    np.testing.assert_allclose(row['rotation'], [w, x, y, z], atol=1e-9)
    if name == 't4':  # its devkit refuses columns that it does not know
        (_, own) = json.loads((folder / 'boxreg_values.json').read_text())
        assert own['token'] == row['token']
        model = {'name': f'boxreg_ros {__version__}', 'score': 0.75, 'uncertainty': None}
        assert (row['automatic_annotation'], row['autolabel_metadata']) == (True, [model])
        row |= own
    assert (row['num_lidar_pts'], row['status'], row['score']) == (42, 'refined', 0.75)
    assert row['class_name'] == 'Car'
    np.testing.assert_allclose(np.reshape(row['covariance'], (6, 6)), COVARIANCE)
    (sample,) = json.loads((folder / version / 'sample.json').read_text())
    assert sample['timestamp'] == 1_700_000_000_123_457
    (pose,) = json.loads((folder / version / 'ego_pose.json').read_text())
    assert pose['translation'] == [10.0, 2.0, 1.0]
    np.testing.assert_allclose(pose['rotation'], [sqrt(0.5), 0, 0, sqrt(0.5)], atol=1e-9)


T4_COLUMNS = {
    'sample_annotation': 'token sample_token instance_token attribute_tokens visibility_token '
    'translation size rotation num_lidar_pts num_radar_pts next prev velocity acceleration '
    'automatic_annotation autolabel_metadata',
    'sample_data': 'token sample_token ego_pose_token calibrated_sensor_token filename fileformat '
    'width height timestamp is_key_frame next prev is_valid info_filename autolabel_metadata',
    'sample': 'token timestamp scene_token next prev',
    'ego_pose': 'token translation rotation timestamp twist acceleration geocoordinate',
    'instance': 'token category_token instance_name nbr_annotations first_annotation_token '
    'last_annotation_token',
    'category': 'token name description index has_orientation has_number',
    'calibrated_sensor': 'token sensor_token translation rotation camera_intrinsic '
    'camera_distortion',
    'sensor': 'token channel modality',
    'scene': 'token name description log_token nbr_samples first_sample_token last_sample_token',
    'log': 'token logfile vehicle data_captured location',
    'map': 'token log_tokens category filename',
    'visibility': 'token level description',
    'attribute': 'token name description',
}
"""Columns that t4-devkit 0.8.0 takes; it raises for others. The registry has only 0.1.0 of it."""


def test_t4_has_no_columns_that_its_devkit_refuses(tmp_path):
    places = [[13.0 + 0.5 * i**2, *IN_FIXED[1:]] for i in range(4)]
    stamps = [STAMP + i * 5 * 10**8 for i in range(3)] + [STAMP + 10**10]
    frames = [frame_of([box], stamp_ns=stamp) for box, stamp in zip(places, stamps, strict=True)]
    human = replace(frames[1].refined, status=('human',))
    frames[1] = replace(frames[1], refined=human)
    _, folder = written('t4', tmp_path, frames)
    tables = {path.stem: json.loads(path.read_text()) for path in folder.glob('annotation/*')}
    assert tables.keys() == T4_COLUMNS.keys()
    for name, rows in tables.items():
        for row in rows:
            assert row.keys() <= set(T4_COLUMNS[name].split())
    rows = sorted(tables['sample_annotation'], key=lambda row: row['translation'][0])
    # 0, 0.5, 2 and 4.5 m after 0, 0.5, 1 and 10 s: the last one is after a gap.
    assert [row['velocity'] for row in rows] == [[1, 0, 0], [2, 0, 0], [3, 0, 0], None]
    assert [row['automatic_annotation'] for row in rows] == [True, False, True, True]
    assert rows[1]['autolabel_metadata'] is None
    (again, *_) = frames_of('t4', folder)
    assert (again.refined.boxes.stamp_ns, again.refined.reasons) == (STAMP, ('',))


def test_t4_has_the_refined_motion_where_it_is_known(tmp_path):
    frames = [
        frame_of([[13.0 + 0.5 * i, *IN_FIXED[1:]]], stamp_ns=STAMP + i * 5 * 10**8)
        for i in range(3)
    ]
    motion = np.zeros(1, KINEMATICS)
    motion['velocity'], motion['acceleration'] = (1.2, 0.1, 0.0, 0.3), (0.5, 0.0, 0.0)
    motion['has_velocity'] = motion['has_acceleration'] = True
    boxes = replace(frames[1].refined.boxes, kinematics=motion)
    frames[1] = replace(frames[1], refined=replace(frames[1].refined, boxes=boxes))
    _, folder = written('t4', tmp_path, frames)
    rows = json.loads((folder / 'annotation/sample_annotation.json').read_text())
    rows.sort(key=lambda row: row['translation'][0])
    assert [row['velocity'] for row in rows] == [[1, 0, 0], [1.2, 0.1, 0], [1, 0, 0]]
    assert [row['acceleration'] for row in rows] == [None, [0.5, 0, 0], None]


OFFICIAL_CLASSES = {
    'nuscenes': {
        'Car': 'vehicle.car', 'truck': 'vehicle.truck', 'VEHICLE.CAR': 'vehicle.car',
        'Pedestrian': 'human.pedestrian.adult', 'REGULAR_VEHICLE': 'vehicle.car',
        'CONSTRUCTION_CONE': 'movable_object.trafficcone', 'ufo': 'ufo',
        'Van': 'vehicle.bus.rigid', 'Construction Signs': 'Construction Signs',
        'vehicle.train': 'vehicle.train', 'bicycle_rack': 'static_object.bicycle_rack',
        'Temporary Construction Barriers': 'movable_object.barrier',
        'MOBILE_PEDESTRIAN_CROSSING_SIGN': 'MOBILE_PEDESTRIAN_CROSSING_SIGN',
        'CONSTRUCTION_BARREL': 'CONSTRUCTION_BARREL',
        'OFFICIAL_SIGNALER': 'human.pedestrian.adult',
    },
    'argoverse2': {
        'Car': 'REGULAR_VEHICLE', 'vehicle.bus.bendy': 'ARTICULATED_BUS', 'bicycle': 'BICYCLE',
        'static_object.bicycle_rack': 'static_object.bicycle_rack', 'traffic_sign': 'SIGN',
        'rider': 'BICYCLIST', 'box_truck': 'BOX_TRUCK', 'ufo': 'ufo', 'Van': 'BUS',
    },
    'kitti': {
        'vehicle.car': 'Car', 'PEDESTRIAN': 'Pedestrian', 'vehicle.bus.rigid': 'Misc',
        'two words': 'two_words', 'Van': 'Truck', 'bicycle_rack': 'Misc',
        'human_depiction': 'Misc', 'DontCare': 'DontCare',
    },
}  # fmt: skip


@pytest.mark.parametrize('name', OFFICIAL_CLASSES)
def test_class_names_are_those_of_the_evaluation_and_ours_are_read_back(tmp_path, name):
    class_map = tmp_path / 'classes.yaml'
    class_map.write_text(
        'nuscenes: {Van: vehicle.bus.rigid}\nargoverse2: {Van: BUS}\nkitti: {Van: Truck}\n'
    )
    classes = OFFICIAL_CLASSES[name]
    frames = [
        frame_of(tracks=(str(i),), stamp_ns=STAMP + i * 10**6, class_name=given)
        for i, given in enumerate(classes)
    ]
    _, folder = written(name, tmp_path / 'out', frames, class_map=class_map)
    found = [frame.refined.boxes.class_names for frame in frames_of(name, folder)]
    assert found == [(given,) for given in classes]
    if name == 'nuscenes':
        tables = folder / 'v1.0-boxreg'
        rows = json.loads((tables / 'category.json').read_text())
        assert {row['name'] for row in rows} == set(classes.values())
    elif name == 'argoverse2':
        rows = import_module('pyarrow.feather').read_table(folder / 'annotations.feather')
        assert rows['category'].to_pylist() == list(classes.values())
    else:
        lines = (folder / 'label_02/0000.txt').read_text().splitlines()
        assert [line.split()[2] for line in lines] == list(classes.values())
    about = json.loads((folder / 'boxreg.json').read_text())['class_names']
    assert about['Van'] == classes['Van'] and 'ufo' not in about


def test_boxes_of_the_class_of_regions_are_read_back(tmp_path):
    """By KITTI object, as by KITTI tracking above: what has extents is no region."""
    frame = frame_of(class_name='DontCare')
    _, folder = written('kitti_object', tmp_path, [frame])
    (found,) = frames_of('kitti_object', folder)
    assert found.refined.boxes.class_names == ('DontCare',)


@pytest.mark.parametrize('name', ['nuscenes', 'argoverse2', 'kitti', 'kitti_object', 'waymo'])
def test_classes_that_an_evaluation_does_not_count_are_said(tmp_path, name):
    frame = frame_of([IN_FIXED] * 3, ['a', 'b', 'c'])
    boxes = replace(frame.refined.boxes, class_names=('car', 'forklift', 'forklift'))
    frames = [replace(frame, refined=replace(frame.refined, boxes=boxes))]
    writer, folder = written(name, tmp_path, frames)
    (note,) = writer.notes
    assert note.startswith("its evaluation has no class 'forklift' and does not count these 2 box")
    assert json.loads((folder / 'boxreg.json').read_text())['uncounted'] == {'forklift': 2}
    class_map = tmp_path / 'classes.yaml'
    official = {'nuscenes': 'vehicle.construction', 'argoverse2': 'LARGE_VEHICLE'}
    class_map.write_text(f'forklift: {official.get(name, "Truck")}\n')
    writer, _ = written(name, tmp_path / 'mapped', frames, class_map=class_map)
    assert writer.notes == []


@pytest.mark.parametrize(
    ('text', 'message'),
    [
        ('car: BUSS', "'car': expected a class of the format 'argoverse2' .*, got 'BUSS'"),
        ('kiti: {car: Van}', "'kiti': expected a format that uses it .*kitti_object"),
        ('[car]', 'expected lines CLASS: NAME'),
        ('car: [', 'not a map of class names'),
        (None, 'No such file'),
    ],
)
def test_a_wrong_class_map_is_refused(tmp_path, text, message):
    path = tmp_path / 'classes.yaml'
    if text is not None:
        path.write_text(text)
    with pytest.raises(ConfigError, match=message):
        check_options(['argoverse2'], Options(class_map=path))


def test_a_class_map_needs_a_format_that_uses_it(tmp_path):
    with pytest.raises(ConfigError, match='--class-map: expected a format that uses it'):
        check_options(['csv'], Options(class_map=tmp_path))


def test_two_boxes_of_one_track_in_a_sample_of_nuscenes_are_two_instances(tmp_path):
    frames = [frame_of([IN_FIXED] * len(ids), ids, STAMP + i) for i, ids in enumerate(['aa', 'a'])]
    _, folder = written('nuscenes', tmp_path, frames)
    tables = folder / 'v1.0-boxreg'
    rows = json.loads((tables / 'sample_annotation.json').read_text())
    samples = {}
    for row in rows:
        samples.setdefault(row['instance_token'], []).append(row['sample_token'])
    assert sorted(len(found) for found in samples.values()) == [1, 2]
    assert all(len(set(found)) == len(found) for found in samples.values())
    counts = {
        row['token']: row['nbr_annotations']
        for row in json.loads((tables / 'instance.json').read_text())
    }
    assert counts == {token: len(found) for token, found in samples.items()}


def test_argoverse2(tmp_path):
    feather = pytest.importorskip('pyarrow.feather')
    _, folder = written('argoverse2', tmp_path)
    (row,) = feather.read_table(folder / 'annotations.feather').to_pylist()
    x, y, z, w = XYZW_SENSOR
    assert (row['timestamp_ns'], row['track_uuid']) == (STAMP, '7')
    assert (row['category'], row['class_name']) == ('REGULAR_VEHICLE', 'Car')
    assert [row[f'{side}_m'] for side in ('length', 'width', 'height')] == EXTENT
    quaternion = [row[name] for name in ('qw', 'qx', 'qy', 'qz')]
    np.testing.assert_allclose(quaternion, [w, x, y, z], atol=1e-9)
    np.testing.assert_allclose([row[f't{axis}_m'] for axis in 'xyz'], [6, -3, 1], atol=1e-9)
    assert (row['num_interior_pts'], row['status']) == (42, 'refined')
    (pose,) = feather.read_table(folder / 'city_SE3_egovehicle.feather').to_pylist()
    found = [pose[name] for name in ('qw', 'qx', 'qy', 'qz', 'tx_m', 'ty_m', 'tz_m')]
    np.testing.assert_allclose(found, [sqrt(0.5), 0, 0, sqrt(0.5), 10, 2, 1], atol=1e-9)


def test_waymo(tmp_path):
    parquet = pytest.importorskip('pyarrow.parquet')
    box = [13.0, 8.0, 2.0, *EXTENT, 0.1, 0.2, radians(130)]  # the yaw of the sensor is 90 degrees
    _, folder = written('waymo', tmp_path, [frame_of([box])])
    (row,) = parquet.read_table(folder / 'lidar_box' / 'drive.parquet').to_pylist()
    box = {k.removeprefix('[LiDARBoxComponent].'): v for k, v in row.items()}
    assert (box['key.segment_context_name'], box['key.laser_object_id']) == ('drive', '7')
    assert box['key.frame_timestamp_micros'] == 1_700_000_000_123_457
    np.testing.assert_allclose([box[f'box.center.{a}'] for a in 'xyz'], [6, -3, 1], atol=1e-9)
    assert [box[f'box.size.{axis}'] for axis in 'xyz'] == EXTENT
    assert box['box.heading'] == pytest.approx(radians(40), abs=1e-9)
    assert (box['type'], box['num_lidar_points_in_box'], box['speed.x']) == (1, 42, None)
    (row,) = parquet.read_table(folder / 'vehicle_pose' / 'drive.parquet').to_pylist()
    pose = row['[VehiclePoseComponent].world_from_vehicle.transform']
    np.testing.assert_allclose(np.reshape(pose, (4, 4)), T_FIXED_SENSOR)


def test_parquet(tmp_path):
    parquet = pytest.importorskip('pyarrow.parquet')
    _, folder = written('parquet', tmp_path)
    table = parquet.read_table(folder / 'boxes.parquet')
    (row,) = table.to_pylist()
    assert (row['stamp_ns'], row['frame_id'], row['track_id']) == (STAMP, 'odom', '7')
    assert [row[name] for name in ('x', 'y', 'z')] == [13.0, 8.0, 2.0]
    assert [row[name] for name in ('length', 'width', 'height')] == EXTENT
    np.testing.assert_allclose([row[f'q{axis}'] for axis in 'xyzw'], XYZW_FIXED, atol=1e-9)
    np.testing.assert_allclose(np.reshape(row['covariance'], (6, 6)), COVARIANCE)
    origin = json.loads(table.schema.metadata[b'boxreg'])
    assert (origin['tool'], origin['config_hash']) == ('boxreg_ros', 'cafe')


@pytest.mark.parametrize('unit', ['int64', 'uint64', 'timestamp[ns]', 'timestamp[ns, tz=UTC]'])
def test_parquet_of_other_writers(tmp_path, unit):
    """Columns as pandas writes them from boxes.csv: ids are numbers, missing values are null."""
    pyarrow = pytest.importorskip('pyarrow')
    parquet = pytest.importorskip('pyarrow.parquet')
    numbers = {name: [1.0, 2.0] for name in COLUMNS}
    zone = 'UTC' if 'tz' in unit else None
    kind = pyarrow.timestamp('ns', zone) if 'stamp' in unit else pyarrow.type_for_alias(unit)
    table = numbers | {
        'stamp_ns': pyarrow.array([STAMP, STAMP], kind), 'frame_id': ['odom'] * 2,
        'track_id': [7, 8], 'class_name': [None, None], 'status': ['truth', None],
        'num_points': [None, 3.0], 'score': [None, 0.5],
    }  # fmt: skip
    path = tmp_path / 'boxes.parquet'
    parquet.write_table(pyarrow.table(table), path)
    (frame,) = frames_of('parquet', tmp_path)
    found, boxes = frame.refined, frame.refined.boxes
    assert boxes.stamp_ns == STAMP
    assert (boxes.track_ids, boxes.class_names) == (('7', '8'), ('', ''))
    assert (found.status, found.num_points.tolist()) == (('truth', 'input'), [0, 3])
    np.testing.assert_array_equal(boxes.scores, [np.nan, 0.5])
    for name in ('openlabel', 'tracklets', 'waymo', 'argoverse2', 'datumaro', 'kitti'):
        written(name, tmp_path, [replace(frame, sensor_frame='odom', T_fixed_sensor=np.eye(4))])


@pytest.mark.parametrize(
    ('name', 'values', 'message'),
    [
        ('stamp_ns', [1.7e18], 'column stamp_ns: expected whole nanoseconds .* got double'),
        ('stamp_ns', ['1700'], 'column stamp_ns: .* got string'),
        ('stamp_ns', [None], 'got int64, 1 of 1 empty'),
        ('num_points', [1.5], 'column num_points: expected int64, got double'),
        ('x', ['far'], 'column x: expected double, got string'),
    ],
)
def test_parquet_with_columns_of_wrong_type_is_refused(tmp_path, name, values, message):
    pyarrow = pytest.importorskip('pyarrow')
    parquet = pytest.importorskip('pyarrow.parquet')
    if values == [None]:
        values = pyarrow.array(values, 'int64')
    table = {key: [1] for key in COLUMNS} | {name: values}
    parquet.write_table(pyarrow.table(table), tmp_path / 'boxes.parquet')
    with pytest.raises(RecordingError, match=message):
        list(frames_of('parquet', tmp_path))


def test_openlabel_contains_the_pose_of_the_sensor(tmp_path):
    checker = pytest.importorskip('openlabel_checker', reason='openlabel-checker not installed')
    _, folder = written('openlabel', tmp_path)
    report = checker.check_file(str(folder / 'labels.json'))
    assert [issue for outcome in report.outcomes for issue in outcome.issues] == []
    label = json.loads((folder / 'labels.json').read_text())['openlabel']
    transform = label['frames']['0']['frame_properties']['transforms']['lidar_to_odom']
    assert (transform['src'], transform['dst']) == ('lidar', 'odom')
    # The standard defines X_dst = matrix4x4 X_src.
    matrix = np.reshape(transform['transform_src_to_dst']['matrix4x4'], (4, 4))
    np.testing.assert_allclose(matrix @ [6, -3, 1, 1], [13, 8, 2, 1], atol=1e-9)
    systems = label['coordinate_systems']
    assert systems['lidar'] == {'type': 'sensor_cs', 'parent': 'odom', 'children': []}
    assert systems['odom'] == {'type': 'scene_cs', 'parent': '', 'children': ['lidar']}
    assert label['metadata']['config_hash'] == 'cafe'


def test_openlabel_of_other_writers(tmp_path):
    """Nine values per cuboid, stamps as text, objects by uid, cuboids that are null."""
    values = [*IN_SENSOR[:3], radians(60), radians(30), 0.0, *EXTENT]
    cuboids = [
        {'name': 'shape', 'val': values, 'coordinate_system': 'top'},
        {'name': 'gone', 'val': None},
    ]
    frame = {
        'frame_properties': {'timestamp': '12.5'},
        'objects': {'3': {'object_data': {'cuboid': cuboids}}},
    }
    objects = {'3': {'name': 'car number three', 'type': 'Car'}}
    label = {'metadata': {'schema_version': '1.0.0'}, 'objects': objects, 'frames': {'4': frame}}
    path = tmp_path / 'labels.json'
    path.write_text(json.dumps({'openlabel': label}))
    (found,) = frames_of('openlabel', path)
    boxes = found.refined.boxes
    assert (boxes.stamp_ns, boxes.frame_id) == (12_500_000_000, 'top')
    assert (boxes.track_ids, boxes.class_names) == (('3',), ('Car',))
    np.testing.assert_allclose(boxes.boxes, [IN_SENSOR])
    assert (found.refined.status, found.refined.reasons) == (('input',), ('',))
    assert np.isnan(boxes.scores).all()


# Round trips -------------------------------------------------------------------------------------


def drive():
    """Return frames of two tracks, with a numeric and a text id, over a moving sensor."""
    rng = np.random.default_rng(3)
    frames = []
    for i in range(4):
        T = T_FIXED_SENSOR.copy()
        T[0, 3] += i
        boxes = np.c_[rng.uniform(5, 20, (2, 3)), [EXTENT] * 2, rng.uniform(-0.4, 0.4, (2, 3))]
        boxes[:, 8] = rng.uniform(-3, 3, 2)
        tracks = ('7', 'left one')[: 1 if i == 2 else 2]
        stamp_ns = STAMP + i * 10**8
        frames.append(frame_of(boxes[: len(tracks)], tracks, stamp_ns, T_fixed_sensor=T))
    return frames


@pytest.mark.parametrize('name', READABLE_FORMATS)
def test_round_trip(tmp_path, name):
    frames = drive()
    _, folder = written(name, tmp_path, frames)
    found = [sorted_by_track(frame) for frame in frames_of(name, folder)]
    assert len(found) == len(frames)
    for before, after in zip(frames, found, strict=True):
        a, b = before.refined.boxes, after.refined.boxes
        assert (b.stamp_ns, b.frame_id, b.track_ids) == (a.stamp_ns, 'odom', a.track_ids)
        assert b.class_names == a.class_names
        kept = [0, 1, 2, 3, 4, 5] if name in UPRIGHT_FORMATS else list(range(9))
        atol = 3e-6 if name in DECIMAL_FORMATS else 1e-9
        np.testing.assert_allclose(b.boxes[:, kept], a.boxes[:, kept], atol=atol)
        if name in UPRIGHT_FORMATS:  # the heading remains, up to its projection to the plane
            cosines = np.cos(b.boxes[:, 8] - a.boxes[:, 8])
            assert (cosines > cos(0.1)).all()
        if name != 'tracklets':
            np.testing.assert_allclose(b.scores, a.scores)
        if name not in ('kitti', 'tracklets'):
            assert after.refined.status == before.refined.status
            assert (after.refined.num_points == before.refined.num_points).all()
        if name not in ('csv', 'kitti', 'tracklets'):
            np.testing.assert_allclose(after.refined.covariances, before.refined.covariances)
        if name != 'csv':
            np.testing.assert_allclose(after.T_fixed_sensor, before.T_fixed_sensor, atol=1e-9)
            assert after.sensor_frame == 'lidar'


@pytest.mark.parametrize('name', READABLE_FORMATS)
def test_boxes_of_a_person_stay_and_empty_frames_are_frames(tmp_path, name):
    """A pinned box keeps size and status; a frame without boxes was looked at."""
    larger = [*IN_FIXED[:3], *np.array(EXTENT) + 0.5, *IN_FIXED[6:]]
    words = ['refined', 'human', 'interpolated', 'refined']
    frames = [
        frame_of([larger if word == 'human' else IN_FIXED], stamp_ns=STAMP + i * 10**8)
        for i, word in enumerate(words)
    ]
    frames = [
        replace(frame, refined=replace(frame.refined, status=(word,)))
        for frame, word in zip(frames, words, strict=True)
    ]
    for i in (4, 5):
        frames.insert(i - 2, frame_of([], (), STAMP + i * 10**8))
    frames.sort(key=lambda frame: frame.refined.boxes.stamp_ns)
    _, folder = written(name, tmp_path, frames)
    found = list(frames_of(name, folder))
    without_rows = name in ('csv', 'parquet')
    assert len(found) == (4 if without_rows else 6)
    status = [word for frame in found for word in frame.refined.status]
    assert [word for word in status if word != 'input'] in (words, words[1:3])
    np.testing.assert_allclose(
        found[1].refined.boxes.boxes[0, 3:6], larger[3:6], atol=1e-5, err_msg=str(status)
    )


def test_tracklets_say_which_sizes_of_a_person_they_change(tmp_path):
    frames = []
    for i, more in enumerate((0, 0.2, 0.2, 9)):
        box = [*IN_FIXED[:3], *np.array(EXTENT) + more, *IN_FIXED[6:]]
        frame = frame_of([box], stamp_ns=STAMP + i * 10**8)
        status = ('human' if i < 3 else 'refined',)
        frames.append(replace(frame, refined=replace(frame.refined, status=status)))
    writer, _ = written('tracklets', tmp_path, frames)
    (note,) = writer.notes
    assert note.startswith(
        '1 boxes of the status human have other extents than they had, by up to 0.20 m'
    )


@pytest.mark.parametrize('name', READABLE_FORMATS)
def test_track_that_changes_its_class(tmp_path, name):
    classes = ['Car', 'Car', 'Van', 'Car']
    frames = [frame_of(stamp_ns=STAMP + i * 10**8, class_name=c) for i, c in enumerate(classes)]
    _, folder = written(name, tmp_path, frames)
    found = [frame.refined.boxes for frame in frames_of(name, folder)]
    assert [(b.track_ids, b.class_names) for b in found] == [(('7',), (c,)) for c in classes]


@pytest.mark.parametrize('name', READABLE_FORMATS)
def test_track_ids_with_special_characters_round_trip(tmp_path, name):
    names = ('a--b', 'a---', '-', '<i> & co', '&amp;', '&#45;', 'a - -b', 'a\x01\x1bb')
    frames = [frame_of([IN_FIXED] * len(names), names)]
    _, folder = written(name, tmp_path, frames)
    (frame,) = frames_of(name, folder)
    assert sorted(frame.refined.boxes.track_ids) == sorted(names)


@pytest.mark.parametrize('name', [name for name in READABLE_FORMATS if name != 'csv'])
def test_dropped_boxes_are_counted(tmp_path, name):
    zero_width = [*IN_FIXED[:3], 4.0, 0.0, 1.6, 0, 0, 0]
    not_finite = [np.nan, *IN_FIXED[1:]]
    frames = [
        frame_of([IN_FIXED, zero_width, not_finite], ['a', 'b', 'c']),
        frame_of(frame_id='radar', stamp_ns=STAMP + 1, T_fixed_sensor=None),
    ]
    writer, folder = written(name, tmp_path, frames)
    if name == 'parquet':
        assert not +writer.dropped
    elif name == 'openlabel':
        assert +writer.dropped == {'invalid_box': 2}
    else:
        assert +writer.dropped == {'invalid_box': 2, 'no_transform': 1}
        names = [f.refined.boxes.track_ids for f in frames_of(name, folder)]
        assert [n for part in names for n in part] == ['a']


@pytest.mark.parametrize('name', READABLE_FORMATS)
def test_boxes_without_track_id_are_not_merged(tmp_path, name):
    frames = [frame_of([IN_FIXED] * 3, ['', 'a', ''], STAMP + i) for i in range(2)]
    _, folder = written(name, tmp_path, frames)
    assert [len(f.refined.status) for f in frames_of(name, folder)] == [3, 3]


def test_openlabel_keeps_frames_without_an_object(tmp_path):
    frames = [frame_of([IN_FIXED] * n, list('ab')[:n], STAMP + i) for i, n in enumerate((2, 0, 1))]
    _, folder = written('openlabel', tmp_path, frames)
    found = [
        (f.refined.boxes.stamp_ns, f.refined.boxes.track_ids)
        for f in frames_of('openlabel', folder)
    ]
    assert found == [(STAMP, ('a', 'b')), (STAMP + 1, ()), (STAMP + 2, ('a',))]


@pytest.mark.parametrize('name', READABLE_FORMATS)
def test_empty_drive_round_trips(tmp_path, name):
    _, folder = written(name, tmp_path, [])
    assert list(frames_of(name, folder)) == []


@pytest.mark.parametrize('name', READABLE_FORMATS)
def test_broken_files_raise_an_error_with_the_path(tmp_path, name):
    _, folder = written(name, tmp_path)
    for path in folder.rglob('*'):
        if path.suffix in ('.txt', '.csv', '.json', '.xml', '.feather', '.parquet'):
            path.write_bytes(b'<[broken\n\0')
    with pytest.raises((RecordingError, ConfigError), match=str(tmp_path)):
        list(frames_of(name, folder))


@pytest.mark.parametrize('name', READABLE_FORMATS)
def test_missing_files_raise_an_error_with_the_path(tmp_path, monkeypatch, name):
    require_packages(name)
    monkeypatch.chdir(tmp_path)
    for path in (tmp_path / 'nowhere', Path('nowhere')):
        with pytest.raises((RecordingError, ConfigError), match='nowhere'):
            list(frames_of(name, path))


@pytest.mark.parametrize(
    ('name', 'inside'),
    [('kitti', 'label_02'), ('waymo', 'lidar_box'), ('nuscenes', 'v1.0-boxreg'), ('t4', '.')],
)
def test_labels_by_a_path_relative_to_the_working_folder(tmp_path, monkeypatch, name, inside):
    _, folder = written(name, tmp_path)
    monkeypatch.chdir(folder / inside)
    path = next(Path().glob('*.[tp][xa][tr]*'), Path())  # a label file, or the folder of tables
    (frame,) = frames_of(name, path)
    assert (frame.fixed_frame, frame.sensor_frame) == ('odom', 'lidar')
    np.testing.assert_allclose(frame.T_fixed_sensor, T_FIXED_SENSOR, atol=1e-9)


@pytest.mark.parametrize('name', READABLE_FORMATS)
def test_hidden_files_beside_the_labels_are_no_labels(tmp_path, name):
    """Archives that macOS has packed have a file ``._NAME`` beside each file."""
    _, folder = written(name, tmp_path)
    expected = [sorted_by_track(frame) for frame in frames_of(name, folder)]
    for path in [path for path in folder.rglob('*') if path.name != folder.name]:
        (path.parent / f'._{path.name}').write_bytes(bytes((0, 5, 22, 7)))
    found = [sorted_by_track(frame) for frame in frames_of(name, folder)]
    assert len(found) == len(expected) == 1
    np.testing.assert_array_equal(found[0].refined.boxes.boxes, expected[0].refined.boxes.boxes)


@pytest.mark.parametrize(
    'name',
    ['kitti_object', 'openpcdet', 'sustechpoints', 'datumaro', 'sly_pointcloud', 'xtreme1'],
)
@pytest.mark.parametrize('is_ascending', [True, False])
def test_frames_that_are_counted_without_zeros_have_the_stamps_of_their_numbers(
    tmp_path, name, is_ascending
):
    """In alphabetical order 10 comes before 2; a program that lists files has it so."""
    stamps_ns = [STAMP + i * 100_000_000 for i in range(12)]
    boxes = [[*IN_SENSOR[:2], 0.1 * i, *IN_SENSOR[3:6], 0.0, 0.0, 0.0] for i in range(12)]
    frames = [
        frame_of([box], stamp_ns=stamp_ns, frame_id='lidar')
        for box, stamp_ns in zip(boxes, stamps_ns, strict=True)
    ]
    _, folder = written(name, tmp_path, frames)
    for i, stamp_ns in enumerate(stamps_ns):
        for path in sorted(folder.rglob(f'{stamp_ns}.*')):
            path.rename(path.with_name(path.name.replace(str(stamp_ns), str(i))))
        for path in folder.rglob('default.json'):
            text = path.read_text().replace(f'"{stamp_ns}"', f'"{i}"')
            path.write_text(text.replace(f'"frame":{i}}}', '"frame":0}'))
    order = range(12) if is_ascending else sorted(range(12), key=str)
    lines = (folder / 'poses.txt').read_text().splitlines(keepends=True)
    (folder / 'poses.txt').write_text(''.join(lines[i] for i in order))
    (folder / 'timestamps.txt').write_text(''.join(f'{stamps_ns[i]}\n' for i in order))
    found = [frame.moved('sensor').refined.boxes for frame in frames_of(name, folder)]
    assert [array.stamp_ns for array in found] == stamps_ns
    heights = [array.boxes[0, 2] for array in found]
    np.testing.assert_allclose(heights, [box[2] for box in boxes], atol=1e-6)


def test_several_sequences_of_kitti_are_refused(tmp_path):
    _, folder = written('kitti', tmp_path)
    for part in ('label_02', 'calib'):
        shutil.copy(folder / part / '0000.txt', folder / part / '0001.txt')
    with pytest.raises(RecordingError, match=r'one sequence, .*, got 0000.txt, 0001.txt; name'):
        list(frames_of('kitti', folder))
    assert len(list(frames_of('kitti', folder / 'label_02' / '0001.txt'))) == 1


@pytest.mark.parametrize('name', READABLE_FORMATS)
def test_folder_names_that_are_not_utf8(tmp_path, name):
    out = tmp_path / 'caf\udce9'
    out.mkdir()
    _, folder = written(name, out, [frame_of(sweep=Sweep(STAMP, 'lidar', POINTS))],
                        with_points=True)  # fmt: skip
    assert len(list(frames_of(name, folder))) == 1


def test_provenance_names_recordings_in_utf8(tmp_path, monkeypatch):
    (tmp_path / 'drive').mkdir()
    monkeypatch.chdir(tmp_path / 'drive')
    link = tmp_path / 'link'
    link.symlink_to('drive')
    paths = (Path(), Path('..', 'drive', '.'), link, Path('caf\udce9.mcap'))
    assert Provenance.of(paths).recordings == ('drive', 'drive', 'link', 'caf\\udce9.mcap')


def test_timestamps_of_kitti_raw(tmp_path):
    from boxreg_ros.labels.sidecar import whole_stamps

    path = tmp_path / 'timestamps.txt'
    # 2011-09-26 13:02:25 UTC is 15243 days and 46945 s after the epoch.
    path.write_text('2011-09-26 13:02:25.951199337\n1316955745951199337\n\n')
    seconds = 15243 * 86400 + 46945
    assert whole_stamps(path) == [seconds * 10**9 + 951199337, 1316955745951199337]


def test_errors_of_a_missing_package_name_the_remedy(monkeypatch):
    monkeypatch.setitem(sys.modules, 'pyarrow', None)
    with pytest.raises(ConfigError, match='pip install pyarrow'):
        module_of('parquet')


def test_camera_from_yaml(tmp_path):
    path = tmp_path / 'camera.yaml'
    path.write_text(
        'image_width: 640\nimage_height: 480\n'
        'projection_matrix: {data: [200, 0, 320, 0, 0, 200, 240, 0, 0, 0, 1, 0]}\n'
        'T_camera_sensor: [0, -1, 0, 0.1, 0, 0, -1, -0.2, 1, 0, 0, -0.5]\n'
    )
    camera = Camera.read(path)
    assert camera.size == (640, 480)
    assert camera.projection[1, 2] == 240
    np.testing.assert_allclose(camera.T_rect_sensor @ [6, -3, 1, 1], [3.1, -1.2, 5.5, 1])
    path.write_text('projection_matrix: [1, 2]\n')
    with pytest.raises(ConfigError, match='expected 12 or 16 numbers under one of Tr_velo_cam'):
        Camera.read(path)


# Third-party readers -----------------------------------------------------------------------------


def test_nuscenes_devkit_reads_the_labels(tmp_path):
    sweep = Sweep(STAMP, 'lidar', POINTS)
    later = [14.0, *IN_FIXED[1:]]  # 1 m in 0.5 s
    frames = [frame_of(sweep=sweep), frame_of([later], stamp_ns=STAMP + 5 * 10**8)]
    for name, version, channel, class_name in (
        ('nuscenes', 'v1.0-boxreg', 'LIDAR_TOP', 'vehicle.car'),
        ('t4', 'annotation', 'LIDAR_CONCAT', 'Car'),
    ):
        _, folder = written(name, tmp_path / name, frames, with_points=True)
        first, second = consumer('nuscenes', folder, version)
        assert first['channel'] == channel
        assert (first['name'], first['num_points']) == (class_name, 42)
        np.testing.assert_allclose(first['wlh'], [2.0, 4.0, 1.6])
        np.testing.assert_allclose(first['local'], [6, -3, 1], atol=1e-9)
        in_fixed = (T_FIXED_SENSOR @ np.c_[CORNERS, np.ones(8)].T).T[:, :3]
        found = np.array(first['corners'])
        assert np.abs(found[:, None] - in_fixed).max(axis=2).min(axis=1).max() < 1e-9
        heading = T_FIXED_SENSOR[:3, :3] @ AXES[0]
        np.testing.assert_allclose(np.array(first['matrix'])[:, 0], heading, atol=1e-9)
        np.testing.assert_allclose(first['points'], POINTS)
        assert first['track'] == second['track']
        assert (bool(first['next']), first['prev'], second['next']) == (True, '', '')
        np.testing.assert_allclose(first['velocity'], [2.0, 0.0, 0.0], atol=1e-9)


def test_t4_marks_what_no_person_has_made(tmp_path):
    """Files of others have no values of ours beside the tables."""
    _, folder = written('t4', tmp_path, [frame_of([IN_FIXED] * 2, ['a', 'b'])])
    (folder / 'boxreg_values.json').unlink()
    path = folder / 'annotation' / 'sample_annotation.json'
    rows = json.loads(path.read_text())
    rows[0]['automatic_annotation'] = False
    path.write_text(json.dumps(rows))
    (found,) = frames_of('t4', folder)
    assert sorted(found.refined.status) == ['automatic', 'input']
    assert found.keyframes().left_out == {'not_a_keyframe': 1}


def test_t4_devkit_reads_the_labels(tmp_path):
    _, folder = written('t4', tmp_path)
    found = consumer('t4', folder / 'annotation')
    (row,) = found['sample_annotation']
    assert 'automatic_annotation' not in row  # of a later version; it is left out
    np.testing.assert_allclose(row['size'], [2.0, 4.0, 1.6])
    np.testing.assert_allclose(row['translation'], [13.0, 8.0, 2.0])
    x, y, z, w = XYZW_FIXED
    np.testing.assert_allclose(row['rotation'], [w, x, y, z], atol=1e-9)
    assert found['instance'][0]['instance_name'] == '7'
    assert found['visibility'][0]['level'] == 'unavailable'
    assert found['sample_data'][0]['fileformat'] == 'pcd.bin'


def test_the_evaluations_of_the_devkits_count_our_classes(tmp_path):
    """The exported boxes as detections of themselves: the average precision is that of truth."""
    frames = [
        frame_of([[*IN_FIXED[:3], 4.0, 2.0, 1.6, 0, 0, 0.3 * i]], stamp_ns=STAMP + i * 10**8)
        for i in range(4)
    ]
    _, folder = written('argoverse2', tmp_path, frames)
    assert consumer('av2_precision', folder)['REGULAR_VEHICLE'] == pytest.approx(1.0)
    _, folder = written('nuscenes', tmp_path, frames)
    assert consumer('nuscenes_precision', folder, 'v1.0-boxreg') == {'car': pytest.approx(1.0)}


def test_av2_reads_labels_pose_and_sweep(tmp_path):
    frames = [frame_of(sweep=Sweep(STAMP, 'lidar', POINTS))]
    _, folder = written('argoverse2', tmp_path, frames, with_points=True)
    (cuboid,) = consumer('av2', folder / 'annotations.feather')
    log = consumer('av2_log', folder, STAMP)
    assert (cuboid['category'], cuboid['stamp_ns']) == ('REGULAR_VEHICLE', STAMP)
    np.testing.assert_allclose(cuboid['center'], [6, -3, 1], atol=1e-9)
    np.testing.assert_allclose(cuboid['lwh'], EXTENT)
    np.testing.assert_allclose(np.array(cuboid['matrix']).T, AXES, atol=1e-9)
    # Its first vertex is at the front left top.
    np.testing.assert_allclose(cuboid['vertices'][0], CORNERS[7], atol=1e-9)
    np.testing.assert_allclose(log['points'], POINTS)
    np.testing.assert_allclose(log['city_SE3_ego'], T_FIXED_SENSOR, atol=1e-9)
    np.testing.assert_allclose(log['ego_SE3_lidar'], np.eye(4), atol=1e-9)


@pytest.mark.parametrize(
    ('intensities', 'expected'),
    [([0.0, 0.5, 1.0], [0, 127, 255]), ([0.0, 100.0, 300.0], [0, 100, 255])],
)
def test_av2_intensities_are_scaled_to_bytes(tmp_path, intensities, expected):
    feather = pytest.importorskip('pyarrow.feather')
    points = np.arange(9, dtype=np.float32).reshape(3, 3)
    sweep = Sweep(STAMP, 'lidar', points)
    frames = [frame_of(sweep=sweep, intensities=np.array(intensities))]
    _, folder = written('argoverse2', tmp_path, frames, with_points=True)
    (file,) = folder.glob('sensors/lidar/*.feather')
    assert feather.read_table(file)['intensity'].to_pylist() == expected


def test_waymo_components_read_the_labels(tmp_path):
    _, folder = written('waymo', tmp_path)
    box, pose = consumer('waymo', folder / 'lidar_box' / 'drive.parquet',
                         folder / 'vehicle_pose' / 'drive.parquet')  # fmt: skip
    assert box['types_agree']
    assert (box['id'], box['type'], box['points']) == ('7', 'TYPE_VEHICLE', 42)
    np.testing.assert_allclose(box['box'], [6, -3, 1, *EXTENT, 0.0], atol=1e-9)
    np.testing.assert_allclose(np.reshape(pose, (4, 4)), T_FIXED_SENSOR)


def test_pykitti_reads_calibration_and_sweep(tmp_path):
    frames = [frame_of(sweep=Sweep(STAMP, 'lidar', POINTS))]
    _, folder = written('kitti', tmp_path, frames, with_points=True)
    found = consumer('pykitti', folder)
    np.testing.assert_allclose(np.reshape(found['P2'], (3, 4))[0], [200, 0, 600, 0])
    np.testing.assert_allclose(np.reshape(found['Tr_velo_cam'], (3, 4))[:, 3], [0.1, -0.2, -0.5])
    np.testing.assert_allclose(np.array(found['points'])[:, :3], POINTS)


def test_pandas_reads_the_tables(tmp_path):
    folders = {name: written(name, tmp_path / name, drive())[1] for name in ('parquet', 'csv')}
    expected = [frame.refined.boxes.boxes[0, 0] for frame in drive()]
    for name, folder in folders.items():
        found = consumer('pandas', folder / f'boxes.{name}')
        assert found['x of 7'] == pytest.approx(expected)
        assert found['stamps'] == [frame.refined.boxes.stamp_ns for frame in drive()]
        assert found['kinds'] == {'stamp_ns': 'int64', 'x': 'float64', 'num_points': 'int64'}


# Memory ------------------------------------------------------------------------------------------


@pytest.mark.parametrize('name', [name for name in READABLE_FORMATS if name != 'tracklets'])
def test_memory_of_writers_does_not_grow_with_frames(tmp_path, name, monkeypatch):
    """Tracklets are excluded: they are held until their track ends."""
    require_packages(name)
    monkeypatch.setattr(arrow, 'BATCH_ROWS', 20)
    writer = writer_for(name, tmp_path, Provenance(), options_in(tmp_path))
    boxes, tracks = [IN_FIXED] * 20, [f'track {k}' for k in range(20)]
    memory = []
    writer.write(frame_of(boxes, tracks, STAMP - 10**8))  # imports what it needs
    gc.freeze()  # what is there already need not be searched
    tracemalloc.start()
    for i in range(60):
        writer.write(frame_of(boxes, tracks, STAMP + i * 10**8))
        if i in (29, 59):
            gc.collect()
            memory.append(tracemalloc.get_traced_memory()[0])
    tracemalloc.stop()
    gc.unfreeze()
    writer.close()
    assert memory[1] - memory[0] < 30 * 20 * 72 / 2  # bytes; nine float64 per box are 72


# Conversion of any format to any other -----------------------------------------------------------


@pytest.mark.parametrize(
    'source', [name for name in READABLE_FORMATS if name not in {'csv', *UPRIGHT_FORMATS}]
)
@pytest.mark.parametrize(
    'target', [name for name in READABLE_FORMATS if name not in UPRIGHT_FORMATS]
)
def test_conversion_between_formats(tmp_path, source, target):
    frames = drive()
    (tmp_path / 'a').mkdir()
    (tmp_path / 'b').mkdir()
    _, first = written(source, tmp_path / 'a', frames)
    converted = [frame.moved('fixed') for frame in frames_of(source, first)]
    _, second = written(target, tmp_path / 'b', converted)
    for before, after in zip(frames, frames_of(target, second), strict=True):
        after = sorted_by_track(after).refined.boxes
        np.testing.assert_allclose(after.boxes, before.refined.boxes.boxes, atol=1e-8)
        assert after.track_ids == before.refined.boxes.track_ids


def test_all_readable_formats_are_tested():
    both = {name for name in FORMATS if can_read(name) and hasattr(module_of(name), 'Writer')}
    assert set(READABLE_FORMATS) == both  # `ros2 bag record` writes recordings
    assert np.allclose(inverse(T_FIXED_SENSOR) @ [13, 8, 2, 1], [6, -3, 1, 1])
