"""The risk grows with the error to expect; the tables list it."""

import csv

from boxreg_ros.review.changes import Changes
from boxreg_ros.review.risk import assess
from boxreg_ros.review.tables import assessed, REVIEW_COLUMNS, write_tables
from boxreg_ros.structures import BoxArray, RefinedBoxes
import numpy as np
import pytest

CAR = [0.0, 0.0, 0.75, 4.5, 1.8, 1.5, 0.0, 0.0, 0.0]


def track_with(deviation=0.05, n=4, status='refined', boxes=None, **columns):
    """Return a track whose covariances are `deviation` [m, rad] squared times the identity."""
    changes = Changes('odom')
    for i in range(n):
        box = np.array([CAR]) if boxes is None else boxes[i : i + 1]
        array = BoxArray(i * 10**8, 'odom', ('1',), ('car',), np.ones(1), box)
        refined = RefinedBoxes(
            array,
            (status,),
            ('no_gain' if status == 'kept' else '',),
            np.array([50]),
            deviation**2 * np.eye(6)[None],
            extent_covariances=deviation**2 * np.eye(3)[None],
            **columns,
        )
        changes.add(array, refined)
    (track,) = changes.tracks()
    return track


def test_risk_is_the_expected_loss_of_overlap():
    # A shift by d along a car of 4.5 m costs 2 d / 4.5, and is its own risk.
    track = track_with(0.05)
    parts = assess(track).parts
    mean = 0.05 * np.sqrt(2 / np.pi)
    expected = mean * (1 + 4.5 / 1.8 + 4.5 / 1.5)
    np.testing.assert_allclose(parts['uncertain position'], expected)
    np.testing.assert_allclose(parts['uncertain size'], expected / 2)


@pytest.mark.parametrize(
    'worse',
    [
        {'deviation': 0.1},
        {'status': 'kept'},
        {'outside': np.array([0.6])},
        {'face_distances': np.full((1, 6), 0.2)},
    ],
)
def test_evidence_of_errors_raises_the_risk(worse):
    assert assess(track_with(**worse)).track > assess(track_with()).track + 0.05


def test_an_id_switch_raises_the_risk_and_steady_motion_does_not():
    driving = np.array([CAR] * 8)
    driving[:, 0] = np.arange(8)
    switched = driving.copy()
    switched[4:, 1] += 8
    assert assess(track_with(n=8, boxes=driving)).parts['id switch'].sum() == 0
    assert assess(track_with(n=8, boxes=switched)).parts['id switch'].all()


def test_tables_list_the_riskiest_track_first(tmp_path):
    rows = assessed([track_with(0.02), track_with(0.3), track_with(0.1)])
    write_tables(tmp_path, rows)
    with (tmp_path / 'tracks.csv').open() as file:
        header = next(csv.reader(file))
    assert header[:6] == ['track_id', 'class_name', 'boxes', 'refined', 'kept', 'risk_m']
    with (tmp_path / 'review.csv').open() as file:
        lines = list(csv.DictReader(file))
    assert tuple(lines[0]) == REVIEW_COLUMNS
    assert [line['rank'] for line in lines] == ['1', '2', '3']
    risks = [float(line['risk_m']) for line in lines]
    assert risks == sorted(risks, reverse=True)
    assert 'uncertain position' in lines[0]['reasons']


def test_no_tracks_give_empty_tables(tmp_path):
    write_tables(tmp_path, [])
    assert (tmp_path / 'review.csv').read_text() == ','.join(REVIEW_COLUMNS) + '\n'
