"""Scores of boxes with known errors."""

import argparse
import codecs
import csv
from dataclasses import replace
import json
import re

from boxreg_ros.errors import RecordingError
from boxreg_ros.io.box_table import BoxTable, COLUMNS
from boxreg_ros.io.stamp_join import joined_stamps
from boxreg_ros.labels import LabelFrame, Provenance, writer_for
from boxreg_ros.offline import evaluate as cli
from boxreg_ros.offline.box_scores import groups, has_word, match, summarise
from boxreg_ros.structures import BoxArray, KEPT, RefinedBoxes
from msg_adapters.convention import Convention
import numpy as np
import pytest

STEP = 100_000_000


def truth_table(count=10):
    """Return a car that moves at 5 m/s along x and a pedestrian at rest."""
    arrays = []
    for i in range(count):
        boxes = [[0.5 * i, 0, 1, 4, 2, 1.5, 0, 0, 0], [0, 9, 1, 0.6, 0.6, 1.8, 0, 0, 2]]
        arrays.append(
            BoxArray(
                i * STEP, 'odom', ('1', '2'), ('Car', 'pedestrian'), np.ones(2), np.array(boxes)
            )
        )
    table = BoxTable.from_arrays(arrays, 'truth')
    return replace(table, num_points=np.tile([200, 20], count))


def rows(table, keep):
    """Return a table with the rows `keep`, which are sorted, of another one."""
    return table.rows(np.isin(np.arange(len(table.scores)), keep))


def run(*words):
    """Run the subcommand; return its exit status."""
    parser = argparse.ArgumentParser()
    cli.add_arguments(parser)
    return cli.run(parser.parse_args([str(word) for word in words]))


def test_truth_has_perfect_scores():
    scores = summarise(match(truth_table(), truth_table()))
    assert scores.iou_bev == scores.iou_3d == pytest.approx(1, abs=1e-8)
    assert scores.recall_3d == scores.recall_bev == (1, 1, 1)
    assert (scores.boxes, scores.missing, scores.unmatched) == (20, 0, 0)
    assert scores.ate == scores.aoe == scores.flips == 0
    assert scores.jitter == pytest.approx(0, abs=1e-9)


def test_boxes_of_true_ones_out_of_scope_are_not_outside_of_the_image(monkeypatch, capsys):
    truth = truth_table()
    predicted = replace(truth, track_ids=('ghost', *truth.track_ids[1:]))
    matches = match(predicted, truth, min_points=100)  # without the pedestrian
    monkeypatch.setattr(cli, 'in_labelled_view', lambda *_: np.zeros(20, bool))
    is_outside = cli._out_of_view(argparse.Namespace(truth=None), predicted, matches)
    assert np.flatnonzero(is_outside).tolist() == matches.unmatched.tolist() == [0]
    assert '1 predicted boxes lie outside' in capsys.readouterr().err


def test_boxes_that_a_person_has_deleted_are_no_true_ones(tmp_path, capsys):
    reviewed = truth_table()
    status = ['rejected' if name == '2' else 'refined' for name in reviewed.track_ids]
    replace(reviewed, status=tuple(status)).write(tmp_path / 'boxes.csv')
    assert run(tmp_path, tmp_path / 'boxes.csv', '--json') == 0
    scores = json.loads(capsys.readouterr().out)
    assert (scores['boxes'], scores['missing'], scores['iou_3d']) == (10, 0, pytest.approx(1))
    assert scores['tracks']['recall'] == 1


def test_scores_of_known_errors():
    truth = truth_table()
    boxes = truth.boxes.copy()
    car = np.array(truth.class_names) == 'Car'
    boxes[car, 0] += 1.0  # overlap 3 m, union 5 m
    boxes[np.flatnonzero(car)[:3], 8] += np.pi
    scores = summarise(match(replace(truth, boxes=boxes), truth, classes=['car']))
    assert scores.boxes == 10
    assert scores.iou_bev == scores.iou_3d == pytest.approx(0.6, abs=1e-8)
    assert scores.recall_3d == (1, 0, 0)
    assert scores.ate == pytest.approx(1)
    assert scores.ase == pytest.approx(0, abs=1e-8)
    assert scores.flips == pytest.approx(0.3)
    assert scores.aoe == pytest.approx(0.3 * np.pi)
    assert scores.aoe_median == 0


def test_scale_error_of_doubled_length():
    truth = truth_table()
    boxes = truth.boxes.copy()
    boxes[:, 3] *= 2
    scores = summarise(match(replace(truth, boxes=boxes), truth))
    assert scores.ase == pytest.approx(0.5, abs=1e-8)
    assert scores.ate == 0


def test_jitter_is_the_second_difference():
    truth = truth_table(5)
    boxes = truth.boxes.copy()
    boxes[4, 1] += 0.1  # the car, at one stamp, 0.1 m to the side: 10, 20, 10 m/s^2
    boxes[4, 8] += 0.01
    matches = match(replace(truth, boxes=boxes), truth, classes=['car'])
    np.testing.assert_allclose(matches.jitter, [np.nan, 10, 20, 10, np.nan], atol=1e-9)
    np.testing.assert_allclose(matches.turn_jitter, [np.nan, 1, 2, 1, np.nan], atol=1e-9)
    np.testing.assert_allclose(matches.true_jitter, [np.nan, 0, 0, 0, np.nan], atol=1e-9)
    assert summarise(matches).jitter == pytest.approx(40 / 3)


def test_constant_velocity_has_no_jitter_at_uneven_steps():
    truth = rows(truth_table(30), np.flatnonzero(np.arange(60) % 2 == 0)[[0, 1, 3, 4, 20, 21]])
    matches = match(truth, truth)  # the last two steps are next to a gap
    np.testing.assert_allclose(matches.jitter, [np.nan, 0, 0, np.nan, np.nan, np.nan], atol=1e-9)


def test_missing_and_unmatched_boxes_are_counted():
    truth = truth_table()
    predicted = rows(truth, np.arange(2, 20))  # both boxes of the first stamp are missing
    predicted = replace(predicted, track_ids=('ghost', *predicted.track_ids[1:]))
    scores = summarise(match(predicted, truth))
    assert (scores.boxes, scores.missing, scores.unmatched) == (20, 3, 1)
    assert scores.iou_3d == pytest.approx(1, abs=1e-8)
    assert scores.recall_3d[2] == pytest.approx(17 / 20)
    broken = predicted.boxes.copy()
    broken[5] = np.nan
    assert summarise(match(replace(predicted, boxes=broken), truth)).missing == 4


def test_least_numbers_of_points_belong_to_what_they_begin():
    truth = replace(truth_table(3), num_points=np.array([99, 100, 101, 299, 300, 301]))
    assert match(truth, truth, 100).num_points.tolist() == [100, 101, 299, 300, 301]
    by_points = groups(match(truth, truth))['by_points']
    low, high = (next(k for k in by_points if k.startswith(f'{n}-')) for n in (100, 300))
    assert (by_points[low].boxes, by_points[high].boxes) == (3, 2)


def test_scope_by_points_and_class():
    truth = truth_table()
    assert summarise(match(truth, truth, min_points=100)).boxes == 10
    assert summarise(match(truth, truth, min_points=201)).boxes == 0
    assert np.isnan(summarise(match(truth, truth, min_points=201)).iou_3d)
    assert has_word('Medium-sized Truck', ['car', 'truck'])
    assert has_word('vehicle.car', ['Car'])
    assert not has_word('Cart', ['car'])
    grouped = groups(match(truth, truth))
    assert set(grouped['by_class']) == {'Car', 'pedestrian'}
    assert {name: scores.boxes for name, scores in grouped['by_points'].items()} == {
        '10-29': 10, '100-299': 10,
    }  # fmt: skip


def test_tables_that_cannot_be_compared_are_refused():
    truth = truth_table()
    with pytest.raises(
        RecordingError, match="expected the frame of the true boxes, 'odom', got 'map'"
    ):
        match(replace(truth, frame_id='map'), truth)
    with pytest.raises(RecordingError, match="got '1' 2 times at stamp 0"):
        match(truth, replace(truth, track_ids=('1',) * 20))
    arrays = [
        BoxArray(0, frame, ('1',), ('car',), np.ones(1), np.ones((1, 9))) for frame in ('a', 'b')
    ]
    with pytest.raises(RecordingError, match='one frame, got a, b'):
        BoxTable.from_arrays(arrays)


def test_table_survives_the_round_trip(tmp_path):
    truth = truth_table()
    boxes = truth.boxes + np.random.default_rng(0).normal(0, 0.3, truth.boxes.shape)
    boxes[:, :3] += 5e5
    table = replace(truth, boxes=boxes)
    table.write(tmp_path / 'boxes.csv')
    again = BoxTable.read(tmp_path / 'boxes.csv')
    np.testing.assert_allclose(again.boxes, boxes, atol=1e-8)
    assert again.track_ids == table.track_ids
    assert again.class_names == table.class_names
    assert again.stamps_ns.dtype == np.int64
    assert again.num_points.tolist() == table.num_points.tolist()
    assert (tmp_path / 'boxes.csv').read_text().splitlines()[0] == ','.join(COLUMNS)
    content = (tmp_path / 'boxes.csv').read_bytes()
    (tmp_path / 'boxes.csv').write_bytes(codecs.BOM_UTF8 + content)
    assert BoxTable.read(tmp_path / 'boxes.csv').track_ids == table.track_ids


@pytest.mark.parametrize(
    ('text', 'message'),
    [
        ('stamp_ns,x\n1,2\n', 'columns missing: frame_id'),
        ('', 'columns missing: stamp_ns'),
        (','.join(COLUMNS) + '\n' + ','.join(['1'] * 6 + ['far'] + ['1'] * 10),
         'line 2, column y: expected a number, got far'),
        (','.join(COLUMNS) + '\n1,odom,1\n', 'line 2, column num_points: .*got nothing'),
        (','.join(COLUMNS) + '\n' + '1,' * 16 + '1\n' + '1,' * 16 + '\n',
         'line 3, column num_points: expected a whole number, got nothing'),
        (','.join(COLUMNS) + '\n' + '9' * 25 + ',1' * 16,
         'line 2, column stamp_ns: expected a whole number of 64 bits .*, got 99999'),
        (','.join(COLUMNS) + '\n1.7E+18' + ',1' * 16,
         'expected a whole number .ns, which spreadsheets round., got 1.7E.18; correct the line'),
    ],
)  # fmt: skip
def test_malformed_table_is_refused(tmp_path, text, message):
    (tmp_path / 'boxes.csv').write_text(text)
    with pytest.raises(RecordingError, match=message):
        BoxTable.read(tmp_path / 'boxes.csv')


@pytest.mark.parametrize(('mark', 'encoding', 'found'), [
    (',', 'utf-16', 'cannot be read as CSV in UTF-8'),
    (';', 'utf-8-sig', r"in UTF-8 with commas, got 'stamp_ns;frame_id"),
    ('\t', 'utf-8', 'in UTF-8 with commas, got .stamp_ns'),
])  # fmt: skip
def test_other_exports_of_spreadsheets_are_refused(tmp_path, mark, encoding, found):
    path = tmp_path / 'boxes.csv'
    path.write_text(mark.join(COLUMNS) + '\n' + mark.join('1' * 17), encoding=encoding)
    with pytest.raises(RecordingError, match=found):
        BoxTable.read(path)


def test_absent_or_binary_table_is_refused(tmp_path):
    (tmp_path / 'binary.csv').write_bytes(bytes(range(256)))
    for name, reason in (('absent.csv', 'read: No such file'), ('binary.csv', 'read as CSV')):
        with pytest.raises(RecordingError, match=f'cannot be {reason}'):
            BoxTable.read(tmp_path / name)


def test_command_prints_scores(tmp_path, capsys):
    truth = truth_table()
    truth.write(tmp_path / 'truth.csv')
    rows(truth, np.arange(4, 20)).write(tmp_path / 'boxes.csv')
    assert run(tmp_path / 'boxes.csv', tmp_path / 'truth.csv', '--json') == 0
    report = json.loads(capsys.readouterr().out)
    assert report['boxes'] == 20
    assert report['missing'] == 4
    assert report['iou_3d'] == pytest.approx(1, abs=1e-6)
    assert report['by_class']['Car']['recall_3d'] == [0.8] * 3
    assert run(tmp_path, tmp_path / 'truth.csv', '--json') == 0, 'the folder of a run'
    assert json.loads(capsys.readouterr().out) == report
    words = ('--min-points', 100, '--classes', 'car,van', 'truck')
    assert run(tmp_path / 'boxes.csv', tmp_path / 'truth.csv', *words) == 0
    text = capsys.readouterr().out
    assert 'pedestrian' not in text
    assert '10 true boxes, 2 missing' in text
    with pytest.raises(RecordingError, match='expected true boxes in scope, got none of 20'):
        run(tmp_path / 'boxes.csv', tmp_path / 'truth.csv', '--classes', 'tank')
    rows(truth_table(), []).write(tmp_path / 'none.csv')
    with pytest.raises(RecordingError, match=r'got none of 0; .* the table has no boxes'):
        run(tmp_path / 'boxes.csv', tmp_path / 'none.csv')


def test_boxes_in_another_frame_are_left_out(tmp_path, capsys):
    truth = truth_table()
    truth.write(tmp_path / 'truth.csv')
    # As relabel writes boxes without a transform, here most of the drive.
    replace(rows(truth, np.arange(14)), frame_id='lidar').write(tmp_path / 'boxes.csv')
    rows(truth, np.arange(14, 20)).write(tmp_path / 'more.csv')
    with (tmp_path / 'boxes.csv').open('a') as file:
        file.writelines((tmp_path / 'more.csv').read_text().splitlines(keepends=True)[1:])
    assert run(tmp_path / 'boxes.csv', tmp_path / 'truth.csv') == 0
    printed = capsys.readouterr()
    assert '20 true boxes, 14 missing, 0 predictions' in printed.out
    assert "14 predicted boxes in frame 'lidar' are left out" in printed.err
    replace(truth, frame_id='map').write(tmp_path / 'truth.csv')
    with pytest.raises(
        RecordingError, match="expected the frame of the true boxes, 'map', got 'lidar'"
    ):
        run(tmp_path / 'boxes.csv', tmp_path / 'truth.csv')


def test_tables_without_a_common_stamp_are_explained(tmp_path, capsys):
    truth = truth_table()
    truth.write(tmp_path / 'truth.csv')
    replace(truth, stamps_ns=truth.stamps_ns + 10**12).write(tmp_path / 'boxes.csv')
    expected = (
        'got boxes of 1000.000 to 1000.900 s (1970-01-01), true boxes of 0.000 to 0.900 s '
        '(1970-01-01): another drive?'
    )
    with pytest.raises(RecordingError, match=re.escape(expected)):
        run(tmp_path / 'boxes.csv', tmp_path / 'truth.csv')
    replace(truth, stamps_ns=truth.stamps_ns + STEP // 5).write(tmp_path / 'boxes.csv')
    expected = (
        r'none of 10 stamps of the true boxes is one of the predicted ones, the nearest is 0.02'
    )
    with pytest.raises(RecordingError, match=expected):
        run(tmp_path / 'boxes.csv', tmp_path / 'truth.csv')


@pytest.mark.parametrize(
    ('unit', 'origin', 'largest'), [(1_000, 789, 0.789), (1_000_000, 456_789, 456.789)]
)
@pytest.mark.parametrize('rounded', [10, 5], ids=['all', 'partly'])
def test_stamps_that_other_programs_rounded_are_joined(
    tmp_path, capsys, unit, origin, largest, rounded
):
    truth = truth_table()
    exact = truth.stamps_ns + 1_700_000_000 * 10**9 + origin
    replace(truth, stamps_ns=exact).write(tmp_path / 'boxes.csv')
    cut = np.where(np.arange(20) // 2 < rounded, exact // unit * unit, exact)
    replace(truth, stamps_ns=cut).write(tmp_path / 'truth.csv')
    assert run(tmp_path / 'boxes.csv', tmp_path / 'truth.csv', '--json') == 0
    printed = capsys.readouterr()
    assert json.loads(printed.out)['recall_3d'] == [1.0, 1.0, 1.0]
    expected = (
        f'{rounded} of 10 stamps of the true boxes are up to {largest} us from those of the '
        f'predicted ones: joined with the nearest'
    )
    assert expected in printed.err


def test_a_stamp_is_joined_with_one_other_at_most():
    own = np.array([0, 700_000, 10**9, 2 * 10**9 + 1_000_001])
    found = joined_stamps(own, np.array([600_000, 2 * 10**9]))
    assert found.stamps_ns.tolist() == [0, 600_000, 10**9, 2 * 10**9 + 1_000_001]
    assert (found.num_common, found.num_moved, found.largest_offset_ns) == (1, 1, 100_000)


def test_other_stamps_on_both_sides_are_said(tmp_path, capsys):
    truth = truth_table()
    truth.write(tmp_path / 'truth.csv')
    shifted = truth.stamps_ns + np.where(np.arange(20) < 8, 0, STEP // 5)
    replace(truth, stamps_ns=shifted).write(tmp_path / 'boxes.csv')
    assert run(tmp_path / 'boxes.csv', tmp_path / 'truth.csv') == 0
    expected = '6 of 10 stamps of the true boxes have no predicted boxes, and 6 stamps of these'
    assert expected in capsys.readouterr().err


def test_boxes_between_the_stamps_of_sparse_truth_are_no_ghosts(tmp_path, capsys):
    """As keyframes at 2 Hz, and boxes of a result at each sweep."""
    truth = truth_table(22)
    truth.write(tmp_path / 'boxes.csv')
    at = truth.stamps_ns // STEP
    rows(truth, np.flatnonzero(np.isin(at, [5, 10, 15]))).write(tmp_path / 'truth.csv')
    assert run(tmp_path / 'boxes.csv', tmp_path / 'truth.csv', '--json') == 0
    printed = capsys.readouterr()
    report = json.loads(printed.out)
    assert '38 predicted boxes lie between the stamps of the true boxes' in printed.err
    assert report['unmatched'] == report['tracks']['ghosts'] == 0
    # A frame without true boxes has none.
    rows(truth, np.flatnonzero(at != 7)).write(tmp_path / 'truth.csv')
    assert run(tmp_path / 'boxes.csv', tmp_path / 'truth.csv', '--json') == 0
    printed = capsys.readouterr()
    assert json.loads(printed.out)['unmatched'] == 2
    assert 'between' not in printed.err


@pytest.mark.parametrize('labelled', [[4], [3, 4, 5, 6]])
def test_truth_of_a_part_of_the_drive_says_nothing_about_the_rest(tmp_path, capsys, labelled):
    truth = truth_table()
    at = truth.stamps_ns // STEP
    names = [
        name if stamp in labelled else 'dog'
        for name, stamp in zip(truth.class_names, at, strict=True)
    ]
    replace(truth, class_names=tuple(names)).write(tmp_path / 'boxes.csv')
    rows(truth, np.flatnonzero(np.isin(at, labelled))).write(tmp_path / 'truth.csv')
    assert run(tmp_path / 'boxes.csv', tmp_path / 'truth.csv', '--json') == 0
    printed = capsys.readouterr()
    report = json.loads(printed.out)
    assert report['unmatched'] == report['tracks']['ghosts'] == report['tracks']['misses'] == 0
    assert f'{20 - 2 * len(labelled)} predicted boxes lie' in printed.err
    assert 'before or after all of them' in printed.err
    assert 'dog' not in printed.err


def test_true_boxes_of_another_time_than_a_result_are_not_missing(tmp_path, capsys):
    """As of a result with --start and --end, or of one file of several."""
    truth = truth_table()
    truth.write(tmp_path / 'truth.csv')
    at = truth.stamps_ns // STEP
    # At stamp 4 nothing was detected, at 3 and 8 there are clouds alone.
    rows(truth, np.flatnonzero(np.isin(at, [5, 6, 7]))).write(tmp_path / 'boxes.csv')
    ranges = {'clouds': [3 * STEP, 8 * STEP], 'boxes': [5 * STEP, 7 * STEP]}
    summary = {'fingerprint': '', 'time_ranges': ranges}
    (tmp_path / 'summary.json').write_text(json.dumps(summary))
    assert run(tmp_path, tmp_path / 'truth.csv', '--json') == 0
    printed = capsys.readouterr()
    report = json.loads(printed.out)
    assert (report['boxes'], report['missing'], report['tracks']['misses']) == (12, 6, 6)
    assert '8 of 20 true boxes are not of the time of' in printed.err


def test_classes_that_the_truth_may_lack_are_said(tmp_path, capsys):
    """Where only cars were labelled, all other boxes lower the precision."""
    truth = truth_table()
    truth.write(tmp_path / 'boxes.csv')
    rows(truth, np.arange(0, 20, 2)).write(tmp_path / 'truth.csv')
    assert run(tmp_path / 'boxes.csv', tmp_path / 'truth.csv') == 0
    assert 'these classes has a true one: pedestrian 10; they count' in capsys.readouterr().err
    for words, ghosts in (('car', 0), ('car,pedestrian', 10)):
        chosen = '--classes', words, '--json'
        assert run(tmp_path / 'boxes.csv', tmp_path / 'truth.csv', *chosen) == 0
        report = json.loads(capsys.readouterr().out)
        assert report['unmatched'] == report['tracks']['ghosts'] == ghosts
    renamed = replace(truth, class_names=tuple(map(str.upper, truth.class_names)))
    renamed.write(tmp_path / 'truth.csv')
    assert run(tmp_path / 'boxes.csv', tmp_path / 'truth.csv') == 0
    assert 'a true one' not in capsys.readouterr().err


@pytest.mark.parametrize(
    'option',
    [('pose_reference', 'bottom'), ('size_order', 'wlh'), ('forward_axis', 'y-')],
)
def test_true_boxes_of_another_convention_are_named(tmp_path, capsys, option):
    truth = truth_table()
    truth.write(tmp_path / 'right.csv')
    raw = BoxArray(0, 'odom', truth.track_ids, truth.class_names, truth.scores, truth.boxes)
    name, value = option
    boxes = Convention(**{name: value}).from_centers(raw).boxes
    replace(truth, boxes=boxes).write(tmp_path / 'truth.csv')
    assert run(tmp_path / 'right.csv', tmp_path / 'truth.csv') == 0
    warning = capsys.readouterr().err
    assert f'with {name} {value}: their mean 3D IoU is then 1.000' in warning
    flag = f'--{name.replace("_", "-")} {value}'
    assert f'boxreg convert {tmp_path / "truth.csv"} -o OUT --from csv --to csv {flag}' in warning
    noise = np.array([0.3, 0.1, 0.1, 0.2, 0.1, 0, 0, 0, 0.1])
    boxes = truth.boxes + noise  # that of a detector is no convention
    replace(truth, boxes=boxes).write(tmp_path / 'truth.csv')
    assert run(tmp_path / 'right.csv', tmp_path / 'truth.csv') == 0
    assert 'mean 3D IoU is then' not in capsys.readouterr().err


def test_invalid_true_boxes_are_left_out_with_a_warning(tmp_path, capsys):
    truth = truth_table()
    boxes = truth.boxes.copy()
    boxes[3, 0], boxes[5, 4] = np.nan, 0
    broken = replace(truth, boxes=boxes)
    scores = summarise(match(truth, broken))
    assert (scores.boxes, scores.missing, scores.unmatched) == (18, 0, 0)
    assert scores.iou_3d == pytest.approx(1, abs=1e-8)
    truth.write(tmp_path / 'boxes.csv')
    broken.write(tmp_path / 'truth.csv')
    assert run(tmp_path / 'boxes.csv', tmp_path / 'truth.csv') == 0
    assert '2 of 20 true boxes are left out' in capsys.readouterr().err


def test_tables_with_invalid_predictions_only_are_explained(tmp_path, capsys):
    truth = truth_table()
    truth.write(tmp_path / 'truth.csv')
    boxes = truth.boxes.copy()
    boxes[:, 0] = np.inf
    replace(truth, boxes=boxes).write(tmp_path / 'boxes.csv')
    assert run(tmp_path / 'boxes.csv', tmp_path / 'truth.csv', '--classes', 'car') == 1
    printed = capsys.readouterr()
    assert 'all 20 predicted boxes are invalid' in printed.err
    assert '10 true boxes, 10 missing' in printed.out


def test_some_invalid_predictions_are_named(tmp_path, capsys):
    truth = truth_table()
    boxes = truth.boxes.copy()
    boxes[2, 3], boxes[4, 0] = -4, np.nan
    truth.write(tmp_path / 'truth.csv')
    replace(truth, boxes=boxes).write(tmp_path / 'predicted.csv')
    assert run(tmp_path / 'predicted.csv', tmp_path / 'truth.csv') == 0
    assert '2 of 20 predicted boxes find no true box: NaN, an extent' in capsys.readouterr().err


def test_predictions_of_one_id_at_a_stamp_are_named(tmp_path, capsys):
    truth = truth_table()
    truth.write(tmp_path / 'truth.csv')
    header, *lines = (tmp_path / 'truth.csv').read_text().splitlines(keepends=True)
    (tmp_path / 'predicted.csv').write_text(''.join([header, *lines, *lines]))
    assert run(tmp_path / 'predicted.csv', tmp_path / 'truth.csv') == 0
    assert '20 of 40 predicted boxes have the id of another one' in capsys.readouterr().err


def test_a_table_without_boxes_is_named(tmp_path, capsys):
    truth = truth_table()
    truth.write(tmp_path / 'truth.csv')
    rows(truth, []).write(tmp_path / 'predicted.csv')
    assert run(tmp_path / 'predicted.csv', tmp_path / 'truth.csv') == 1
    assert 'there are no predicted boxes' in capsys.readouterr().err


def test_no_cell_of_a_table_is_a_formula_and_every_text_is_read_back(tmp_path):
    ids = ('=1+1', '@x', '+a', '-b', '-1', "'=x", "'", 'a\rb', '\tq', 'a,"b"\nc', 'x' * 10**6)
    truth = truth_table()
    table = replace(rows(truth, np.arange(len(ids))), frame_id='=odom', track_ids=ids)
    table.write(tmp_path / 'boxes.csv')
    assert BoxTable.read(tmp_path / 'boxes.csv').track_ids == ids
    with (tmp_path / 'boxes.csv').open(newline='') as file:
        cells = [row['track_id'] for row in csv.DictReader(file)]
    assert cells[:8] == ["'=1+1", "'@x", "'+a", "'-b", '-1', "''=x", "''", 'a\rb']
    frame = LabelFrame(
        RefinedBoxes(
            BoxArray(5, '=odom', ids, ids, np.ones(len(ids)), table.boxes),
            (KEPT,) * len(ids), ('',) * len(ids), table.num_points,
            np.tile(np.eye(6), (len(ids), 1, 1)),
        ),
        '=odom', 'lidar',
    )  # fmt: skip
    writer = writer_for('csv', tmp_path, Provenance())
    writer.write(frame)
    writer.close()
    again = BoxTable.read(tmp_path / 'boxes.csv')
    assert (again.track_ids, again.class_names, again.frame_id) == (ids, ids, '=odom')
