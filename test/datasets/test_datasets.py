"""Public data sets as recordings: clouds, poses and boxes by hand-derived values."""

import csv
import itertools
import json
from pathlib import Path
import re
import shutil
from typing import NamedTuple

from boxreg_ros.cli import main
from boxreg_ros.datasets.registry import address_of, scene_names
from boxreg_ros.datasets.scene_recording import SceneRecording
from boxreg_ros.errors import RecordingError, UnsupportedMessage
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.io.items import EVERYTHING, ItemSource, Wanted
from boxreg_ros.io.transform_tree import TransformTree
from boxreg_ros.io.transforms import boxes_to_frame, sweep_to_frame
from boxreg_ros.labels import frames_of
from boxreg_ros.offline.job import jobs_of
from boxreg_ros.structures import Sweep
import layouts
from layouts import FRAMES
import numpy as np
import pytest
from relabel_results import rows_of

QUICK = ['--set=solver.rounds=2', '--set=sampling.points=64']


class Case(NamedTuple):
    """A data set: how its folder is written, and what is expected of its drive."""

    write: object
    scene: str
    track: str
    class_name: str
    origin: object
    points: object = layouts.face_in_map
    box: object = layouts.car_in_map
    stamps_ns: object = layouts.stamps_ns
    step: int = 1
    has_times: bool = False


def kitti_points(i):
    return layouts.face_in_ego(i) - [0, 0, 1.7] + layouts.kitti_position(i)


def kitti_box(i):
    box = layouts.car_in_velo(i)
    box[:3] += layouts.kitti_position(i)
    return box


def raw_box(i):
    box = layouts.car_in_velo(i)
    box[:3] += layouts.kitti_position(i - 0.2)
    return box


CASES = {
    'nuscenes': Case(
        layouts.nuscenes, 'scene-0061', 'car', 'vehicle.car', layouts.lidar_position, step=2
    ),
    'kitti-tracking': Case(
        layouts.kitti_tracking,
        '0004',
        '3',
        'Car',
        layouts.kitti_position,
        kitti_points,
        kitti_box,
        lambda: [(1 + i) * 100_000_000 for i in range(FRAMES)],
    ),
    'argoverse2': Case(
        layouts.argoverse2,
        layouts.LOG,
        'car-1',
        'REGULAR_VEHICLE',
        # Both LiDARs are 1.35 m ahead of the ego frame, 1.6 m high in the mean.
        lambda i: layouts.ego_position(i) + np.array([0, 1.35, 1.6]),
        has_times=True,
    ),
    'kitti-raw': Case(
        layouts.kitti_raw,
        layouts.DRIVE,
        '0',
        'Car',
        lambda i: layouts.kitti_position(i - 0.2),
        lambda i: layouts.face_in_ego(i) - [0, 0, 1.7] + layouts.kitti_position(i - 0.2),
        raw_box,
        lambda: [layouts.RAW_START_NS + i * 100_000_000 for i in range(FRAMES)],
    ),
    'pandaset': Case(
        layouts.pandaset,
        '001',
        'car-p',
        'Car',
        # The LiDAR is 0.8 m ahead of the vehicle's frame, whose y axis, ahead, is west here.
        lambda i: layouts.lidar_position(i) + np.array([-0.8, 0, 1.85]),
        stamps_ns=lambda: [round(seconds * 1e9) for seconds in layouts.pandaset_seconds()],
        has_times=True,
    ),
    'waymo': Case(
        layouts.waymo,
        layouts.SEGMENT,
        'car-w',
        'vehicle',
        lambda i: layouts.ego_position(i) + np.array([0, 1.4, 2.0]),
        layouts.waymo_points,
    ),
}


def source_of(name, root, **options):
    return SceneRecording(address_of(Path(f'{name}:{root}')), **options)


def read(source, wanted=EVERYTHING):
    """Return the sweeps and the boxes of a source in its fixed frame."""
    tree = TransformTree()
    sweeps, boxes = [], []
    with source:
        assert isinstance(source, ItemSource)
        fixed_frame = source.choose_fixed_frame(tree)
        for item in source.items(tree, wanted):
            content = item.content
            T_fixed_item = tree.lookup(fixed_frame, content.frame_id, content.stamp_ns)
            move = sweep_to_frame if isinstance(content, Sweep) else boxes_to_frame
            moved = move(content, T_fixed_item, fixed_frame)
            if isinstance(moved, Sweep):
                sweeps.append(moved.in_frame())
            else:
                boxes.append(moved)
        source.check_readable()
    return sweeps, boxes


@pytest.mark.parametrize('name', CASES)
def test_clouds_poses_and_boxes_are_those_of_the_drive(tmp_path, name):
    case = CASES[name]
    case.write(tmp_path)
    sweeps, arrays = read(source_of(name, f'{tmp_path}#{case.scene}'), Wanted(intensities=True))
    stamps = case.stamps_ns()
    assert [sweep.stamp_ns for sweep in sweeps] == stamps
    for i, sweep in enumerate(sweeps):
        np.testing.assert_allclose(sweep.points, case.points(i), atol=3e-5)
        np.testing.assert_allclose(sweep.origin, case.origin(i), atol=1e-6)
    assert all((sweep.times is not None) == case.has_times for sweep in sweeps)
    assert [array.stamp_ns for array in arrays] == stamps[:: case.step]
    for i, array in zip(range(0, FRAMES, case.step), arrays, strict=True):
        np.testing.assert_allclose(array.boxes, [case.box(i)], atol=2e-6)
        assert array.track_ids == (case.track,)
        assert array.class_names == (case.class_name,)


def sensors_of(name, root, *lidars):
    """Return the first sweep of a scene, and the position of the sensor of each point."""
    (sweep, *_), _ = read(source_of(name, f'{root}#{CASES[name].scene}', lidars=lidars))
    np.testing.assert_allclose(sweep.origin, sweep.origins.mean(axis=0))
    return sweep, sweep.origins[sweep.sensors]


def test_points_of_argoverse2_are_of_the_upper_or_the_lower_lidar(tmp_path):
    layouts.argoverse2(tmp_path)
    _, found = sensors_of('argoverse2', tmp_path)
    is_upper = np.arange(len(found)) % 64 < 32
    expected = layouts.ego_position(0) + np.array([0, 1.35, 0])
    np.testing.assert_allclose(found[is_upper], [np.add(expected, [0, 0, 1.7])] * is_upper.sum())
    np.testing.assert_allclose(
        found[~is_upper], [np.add(expected, [0, 0, 1.5])] * (~is_upper).sum()
    )


def test_points_of_waymo_are_of_the_lidars_that_are_asked_for(tmp_path):
    layouts.waymo(tmp_path)
    sweep, found = sensors_of('waymo', tmp_path, 'TOP', 'FRONT')
    ego = layouts.ego_position(0)
    np.testing.assert_allclose(sweep.points[:-1], layouts.waymo_points(0), atol=3e-5)
    np.testing.assert_allclose(sweep.points[-1], np.add(ego, [0, 4.8, 0.8]), atol=3e-5)
    np.testing.assert_allclose(found[:-1], [np.add(ego, [0, 1.4, 2.0])] * (len(found) - 1))
    np.testing.assert_allclose(found[-1], np.add(ego, [0, 3.8, 0.8]), atol=1e-9)
    (alone, *_), _ = read(source_of('waymo', tmp_path, lidars=['FRONT']))
    np.testing.assert_allclose(alone.points, sweep.points[-1:], atol=1e-6)
    assert alone.sensors is None
    with pytest.raises(RecordingError, match=r"TOP, FRONT, .*, REAR, got 'BACK'"):
        source_of('waymo', tmp_path, lidars=['TOP', 'BACK']).__enter__()
    with pytest.raises(RecordingError, match='expected the LiDAR REAR, got others'):
        source_of('waymo', tmp_path, lidars=['REAR']).__enter__()


def test_points_of_pandaset_are_of_either_lidar(tmp_path):
    layouts.pandaset(tmp_path)
    sweep, found = sensors_of('pandaset', tmp_path, 'pandar64', 'pandarGT')
    n = len(layouts.face_in_map(0))
    both = np.concatenate([layouts.face_in_map(0), layouts.face_in_map(0) + 50])
    np.testing.assert_allclose(sweep.points, both, atol=3e-5)
    vehicle = layouts.lidar_position(0)  # x is north, y is west
    np.testing.assert_allclose(found[:n], [np.add(vehicle, [-0.8, 0, 1.85])] * n, atol=1e-9)
    np.testing.assert_allclose(found[n:], [np.add(vehicle, [-1.41, -0.02, 1.55])] * n, atol=1e-9)
    _, arrays = read(source_of('pandaset', tmp_path, lidars=['pandarGT']))
    assert arrays[0].track_ids == ('other',)


def test_several_lidars_of_a_scene_on_the_command_line(tmp_path, capsys):
    layouts.waymo(tmp_path / 'waymo')
    layouts.kitti_tracking(tmp_path / 'kitti')
    out = str(tmp_path / 'out')
    lidars = ['--points=TOP', '--points=FRONT', '--formats=csv', *QUICK]
    assert main(['relabel', f'waymo:{tmp_path / "waymo"}', '-o', out, *lidars]) == 0
    capsys.readouterr()
    assert main(['relabel', f'kitti-tracking:{tmp_path / "kitti"}', '-o', f'{out}2', *lidars]) == 1
    assert "LiDARs velodyne, got 'TOP', 'FRONT'" in capsys.readouterr().err


def test_several_lidars_of_truckscenes_are_merged_by_time(tmp_path, capsys):
    """Each point is where it was measured: the motion of the truck during a sweep is undone."""
    layouts.truckscenes(tmp_path / 'data')
    address = f'truckscenes:{tmp_path / "data"}#scene-a-1'
    sweeps, arrays = read(source_of('truckscenes', f'{tmp_path / "data"}#scene-a-1'))
    assert len(sweeps) == 2 * FRAMES
    for number, sweep in enumerate(sweeps):
        i = number // 2
        delay, position, _ = layouts.TRUCK_LIDARS[sweep.topic]
        frames, half = layouts.truck_points(sweep.topic, i)
        assert sweep.stamp_ns == layouts.stamps_ns()[i] + round(delay * 1e9)
        points = np.array([layouts.face_in_map(f)[k] for k, f in enumerate(frames)])
        np.testing.assert_allclose(sweep.points, points[half], atol=5e-5)
        np.testing.assert_allclose(sweep.times, (frames[half] - i) * 0.1 - delay, atol=1e-6)
        x, y, z = position
        origin = layouts.ego_position(i + delay / 0.1) + np.array([-y, x, z])
        np.testing.assert_allclose(sweep.origin, origin, atol=1e-6)
    np.testing.assert_allclose(arrays[3].boxes, [layouts.car_in_map(6)], atol=2e-6)
    out = tmp_path / 'out'
    assert main(['relabel', address, '-o', str(out), '--formats=csv', *QUICK]) == 0
    lidars = json.loads((out / 'summary.json').read_text())['lidars']
    assert lidars == {channel: {'merged': FRAMES} for channel in layouts.TRUCK_LIDARS}
    left = source_of('truckscenes', f'{tmp_path / "data"}#scene-a-1', lidars=['LIDAR_LEFT'])
    assert len(read(left)[0]) == FRAMES
    with pytest.raises(RecordingError, match='expected one of the LiDARs LIDAR_LEFT, LIDAR_TOP_'):
        source_of('nuscenes', f'{tmp_path / "data"}#scene-a-1').__enter__()


def test_clouds_of_nuscenes_tables_are_read_by_their_suffix(tmp_path):
    """PCD and BIN of more columns, as T4 has them, hold the same points as those of nuScenes."""
    layouts.nuscenes(tmp_path)
    table = tmp_path / 'v1.0-mini' / 'sample_data.json'
    rows = json.loads(table.read_text())
    lidar = [row for row in rows if row['token'].startswith('sweep')]
    layouts.write_json(tmp_path / 'info.json', {'num_pts_feats': 7})
    for number, row in enumerate(lidar):
        points = layouts.face_in_map(number) - layouts.lidar_position(number)
        name = row['filename'].removesuffix('.pcd.bin')
        if number % 3 == 0:
            row['filename'] = f'{name}.pcd'
            x, y, z = points.astype(np.float32).T
            layouts.write_pcd(tmp_path / row['filename'], {'x': x, 'y': y, 'z': z})
        elif number % 3 == 1:
            row |= {'filename': f'{name}.bin', 'info_filename': 'info.json'}
            layouts.write_bin(tmp_path / row['filename'], points, 7)
        else:
            row |= {'filename': name, 'fileformat': 'pcd.bin'}
            layouts.write_bin(tmp_path / name, points, 5)
    layouts.write_json(table, rows)
    source = source_of('nuscenes', f'{tmp_path}#scene-0061')
    sweeps, _ = read(source)
    assert not source.unreadable
    for i, sweep in enumerate(sweeps):
        np.testing.assert_allclose(sweep.points, layouts.face_in_map(i), atol=3e-5)
    assert len(sweeps) == FRAMES


def test_sweeps_that_t4_excludes_are_left_out_and_counted(tmp_path):
    layouts.nuscenes(tmp_path)
    table = tmp_path / 'v1.0-mini' / 'sample_data.json'
    rows = json.loads(table.read_text())
    for number, row in enumerate(row for row in rows if row['token'].startswith('sweep')):
        row['is_valid'] = number not in (2, 5)
    layouts.write_json(table, rows)
    source = source_of('nuscenes', f'{tmp_path}#scene-0061')
    sweeps, _ = read(source)
    kept = [stamp for number, stamp in enumerate(layouts.stamps_ns()) if number not in (2, 5)]
    assert [sweep.stamp_ns for sweep in sweeps] == kept
    assert source.unreadable == {'LIDAR_TOP': 2}
    assert 'is_valid of T4 excludes' in str(source.first_errors['LIDAR_TOP'])


@pytest.mark.parametrize('is_linked', [True, False], ids=['linked', 'only scene'])
def test_sweeps_that_name_no_sample_are_of_the_scene_that_they_are_linked_with(
    tmp_path, is_linked
):
    layouts.nuscenes(tmp_path)
    tables = tmp_path / 'v1.0-mini'
    rows = json.loads((tables / 'sample_data.json').read_text())
    lidar = [row for row in rows if row['token'].startswith('sweep')]
    for before, after in itertools.pairwise(lidar):
        if is_linked:
            before['next'], after['prev'] = after['token'], before['token']
    for row in lidar:
        row['sample_token'] = row['sample_token'] if row['is_key_frame'] else ''
    # A sweep of another scene names no sample either, and is linked with none of this one.
    stray = lidar[1] | {'token': 'stray', 'timestamp': 1, 'prev': '', 'next': ''}
    layouts.write_json(tables / 'sample_data.json', [*rows, stray] if is_linked else rows)
    if not is_linked:
        scenes = json.loads((tables / 'scene.json').read_text())
        layouts.write_json(tables / 'scene.json', scenes[:1])
    sweeps, _ = read(source_of('nuscenes', f'{tmp_path}#scene-0061'))
    assert [sweep.stamp_ns for sweep in sweeps] == layouts.stamps_ns()


LATE_FRAMES = {4, 5, FRAMES - 1}
"""Frames of KITTI raw without a sweep."""


def test_a_blank_stamp_of_kitti_raw_keeps_its_number(tmp_path):
    layouts.kitti_raw(tmp_path)
    folder = next(tmp_path.glob('*/*_sync/velodyne_points'))
    lines = (folder / 'timestamps.txt').read_text().splitlines()
    for number in LATE_FRAMES:
        lines[number] = ''
        (folder / 'data' / f'{number:010d}.bin').unlink()
    (folder / 'timestamps.txt').write_text('\n'.join(lines) + '\n')
    source = source_of('kitti-raw', tmp_path)
    sweeps, arrays = read(source)
    stamps_ns = [layouts.RAW_START_NS + i * layouts.STEP_NS for i in range(FRAMES)]
    assert [sweep.stamp_ns for sweep in sweeps] == [
        stamp_ns for i, stamp_ns in enumerate(stamps_ns) if i not in LATE_FRAMES
    ]
    assert not source.unreadable
    assert [array.stamp_ns for array in arrays] == stamps_ns  # between and behind the others
    for i, array in enumerate(arrays[:-1]):
        np.testing.assert_allclose(array.boxes, [raw_box(i)], atol=2e-6)


def test_a_sweep_of_kitti_raw_without_a_stamp_is_counted(tmp_path):
    layouts.kitti_raw(tmp_path)
    path = next(tmp_path.glob('*/*_sync/velodyne_points/timestamps.txt'))
    lines = path.read_text().splitlines()
    lines[0] = ''
    path.write_text('\n'.join(lines))
    source = source_of('kitti-raw', tmp_path)
    sweeps, arrays = read(source)
    assert len(sweeps) == FRAMES - 1 and len(arrays) == FRAMES
    assert source.unreadable.total() == 1
    (error,) = source.first_errors.values()
    assert 'expected a stamp in line 1 of timestamps.txt, got a blank line' in str(error)


def by_laser_then_reversed(table):
    keys = zip(table['key.laser_name'].to_pylist(), range(len(table)), strict=True)
    return [row for _, row in sorted(keys, key=lambda key: (key[0], -key[1]))]


@pytest.mark.parametrize('part', ['lidar', 'lidar_pose', 'vehicle_pose', 'lidar_box'])
def test_rows_of_waymo_may_be_in_any_order_and_in_several_groups(tmp_path, part):
    from pyarrow import parquet

    layouts.waymo(tmp_path)
    (path,) = (tmp_path / 'training' / part).iterdir()
    table = parquet.read_table(path)
    shuffled = np.random.default_rng(1).permutation(len(table))
    order = by_laser_then_reversed(table) if part == 'lidar' else shuffled
    parquet.write_table(table.take(order), path, row_group_size=5)
    source = source_of('waymo', tmp_path, lidars=['TOP', 'FRONT'])
    sweeps, arrays = read(source)
    assert not source.unreadable
    assert [sweep.stamp_ns for sweep in sweeps] == layouts.stamps_ns()
    for i, sweep in enumerate(sweeps):
        np.testing.assert_allclose(sweep.points[:-1], layouts.waymo_points(i), atol=3e-5)
        np.testing.assert_allclose(arrays[i].boxes, [layouts.car_in_map(i)], atol=2e-6)


def test_times_of_points_are_seconds_after_the_stamp(tmp_path):
    layouts.argoverse2(tmp_path)
    sweeps, _ = read(source_of('argoverse2', tmp_path))
    assert sweeps[0].times[[0, -1]].tolist() == pytest.approx([0.0, 0.099])


@pytest.mark.parametrize('name', CASES)
def test_one_command_relabels_a_scene(tmp_path, name, capsys):
    case = CASES[name]
    case.write(tmp_path / 'data')
    address = f'{name}:{tmp_path / "data"}#{case.scene}'
    out = tmp_path / 'out'
    command = ['relabel', address, '-o', str(out), *QUICK]
    assert main([*command, f'--truth={address}', '--report']) == 0
    assert len(rows_of(out)) == len(range(0, FRAMES, case.step))
    assert 'truth' not in capsys.readouterr().err
    # The input is the truth, and the points are exact.
    assert main(['evaluate', str(out), address]) == 0
    assert main(['evaluate', address, address, '--json']) == 0
    assert '"iou_3d": 1.0' in capsys.readouterr().out
    if name == 'kitti-raw':  # the least that is read
        assert main([*command, '--formats=csv']) == 0


def test_boxes_out_of_the_labelled_image_are_no_ghosts(tmp_path, capsys):
    """KITTI has labels of what the camera sees; detections of the LiDAR are all around."""
    layouts.kitti_tracking(tmp_path / 'data')
    address, out = f'kitti-tracking:{tmp_path / "data"}#0004', tmp_path / 'out'
    assert main(['relabel', address, '-o', str(out), *QUICK]) == 0
    rows = rows_of(out)
    behind = [row | {'track_id': 'behind', 'x': str(float(row['x']) - 60)} for row in rows]
    ahead = [row | {'track_id': 'ahead', 'x': str(float(row['x']) + 20)} for row in rows]
    with (out / 'boxes.csv').open('w', newline='') as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows([*rows, *behind, *ahead])
    capsys.readouterr()
    assert main(['evaluate', str(out), address]) == 0
    printed = capsys.readouterr()
    assert f'{len(rows)} predicted boxes lie outside of the image' in printed.err
    assert f'{len(rows)} predictions without a true box' in printed.out
    assert f'({len(rows)} ghosts)' in printed.out


def test_clouds_of_a_scene_are_labelled_but_not_copied(tmp_path, capsys):
    """A copy is refused before the work; labels of points and clouds of objects need none."""
    layouts.kitti_tracking(tmp_path / 'data')
    source, out = f'kitti-tracking:{tmp_path / "data"}#0004', str(tmp_path / 'out')
    command = ['relabel', source, '-o', out, *QUICK]
    assert main([*command, '--clouds=static']) == 2
    assert 'ask for --label-points or --clouds object alone' in capsys.readouterr().err
    assert not (tmp_path / 'out').exists()
    assert main([*command, '--clouds=object', '--formats=semantickitti']) == 0
    written = {path.name for path in (tmp_path / 'out').iterdir()}
    assert {'clouds', 'semantickitti'} <= written


@pytest.mark.parametrize('name', CASES)
def test_inspect_prints_the_command_for_a_scene(tmp_path, name, capsys):
    case = CASES[name]
    case.write(tmp_path)
    address = f'{name}:{tmp_path}#{case.scene}'
    assert main(['inspect', address]) == 0
    printed = capsys.readouterr().out
    assert 'next: boxreg relabel ' in printed
    assert f'-o out/{case.scene}' in printed
    assert f'{len(case.points(0))} points' in printed or name == 'waymo'


def test_inspect_lists_the_scenes_of_a_folder(tmp_path, capsys):
    layouts.nuscenes(tmp_path)
    assert main(['inspect', f'nuscenes:{tmp_path}']) == 0
    root = f'nuscenes:{tmp_path}'
    assert capsys.readouterr().out.split() == [f'{root}#scene-0061', f'{root}#scene-0103']


def test_a_part_of_a_scene(tmp_path):
    layouts.argoverse2(tmp_path)
    source = source_of('argoverse2', tmp_path, start=0.2, end=0.65)
    sweeps, boxes = read(source)
    stamps = layouts.stamps_ns()[2:7]
    assert [item.stamp_ns for item in sweeps] == stamps
    assert [item.stamp_ns for item in boxes] == stamps
    assert source.outside == FRAMES - 5


def test_one_sweep_is_in_memory_at_a_time(tmp_path):
    layouts.kitti_tracking(tmp_path)
    source = source_of('kitti-tracking', tmp_path)
    tree = TransformTree()
    with source:
        source.choose_fixed_frame(tree)
        items = source.items(tree)
        next(items)
        # Sweeps are read when they are asked for: this one disappears before that.
        shutil.rmtree(tmp_path / 'training' / 'velodyne')
        assert not [item for item in items if isinstance(item.content, Sweep)]
    assert source.unreadable['velodyne'] == FRAMES - 1


RESULTS = {
    'nuscenes-detection': ('nuscenes', lambda p: layouts.nuscenes_results(p, 'detection', 0.1)),
    'nuscenes-tracking': ('nuscenes', lambda p: layouts.nuscenes_results(p, 'tracking', 0.1)),
    'argoverse2': ('argoverse2', layouts.argoverse2_detections),
}


@pytest.mark.parametrize('name', RESULTS)
def test_results_as_they_are_submitted_are_labels(tmp_path, name):
    dataset, write = RESULTS[name]
    case = CASES[dataset]
    case.write(tmp_path / 'data')
    suffix = '.feather' if dataset == 'argoverse2' else '.json'
    labels = (dataset, write(tmp_path / f'results{suffix}'))
    address = f'{tmp_path / "data"}#{case.scene}'
    _, arrays = read(source_of(dataset, address, labels=labels))
    assert len(arrays) == len(range(0, FRAMES, case.step))
    shift = 0.1 if dataset == 'nuscenes' else 0.0
    track = '5' if name == 'nuscenes-tracking' else ''
    for i, array in zip(range(0, FRAMES, case.step), arrays, strict=True):
        expected = case.box(i)
        expected[1] += shift
        np.testing.assert_allclose(array.boxes, [expected], atol=2e-6)
        assert array.track_ids == (track,)
        assert array.scores.tolist() == [0.75]


def test_tracks_of_kitti_need_neither_stamps_nor_calibration_of_their_own(tmp_path):
    layouts.kitti_tracking(tmp_path / 'data', labels=False)
    results = tmp_path / 'results'
    results.mkdir()
    lines = [layouts.kitti_line(i, 0.5) for i in range(0, FRAMES, 2)]
    (results / '0004.txt').write_text('\n'.join(lines))
    case = CASES['kitti-tracking']
    source = source_of('kitti-tracking', tmp_path / 'data', labels=('kitti', results))
    _, arrays = read(source)
    assert [len(array.boxes) for array in arrays] == [1, 0] * (FRAMES // 2)
    np.testing.assert_allclose(arrays[2].boxes, [case.box(2)], atol=2e-6)
    assert arrays[2].scores.tolist() == [0.5]


def test_detections_are_associated_and_relabelled(tmp_path, capsys):
    layouts.nuscenes(tmp_path / 'data')
    results = layouts.nuscenes_results(tmp_path / 'results.json', 'detection')
    address = f'nuscenes:{tmp_path / "data"}#scene-0061'
    arguments = ['relabel', address, '-o', str(tmp_path / 'out'), '--formats=csv', *QUICK]
    assert main([*arguments, f'--labels=nuscenes:{results}', '--associate']) == 0
    assert {row['track_id'] for row in rows_of(tmp_path / 'out')} == {'1'}


def test_rejected_boxes_of_label_files_of_a_scene_are_left_out(tmp_path):
    layouts.nuscenes(tmp_path / 'data')
    address = f'nuscenes:{tmp_path / "data"}#scene-0061'
    arguments = ['relabel', address, '--formats=csv', *QUICK]
    assert main([*arguments, '-o', str(tmp_path / 'first')]) == 0
    rows = rows_of(tmp_path / 'first')
    table = tmp_path / 'first' / 'boxes.csv'
    words = {row['status'] for row in rows}
    text = table.read_text()
    for word in words:
        text = text.replace(f',{word},', ',rejected,', 1)
    table.write_text(text)
    labels = f'--labels=csv:{tmp_path / "first"}'
    assert main([*arguments, labels, '-o', str(tmp_path / 'second')]) == 0
    assert len(rows_of(tmp_path / 'second')) == len(rows) - len(words)


def test_results_with_a_score_that_is_no_number_are_named(tmp_path, capsys):
    layouts.nuscenes(tmp_path / 'data')
    results = layouts.nuscenes_results(tmp_path / 'results.json', 'detection')
    content = json.loads(results.read_text())
    for box in itertools.chain(*content['results'].values()):
        box['detection_score'] = 'high'
    results.write_text(json.dumps(content))
    address = f'nuscenes:{tmp_path / "data"}#scene-0061'
    arguments = ['relabel', address, '-o', str(tmp_path / 'out'), '--formats=csv', *QUICK]
    assert main([*arguments, f'--labels=nuscenes:{results}', '--associate']) == 1
    assert f'{results}: expected the tables or results of nuScenes' in capsys.readouterr().err


def broken(name, tmp_path, *parts):
    """Write a data set and delete a part of it."""
    CASES[name].write(tmp_path)
    for path in tmp_path.glob('/'.join(parts)):
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    return source_of(name, f'{tmp_path}#{CASES[name].scene}')


@pytest.mark.parametrize(
    ('name', 'deleted', 'message'),
    [
        ('nuscenes', ['v1.0-mini', 'ego_pose.json'], "the table 'ego_pose' of nuScenes"),
        ('nuscenes', ['v1.0-mini', 'sensor.json'], 'sensor.json: cannot be read'),
        ('nuscenes', ['v1.0-mini'], r'expected v1.0-\*/scene.json'),
        ('kitti-tracking', ['training', 'oxts', '*'], 'unpack data_tracking_oxts.zip'),
        ('kitti-tracking', ['training', 'calib', '*'], 'unpack data_tracking_calib.zip'),
        ('kitti-tracking', ['training', 'velodyne', '*', '*'], 'data_tracking_velodyne.zip'),
        ('argoverse2', ['val', '*', 'sensors', 'lidar'], 'the sweeps, got no such file'),
        ('argoverse2', ['val', '*', 'calibration', '*'], 'the calibration, got no such file'),
        (
            'argoverse2',
            ['val', '*', 'annotations.feather'],
            'no boxes: expected .*argoverse2:PATH',
        ),
        ('kitti-tracking', ['training', 'label_02', '*'], 'no boxes: expected .*kitti:PATH'),
    ],
)
def test_a_missing_part_is_named_with_a_remedy(tmp_path, name, deleted, message):
    with pytest.raises(RecordingError, match=message):
        broken(name, tmp_path, *deleted).__enter__()


def test_a_pose_that_is_missing_is_named(tmp_path):
    layouts.nuscenes(tmp_path)
    path = tmp_path / 'v1.0-mini' / 'ego_pose.json'
    path.write_text(path.read_text().replace('pose3', 'lost'))
    with pytest.raises(RecordingError, match=r'poses of 12 sweeps, got 11, .* is pose3'):
        source_of('nuscenes', f'{tmp_path}#scene-0061').__enter__()


@pytest.mark.parametrize(('table', 'lost'), [('instance', 'car'), ('category', 'vehicle.car')])
def test_a_token_that_is_missing_is_named(tmp_path, table, lost):
    layouts.nuscenes(tmp_path)
    path = tmp_path / 'v1.0-mini' / f'{table}.json'
    path.write_text(path.read_text().replace(f'"token": "{lost}"', '"token": "lost"'))
    expected = f"{table}.json of nuScenes: expected a row with the token '{lost}', got none"
    with pytest.raises(RecordingError, match=expected):
        read(source_of('nuscenes', f'{tmp_path}#scene-0061'))


def test_a_file_of_waymo_without_the_poses_of_a_sweep_is_named(tmp_path):
    parquet = pytest.importorskip('pyarrow.parquet')
    layouts.waymo(tmp_path)
    (path,) = tmp_path.glob('training/lidar_pose/*.parquet')
    parquet.write_table(parquet.read_table(path).slice(0, 5), path)
    source = source_of('waymo', str(tmp_path))
    assert len(read(source)[0]) == 5
    (error,) = source.first_errors.values()
    assert f'{path}: expected the poses of the LiDAR TOP in a sweep, got none' in str(error)


def test_labels_of_tables_with_several_lidars_are_in_the_frame_of_none(tmp_path, capsys):
    """Each LiDAR has a frame: boxes for one of them need the recording, which names it."""
    root = layouts.truckscenes(tmp_path / 'data')
    out = tmp_path / 'out'
    words = ['convert', str(root), '--from=nuscenes', '--to=openpcdet', '-o', str(out)]
    assert main(words) == 1
    assert 'give --recording' in capsys.readouterr().err
    address = f'truckscenes:{root}#scene-a-1'
    assert main([*words, f'--recording={address}']) == 0
    frames = [frame.moved('fixed') for frame in frames_of('openpcdet', out / 'openpcdet')]
    expected = [layouts.car_in_map(i) for i in range(0, FRAMES, 2)]
    found = np.concatenate([frame.refined.boxes.boxes for frame in frames])
    np.testing.assert_allclose(found, expected, atol=1e-5)


@pytest.mark.parametrize('folder', ['data', 'data/v1.0-mini'])
def test_the_folder_of_nuscenes_has_labels_of_its_scenes(tmp_path, folder):
    layouts.nuscenes(tmp_path / 'data')
    labels = 'nuscenes', tmp_path / folder
    _, boxes = read(source_of('nuscenes', f'{tmp_path}/data#scene-0061', labels=labels))
    assert len(boxes) == FRAMES / 2


@pytest.mark.parametrize('name', CASES)
def test_annotations_of_a_scene_are_converted(tmp_path, name, capsys):
    case = CASES[name]
    address = f'{name}:{case.write(tmp_path / "data")}#{case.scene}'
    out = tmp_path / 'out'
    words = ['convert', address, '--to=csv,openpcdet', '--with-points', '-o', str(out)]
    assert main([*words, f'--from={name}']) == 2
    assert 'expected --from recording alone' in capsys.readouterr().err
    assert main([*words, '--from=recording']) == 0
    found = BoxTable.read(out / 'boxes.csv')
    assert found.stamps_ns.tolist() == case.stamps_ns()[:: case.step]
    expected = [case.box(i) for i in range(0, FRAMES, case.step)]
    np.testing.assert_allclose(found.boxes, expected, atol=1e-5)
    assert len(list((out / 'openpcdet' / 'points').iterdir())) == len(expected)


CLOUDS = {
    'nuscenes': 'samples/**/*.bin',
    'kitti-tracking': '**/*.bin',
    'argoverse2': '**/lidar/*.feather',
    'kitti-raw': '**/*.bin',
    'pandaset': '001/lidar/*.pkl.gz',
}


@pytest.mark.parametrize('name', CLOUDS)
def test_a_missing_or_damaged_sweep_is_counted_and_the_others_go_on(tmp_path, name):
    case = CASES[name]
    case.write(tmp_path)
    first, second, *_ = sorted(tmp_path.glob(CLOUDS[name]))
    first.unlink()
    content = second.read_bytes()
    second.write_bytes(content[: len(content) // 2])
    source = source_of(name, f'{tmp_path}#{case.scene}')
    sweeps, _ = read(source)
    assert len(sweeps) == FRAMES - 2
    # The list of sweeps of Argoverse 2 is that of its files.
    assert source.unreadable.total() == (1 if name == 'argoverse2' else 2)
    assert 'download' in str(next(iter(source.first_errors.values())))


@pytest.mark.parametrize('name', CASES)
def test_hidden_files_are_neither_scenes_nor_sweeps(tmp_path, name):
    """Archives that macOS has packed have a file ``._NAME`` beside each file."""
    root = CASES[name].write(tmp_path)
    for path in list(root.rglob('*')):
        (path.parent / f'._{path.name}').write_bytes(bytes((0, 5, 22, 7)))
    names = scene_names(address_of(Path(f'{name}:{root}')))
    assert CASES[name].scene in names
    assert not any(one.startswith('.') for one in names)
    sweeps, _ = read(source_of(name, f'{root}#{CASES[name].scene}'))
    assert len(sweeps) == FRAMES


def test_a_scene_without_any_sweep_is_an_error(tmp_path):
    source = broken('nuscenes', tmp_path, 's*s')
    with pytest.raises(
        UnsupportedMessage, match=r"none of 12 sweeps of 'LIDAR_TOP' .*; unpack its"
    ):
        read(source)


@pytest.mark.parametrize(
    ('address', 'message'),
    [
        ('nuscenes:{}#scene-0062', 'no scene .* did you mean scene-0061.*is its split downloaded'),
        ('nuscenes:{}', 'expected the name of a scene .* there: scene-0061, scene-0103'),
        ('nuscene:{}#scene-0061', 'did you mean nuscenes:'),
        ('nuscenes:{}/none#scene-0061', 'no such folder'),
        ('argoverse2:{}#x', 'expected LOG/city_SE3_egovehicle.feather'),
    ],
)
def test_a_wrong_address_is_explained_in_one_line(tmp_path, capsys, address, message):
    layouts.nuscenes(tmp_path)
    out = tmp_path / 'out'
    assert main(['relabel', address.format(tmp_path), '-o', str(out)]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert re.search(message, line), line
    assert not out.exists()


@pytest.mark.parametrize(
    ('options', 'message'),
    [
        (['--boxes=/boxes'], 'boxes: expected for recordings with topics only'),
        (['--odometry=/odom'], 'odometry: expected for recordings with topics only'),
        (['--pose-reference=bottom'], 'a data set has its own convention'),
    ],
)
def test_options_of_topics_are_refused(tmp_path, capsys, options, message):
    layouts.argoverse2(tmp_path / 'data')
    arguments = ['relabel', f'argoverse2:{tmp_path / "data"}', '-o', str(tmp_path / 'out')]
    assert main([*arguments, *options]) == 2
    assert message in capsys.readouterr().err


def test_another_lidar_or_fixed_frame_is_refused(tmp_path):
    layouts.nuscenes(tmp_path)
    address = f'{tmp_path}#scene-0061'
    with pytest.raises(RecordingError, match="LiDARs LIDAR_TOP, got 'LIDAR_BACK'"):
        source_of('nuscenes', address, lidars=['LIDAR_BACK']).__enter__()
    with (
        source_of('nuscenes', address) as source,
        pytest.raises(RecordingError, match="'map' or 'LIDAR_TOP', got 'utm'"),
    ):
        source.choose_fixed_frame(TransformTree(), 'utm')


def test_results_of_other_scenes_are_refused(tmp_path):
    layouts.nuscenes(tmp_path)
    results = layouts.nuscenes_results(tmp_path / 'results.json', 'detection')
    source = source_of('nuscenes', f'{tmp_path}#scene-0103', labels=('nuscenes', results))
    with pytest.raises(RecordingError, match='got none'):  # it has no sweeps either
        source.__enter__()
    layouts.argoverse2(tmp_path / 'av2', log='unknown-log')
    detections = layouts.argoverse2_detections(tmp_path / 'detections.feather')
    source = source_of('argoverse2', tmp_path / 'av2', labels=('argoverse2', detections))
    with pytest.raises(RecordingError, match='expected boxes of log unknown-log'):
        read(source)


def test_batch_relabels_every_scene_and_counts_those_that_fail(tmp_path, capsys):
    for name in ('0004', '0005'):
        layouts.kitti_tracking(tmp_path / name, name)
    shutil.copytree(tmp_path / '0005', tmp_path / '0004', dirs_exist_ok=True)
    (tmp_path / '0004' / 'training' / 'oxts' / '0005.txt').unlink()
    out = tmp_path / 'out'
    address = f'kitti-tracking:{tmp_path / "0004"}'
    assert main(['batch', address, '-o', str(out), '--workers=1', '--formats=csv']) == 1
    streams = capsys.readouterr()
    assert '1 of 2 drives done' in streams.out
    assert 'boxreg: 0005: ' in streams.err
    assert 'data_tracking_oxts.zip' in streams.err
    assert len(rows_of(out / '0004')) == FRAMES


def test_a_scene_of_nuscenes_is_relabelled_again_once_its_clouds_are_there(tmp_path, capsys):
    """The archives of its sweeps are unpacked one after the other."""
    root = layouts.nuscenes(tmp_path / 'data')
    (root / 'sweeps').rename(tmp_path / 'sweeps')
    out = tmp_path / 'out'
    words = ['batch', f'nuscenes:{root}#scene-0061', '-o', str(out), '--formats=csv', *QUICK]
    for earlier, sweeps in ((0, FRAMES / 2), (1, FRAMES / 2), (0, FRAMES), (1, FRAMES)):
        if (earlier, sweeps) == (0, FRAMES):
            (tmp_path / 'sweeps').rename(root / 'sweeps')
        assert main(words) == 0
        assert f'1 of 1 drives done, {earlier} of them' in capsys.readouterr().out
        summary = json.loads((out / 'scene-0061' / 'summary.json').read_text())
        assert summary['sweeps'] == sweeps


def test_formats_lists_the_data_sets(capsys):
    assert main(['formats']) == 0
    printed = capsys.readouterr().out
    assert 'nuscenes:FOLDER#scene-0061: nuScenes' in printed
    assert '--labels argoverse2:PATH' in printed


def test_the_name_of_a_folder_may_have_the_mark_of_a_scene(tmp_path):
    root = tmp_path / 'drive #1'
    root.mkdir()
    assert address_of(Path(f'argoverse2:{root}')) == ('argoverse2', root, '')
    assert address_of(Path(f'argoverse2:{root}#log')) == ('argoverse2', root, 'log')
    assert address_of(Path(f'argoverse2:{tmp_path}#log')) == ('argoverse2', tmp_path, 'log')


def test_a_manifest_names_scenes(tmp_path):
    layouts.nuscenes(tmp_path / 'data')
    manifest = tmp_path / 'drives.txt'
    manifest.write_text(f'nuscenes:{tmp_path / "data"}#scene-0061  # a comment\n')
    (job,) = jobs_of([manifest])
    assert (job.name, job.problem) == ('scene-0061', '')
    assert [job.name for job in jobs_of([Path(f'nuscenes:{tmp_path / "data"}')])] == [
        'scene-0061',
        'scene-0103',
    ]
