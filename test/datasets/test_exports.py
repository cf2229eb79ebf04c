"""Exports of our own, read back as recordings, give the result of their recording."""

from boxreg_ros.cli import main
from boxreg_ros.datasets.registry import Address, open_scene
from boxreg_ros.errors import RecordingError
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.io.fixed_frame import input_boxes
from boxreg_ros.io.recording import Recording
from boxreg_ros.labels.camera import Camera
import layouts
import numpy as np
import pytest
from relabel_results import rows_of
from ros_messages import Drive
import test_datasets

QUICK = ['--set=solver.rounds=2', '--set=sampling.points=64']
NUMBERS = ('x', 'y', 'z', 'qx', 'qy', 'qz', 'qw', 'length', 'width', 'height')
CAMERA = """\
projection_matrix: [720, 0, 600, 45, 0, 720, 170, 0.2, 0, 0, 1, 0.003]
T_camera_sensor: [0, -1, 0, 0.05, 0, 0, -1, -0.08, 1, 0, 0, -0.27]
"""
# Data set, format and whether the boxes of the format are exact: KITTI loses roll and pitch, and
# tracklets have one extent per track.
EXPORTS = [
    ('nuscenes', 'nuscenes', True),
    ('nuscenes', 't4', True),
    ('argoverse2', 'argoverse2', True),
    ('kitti-tracking', 'kitti', False),
    ('kitti-raw', 'tracklets', False),
    ('openpcdet', 'openpcdet', False),
]


def relabelled(out, source, *options):
    """Return the refined boxes by stamp and track, and their statuses."""
    words = ['relabel', str(source), '-o', str(out), '--formats=csv', *QUICK, *options]
    assert main(words) == 0
    rows = {(row['stamp_ns'], row['track_id']): row for row in rows_of(out)}
    boxes = {key: [float(row[name]) for name in NUMBERS] for key, row in rows.items()}
    return boxes, {key: row['status'] for key, row in rows.items()}


@pytest.fixture(scope='module')
def exports(tmp_path_factory):
    """Return a folder with exports of the input boxes of a drive, and the drive's result."""
    folder = tmp_path_factory.mktemp('exports')
    drive = Drive(sweeps=12).write(folder / 'drive')
    table = folder / 'input.csv'
    BoxTable.from_arrays(input_boxes(Recording([drive]))[0]).write(table)
    (folder / 'camera.yaml').write_text(CAMERA)
    formats = ','.join(name for _, name, _ in EXPORTS)
    arguments = ['convert', str(table), '--from=csv', '-o', str(folder / 'out'), f'--to={formats}']
    arguments += ['--with-points', f'--camera={folder / "camera.yaml"}', f'--recording={drive}']
    assert main(arguments) == 0
    return folder, relabelled(folder / 'expected', drive, f'--labels=csv:{table}')


@pytest.mark.parametrize(('dataset', 'name', 'has_exact_boxes'), EXPORTS)
def test_an_export_gives_the_result_of_its_recording(
    tmp_path, exports, dataset, name, has_exact_boxes
):
    folder, (boxes, statuses) = exports
    labels = [] if has_exact_boxes else [f'--labels=csv:{folder / "input.csv"}']
    source = f'{dataset}:{folder / "out" / name}'
    found, found_statuses = relabelled(tmp_path / 'out', source, *labels)
    assert found_statuses == statuses
    assert 'refined' in statuses.values()
    for key, numbers in boxes.items():
        np.testing.assert_allclose(found[key], numbers, atol=1e-6)


def test_clouds_of_openpcdet_without_poses_are_those_of_a_lidar_that_stands(tmp_path, capsys):
    """Files of others: ``.npy`` and ``.bin``, no ids, no poses, stamps as names."""
    rng = np.random.default_rng(0)
    for name in ('points', 'labels'):
        (tmp_path / name).mkdir()
    for k in range(6):
        box = np.array([10.0 + k, 3.0, 0.0, 4.2, 1.8, 1.6, 0.0])
        unit = rng.uniform(-0.5, 0.5, (200, 3))
        unit[:100, 0] = unit[100:, 1] = -0.5
        rows = np.column_stack([unit * box[3:6] + box[:3], np.ones(200)]).astype(np.float32)
        path = tmp_path / 'points' / f'{1_700_000_000 + k // 10}.{k % 10}00000000'
        if k % 2:
            np.save(f'{path}.npy', rows)
        else:
            rows.tofile(f'{path}.bin')
        line = ' '.join(map(str, box)) + ' Vehicle\n'
        (tmp_path / 'labels' / f'{path.name}.txt').write_text(line)
    source = f'openpcdet:{tmp_path}'
    boxes, statuses = relabelled(tmp_path / 'out', source, '--associate')
    assert list(statuses.values()) == ['refined'] * 6
    assert {track_id for _, track_id in boxes} == {'1'}
    np.testing.assert_allclose([b[0] for b in boxes.values()], 10 + np.arange(6), atol=0.1)
    assert 'poses.txt: expected the poses of the LiDAR' in capsys.readouterr().err
    (tmp_path / 'points' / '1700000000.100000000.npy').write_bytes(b'no numbers')
    _, statuses = relabelled(tmp_path / 'out', source, '--associate')
    assert len(statuses) == 6
    assert '1700000000.100000000.npy: expected an array of numbers' in capsys.readouterr().err


def test_clouds_of_openpcdet_do_not_take_the_stamps_of_missing_ones(tmp_path):
    """A download in parts: ``timestamps.txt`` has lines of clouds that are not there."""
    stamps_ns = [1_700_000_000_000_000_000 + k * 100_000_000 for k in range(4)]
    (tmp_path / 'timestamps.txt').write_text(''.join(f'{stamp_ns}\n' for stamp_ns in stamps_ns))
    (tmp_path / 'points').mkdir()
    for k in (2, 3):
        np.save(tmp_path / 'points' / f'{k:06d}.npy', np.ones((5, 3)))
    address = Address('openpcdet', tmp_path, '')
    with pytest.raises(RecordingError, match='expected one stamp for each of 2 frames, got 4'):
        open_scene(address)
    for k in (2, 3):
        path = tmp_path / 'points' / f'{k:06d}.npy'
        path.rename(path.with_stem(str(stamps_ns[k])))
    assert open_scene(address).sweep_stamps_ns.tolist() == stamps_ns[2:]


def test_exports_of_argoverse2_keep_the_times_of_points(tmp_path):
    layouts.argoverse2(tmp_path / 'data')
    address = f'argoverse2:{tmp_path / "data"}'
    out = tmp_path / 'out'
    arguments = ['relabel', address, '-o', str(out), '--formats=argoverse2', '--with-points']
    assert main(arguments) == 0
    expected, _ = test_datasets.read(test_datasets.source_of('argoverse2', tmp_path / 'data'))
    found, _ = test_datasets.read(test_datasets.source_of('argoverse2', out / 'argoverse2'))
    assert len(found) == len(expected)
    for sweep, original in zip(found, expected, strict=True):
        np.testing.assert_array_equal(sweep.points, original.points)
        np.testing.assert_allclose(sweep.times, original.times, atol=1e-9)


def test_the_camera_of_a_scene_is_that_of_its_data_set(tmp_path):
    layouts.kitti_tracking(tmp_path)
    words = [
        'relabel',
        f'kitti-tracking:{tmp_path}',
        '--formats=kitti,kitti_object',
        '--set=solver.rounds=1',
    ]
    assert main([*words, '-o', str(tmp_path / 'out')]) == 0
    (true,) = tmp_path.glob('training/calib/*.txt')
    expected = Camera.read(true)
    for path in (tmp_path / 'out').glob('kitti*/calib/*.txt'):
        np.testing.assert_allclose(Camera.read(path).T_camera_sensor, expected.T_camera_sensor)
