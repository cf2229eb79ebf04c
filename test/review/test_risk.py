"""The risk grows with the error to expect; the tables list it."""

import csv
from dataclasses import replace

from boxreg_ros.review.changes import Changes
from boxreg_ros.review.risk import assess, MIN_COMPARED, parts_of, risks_of_box, Usual
from boxreg_ros.review.tables import assessed, REVIEW_COLUMNS, write_tables
from boxreg_ros.structures import BoxArray, RefinedBoxes
import numpy as np
import pytest

CAR = [0.0, 0.0, 0.75, 4.5, 1.8, 1.5, 0.0, 0.0, 0.0]


def boxes_of(size, n=4):
    """Return boxes of a car of `size` times the usual extents."""
    boxes = np.array([CAR] * n)
    boxes[:, 3:6] *= size
    return boxes


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
    # A face that is off by d costs d / L, and 4.5 / 2 turns a loss into a shift of a car. Errors
    # of a face are those of the centre and half the extent: .05 m and .025 m. Of a pair of faces
    # one has them all: twice the variance of one.
    track = track_with(0.05)
    mean = np.hypot(0.05, 0.025) * np.sqrt(2 / np.pi)
    parts = parts_of(track)
    for faces, across in (('ends', 4.5), ('sides', 1.8), ('top and bottom', 1.5)):
        expected = np.sqrt(2) * mean / across * 4.5 / 2
        np.testing.assert_allclose(parts[f'uncertain {faces}'], expected)


def test_estimates_that_disagree_beyond_their_deviations_raise_the_risk():
    # Boxes of a length of 4.5 m that are .5 m apart share 4 of 5 m.
    array = BoxArray(0, 'odom', ('1',), ('car',), np.ones(1), np.array([CAR]))
    early = BoxArray(0, 'odom', ('1',), ('car',), np.ones(1), np.array([CAR]))
    early.boxes[0, 0] += 0.5
    parts = []
    for deviation in (1e-6, 0.3):
        changes = Changes('odom')
        columns = ('refined',), ('',), np.array([50]), deviation**2 * np.eye(6)[None]
        spread = {'extent_covariances': 1e-12 * np.eye(3)[None]}
        refined, before = (RefinedBoxes(boxes, *columns, **spread) for boxes in (array, early))
        changes.add(array, refined, before)
        (track,) = changes.tracks()
        parts.append(parts_of(track)['estimates disagree'])
    np.testing.assert_allclose(parts[0], (1 - 4 / 5) * 4.5 / 2, rtol=1e-3)
    assert parts[1] == 0  # the deviations explain it


def test_a_face_far_off_its_points_costs_its_distance():
    # .33 m beyond the .03 m of a car's surface is certain: the loss is .3 / 1.8, less what the
    # deviation of the face costs anyway.
    distances = np.array([[0.0, 0.0, 0.33, 0.0, 0.0, 0.0]])
    parts = parts_of(track_with(0.001, face_distances=distances))
    noise = np.hypot(0.001, 0.0005) * np.sqrt(2 / np.pi)
    np.testing.assert_allclose(
        parts['sides off their points'], (0.3 - noise) / 1.8 * 4.5 / 2, rtol=1e-6
    )


def test_extents_unlike_those_of_the_class_raise_the_risk():
    cars = [track_with(boxes=boxes_of(size)) for size in np.linspace(0.95, 1.05, MIN_COMPARED)]
    usual = Usual.of(cars)
    reason = 'size unlike its class'
    assert parts_of(cars[0], usual)[reason].sum() == 0
    assert parts_of(track_with(boxes=boxes_of(1.3)), usual)[reason].min() > 0.3
    assert Usual.of(cars[1:]).sizes == {}  # too few tracks


def near(inside, outside):
    """Return the near points of one box."""
    return {'near_points': np.array([[inside, outside]])}


def test_points_outside_count_beyond_what_is_usual_and_by_their_number():
    reason = 'points left outside'
    track = track_with(1e-6, **near(70, 30))  # 4 boxes
    of_track = (120 + 10 * 0.1) / (400 + 10)
    part = (30 + 10 * of_track) / (100 + 10)
    fill = np.prod(np.array(CAR[3:6]) / (np.array(CAR[3:6]) + 1.2)) / 0.34
    shift = (part - 0.1) * fill
    loss = parts_of(track)[reason] / (4.5 / 2)
    np.testing.assert_allclose(loss, 2 * shift / (1 + shift), atol=1e-5)
    assert parts_of(track, Usual(outside=0.3))[reason].sum() == 0


def test_a_box_off_its_object_is_found_by_the_few_points_of_all_its_boxes():
    # One point of a parked car, outside of its box at each of 70 stamps.
    reason = 'points left outside'
    assert parts_of(track_with(n=70, **near(0, 1)))[reason].min() > 1.0
    assert parts_of(track_with(n=1, **near(0, 1)))[reason].max() < 0.3
    assert parts_of(track_with(n=70, **near(0, 0)))[reason].max() == 0.0


def test_points_outside_that_other_reasons_explain_count_once():
    distances = np.full((1, 6), 0.4)
    off = assess(track_with(face_distances=distances)).track
    both = assess(track_with(face_distances=distances, **near(90, 30)))
    assert both.track == pytest.approx(off)


@pytest.mark.parametrize(
    'worse',
    [
        {'deviation': 0.1},
        {'status': 'kept'},
        near(20, 30),
        {'face_distances': np.full((1, 6), 0.2)},
    ],
)
def test_evidence_of_errors_raises_the_risk(worse):
    assert assess(track_with(**worse)).track > assess(track_with()).track + 0.05


def test_an_id_switch_raises_the_risk_and_steady_motion_does_not():
    driving = np.array([CAR] * 8)
    driving[:, 0] = np.arange(8)
    assert parts_of(track_with(n=8, boxes=driving))['id switch'].sum() == 0
    for across in (2.8, 8.0):  # a car in the next lane, and further
        switched = driving.copy()
        switched[4:, 1] += across
        assert parts_of(track_with(n=8, boxes=switched))['id switch'].all()
    switched, beside = driving.copy(), driving.copy()
    switched[4:, 1] += 3.5
    beside[:4, 1] += 3.5
    other = replace(track_with(n=8, boxes=beside), track_id='2', input_ids=('2',) * 8)
    rows = assessed([track_with(n=8, boxes=switched), other])
    assert all('1 and 2 changed places at 400000000' in row.reasons for row in rows)
    assert 'changed places' not in assessed([track_with(n=8, boxes=driving)])[0].reasons


def test_added_boxes_have_the_risk_of_the_others_of_their_track():
    changes = Changes('odom')
    for i, status in enumerate(('refined', 'interpolated', 'refined', 'extended')):
        array = BoxArray(i * 10**8, 'odom', ('1',), ('car',), np.ones(1), np.array([CAR]))
        variance = (0.02 * (i + 1)) ** 2
        covariances = variance * np.eye(6)[None]
        spread = {'extent_covariances': variance * np.eye(3)[None]}
        columns = (status,), ('',), np.array([50]), covariances
        changes.add(array, RefinedBoxes(array, *columns, **spread))
    (track,) = changes.tracks()
    risk = assess(track)
    assert risk.boxes[0] < risk.boxes[2]
    np.testing.assert_allclose(risk.boxes[[1, 3]], risk.boxes[[0, 2]].mean())
    assert risk.track == pytest.approx(risk.boxes[[0, 2]].mean())


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
    assert 'uncertain heading' in lines[0]['reasons']


def test_the_first_reason_is_what_other_tracks_do_not_have():
    # All tracks are as uncertain; the points of one are off its left side as well.
    tracks = [track_with(0.3) for _ in range(MIN_COMPARED)]
    distances = np.array([[0.0, 0.0, 0.5, 0.0, 0.0, 0.0]])
    tracks.append(track_with(0.3, face_distances=distances))
    reasons = [row.reasons for row in assessed(tracks)]
    assert reasons[0].startswith('sides off their points')
    assert all(text.startswith('uncertain') for text in reasons[1:])


def test_no_tracks_give_empty_tables(tmp_path):
    write_tables(tmp_path, [])
    assert (tmp_path / 'review.csv').read_text() == ','.join(REVIEW_COLUMNS) + '\n'


def test_a_box_that_is_dragged_has_the_risk_of_its_place():
    size = np.array(CAR[3:6])
    track = track_with(**near(50, 0))
    rng = np.random.default_rng(5)
    sides = rng.uniform(-0.5, 0.5, (200, 3)) * size
    sides[:100, 0] = -size[0] / 2
    sides[100:, 1] = -size[1] / 2
    counts = [len(sides)] * 4
    part = {name: getattr(track, name).tolist() for name in (
        'given', 'boxes', 'change', 'deviations', 'extent_deviations', 'disagreement', 'status',
        'reasons', 'num_points',
    )} | {
        'stamps': [str(stamp) for stamp in track.stamps_ns], 'flipped': track.is_flipped.tolist(),
        'faces': track.face_distances.tolist(), 'near': track.near_points.tolist(),
        'usual': [0.1, None], 'counts': counts,
    }  # fmt: skip
    box = track.boxes[1]
    points = sides + box[:3]
    same = risks_of_box(part, 1, box, track.class_name, points)
    assert same[0] == pytest.approx(same[1])
    assert same[0] == pytest.approx(assess(track, Usual(0.1)).boxes[1])
    risks = []
    for off in (0.1, 0.3, 0.6):  # off the face that the points show
        moved = box - np.eye(9)[0] * off
        risks.append(risks_of_box(part, 1, moved, track.class_name, points)[1])
    assert same[0] < risks[0] < risks[1] < risks[2]
    assert risks[2] - same[0] == pytest.approx(0.5, abs=0.4)  # about the distance of a car
