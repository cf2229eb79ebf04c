"""Exports of our own, read back as recordings, give the result of their recording."""

from boxreg_ros.cli import main
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
