"""`measure real` and `paper` end to end on small scenes."""

from dataclasses import replace
import json
import sys

from boxreg_ros import __version__
from boxreg_ros.config import Config
from boxreg_ros.core.metrics import iou_3d
from boxreg_ros.core.refine import refine
from boxreg_ros.offline.box_scores import match, summarise
from boxreg_ros.simulation.noise import TABLE_ONE
from boxreg_ros.simulation.simulate import simulate
from measure import main
from measure.drives import Drive
from measure.methods import METHODS, run_methods
from measure.paper import ERROR_COLUMNS, error_row
from measure.real import GROUPINGS
import numpy as np
import pytest
from scenes import cut, write_scene
import torch

ROWS = {
    'input',
    'smoothing, early',
    'smoothing, final',
    'smoothing only',
    'CTRA smoothing',
    'L-shape per sweep',
    'ICP on box points',
    'paper, track',
    'ours, early',
    'ours, final',
    'ours, track',
}
QUICK = [method for method in METHODS if method != 'paper']
"""One test runs the paper's method, which takes as long as all others."""


@pytest.fixture(autouse=True)
def one_thread():
    """Use one thread: the tensors are too small for more."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def run(*words):
    return main([str(word) for word in words])


def small_street(seed, vehicles=('4', '9', '10', '16')):
    """Return a short scene with the boxes of few vehicles: the paper's method is slow."""
    scene = simulate('street', seed, sweeps=6)
    detections = [
        array.take([i for i, name in enumerate(array.track_ids) if name in vehicles])
        for array in scene.detections
    ]
    return replace(scene, detections=tuple(detections))


def test_all_methods_return_every_input_box(monkeypatch):
    monkeypatch.setitem(sys.modules, 'small_gicp', None)  # as if it were not installed
    scene = small_street(seed=1, vehicles=('4', '9'))
    drive = Drive.from_scene(scene)
    methods = run_methods(drive)
    assert set(methods) == ROWS
    assert methods.pop('ICP on box points') == 'skipped: small_gicp is not installed'
    count = sum(len(array.track_ids) for array in scene.detections)
    for name, boxes in methods.items():
        assert len(boxes.boxes) == count, name
        assert summarise(match(boxes, drive.truth)).unmatched == 0
    distances = drive.ranges(np.arange(len(drive.truth.boxes)))
    assert 2 < distances.min() < distances.max() < 75


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp('drive')
    scene = small_street(seed=2)
    write_scene(folder / 'recording.mcap', scene)
    scene.truth.write(folder / 'truth.csv')
    return folder


def test_real_prints_all_methods_and_groups(folder, capsys):
    assert run('real', folder, '--methods', *QUICK, '--json') == 0
    report = json.loads(capsys.readouterr().out)['results'][str(folder)]
    assert set(report) == ROWS - {'paper, track'}
    assert 0.6 < report['input']['iou_3d'] < 0.95
    assert report['smoothing only']['flips'] == 0
    assert len(report['ours, track']['recall_3d']) == 3
    ours = report['ours, track']
    gain = ours['differences']['all']['smoothing only']
    assert gain['iou_3d'] == pytest.approx(ours['iou_3d'] - report['smoothing only']['iou_3d'])
    assert 0 < gain['iou_3d_error'] < 0.2
    assert gain['tracks'] <= 4
    assert 0 < ours['moving']['boxes'] < ours['boxes']
    # Group means are of the same boxes as the overall mean, so they lie on both sides of it.
    for grouping in ('by_range', 'by_points'):
        values = report['input'][grouping].values()
        assert min(values) <= report['input']['iou_3d'] <= max(values)
    whole, *ranges = report['input']['as_people'].values()
    assert whole['boxes'] == sum(part['boxes'] for part in ranges) > 0
    words = ['--classes', 'van', '--min-points', 10, '--methods', 'smoothing', 'ours']
    assert run('real', folder, *words) == 0
    text = capsys.readouterr().out
    for shown in (
        'smoothing only',
        '| BEV | 3D | R@0.5 |',
        '| 3D IoU |',
        'ours, track - input | all',
    ):
        assert shown in text
    assert 'CTRA' not in text


def test_real_refuses_folders_without_truth_or_recording(tmp_path, folder, capsys):
    assert run('real', tmp_path / 'absent') == 1
    assert 'expected a folder' in capsys.readouterr().err
    (tmp_path / 'truth.csv').write_bytes((folder / 'truth.csv').read_bytes())
    assert run('real', tmp_path) == 1
    assert 'expected one recording in it, got 0' in capsys.readouterr().err


def test_paper_prints_table_one_and_draws_figures(tmp_path, capsys):
    pytest.importorskip('matplotlib', reason='the figures need matplotlib')
    one = ('--seeds', 1, '--steps', 4, '--output', tmp_path / 'figures')
    assert run('paper', *one, '--methods', *QUICK) == 0
    text = capsys.readouterr().out
    held = {f'held extents, {estimate}' for estimate in ('early', 'final', 'track')}
    held |= {'short tracks', 'held extents, short tracks'}
    published = {'initial, published', 'refined, published'}
    for method in (ROWS - {'paper, track'}) | held | published:
        if f'| {method} |' not in text:
            assert method == 'ICP on box points'  # small_gicp is not installed
        else:
            assert text.count(f'| {method} |') == 2, method  # in Table I of each mode
    figures = sorted(path.name for path in (tmp_path / 'figures').iterdir())
    assert figures == [
        f'paper_{mode}_{what}.png' for mode in ('3d', 'bev') for what in ('errors', 'trajectory')
    ]
    assert all(p.read_bytes()[:4] == b'\x89PNG' for p in (tmp_path / 'figures').iterdir())
    quick = ('--seeds', 2, '--steps', 4, '--methods', 'smoothing', '--output', tmp_path / 'again')
    assert run('paper', *quick, '--json') == 0
    report = json.loads(capsys.readouterr().out)['results']
    assert set(report) == {'3d', 'bev'}
    for rows in report.values():
        row = rows['smoothing only']
        assert set(row) == {*ERROR_COLUMNS, *GROUPINGS}
        assert row['x'] > 0
        assert rows['refined, published']['x'] in (0.121, 0.054)
    assert run('paper', '--seeds', 0) == 1
    assert '--seeds: expected 1 or more, got 0' in capsys.readouterr().err


def test_error_row_of_perfect_boxes():
    truth = simulate('paper', seed=0, sweeps=12).truth
    row = error_row(match(truth, truth), '3d')
    np.testing.assert_allclose(row, [0] * 6 + [1] * 4, atol=1e-8)
    few = truth.rows(np.arange(12) < 6)
    assert np.isnan(error_row(match(few, few), '3d')[-1])


def test_json_names_version_and_command(folder, capsys, monkeypatch):
    words = ['real', str(folder), '--methods', 'smoothing', '--json']
    monkeypatch.setattr(sys, 'argv', ['test/measure', *words])
    assert main(words) == 0
    document = json.loads(capsys.readouterr().out)
    assert document['version'] == __version__
    assert document['command'] == ' '.join(['python test/measure', *words])
    assert set(document) == {'version', 'command', 'results'}


def test_a_vehicle_that_rolls_is_not_turned_toward_the_sensor():
    # Its rolls have errors of .1 rad, 100 of them a mean of .01: points of a round body, seen from
    # one side alone, must not add three times as much.
    drive = Drive.from_scene(simulate('paper', seed=6, sweeps=None))
    boxes = drive.registered(Config())['track']
    roll = match(boxes, drive.truth).rotation[:, 0]
    deviation = TABLE_ONE[3] * np.sqrt(np.pi / 2) / np.sqrt(len(roll))
    assert abs(roll.mean()) < 3 * deviation


def test_margins_of_short_tracks_are_not_those_of_boxes_that_are_turned():
    # The yaw of the input errs by .23 rad. Its outermost points are corners, and no labelling
    # margin; those of the settings are the ones that boxes are simulated with.
    drive = Drive.from_scene(simulate('paper', seed=0, sweeps=None))
    tracks = [
        replace(cut(track, slice(row, row + 10)), track_id=str(row))
        for track in drive.tracks()
        for row in range(0, 100, 10)
    ]
    means = []
    for learns in (True, False):
        config = Config(extent='fixed').updated({'faces.learn': learns})
        boxes = np.concatenate([refined.boxes for refined in refine(tracks, config)])
        means.append(iou_3d(boxes, drive.truth.boxes).mean())
    assert means[0] > means[1]
