"""`boxreg check` and the consistency of `boxreg evaluate`, from the command line."""

from dataclasses import replace
import json
from pathlib import Path

from boxreg_ros.cli import main
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.io.covariance_table import (
    COVARIANCE_COLUMNS,
    covariance_lines,
    COVARIANCES,
    read_covariances,
)
from boxreg_ros.offline.consistency import _over, table
from boxreg_ros.structures import BoxArray, RefinedBoxes
import numpy as np
import pytest

BAGS = Path(__file__).parents[2] / 'bags'


def flipped_table(path):
    """Write labels of one track with one flipped heading."""
    boxes = np.tile([0.0, 0.0, 0.75, 4.5, 1.8, 1.5, 0.0, 0.0, 0.0], (10, 1))
    boxes[:, 0] = np.arange(10)
    boxes[5, 8] = np.pi
    arrays = [
        BoxArray(i * 10**8, 'odom', ('7',), ('car',), np.ones(1), boxes[i : i + 1])
        for i in range(10)
    ]
    BoxTable.from_arrays(arrays).write(path)


def test_check_prints_violations_and_fails_with_strict_only(tmp_path, capsys):
    path = tmp_path / 'boxes.csv'
    flipped_table(path)
    assert main(['check', str(path)]) == 0
    out = capsys.readouterr().out
    assert 'track 7 at 500000000: turns by 180 degrees' in out
    assert out.endswith('1 of 11 rules violated; errors: 1, warnings: 0\n')
    assert main(['check', str(path), '--strict', '--json']) == 1
    report = json.loads(capsys.readouterr().out)
    assert report['boxes'] == 10
    assert len(report['rules']['spin']['violations']) == 1
    assert report['rules']['jump']['violations'] == []
    labels = BoxTable.read(path)
    boxes = labels.boxes.copy()
    boxes[5:, 3] = 0
    replace(labels, boxes=boxes, track_ids=('', *labels.track_ids[1:])).write(path)
    assert main(['check', str(path)]) == 0  # boxes 1 to 4
    first, second, last = capsys.readouterr().out.splitlines()
    assert first.startswith('1 boxes are not checked: no track id')
    assert second.startswith('5 boxes are not checked: contains NaN or infinity, an extent')
    assert last == '1 tracks, 4 boxes: no rule violated'
    assert main(['check', str(path), '--strict', '--json']) == 1
    report = json.loads(capsys.readouterr().out)
    assert (report['boxes_without_id'], report['invalid_boxes']) == (1, 5)
    replace(labels, boxes=0 * boxes).write(path)
    assert main(['check', str(path)]) == 1
    assert 'expected valid boxes with a track id, got none: 10' in capsys.readouterr().err


def test_check_reads_recordings_and_refuses_unreadable_files(tmp_path, capsys):
    assert main(['check', str(BAGS / 'street.mcap')]) == 0
    assert 'spin' in capsys.readouterr().out
    assert main(['check', str(tmp_path / 'labels')]) == 2
    assert 'FORMAT:PATH' in capsys.readouterr().err


def refined_with(errors, deviation):
    """Return refined boxes of one stamp each, with an error along x, and their truth."""
    count = len(errors)
    truth = np.tile([0.0, 0.0, 0.75, 4.5, 1.8, 1.5, 0.0, 0.0, 0.0], (count, 1))
    boxes = truth.copy()
    boxes[:, 0] += errors
    names = tuple(map(str, range(count)))
    array = BoxArray(0, 'odom', names, ('car',) * count, np.ones(count), boxes)
    covariances = np.tile(deviation**2 * np.eye(6), (count, 1, 1))
    columns = ('refined',) * count, ('',) * count, np.ones(count, int), covariances
    refined = RefinedBoxes(array, *columns)
    true = BoxArray(0, 'odom', names, ('car',) * count, np.ones(count), truth)
    return refined, BoxTable.from_arrays([true])


def test_evaluate_prints_coverage_and_nees(tmp_path, capsys):
    refined, truth = refined_with(np.array([0.1, -0.1, 0.1, 0.5]), 0.1)
    truth.write(tmp_path / 'truth.csv')
    BoxTable.from_arrays([refined.boxes]).write(tmp_path / 'boxes.csv')
    lines = [','.join(COVARIANCE_COLUMNS) + '\n', *covariance_lines(refined, np.eye(4))]
    (tmp_path / COVARIANCES).write_text(''.join(lines))
    known = read_covariances(tmp_path / COVARIANCES)[0, '3']
    np.testing.assert_allclose(known.pose, 0.01 * np.eye(6))
    assert known.distance == pytest.approx(0.5)
    paths = [str(tmp_path / name) for name in ('boxes.csv', 'truth.csv')]
    assert main(['evaluate', *paths, '--json']) == 0
    found = json.loads(capsys.readouterr().out)['consistency']
    assert found['all']['coverage']['along'] == 0.75
    assert found['all']['nees']['along'] == pytest.approx((3 + 25) / 4)
    assert found['car']['boxes'] == found['0-20 m']['boxes'] == 4
    # Four tracks of one box each: the standard error of a mean of 1, 1, 1 and 25.
    assert found['all']['tracks'] == 4
    error = np.std([1, 1, 1, 25], ddof=1) / 2
    assert found['all']['nees_error']['along'] == pytest.approx(error)
    assert main(['evaluate', *paths]) == 0
    out = capsys.readouterr().out
    assert 'part of the errors within 2 sigma' in out
    title, columns, first = out.splitlines()[out.splitlines().index('') + 2 :][:3]
    assert title.split()[2:4] == ['along', 'across']
    assert columns.split() == ['cover', 'NEES'] * 7
    assert first.split()[3:5] == ['0.75', '7.00']


def test_nees_counts_tracks_and_marks_what_is_no_chance(tmp_path, capsys):
    # Two boxes of each of four tracks err alike: they count as four, not as eight.
    errors = np.repeat([2.0, 2.1, 1.9, 2.0], 2)
    tracks = np.repeat(np.array(list('abcd'), object), 2)
    squared = np.repeat(errors[:, None] ** 2, 7, axis=1)
    group = _over(squared, tracks, np.ones(8, bool))
    assert group.tracks == 4
    wide = table({'car': group._replace(nees=dict.fromkeys(group.nees, 171.33))})
    assert wide.count(' 171.33') == 7  # apart from the coverage
    error = np.std(errors[::2] ** 2, ddof=1) / 2
    assert group.nees_error['yaw'] == pytest.approx(error)
    assert group.is_off('yaw')
    assert not _over(squared / 4, tracks, np.ones(8, bool)).is_off('yaw')
    assert not _over(squared, np.array(['a'] * 8, object), np.ones(8, bool)).is_off('yaw')
