"""`boxreg bench follow` end to end on a small scene."""

import argparse
import json

from boxreg_ros.bench import main as bench
from boxreg_ros.bench.follow import CASES, KEYFRAMES, OFF_SIZE, ONE, ONE_OF_CLASS, TWO
from boxreg_ros.simulation.simulate import simulate
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


def run(*words):
    parser = argparse.ArgumentParser()
    bench.add_arguments(parser)
    return bench.run(parser.parse_args([str(word) for word in words]))


def test_follow_is_scored_beside_lines_and_constant_velocity(folder, capsys):
    assert run('follow', folder, '--json') == 0
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
    assert run('follow', folder, '--exact') == 0
    lines = capsys.readouterr().out.splitlines()
    assert 'true boxes' in lines[0]
    after = lines[lines.index(next(line for line in lines if line.startswith('2 Hz'))) :]
    follow = next(line for line in after if 'follow' in line).split()
    assert float(follow[-1]) > 0.985
