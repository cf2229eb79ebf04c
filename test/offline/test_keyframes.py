"""`boxreg follow` and `--keyframes`: boxes at every sweep from a few of a person."""

import csv
import json

from boxreg_ros.cli import main
from boxreg_ros.core.metrics import iou_3d
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.offline.completion import Arrivals
from boxreg_ros.structures import BoxArray, Sweep
import numpy as np
import pytest
from relabel_results import rows_in, rows_of

SWEEPS = 13


@pytest.fixture(scope='module')
def street(tmp_path_factory):
    """Return a folder with a recording, its truth, and keyframes at every fifth sweep."""
    folder = tmp_path_factory.mktemp('street')
    words = f'simulate -o {folder}/drive.mcap --truth {folder}/truth.csv --sweeps {SWEEPS}'
    assert main(words.split()) == 0
    rows = rows_in(folder / 'truth.csv')
    stamps = sorted({int(row['stamp_ns']) for row in rows})
    keys = [row for row in rows if int(row['stamp_ns']) in stamps[1:12:5]]
    write(folder / 'keys.csv', keys)
    write(folder / 'seeds.csv', [row for row in rows if int(row['stamp_ns']) == stamps[6]])
    off = dict(keys[0], track_id='nothing', y='300')
    late = dict(keys[0], track_id='late', stamp_ns=str(stamps[-1] + 10**10))
    write(folder / 'bad.csv', [*keys, off, late])
    return folder


def write(path, rows):
    with open(path, 'w', newline='') as file:
        table = csv.DictWriter(file, rows[0])
        table.writeheader()
        table.writerows(rows)


def scores(out, truth):
    """Return the IoU (n,) of all written boxes that the truth has."""
    found, true = BoxTable.read(out / 'boxes.csv'), BoxTable.read(truth)
    at = dict(zip(zip(true.track_ids, true.stamps_ns, strict=True), true.boxes, strict=True))
    keys = list(zip(found.track_ids, found.stamps_ns, strict=True))
    rows = [row for row, key in enumerate(keys) if key in at]
    return iou_3d(found.boxes[rows], np.array([at[keys[row]] for row in rows]))


def test_keyframes_get_a_box_at_every_sweep(street, tmp_path, capsys):
    out = tmp_path / 'out'
    words = [
        'relabel',
        f'{street}/drive.mcap',
        '--labels',
        f'csv:{street}/bad.csv',
        '-o',
        str(out),
    ]
    assert main([*words, '--keyframes', '--formats', 'csv,openlabel']) == 0
    printed = capsys.readouterr()
    assert f'boxes at 4 stamps before, {SWEEPS + 1} after' in printed.out
    assert "seeds of track 'nothing': expected 5 points in their boxes" in printed.err
    assert "track 'late'" in printed.err and 'the nearest is' in printed.err
    rows = rows_of(out)
    given = rows_in(street / 'keys.csv')
    for track_id in {row['track_id'] for row in given}:
        stamps = [int(row['stamp_ns']) for row in given if row['track_id'] == track_id]
        of_track = [row for row in rows if row['track_id'] == track_id]
        word = {int(row['stamp_ns']): row['status'] for row in of_track}
        assert all(word[stamp] in ('refined', 'kept') for stamp in stamps)
        between = [at for at in word if min(stamps) < at < max(stamps) and at not in stamps]
        assert all(word[at] == 'interpolated' for at in between)
        assert len(between) == 4 * (len(stamps) - 1) or len(stamps) < 3
        beyond = [at for at in word if not min(stamps) <= at <= max(stamps)]
        assert all(word[at] == 'extended' for at in beyond)
    assert scores(out, street / 'truth.csv').mean() > 0.9
    assert scores(out, street / 'keys.csv').mean() > 0.995
    summary = json.loads((out / 'summary.json').read_text())
    ends = {seed['track_id']: seed for seed in summary['seeds']}
    assert ends['nothing']['after']['reason'] == 'few_points'
    assert summary['sweeps_with_boxes'] == {'before': 4, 'after': SWEEPS + 1}


def test_bad_keyframes_are_named_in_one_line_each_and_the_rest_is_done(street, tmp_path, capsys):
    rows = rows_in(street / 'truth.csv')
    stamps = sorted({int(row['stamp_ns']) for row in rows})
    at = {(row['track_id'], stamps.index(int(row['stamp_ns']))): row for row in rows}

    def key(of, step, name, **changes):
        return at[of, step] | {'track_id': name} | {k: str(v) for k, v in changes.items()}

    y = float(at['4', 6]['y'])
    write(
        tmp_path / 'bad.csv',
        [
            at['4', 1], at['4', 11],
            key('9', 1, '9', stamp_ns=stamps[1] + 30_000_000), at['9', 11],  # a near stamp
            key('4', 6, 'between', stamp_ns=stamps[6] + 10**12),
            key('11', 1, 'twice'), key('11', 1, 'twice', z=3), key('11', 11, 'twice'),
            key('16', 1, 'jumps'), key('16', 6, 'jumps', y=y + 90),
            key('4', 6, 'road', y=y + 3.3),
            key('4', 6, 'elsewhere', frame_id='nowhere'),
            key('17', 3, 'outer'), key('17', 3, 'inner', length=1.5),
            at['10', 6],  # a single one
        ],
    )  # fmt: skip
    out = tmp_path / 'out'
    words = ['relabel', f'{street}/drive.mcap', '--labels', f'csv:{tmp_path}/bad.csv']
    assert main([*words, '--keyframes', '-o', str(out), '--formats', 'csv']) == 0
    printed = capsys.readouterr().err.splitlines()
    assert len([line for line in printed if 'transform' in line and 'nowhere' in line]) == 1
    summary = json.loads((out / 'summary.json').read_text())
    problems = {seed['track_id']: seed['problems'] for seed in summary['seeds']}
    named = {
        'between': 'the nearest is 999',
        'twice': 'expected one box at a stamp; the first is used',
        'jumps': 'too far apart',
        'road': 'expected 5 points in their boxes',
    }
    for name, words in named.items():
        assert [line for line in problems[name] if words in line], (name, problems[name])
    assert [line for line in problems['inner'] if 'one is inside that of track' in line]
    lines = [line for of_track in problems.values() for line in of_track]
    assert all('\n' not in line for line in lines)
    assert sum(line.removeprefix('boxreg: ') in lines for line in printed) == min(len(lines), 5)
    found = {name: set() for name in ('4', '9', '10', 'twice')}
    for row in rows_of(out):
        found.get(row['track_id'], set()).add(int(row['stamp_ns']))
    assert set(stamps[1:12]) <= found['4'] and set(stamps[1:12]) <= found['twice']
    assert set(stamps[2:12]) <= found['9'] and stamps[1] + 30_000_000 in found['9']
    assert not problems['4'] and not problems['9'] and not problems['10']
    assert len(found['10']) > 10


def test_keyframes_of_a_vehicle_that_are_turned_around_are_named(street, tmp_path, capsys):
    keys = rows_in(street / 'keys.csv')
    stamps = sorted({row['stamp_ns'] for row in keys})
    for row in keys:
        if row['track_id'] in ('9', '6') and row['stamp_ns'] == stamps[1]:  # a car, a cyclist
            row |= {'qz': row['qw'], 'qw': str(-float(row['qz']))}
    write(tmp_path / 'turned.csv', keys)
    words = f'relabel {street}/drive.mcap --keyframes --labels csv:{tmp_path}/turned.csv'
    assert main([*words.split(), '-o', f'{tmp_path}/out']) == 0
    lines = [line for line in capsys.readouterr().err.splitlines() if 'expected headings' in line]
    assert [line.split(': ')[1] for line in lines] == [
        f"seeds of track '9' at {stamps[k]} and {stamps[k + 1]}" for k in range(2)
    ]


def test_a_second_box_of_an_exact_keyframe_is_written_as_it_is(street, tmp_path):
    keys = rows_in(street / 'keys.csv')
    second = dict(keys[0], x=str(float(keys[0]['x']) + 3))
    write(tmp_path / 'twice.csv', [*keys, second])
    words = f'relabel {street}/drive.mcap --keyframes --labels csv:{tmp_path}/twice.csv'
    assert main([*words.split(), '-o', f'{tmp_path}/out']) == 0
    kept = [row for row in rows_of(tmp_path / 'out') if row['status'] == 'kept']
    assert [row['track_id'] for row in kept] == [second['track_id']]
    assert abs(float(kept[0]['x']) - float(second['x'])) < 1e-9


def test_what_a_person_has_corrected_stays_as_it_is(street, tmp_path):
    truth = rows_in(street / 'truth.csv')
    seeds = [row for row in truth if row['stamp_ns'] == truth[0]['stamp_ns']]
    drawn = max(seeds, key=lambda row: int(row['num_points']))
    drawn |= {'status': 'human', 'width': str(float(drawn['width']) + 0.8)}
    write(tmp_path / 'drawn.csv', seeds)
    words = f'relabel {street}/drive.mcap --keyframes --labels csv:{tmp_path}/drawn.csv'
    assert main([*words.split(), '-o', f'{tmp_path}/out']) == 0
    found = [row for row in rows_of(tmp_path / 'out') if row['track_id'] == drawn['track_id']]
    for name in ('x', 'y', 'z', 'length', 'width', 'height'):
        assert abs(float(found[0][name]) - float(drawn[name])) < 1e-9
    assert [row['status'] for row in found] == ['human', *['extended'] * (SWEEPS - 1)]
    wider = [float(row['width']) - float(drawn['width']) for row in found]
    assert np.abs(wider).max() < 0.05


def test_one_box_of_each_object_is_followed(street, tmp_path, capsys):
    out = tmp_path / 'out'
    words = ['follow', f'{street}/drive.mcap', f'{street}/seeds.csv', '-o', str(out)]
    assert main([*words, '--formats', 'csv']) == 0
    assert 'associate' not in capsys.readouterr().err  # one box is no fault of an id
    iou = scores(out, street / 'truth.csv')
    true = [row for row in rows_in(street / 'truth.csv') if int(row['num_points']) >= 30]
    assert len(iou) > 0.7 * len(true)
    assert (iou > 0.5).mean() > 0.97
    assert main(['follow', f'{street}/drive.mcap', '-o', str(out)]) == 2
    # Seeds beside the stamp of a sweep do not take its place.
    seeds = rows_in(street / 'seeds.csv')
    beside = [dict(row, stamp_ns=str(int(row['stamp_ns']) + 30_000_000)) for row in seeds]
    write(tmp_path / 'beside.csv', beside)
    words = ['follow', f'{street}/drive.mcap', f'{tmp_path}/beside.csv', '--formats', 'csv']
    assert main([*words, '-o', str(tmp_path / 'beside')]) == 0
    keys, own = (
        {(row['track_id'], int(row['stamp_ns'])) for row in rows}
        for rows in (rows_of(out), beside)
    )
    more = rows_of(tmp_path / 'beside')
    assert {(row['track_id'], int(row['stamp_ns'])) for row in more} == keys | own
    assert scores(tmp_path / 'beside', street / 'truth.csv').mean() > 0.9


def test_a_seed_in_an_unknown_frame_is_said(street, tmp_path, capsys):
    seeds = tmp_path / 'seeds.csv'
    rows = (street / 'seeds.csv').read_text().splitlines()[:2]
    seeds.write_text('\n'.join(rows).replace(',odom,', ',nowhere,') + '\n')
    out = str(tmp_path / 'out')
    assert main(['follow', f'{street}/drive.mcap', str(seeds), '--formats', 'csv', '-o', out]) == 1
    lines = capsys.readouterr().err
    assert "no transform from 'nowhere' to 'odom'" in lines
    assert '--keyframes' not in lines
    assert '1 boxes and 0 clouds have no transform' in lines
    seeds.write_text(seeds.read_text().replace(',truth,', ',human,'))
    main(['follow', f'{street}/drive.mcap', str(seeds), '--formats', 'csv', '-o', out])
    assert 'boxes of a person have no transform' in capsys.readouterr().err


def test_few_boxes_are_said_and_completed(street, tmp_path, capsys):
    words = ['relabel', f'{street}/drive.mcap', '--labels', f'csv:{street}/keys.csv']
    words += ['--formats', 'csv', '-o', str(tmp_path / 'out')]
    assert main(words) == 0
    assert 'for a box at every cloud use --keyframes' in capsys.readouterr().err
    assert main([*words, '--complete']) == 0
    assert 'stamps before, 11 after' in capsys.readouterr().out
    assert main([*words, '--complete', '--keyframes']) == 2


def test_empty_arrays_stand_between_late_ones():
    part = Arrivals()
    for item in (0, 10, 20, BoxArray.empty(0, 'odom'), 30, BoxArray.empty(30, 'odom'), 40):
        is_sweep = isinstance(item, int)
        part.add(Sweep(item, 'odom', np.zeros((0, 3))) if is_sweep else item)
    assert part.missing_ns() == [10, 20, 40]
    assert [array.stamp_ns for array in part.completed('odom')] == [0, 10, 20, 30, 40]
