"""What the measurements compute, by hand; that each starts; their stored commands."""

import argparse
from importlib import import_module
import json

from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.io.recording import Recording
from boxreg_ros.io.transform_tree import TransformTree
from boxreg_ros.review.changes import Changes
from boxreg_ros.rotations import matrix_from_rpy
from boxreg_ros.simulation.simulate import simulate
from boxreg_ros.structures import BoxArray, RefinedBoxes, Sweep
import measure
from measure import renew, scale
from measure.drives import Drive
from measure.review import _without_constant_error, with_pins
from measure.tracks import ONE_LABEL, rows_with_one_label, scores_by_kind
import numpy as np
import pytest
from ros_messages import Drive as RecordedDrive
from ros_messages import SECOND


@pytest.fixture(scope='module')
def drive():
    return Drive.from_scene(simulate('street', 2, sweeps=6))


@pytest.mark.parametrize('name', measure.MEASUREMENTS)
def test_every_measurement_declares_options(name):
    parser = argparse.ArgumentParser()
    measure.add_arguments(parser, import_module(f'measure.{name}').ARGUMENTS)
    is_simulated = name in (
        'paper', 'speed', 'highway', 'lidars', 'load', 'node', 'report', 'kinds', 'points',
        'labeller', 'robot',
    )  # fmt: skip
    parser.parse_args([] if is_simulated else ['folder'])


def test_a_stored_measurement_is_renewed_by_its_command(tmp_path, monkeypatch, capfd):
    monkeypatch.setattr(renew, 'STORE', tmp_path)
    stored = tmp_path / 'street.json'
    command = 'python test/measure kinds --seeds 0 --json'
    stored.write_text(json.dumps({'command': command}), encoding='utf-8')
    assert measure.main(['renew', str(tmp_path), '--only', 'str*']) == 0
    document = json.loads(stored.read_text(encoding='utf-8'))
    assert document['command'] == command
    assert document['results'] == {}
    assert renew.resolved('python test/measure tracks street')[1:] == [
        measure.MEASURE[1], 'tracks', 'street',
    ]  # fmt: skip
    command = 'python test/measure real absent --json'
    failing = json.dumps({'command': command})
    stored.write_text(failing, encoding='utf-8')
    assert measure.main(['renew', str(tmp_path)]) == 1
    assert f'{command}: ended with exit status 1' in capfd.readouterr().err
    assert stored.read_text(encoding='utf-8') == failing


def test_errors_that_are_constant_in_the_box_frame_are_removed(drive):
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


def test_objects_with_two_labels_are_scored_apart(drive):
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


def test_a_pin_holds_the_true_box_at_its_stamp(drive):
    array = drive.boxes[2]
    pinned = with_pins(drive, {'9': array.stamp_ns}).boxes
    row = array.track_ids.index('9')
    true = drive.truth.boxes[
        (drive.truth.stamps_ns == array.stamp_ns) & (np.array(drive.truth.track_ids) == '9')
    ]
    np.testing.assert_array_equal(pinned[2].boxes[[row]], true)
    assert sum(int(array.pinned.sum()) for array in pinned) == 1


def test_a_fleet_takes_little_longer_than_cores_that_are_never_idle():
    fleet = scale.simulated(600.0, np.random.default_rng(1))
    assert fleet.least_hours <= fleet.hours < 1.5 * fleet.least_hours
    # A loss costs half of its job, and one attempt of twenty is lost.
    assert fleet.lost == pytest.approx(scale.LOST_PART * 0.05 / 0.95, rel=0.3)
    assert 0.6 < fleet.used <= 1


def test_equal_jobs_without_losses_fill_the_cores(monkeypatch):
    monkeypatch.setattr(scale, 'LENGTH_SPREAD', 0.0)
    monkeypatch.setattr(scale, 'STRAGGLER_PART', 0.0)
    monkeypatch.setattr(scale, 'LOSS_PART', 0.0)
    fleet = scale.simulated(3600.0, np.random.default_rng(1), count=20, cores=4)
    assert fleet == scale.Fleet(5.0, 5.0, 1.0, 0.0)


def test_a_recording_is_repeated_with_later_stamps(tmp_path):
    drive = RecordedDrive(sweeps=4)
    path = tmp_path / 'large.mcap'
    scale.repeated(drive.write(tmp_path / 'drive'), path, 1e-4, copies=2)
    tree = TransformTree()
    with Recording([path]) as recording:
        recording.choose_fixed_frame(tree)
        items = [item.content for item in recording.items(tree)]
    sweeps = [item for item in items if isinstance(item, Sweep)]
    assert len(sweeps) % 4 == 0 and len(sweeps) > 4
    steps = np.diff([sweep.stamp_ns for sweep in sweeps])
    assert (steps == SECOND // 10).all()
    assert all(len(sweep.points) == 2 * 240 for sweep in sweeps)
    assert path.stat().st_size >= 1e5
