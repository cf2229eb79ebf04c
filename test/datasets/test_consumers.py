"""Data sets read by the libraries of their publishers: the same clouds, poses and boxes."""

import json

from boxreg_ros.cli import main
from boxreg_ros.datasets.kitti import oxts_poses, oxts_rows
from boxreg_ros.io.transforms import matrix
from consumers import consumer
import layouts
import numpy as np
from pyarrow import parquet
import test_datasets


def test_nuscenes_devkit_has_the_same_clouds_and_boxes(tmp_path):
    layouts.nuscenes(tmp_path)
    found = consumer('nuscenes_scene', tmp_path, 'v1.0-mini', 'scene-0061')
    source = test_datasets.source_of('nuscenes', f'{tmp_path}#scene-0061')
    sweeps, arrays = test_datasets.read(source)
    assert [micros * 1000 for micros, _ in found['sweeps']] == [s.stamp_ns for s in sweeps]
    for (_, points), sweep in zip(found['sweeps'], sweeps, strict=True):
        np.testing.assert_allclose(sweep.points, points, atol=5e-5)  # float32, 200 m away
    boxes = np.concatenate([array.boxes for array in arrays])
    np.testing.assert_allclose(boxes[:, [0, 1, 2, 3, 4, 5, 8]], found['boxes'], atol=1e-9)


def test_truckscenes_devkit_has_the_same_clouds(tmp_path):
    layouts.truckscenes(tmp_path)
    found = consumer('truckscenes_clouds', tmp_path, 'v1.2-mini')
    sweeps, _ = test_datasets.read(test_datasets.source_of('truckscenes', f'{tmp_path}#scene-a-1'))
    ours = {(sweep.topic, sweep.stamp_ns // 1000): sweep.points for sweep in sweeps}
    assert ours.keys() == {(channel, micros) for channel, micros, _ in found}
    for channel, micros, points in found:
        # The closest of the poses, 10 ms apart, is 25 mm off at 5 m/s; ours are interpolated.
        np.testing.assert_allclose(ours[channel, micros], points, atol=0.0251)


def test_pykitti_counts_the_clouds_of_kitti_raw_that_are_there(tmp_path):
    """Docs: other readers; frames without a cloud shift the later ones there, and not here."""
    layouts.kitti_raw(tmp_path)
    day = tmp_path / '2011_09_26'
    for name, text in (('velo_to_cam', KITTI_RIGID), ('cam_to_cam', '')):
        cameras = ''.join(KITTI_CAMERA.format(i) for i in range(4))
        (day / f'calib_{name}.txt').write_text(text or cameras)
    folder = next(day.glob('*_sync/velodyne_points'))
    lines = (folder / 'timestamps.txt').read_text().splitlines()
    lines[4] = ''
    (folder / 'timestamps.txt').write_text('\n'.join(lines) + '\n')
    (folder / 'data' / f'{4:010d}.bin').unlink()
    first_points = consumer('kitti_raw_clouds', tmp_path, '2011_09_26', '0001')
    sweeps, _ = test_datasets.read(test_datasets.source_of('kitti-raw', tmp_path))
    after_ns = layouts.RAW_START_NS + 5 * layouts.STEP_NS
    (ours,) = (sweep for sweep in sweeps if sweep.stamp_ns == after_ns)
    frame = test_datasets.CASES['kitti-raw']
    np.testing.assert_allclose(ours.points, frame.points(5), atol=3e-5)
    for index, number in ((3, 3), (4, 5)):
        expected = layouts.face_in_ego(number)[0] - [0, 0, 1.7]
        np.testing.assert_allclose(first_points[index][:3], expected, atol=1e-5)


KITTI_RIGID = 'R: 1 0 0 0 1 0 0 0 1\nT: 0 0 0\n'
KITTI_CAMERA = (
    'P_rect_0{0}: 1 0 0 0 0 1 0 0 0 0 1 0\nR_rect_0{0}: 1 0 0 0 1 0 0 0 1\n'
    'K_0{0}: 1 0 0 0 1 0 0 0 1\n'
)


def test_keyframes_of_nuscenes_become_boxes_at_every_sweep(tmp_path):
    """One command from annotations at a part of the sweeps to tables that the devkit reads."""
    layouts.nuscenes(tmp_path)
    words = ['relabel', f'nuscenes:{tmp_path}#scene-0061', '--keyframes', '-o', f'{tmp_path}/out']
    assert main([*words, '--formats', 'nuscenes']) == 0
    found = consumer('nuscenes', tmp_path / 'out' / 'nuscenes', 'v1.0-boxreg')
    assert [box['timestamp'] * 1000 for box in found] == layouts.stamps_ns()
    truth = np.array([layouts.car_in_map(i) for i in range(layouts.FRAMES)])
    np.testing.assert_allclose([box['center'] for box in found], truth[:, :3], atol=0.05)
    np.testing.assert_allclose([box['wlh'] for box in found], truth[:, [4, 3, 5]], atol=0.05)
    assert {box['name'] for box in found} == {'vehicle.car'}
    assert len({box['track'] for box in found}) == 1
    assert [box['prev'] == '' for box in found] == [True] + [False] * 11
    rows = json.loads((tmp_path / 'out/nuscenes/v1.0-boxreg/sample_annotation.json').read_text())
    words = [row['status'] for row in sorted(rows, key=lambda row: row['stamp_ns'])]
    assert words == ['refined', 'interpolated'] * 5 + ['refined', 'extended']


def test_av2_has_the_same_clouds_and_poses(tmp_path):
    layouts.argoverse2(tmp_path)
    source = test_datasets.source_of('argoverse2', tmp_path)
    sweeps, _ = test_datasets.read(source)
    found = consumer('av2_log', tmp_path / 'val' / layouts.LOG, sweeps[3].stamp_ns)
    T = np.array(found['city_SE3_ego'])
    points = np.array(found['points'])[:, :3] @ T[:3, :3].T + T[:3, 3]
    np.testing.assert_allclose(sweeps[3].points, points, atol=5e-5)
    positions = np.array(found['positions']) @ T[:3, :3].T + T[:3, 3]
    np.testing.assert_allclose(sweeps[3].origins, positions, atol=1e-9)


def test_pykitti_has_the_same_poses_of_the_gps_unit(tmp_path):
    layouts.kitti_raw(tmp_path / 'raw')
    layouts.kitti_tracking(tmp_path / 'tracking')
    sequence = tmp_path / 'tracking' / 'training' / 'oxts' / '0004.txt'
    # A turn, a slope and a lane change: all six columns that count.
    rows = oxts_rows(sequence)
    k = np.arange(len(rows))
    rows[:, 0] += 1e-5 * k**2
    rows[:, 2:6] += np.stack([0.1 * k, 0.01 * k, -0.02 * k, 0.3 * k], axis=1)
    np.savetxt(sequence, rows, fmt=['%.15g'] * 25 + ['%d'] * 5)
    for files in ([sequence], sorted((tmp_path / 'raw').glob('*/*/oxts/data/*.txt'))):
        found = consumer('pykitti_oxts', *files)
        poses = oxts_poses(np.concatenate([oxts_rows(path) for path in files]), np.eye(4))
        np.testing.assert_allclose([matrix(pose) for pose in poses], found, atol=1e-6)


def test_the_tables_of_waymo_have_the_columns_of_its_components(tmp_path):
    split = layouts.waymo(tmp_path) / 'training'
    for folder, columns in consumer('waymo_schemas').items():
        schema = parquet.read_schema(split / folder / f'{layouts.SEGMENT}.parquet')
        # Parquet names the items of a list itself.
        found = {field.name: str(field.type).replace('element', 'item') for field in schema}
        assert found == columns
