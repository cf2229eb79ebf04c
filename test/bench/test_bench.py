"""Benches end to end on small scenes, and the plain methods beside ours on known answers."""

import argparse
from dataclasses import replace
import json
import sys

from boxreg_ros.bench import main as bench
from boxreg_ros.bench.baselines import icp, l_shaped, smoothed, smoothed_live
from boxreg_ros.core.refine import Track
from boxreg_ros.errors import ConfigError, RecordingError
from boxreg_ros.offline.evaluate import evaluate, match
from boxreg_ros.simulation.recorder import write_recording
from boxreg_ros.simulation.simulate import simulate
import numpy as np
import pytest
import torch

METHODS = {
    'input',
    'smoothing, early',
    'smoothing, final',
    'smoothing only',
    'L-shape per sweep',
    'ICP on box points',
    'paper, track',
    'ours, early',
    'ours, final',
    'ours, track',
}


@pytest.fixture(autouse=True)
def one_thread():
    """Use one thread: tensors are tiny here, more would only wait for each other."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def run(*words):
    parser = argparse.ArgumentParser()
    bench.add_arguments(parser)
    return bench.run(parser.parse_args([str(word) for word in words]))


def make_track(boxes, points=None, origins=None):
    n = len(boxes)
    stamps = np.arange(n) * 100_000_000
    return Track('1', 'car', stamps, boxes, points or [np.zeros((0, 3))] * n, origins)


def car(n, speed):
    boxes = np.tile([0, 0, 0.75, 4.4, 1.8, 1.5, 0, 0, 0.6], (n, 1))
    boxes[:, :2] += np.outer(np.arange(n) * 0.1 * speed, [np.cos(0.6), np.sin(0.6)])
    return boxes


@pytest.mark.parametrize('speed', [0.0, 8.0])
def test_smoother(speed):
    truth = car(60, speed)
    rng = np.random.default_rng(0)
    noisy = truth.copy()
    noisy[:, [0, 1, 2, 8]] += rng.normal(0, (0.2, 0.2, 0.1, 0.1), (60, 4))
    noisy[:, 3:6] += rng.normal(0, 0.1, (60, 3))
    noisy[[3, 30, 31], 8] += np.pi
    noisy[20, :2] += 3  # once, far off
    found = smoothed(make_track(noisy))
    error = np.abs(found - truth)
    assert error[:, :2].mean() < 0.06
    assert error[:, 8].max() < 0.1
    assert np.ptp(found[:, 3:6], axis=0).max() == 0
    assert error[20, :2].max() < 0.15
    assert (np.ptp(found[:, 0]) == 0) == (speed == 0)


def test_smoother_leaves_perfect_and_short_tracks():
    truth = car(40, 6.0)
    np.testing.assert_allclose(smoothed(make_track(truth)), truth, atol=1e-6)
    np.testing.assert_allclose(smoothed(make_track(truth[:2])), truth[:2], atol=1e-6)


def test_smoother_over_the_wrap():
    truth = car(30, 0.0)
    truth[:, 8] = np.pi + np.random.default_rng(1).normal(0, 0.05, 30)
    truth[:, 8] = (truth[:, 8] + np.pi) % (2 * np.pi) - np.pi
    found = smoothed(make_track(truth))[:, 8]
    assert np.abs(np.cos(found) + 1).max() < 1e-2


def test_smoother_live_knows_no_future():
    truth = car(30, 8.0)
    noisy = truth.copy()
    noisy[:, :2] += np.random.default_rng(3).normal(0, 0.2, (30, 2))
    newest, lagged = smoothed_live(make_track(noisy), lag=5)
    np.testing.assert_allclose(newest[12], smoothed(make_track(noisy[:13]))[-1])
    np.testing.assert_allclose(lagged[12], smoothed(make_track(noisy[:18]))[12])
    np.testing.assert_allclose(lagged[24:], smoothed(make_track(noisy))[24:])
    # Later is better: errors of the inner boxes, where all three have had time to settle.
    errors = [
        np.abs(found - truth)[10:25, :2].mean()
        for found in (newest, lagged, smoothed(make_track(noisy)))
    ]
    assert errors[0] > 1.2 * errors[1] > 1.2 * errors[2]


def corner_points(box, rng):
    """Return points on the rear and the right side of an upright box."""
    x, _, _, length, width, height, *_, yaw = box
    del x
    rear = np.c_[np.full(150, -length / 2), rng.uniform(-width / 2, width / 2, 150)]
    right = np.c_[rng.uniform(-length / 2, length / 2, 250), np.full(250, -width / 2)]
    flat = np.concatenate([rear, right])
    R = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    z = rng.uniform(-0.4 * height, 0.5 * height, len(flat))
    return np.c_[flat @ R.T + box[:2], box[2] + z]


def seen_track(shift):
    """Return a car seen from behind and its right, its boxes off by `shift`, and its truth."""
    truth = car(3, 0.0)
    rng = np.random.default_rng(2)
    points = [corner_points(box, rng) for box in truth]
    away = np.array(
        [-12 * np.cos(0.6) + 8 * np.sin(0.6), -12 * np.sin(0.6) - 8 * np.cos(0.6), 1.0]
    )
    return make_track(truth + shift, points, np.tile(away, (3, 1))), truth


def test_rectangle_fit_finds_the_corner():
    track, truth = seen_track(np.array([0.25, -0.2, 0, 0, 0, 0, 0, 0, 0.15]))
    found = l_shaped(track)
    np.testing.assert_allclose(found[:, :2], truth[:, :2], atol=0.06)
    np.testing.assert_allclose(found[:, 8], truth[:, 8], atol=np.radians(1))
    np.testing.assert_allclose(found[:, 2:8], track.boxes[:, 2:8])


def test_icp_moves_towards_the_points():
    pytest.importorskip('small_gicp', reason='small_gicp is not installed')
    track, truth = seen_track(np.array([0.1, -0.1, 0, 0, 0, 0, 0, 0, 0.05]))
    found = icp(track)
    before = np.linalg.norm((track.boxes - truth)[:, :2], axis=1)
    assert (np.linalg.norm((found - truth)[:, :2], axis=1) < 0.6 * before).all()
    assert np.abs(found[:, 8] - truth[:, 8]).max() < 0.03


@pytest.mark.parametrize('method', [l_shaped, icp])
def test_without_points_boxes_stay(method):
    if method is icp:
        pytest.importorskip('small_gicp', reason='small_gicp is not installed')
    truth = car(3, 5.0)
    np.testing.assert_array_equal(method(make_track(truth)), truth)


def small_street(seed):
    """Return a short scene with the boxes of four vehicles only: the paper's method is slow."""
    scene = simulate('street', seed, sweeps=6)
    few = []
    for array in scene.detections:
        kept = [i for i, name in enumerate(array.track_ids) if name in ('4', '9', '10', '16')]
        few.append(
            replace(
                array,
                track_ids=tuple(array.track_ids[i] for i in kept),
                class_names=tuple(array.class_names[i] for i in kept),
                scores=array.scores[kept],
                boxes=array.boxes[kept],
            )
        )
    return replace(scene, detections=tuple(few))


def test_all_methods_see_the_same(monkeypatch):
    monkeypatch.setitem(sys.modules, 'small_gicp', None)  # as if it were not installed
    scene = small_street(seed=1)
    drive = bench.Drive.from_scene(scene)
    calls = []
    methods = bench.run_methods(drive, done=lambda: calls.append(1))
    assert set(methods) == METHODS
    assert len(calls) == len(bench.METHODS)
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


def test_real(folder, capsys):
    assert run('real', folder, '--json') == 0
    report = json.loads(capsys.readouterr().out)[str(folder)]
    assert set(report) == METHODS
    assert 0.6 < report['input']['iou_3d'] < 0.95
    assert report['smoothing only']['flips'] == 0
    assert len(report['ours, track']['recall_3d']) == 3
    # Means by range and by points are of the same boxes as the mean of all: on either side of it.
    for part in ('by_range', 'by_points'):
        values = report['input'][part].values()
        assert min(values) <= report['input']['iou_3d'] <= max(values)
    assert run('real', folder, '--classes', 'van', '--min-points', 10) == 0
    text = capsys.readouterr().out
    assert all(method in text for method in METHODS)
    assert '3D by range [m]' in text
    assert '3D by points' in text
    assert run('real', folder, '--methods', 'l-shape', 'smoothing', '--json') == 0
    report = json.loads(capsys.readouterr().out)[str(folder)]
    smoothed = {'smoothing, early', 'smoothing, final', 'smoothing only'}
    assert set(report) == {'input', 'L-shape per sweep'} | smoothed


def test_real_refuses(tmp_path, folder):
    with pytest.raises(RecordingError, match='expected a folder'):
        run('real', tmp_path / 'absent')
    (tmp_path / 'truth.csv').write_bytes((folder / 'truth.csv').read_bytes())
    with pytest.raises(RecordingError, match='expected one recording in it, got 0'):
        run('real', tmp_path)


def test_paper(tmp_path, capsys):
    pytest.importorskip('matplotlib', reason='the figures need matplotlib')
    assert run('paper', '--seeds', 1, '--steps', 8, '-o', tmp_path / 'figures') == 0
    text = capsys.readouterr().out
    for method in METHODS | {'initial, published', 'refined, published'}:
        # Once per mode in Table I and, but for what is published, by range and by points.
        assert text.count(method) == (2 if 'published' in method else 6), method
    figures = sorted(path.name for path in (tmp_path / 'figures').iterdir())
    assert figures == [
        f'paper_{mode}_{what}.png' for mode in ('3d', 'bev') for what in ('errors', 'trajectory')
    ]
    assert all(p.read_bytes()[:4] == b'\x89PNG' for p in (tmp_path / 'figures').iterdir())
    quick = ('--seeds', 2, '--steps', 4, '--methods', 'smoothing', '-o', tmp_path / 'again')
    assert run('paper', *quick, '--json') == 0
    report = json.loads(capsys.readouterr().out)
    assert set(report) == {'3d', 'bev'}
    for rows in report.values():
        row = rows['smoothing only']
        assert set(row) == {*bench.VARIABLES, 'iou', 'iou_first', 'iou_last', *bench.PARTS}
        assert row['x'] > 0
        assert rows['refined, published']['x'] in (0.121, 0.054)
    with pytest.raises(ConfigError, match='--seeds: expected 1 or more, got 0'):
        run('paper', '--seeds', 0)


def test_paper_row_by_hand():
    truth = simulate('paper', seed=0, sweeps=6).truth
    row = bench.paper_row(match(truth, truth), '3d')
    np.testing.assert_allclose(row, [0] * 6 + [1] * 3, atol=1e-8)
