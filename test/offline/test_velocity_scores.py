"""Velocities in tables: written, read and scored against true ones."""

import argparse
from dataclasses import replace
import json

from boxreg_ros.errors import RecordingError
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.io.label_messages import from_text, LabelMessage, to_text
from boxreg_ros.io.velocity_table import (
    read_velocities,
    VELOCITIES,
    VELOCITY_COLUMNS,
    velocity_lines,
)
from boxreg_ros.labels import LabelFrame, Provenance, writer_for
from boxreg_ros.offline import evaluate
from boxreg_ros.offline.box_scores import match
from boxreg_ros.offline.velocity_scores import velocity_scores
from boxreg_ros.structures import BoxArray, KINEMATICS, REFINED, RefinedBoxes
import numpy as np
import pytest

STEP = 100_000_000
SPEED, TURN = 5.0, 0.2


def boxes_at(time):
    """Return the box (1, 9) of a car that drives a circle."""
    yaw = TURN * time
    radius = SPEED / TURN
    return np.array([[radius * np.sin(yaw), -radius * np.cos(yaw), 1, 4, 2, 1.5, 0, 0, yaw]])


def arrays(count=20):
    return [
        BoxArray(i * STEP, 'odom', ('=1',), ('car',), np.ones(1), boxes_at(i / 10))
        for i in range(count)
    ]


def refined_of(boxes, error=0.0, has_velocity=True):
    """Return a refined box with its velocity, off by an error in x."""
    yaw = boxes.boxes[0, 8]
    kinematics = np.zeros(1, KINEMATICS)
    kinematics['velocity'] = SPEED * np.cos(yaw) + error, SPEED * np.sin(yaw), 0.0, TURN
    kinematics['velocity_covariance'] = np.diag([0.1, 0.2, 0.3, 0.01])
    kinematics['acceleration'] = -SPEED * TURN * np.sin(yaw), SPEED * TURN * np.cos(yaw), 0.0
    kinematics['acceleration_covariance'] = np.diag([1.0, 2.0, 3.0])
    kinematics['has_velocity'] = has_velocity
    kinematics['has_acceleration'] = has_velocity and boxes.stamp_ns > 0
    moving = replace(boxes, kinematics=kinematics)
    return RefinedBoxes(moving, (REFINED,), ('',), np.ones(1, int), np.eye(6)[None])


def test_velocities_are_written_and_read(tmp_path):
    known = [refined_of(boxes, has_velocity=i != 2) for i, boxes in enumerate(arrays(4))]
    lines = [','.join(VELOCITY_COLUMNS) + '\n']
    lines += [line for refined in known for line in velocity_lines(refined.boxes)]
    (tmp_path / VELOCITIES).write_text(''.join(lines))
    found = read_velocities(tmp_path / VELOCITIES)
    assert list(found) == [(i * STEP, '=1') for i in (0, 1, 3)]
    for i in (0, 1, 3):
        given = known[i].boxes.kinematics[0]
        record = found[i * STEP, '=1']
        assert bool(record['has_acceleration']) == (i > 0)
        np.testing.assert_allclose(record['velocity'], given['velocity'], rtol=1e-6)
        covariance = record['velocity_covariance']
        np.testing.assert_allclose(covariance, given['velocity_covariance'], rtol=1e-6)
        if i:
            np.testing.assert_allclose(record['acceleration'], given['acceleration'], rtol=1e-6)


def test_a_damaged_table_is_named(tmp_path):
    (tmp_path / VELOCITIES).write_text('stamp_ns,track_id,vx\n1,2,3\n')
    with pytest.raises(RecordingError, match='columns of velocities'):
        read_velocities(tmp_path / VELOCITIES)


def test_messages_of_labels_have_the_velocities():
    refined = refined_of(arrays(2)[1])
    found = from_text(to_text(LabelMessage(refined, 'odom', ''))).refined
    assert found.boxes.kinematics.tobytes() == refined.boxes.kinematics.tobytes()


def test_differences_smoother_and_estimates_are_scored():
    truth = BoxTable.from_arrays(arrays(), 'truth')
    known = {
        (boxes.stamp_ns, '=1'): refined_of(boxes, error=0.1).boxes.kinematics[0]
        for boxes in arrays()
    }
    scores = velocity_scores(match(truth, truth), truth, truth, known)
    # Boxes with a difference over 0.3 s and a true velocity: all but three and the last.
    assert {name: found.boxes for name, found in scores.items()} == dict.fromkeys(
        ('difference', 'smoother', 'estimate'), 16
    )
    assert scores['estimate'].mean == pytest.approx(0.1, abs=2e-3)
    # The difference is the velocity 0.15 s before: 0.15 s times 1 m/s^2 off.
    assert scores['difference'].mean == pytest.approx(0.15, abs=2e-3)
    assert scores['smoother'].mean < 0.02
    assert scores['estimate'].yaw_rate == pytest.approx(0.0, abs=1e-9)


def test_evaluate_prints_velocities_of_a_result(tmp_path, capsys):
    writer = writer_for('csv', tmp_path, Provenance())
    for boxes in arrays():
        writer.write(LabelFrame(refined_of(boxes, error=0.1), 'odom', ''))
    writer.close()
    truth = tmp_path / 'truth.csv'
    truth.write_text((tmp_path / 'boxes.csv').read_text())
    parser = argparse.ArgumentParser()
    evaluate.add_arguments(parser)
    assert evaluate.run(parser.parse_args([str(tmp_path), str(truth), '--json'])) == 0
    report = json.loads(capsys.readouterr().out)['velocities']
    assert report['boxes, estimate']['mean'] == pytest.approx(0.1, abs=2e-3)
    assert evaluate.run(parser.parse_args([str(tmp_path), str(truth)])) == 0
    printed = capsys.readouterr().out
    assert 'boxes, difference' in printed and 'boxes, smoother' in printed
