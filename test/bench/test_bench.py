"""`boxreg bench real` and `paper` end to end on small scenes."""

import argparse
from dataclasses import replace
import json
import sys

from boxreg_ros import __version__, cli
from boxreg_ros.bench import kinds
from boxreg_ros.bench import main as bench
from boxreg_ros.bench.accuracy import GROUPINGS
from boxreg_ros.bench.methods import METHODS, run_methods
from boxreg_ros.bench.paper import ERROR_COLUMNS, error_row
from boxreg_ros.bench.report import COMPOSITORS
from boxreg_ros.bench.review import _without_constant_error, with_pins
from boxreg_ros.bench.tracks import ONE_LABEL, rows_with_one_label, scores_by_kind, UNBROKEN
from boxreg_ros.errors import ConfigError, RecordingError
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.offline.box_scores import evaluate, match
from boxreg_ros.offline.drive import Drive
from boxreg_ros.review.changes import Changes
from boxreg_ros.rotations import matrix_from_rpy
from boxreg_ros.simulation.recorder import write_recording
from boxreg_ros.simulation.simulate import simulate
from boxreg_ros.structures import BoxArray, RefinedBoxes
from browser import NEEDS_BROWSER
import numpy as np
import pytest
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


@pytest.fixture(autouse=True)
def one_thread():
    """Use one thread: the tensors are too small for more."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def run(*words):
    parser = argparse.ArgumentParser()
    bench.add_arguments(parser)
    return bench.run(parser.parse_args([str(word) for word in words]))


def small_street(seed):
    """Return a short scene with the boxes of four vehicles: the paper's method is slow."""
    scene = simulate('street', seed, sweeps=6)
    detections = []
    for array in scene.detections:
        kept = [i for i, name in enumerate(array.track_ids) if name in ('4', '9', '10', '16')]
        detections.append(
            replace(
                array,
                track_ids=tuple(array.track_ids[i] for i in kept),
                class_names=tuple(array.class_names[i] for i in kept),
                scores=array.scores[kept],
                boxes=array.boxes[kept],
            )
        )
    return replace(scene, detections=tuple(detections))


def test_all_methods_return_every_input_box(monkeypatch):
    monkeypatch.setitem(sys.modules, 'small_gicp', None)  # as if it were not installed
    scene = small_street(seed=1)
    drive = Drive.from_scene(scene)
    calls = []
    methods = run_methods(drive, done=lambda: calls.append(1))
    assert set(methods) == ROWS
    assert len(calls) == len(METHODS)
    assert methods.pop('ICP on box points') == 'skipped: small_gicp is not installed'
    count = sum(len(array.track_ids) for array in scene.detections)
    for name, boxes in methods.items():
        assert len(boxes.boxes) == count, name
        assert evaluate(boxes, drive.truth).unmatched == 0
    distances = drive.ranges(np.arange(len(drive.truth.boxes)))
    assert 2 < distances.min() < distances.max() < 75


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp('drive')
    scene = small_street(seed=2)
    intensities = [np.zeros(len(owner)) for owner in scene.owners]
    path = folder / 'recording.mcap'
    write_recording(
        path, scene.sweeps, intensities, scene.detections, scene.T_fixed_sensor, 'odom'
    )
    scene.truth.write(folder / 'truth.csv')
    return folder


def test_real_prints_all_methods_and_groups(folder, capsys):
    assert run('real', folder, '--json') == 0
    report = json.loads(capsys.readouterr().out)['results'][str(folder)]
    assert set(report) == ROWS
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
    assert run('real', folder, '--classes', 'van', '--min-points', 10) == 0
    text = capsys.readouterr().out
    assert all(method in text for method in ROWS)
    assert '3D by range [m]' in text
    assert '3D by points' in text
    assert 'ours, track, all, minus' in text
    assert run('real', folder, '--methods', 'l-shape', 'smoothing', '--json') == 0
    report = json.loads(capsys.readouterr().out)['results'][str(folder)]
    smoothed = {'smoothing, early', 'smoothing, final', 'smoothing only'}
    assert set(report) == {'input', 'L-shape per sweep'} | smoothed


def test_kinds_compares_each_class_with_input_and_smoothing(folder, capsys, monkeypatch):
    monkeypatch.setattr(kinds, 'MIN_CLASS_BOXES', 10)
    assert run('kinds', folder, '--json') == 0
    found = json.loads(capsys.readouterr().out)['results'][str(folder)]
    assert set(found) == {'car'}
    assert set(found['car']) == {'ours, early', 'ours, final', 'ours, track'}
    drive = Drive.read(folder)
    methods = run_methods(drive, wanted=('ours',))
    own, given = (match(methods[name], drive.truth, 1) for name in ('ours, track', 'input'))
    is_car = own.is_matched & np.equal(own.class_names, 'car')
    gain = found['car']['ours, track']['input']
    assert gain['boxes'] == is_car.sum()
    assert gain['iou_bev'] == pytest.approx((own.iou_bev - given.iou_bev)[is_car].mean())
    assert set(found['car']['ours, final']) == {'input', 'smoothing, final'}
    assert run('kinds', folder) == 0
    assert 'ours, early, minus' in capsys.readouterr().out


def test_real_refuses_folders_without_truth_or_recording(tmp_path, folder):
    with pytest.raises(RecordingError, match='expected a folder'):
        run('real', tmp_path / 'absent')
    (tmp_path / 'truth.csv').write_bytes((folder / 'truth.csv').read_bytes())
    with pytest.raises(RecordingError, match='expected one recording in it, got 0'):
        run('real', tmp_path)


def test_paper_prints_table_one_and_draws_figures(tmp_path, capsys):
    pytest.importorskip('matplotlib', reason='the figures need matplotlib')
    assert run('paper', '--seeds', 1, '--steps', 8, '-o', tmp_path / 'figures') == 0
    text = capsys.readouterr().out
    held = {f'held extents, {estimate}' for estimate in ('early', 'final', 'track')}
    once = {'initial, published', 'refined, published'}
    once |= {
        line.partition('skipped:')[0].strip() for line in text.splitlines() if 'skipped:' in line
    }
    for method in ROWS | held | once:
        # Per mode once in Table I and, unless published or skipped, once by range and by points.
        assert text.count(method) == (2 if method in once else 6), method
    figures = sorted(path.name for path in (tmp_path / 'figures').iterdir())
    assert figures == [
        f'paper_{mode}_{what}.png' for mode in ('3d', 'bev') for what in ('errors', 'trajectory')
    ]
    assert all(p.read_bytes()[:4] == b'\x89PNG' for p in (tmp_path / 'figures').iterdir())
    quick = ('--seeds', 2, '--steps', 4, '--methods', 'smoothing', '-o', tmp_path / 'again')
    assert run('paper', *quick, '--json') == 0
    report = json.loads(capsys.readouterr().out)['results']
    assert set(report) == {'3d', 'bev'}
    for rows in report.values():
        row = rows['smoothing only']
        assert set(row) == {*ERROR_COLUMNS, *GROUPINGS}
        assert row['x'] > 0
        assert rows['refined, published']['x'] in (0.121, 0.054)
    with pytest.raises(ConfigError, match='--seeds: expected 1 or more, got 0'):
        run('paper', '--seeds', 0)


def test_error_row_of_perfect_boxes():
    truth = simulate('paper', seed=0, sweeps=12).truth
    row = error_row(match(truth, truth), '3d')
    np.testing.assert_allclose(row, [0] * 6 + [1] * 4, atol=1e-8)
    few = truth.rows(np.arange(12) < 6)
    assert np.isnan(error_row(match(few, few), '3d')[-1])


def test_json_names_version_and_command(folder, capsys, monkeypatch):
    words = ['bench', 'real', str(folder), '--methods', 'smoothing', '--json']
    monkeypatch.setattr(sys, 'argv', ['boxreg', *words])
    assert cli.main(words) == 0
    document = json.loads(capsys.readouterr().out)
    assert document['version'] == __version__
    assert document['command'] == ' '.join(['boxreg', *words])
    assert set(document) == {'version', 'command', 'results'}


def test_covariances_are_measured_for_each_estimate(folder, capsys):
    assert run('covariance', folder, '--json') == 0
    report = json.loads(capsys.readouterr().out)['results'][str(folder)]
    assert set(report) == {'early', 'final', 'track'}
    for groups in report.values():
        group = groups['all']
        assert group['boxes'] > 10
        assert all(0.6 < value <= 1 for value in group['coverage'].values())
        assert all(0 < value < 6 for value in group['nees'].values())
    assert run('covariance', folder) == 0
    assert 'early' in capsys.readouterr().out


def test_review_ranks_tracks_and_pins_a_box_of_the_worst(folder, capsys):
    assert run('review', folder, '--json') == 0
    report = json.loads(capsys.readouterr().out)['results'][str(folder)]
    assert set(report) == {'own boxes', 'planted errors'}
    for found in report.values():
        assert found['bad'] == np.ceil(0.1 * found['tracks'])
        pins = found['pins']
        missing = 1 - pins['before']
        assert pins['gained'] == pytest.approx((pins['after'] - pins['before']) / missing)
    assert report['own boxes']['tracks'] == 4
    assert report['own boxes']['pins']['gained'] > 0


def test_errors_that_are_constant_in_the_box_frame_are_removed(folder):
    drive = Drive.read(folder)
    truth = drive.truth
    is_car = np.array(truth.track_ids) == '9'
    boxes = truth.boxes[is_car].copy()
    boxes[:, :3] += matrix_from_rpy(boxes[:, 6:]) @ np.array([0.4, -0.2, 0.1])
    boxes[:, 3:6] += 0.3
    boxes[:, 8] += 0.05
    changes = Changes(truth.frame_id)
    for stamp_ns, box in zip(truth.stamps_ns[is_car].tolist(), boxes, strict=True):
        array = BoxArray(stamp_ns, truth.frame_id, ('9',), ('car',), np.ones(1), box[None])
        columns = ('refined',), ('',), np.ones(1, int), np.eye(6)[None]
        changes.add(array, RefinedBoxes(array, *columns))
    (track,) = changes.tracks()
    found = _without_constant_error(drive, track)
    np.testing.assert_allclose(found.boxes, truth.boxes[is_car], atol=1e-9)


def test_coasting_finds_missed_boxes(folder, capsys):
    assert run('tracks', folder, '--coast', 0.5, '--far-misses', '--json') == 0
    rows = json.loads(capsys.readouterr().out)['results'][str(folder)]
    assert list(rows) == [UNBROKEN, 'input', 'final', 'coast 0.5 s']
    assert rows['final']['added'] == 0 < rows['coast 0.5 s']['added']
    assert rows['final']['recall'] < rows['coast 0.5 s']['recall']
    assert rows['input']['recall'] <= rows[UNBROKEN]['recall']
    # Only vehicles have boxes in this drive.
    last = rows['coast 0.5 s']
    assert set(last['by_kind']) == {'vehicle', 'cyclist', 'pedestrian'}
    assert last['by_kind']['vehicle']['added_iou'] == last['added_iou']
    assert last['by_kind']['pedestrian']['recall'] == 0
    assert 0.5 < last['given_iou'] < 1


def test_objects_with_two_labels_are_scored_apart(folder):
    drive = Drive.read(folder)
    truth = drive.truth
    assert len(rows_with_one_label(truth)) == len(truth.boxes)
    car = [row for row, track_id in enumerate(truth.track_ids) if track_id == '9']
    rows = [*range(len(truth.boxes)), *car]
    doubled = BoxTable(
        truth.stamps_ns[rows], truth.frame_id, (*truth.track_ids, *('second',) * len(car)),
        tuple(truth.class_names[row] for row in rows), truth.scores[rows], truth.boxes[rows],
        tuple(truth.status[row] for row in rows), truth.num_points[rows],
    )  # fmt: skip
    names = [doubled.track_ids[row] for row in rows_with_one_label(doubled)]
    assert set(names) == set(truth.track_ids) - {'9'}
    scores = scores_by_kind(truth, doubled)
    assert scores['vehicle'].recall < 1
    assert scores[ONE_LABEL].recall == scores[ONE_LABEL].precision == 1


def test_highway_measures_all_methods_at_both_speeds(capsys):
    assert run('highway', '--seeds', 1, '--sweeps', 6, '--json') == 0
    results = json.loads(capsys.readouterr().out)['results']
    assert list(results) == ['stamp', 'sight']
    for rows in results.values():
        assert {'input', 'smoothing only', 'ours, early', 'ours, track'} <= set(rows)
        assert all(0.5 < iou < 1 for found in rows.values() for iou in found.values())


def test_a_pin_holds_the_true_box_at_its_stamp(folder):
    drive = Drive.read(folder)
    array = drive.boxes[2]
    pinned = with_pins(drive, {'9': array.stamp_ns}).boxes
    row = array.track_ids.index('9')
    true = drive.truth.boxes[
        (drive.truth.stamps_ns == array.stamp_ns) & (np.array(drive.truth.track_ids) == '9')
    ]
    np.testing.assert_array_equal(pinned[2].boxes[[row]], true)
    assert sum(int(array.pinned.sum()) for array in pinned) == 1


@NEEDS_BROWSER
def test_report_measures_paint_and_frames(capsys):
    pytest.importorskip('plotly', reason='plotly is not installed')
    pytest.importorskip('playwright', reason='playwright is not installed')
    small = ['--tracks', 3, '--boxes', 4, '--points', 2000]
    assert run('report', *small, '--json') == 0
    measured = json.loads(capsys.readouterr().out)['results']['3 tracks of 4 boxes']
    for compositor in COMPOSITORS:
        found = measured[compositor]
        assert found['first paint [ms]'] > 0
        assert 0 < found['script of a step [ms]'] <= found['longest script of a step [ms]']
        assert 0 < found['frames per second'] < 70
        assert 0 <= found['part of late frames'] <= 1


@pytest.mark.parametrize('name', bench.MEASUREMENTS)
def test_every_measurement_prints_json(name):
    parser = argparse.ArgumentParser()
    bench.add_arguments(parser)
    own_data = ('highway', 'kills', 'lidars', 'load', 'node', 'paper', 'report', 'speed')
    data = [] if name in own_data else ['folder']
    assert parser.parse_args([name, *data, '--json']).json
