"""`measure follow` end to end on a small scene."""

import json

from boxreg_ros.simulation.simulate import simulate
from measure import main
from measure.follow import CASES, KEYFRAMES, OFF_SIZE, ONE, ONE_OF_CLASS, TWO
import numpy as np
import pytest
from scenes import write_scene

OBJECTS = ('4', '9', '10', '16')
"""Three moving cars and a parked one."""
SWEEPS = 21


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp('drive')
    scene = simulate('street', 2, SWEEPS)
    write_scene(folder / 'recording.mcap', scene)
    scene.truth.rows(np.isin(scene.truth.track_ids, OBJECTS)).write(folder / 'truth.csv')
    return folder


def test_follow_is_scored_beside_lines_and_constant_velocity(folder, capsys):
    assert main(['follow', str(folder), '--json']) == 0
    report = json.loads(capsys.readouterr().out)['results'][str(folder)]
    assert set(CASES) <= set(report)
    for case in (ONE, ONE_OF_CLASS, *OFF_SIZE):
        assert set(report[case]) == {'constant velocity', 'follow'}
    assert report[ONE]['follow']['iou_found'] > report[ONE]['constant velocity']['iou_found']
    assert report[ONE]['follow']['found'] > 0.85
    assert report[ONE]['follow']['above_half'] > 0.97
    assert set(report[TWO]) == {'linear', 'spline', 'follow'}
    for case in KEYFRAMES:
        rows = report[case]
        assert set(rows) == {'linear', 'spline', 'all boxes', 'follow'}
        assert len({row['true'] for row in rows.values()}) == 1
    assert report['2 Hz']['follow']['iou_all'] > report['2 Hz']['linear']['iou_all'] + 0.01
    # Of 21 sweeps at 10 Hz all count, the keyframes too.
    assert report['2 Hz']['follow']['true'] == len(OBJECTS) * SWEEPS


def test_exact_keyframes_come_back(folder, capsys):
    assert main(['follow', str(folder), '--exact']) == 0
    (report,) = json.loads(capsys.readouterr().out).values()
    assert report['2 Hz']['follow']['iou_all'] > 0.985
