"""`relabel --proposals`: objects that no box covers, and the way from there to their tracks."""

import csv
import json

from boxreg_ros.cli import main
from boxreg_ros.core.metrics import iou_3d
from boxreg_ros.io.box_table import BoxTable
import numpy as np

SWEEPS = 14
LEFT_OUT = ('4', '9')
"""A car that drives past, and one that is parked."""


def rows_of(path):
    with open(path, newline='', encoding='utf-8') as file:
        return list(csv.DictReader(file))


def write(path, rows):
    with open(path, 'w', newline='', encoding='utf-8') as file:
        table = csv.DictWriter(file, rows[0])
        table.writeheader()
        table.writerows(rows)


def best_iou(box, stamp_ns, truth):
    """Return the largest IoU of a box with true ones, and the track of that."""
    rows = np.flatnonzero(truth.stamps_ns == stamp_ns)
    iou = iou_3d(np.tile(box, (len(rows), 1)), truth.boxes[rows])
    return iou.max(), truth.track_ids[rows[iou.argmax()]]


def test_what_is_left_out_is_proposed_and_followed_once_accepted(tmp_path, capsys):
    drive, true_path = tmp_path / 'drive.mcap', tmp_path / 'truth.csv'
    assert main(f'simulate -o {drive} --truth {true_path} --sweeps {SWEEPS}'.split()) == 0
    rows = rows_of(true_path)
    write(tmp_path / 'known.csv', [row for row in rows if row['track_id'] not in LEFT_OUT])
    out = tmp_path / 'out'
    words = ['relabel', str(drive), '--labels', f'csv:{tmp_path}/known.csv', '-o', str(out)]
    assert main([*words, '--proposals', '--report', '--formats', 'csv']) == 0

    truth = BoxTable.read(true_path)
    proposals = BoxTable.read(out / 'proposals.csv')
    found = [
        best_iou(box, stamp_ns, truth)
        for box, stamp_ns in zip(proposals.boxes, proposals.stamps_ns, strict=True)
    ]
    assert {name for _, name in found} == set(LEFT_OUT), 'all of these, and nothing else'
    assert min(iou for iou, _ in found) > 0.4
    assert set(proposals.status) == {'proposed'}
    names = list(proposals.track_ids)
    assert [row['track_id'] for row in rows_of(out / 'review.csv')][-len(names) :] == names
    assert 'no box; ' in rows_of(out / 'review.csv')[-1]['reasons']
    summary = json.loads((out / 'summary.json').read_text())
    assert [one['track_id'] for one in summary['proposals']] == names
    assert 'Objects without boxes' in (out / 'report.html').read_text()
    assert not set(names) & {row['track_id'] for row in rows_of(out / 'boxes.csv')}

    none = tmp_path / 'none.csv'
    none.write_text((out / 'proposals.csv').read_text().splitlines()[0] + '\n')
    assert main(['follow', str(drive), str(none)]) == 2
    text = f'{none}: expected boxes to follow, got a table of none; add a box'
    assert text in capsys.readouterr().err
    words = ['follow', str(drive), str(out / 'proposals.csv'), '-o', str(tmp_path / 'followed')]
    assert main([*words, '--formats', 'csv']) == 2
    assert 'write accepted in place of proposed' in capsys.readouterr().err
    rows = rows_of(out / 'proposals.csv')
    moving = next(i for i, (_, name) in enumerate(found) if name == LEFT_OUT[0])
    rows[moving]['status'] = 'accepted'
    write(out / 'proposals.csv', rows)
    assert main([*words, '--formats', 'csv']) == 0
    assert f'{len(rows) - 1} of {len(rows)} boxes are proposals' in capsys.readouterr().err
    track = BoxTable.read(tmp_path / 'followed' / 'boxes.csv')
    assert set(track.track_ids) == {names[moving]}
    iou = [best_iou(*one, truth) for one in zip(track.boxes, track.stamps_ns, strict=True)]
    assert len(iou) >= SWEEPS - 1
    assert np.mean([value for value, name in iou if name == LEFT_OUT[0]]) > 0.5
