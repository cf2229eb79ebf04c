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
