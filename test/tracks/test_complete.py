"""The steps together: from a broken drive to whole tracks, through files."""

from collections import Counter
from dataclasses import replace
import json
import re

from boxreg_ros import cli
from boxreg_ros.config import COMPLETE_STEPS, Config, KINDS
from boxreg_ros.core.input_statistics import drive_of, KindStatistics, NOISE, TRACK
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.labels import frames_of
from boxreg_ros.offline.completion import first_pass, points_above_road
from boxreg_ros.offline.relabel import relabel, Request
from boxreg_ros.offline.track_scores import track_scores
from boxreg_ros.simulation.simulate import simulate
from boxreg_ros.structures import ADDED, Sweep
from boxreg_ros.tracks.decided import NOTHING, Nothing
from drives import ALL_STEPS, complete, drive, only, path, STEP_NS, steps_of
from measure.drives import Drive
from measure.tracks import broken, completed, table_of
import numpy as np
import pytest
from relabel_results import rows_in, rows_of
from ros_messages import Drive as Recorded

FORMATS = ('csv', 'openlabel', 'tracklets', 'nuscenes', 'sustechpoints', 'xtreme1')


@pytest.fixture(scope='module')
def street():
    """Return a broken street with ghosts, its result with all steps, and the steps by track."""
    whole = Drive.from_scene(simulate('street', seed=4, sweeps=40))
    found = broken(whole, seed=4, ghosts=1.5)
    items = sorted([*found.sweeps, *found.boxes], key=lambda item: item.stamp_ns)
    config = Config().updated({f'complete.{step}': True for step in COMPLETE_STEPS})
    results, tracks = completed(items, 'odom', config)
    return found, results, tracks


def test_broken_street_becomes_whole(street):
    found, results, _ = street
    # Boxes with fewer than five returns may have no detection at all in the simulation.
    scope = np.flatnonzero(found.truth.num_points >= 5)
    before = track_scores(BoxTable.from_arrays(found.boxes), found.truth, scope)
    after = track_scores(table_of(results), found.truth, scope)
    assert before.recall < 0.85
    assert after.recall > 0.97
    assert after.precision > 0.97
    assert before.ids_per_object > 1.2
    assert after.ids_per_object < 1.05
    assert after.added > 80
    assert after.added_iou > 0.82


def test_the_first_pass_begins_with_what_other_drives_have_shown():
    # Fifty cars of another drive, whose labels are 0.1 m larger on every side than their points.
    tracks = np.zeros(50, TRACK)
    tracks['sums'][:, 0] = np.array([0.4, 4.0, 4.0])[:, None]
    tracks['evidence'][:, 0] = np.log([4.0, 2.0, 1.5])
    of_kinds = [
        KindStatistics(tracks[:n], np.zeros((), NOISE)) for n in (50, *[0] * len(KINDS[1:]))
    ]
    cars = path((12.0, 4.0), (3.0, 0.0), 12)
    items = [(item, False) for item in drive([[c] for c in cars], [[('a', c)] for c in cars])]
    config, boxes = only(), []
    for drives in (None, drive_of(of_kinds, 'other')):
        ((*_, last),) = first_pass(items, config, drives=drives).results
        boxes.append(last.boxes.boxes[0])
    assert (boxes[1][3:6] > boxes[0][3:6] + 0.02).any()


def test_ghosts_of_the_street_are_rejected_and_objects_are_kept(street):
    found, results, _ = street
    ghosts = Counter()
    objects = Counter()
    for array, result in zip(found.boxes, results, strict=True):
        for row, name in enumerate(array.track_ids):
            (ghosts if name.startswith('ghost') else objects)[result.status[row]] += 1
    assert ghosts['rejected'] >= 0.9 * ghosts.total() > 25
    assert objects['rejected'] * 300 <= objects.total()


def test_boxes_of_complete_tracks_keep_their_evidence(street):
    # Identity matrices, 1 m^2, stand for unknown covariances.
    _, results, _ = street
    refined = [
        (result, row)
        for result in results
        for row, status in enumerate(result.status)
        if status == 'refined'
    ]
    lengths = np.array([result.extent_covariances[row][0, 0] for result, row in refined])
    assert (lengths < 0.5).mean() > 0.99
    assert all(
        np.array_equal(result.extent_covariances[row], np.eye(3))
        for result in results
        for row, status in enumerate(result.status)
        if status == 'rejected'
    )
    assert any(result.face_distances[row].any() for result, row in refined)


def test_all_boxes_of_the_street_are_returned(street):
    found, results, tracks = street
    assert len(results) == len(found.boxes)
    for given, result in zip(found.boxes, results, strict=True):
        n = len(given.track_ids)
        assert result.boxes.stamp_ns == given.stamp_ns
        assert not set(result.status[:n]) & set(ADDED)
        assert set(result.status[n:]) <= set(ADDED)
        assert np.isfinite(result.boxes.boxes).all()
        assert np.isfinite(result.covariances).all()
        is_rejected = np.array([status == 'rejected' for status in result.status[:n]], bool)
        np.testing.assert_array_equal(
            result.boxes.boxes[:n][is_rejected], given.boxes[is_rejected]
        )
    status = Counter(word for result in results for word in result.status)
    assert sum(track.filled for track in tracks) == status['interpolated']
    assert sum(track.extended for track in tracks) == status['extended']
    assert sum(track.rejected for track in tracks) == status['rejected']


def test_filled_boxes_are_registered_to_their_points():
    # The car brakes in the gap, against the motion model; the boxes follow its points.
    boxes = path((5, 6), (8, 0), 30)
    seconds = np.arange(30) * 0.1
    speed = 8 - 4 * np.clip(seconds - 0.9, 0, 1.0)
    boxes[:, 0] = 5 + np.cumsum(speed) * 0.1
    truth = [[box] for box in boxes]
    given = [[('a', box)] if k < 10 or k >= 20 else [] for k, box in enumerate(boxes)]
    config = Config().updated({'complete.fill': True})
    rows, tracks = complete(drive(truth, given), config)
    assert steps_of(rows, 'a', 'interpolated') == list(range(10, 20))
    assert tracks['a'].filled == 10
    errors = [np.linalg.norm((row[4] - boxes[row[0]])[:2]) for row in rows]
    assert max(errors) < 0.15


class OnePerson(Nothing):
    """A person who has accepted the box of the track `b` at one step."""

    def __init__(self, step):
        self.stamp_ns = step * STEP_NS

    def is_accepted(self, track_id, stamp_ns):
        return (track_id, stamp_ns) == ('b', self.stamp_ns)


@pytest.mark.parametrize(
    ('decided', 'is_pinned', 'is_filled'),
    [
        (NOTHING, False, False),
        (OnePerson(7), False, True),
        (OnePerson(8), False, True),  # a box that is missing, in the report of an earlier run
        (NOTHING, True, True),
    ],
)
def test_what_is_seen_now_and_then_is_filled_by_a_person_alone(decided, is_pinned, is_filled):
    car, bush = path((5, 6), (8, 0), 24), path((10, -6), (0, 0), 24)
    seen = (2, 7, 11, 16, 21)
    given = [[('a', car[k])] * (k != 9) + [('b', bush[k])] * (k in seen) for k in range(24)]
    items = drive([[*boxes] for boxes in zip(car, bush, strict=True)], given)
    if is_pinned:
        has_both = [len(getattr(item, 'track_ids', ())) == 2 for item in items]
        items = [
            replace(item, pinned=[False, True]) if both else item
            for item, both in zip(items, has_both, strict=True)
        ]
    config = only('fill')
    plan = first_pass([(item, False) for item in items], config).plan('odom', config, decided)
    tracks = {one.track_id: one for one in plan.tracks}
    missing = 15  # between the first and the last of its five boxes
    assert (tracks['a'].unfilled, tracks['b'].unfilled) == (0, 0 if is_filled else missing)
    added = Counter(one.track_id for array in plan.arrays for one in array.added)
    assert (added['a'], added['b']) == (1, missing if is_filled else 0)


def test_boxes_without_points_have_a_growing_covariance():
    boxes = path((5, 6), (8, 0), 24)
    truth = [[box] if k < 8 or k >= 16 else [] for k, box in enumerate(boxes)]
    given = [[('a', box)] if k < 8 or k >= 16 else [] for k, box in enumerate(boxes)]
    results, _ = completed(drive(truth, given), 'odom', only('fill'))
    variances = np.array([result.covariances[0, 0, 0] for result in results])
    assert (np.diff(variances[8:12]) > 0).all()
    assert variances[12] > 2 * variances[7]


def test_track_is_extended_while_points_support_it():
    boxes = path((5, 6), (6, 0), 30)
    # The detector sees the car from 10 to 19; points exist from 6 to 22.
    truth = [[box] if 6 <= k <= 22 else [] for k, box in enumerate(boxes)]
    given = [[('a', box)] if 10 <= k < 20 else [] for k, box in enumerate(boxes)]
    rows, tracks = complete(drive(truth, given), only('extend'))
    assert steps_of(rows, 'a', 'extended') == [6, 7, 8, 9, 20, 21, 22]
    assert tracks['a'].extended == 7
    errors = [np.linalg.norm((row[4] - boxes[row[0]])[:2]) for row in rows]
    assert max(errors) < 0.3


def test_points_above_the_road_are_counted():
    box = np.array([[0, 0, 0.75, 4, 2, 1.5, 0, 0, 0.0], [9, 9, 1, 4, 2, 1.5, 0, 0, np.nan]])
    inside = [[0, 0, 0.5], [1.9, 0.9, 1.4], [2.1, 0, 1.0]]  # the last one within the margin
    outside = [[0, 0, 0.1], [3, 0, 1.0]]  # the road; beside the box
    sweep = Sweep(0, 'odom', np.array(inside + outside))
    assert points_above_road(sweep, box).tolist() == [3, 0]


def test_every_format_has_added_boxes_and_no_rejected_ones(tmp_path):
    recorded = Recorded(sweeps=14)
    for k in (4, 5, 6):  # the moving car is missing
        recorded.replace('/boxes', k, lambda message: message.detections.pop(1))
    recorded.add_ghost(8)
    path_ = recorded.write(tmp_path / 'drive')
    request = Request((path_,), formats=(*FORMATS, 'mcap'), config=ALL_STEPS)
    summary = relabel(request, tmp_path / 'out')
    assert (summary.boxes_in, summary.boxes_out) == (26, 29)
    assert summary.status['interpolated'] == summary.complete['filled'] == 3
    assert summary.status['rejected'] == summary.reasons['ghost'] == 1
    rows = rows_of(tmp_path / 'out')
    assert len(rows) == 29
    assert [row['track_id'] for row in rows if row['status'] == 'rejected'] == ['9']
    for name in FORMATS[1:]:
        frames = frames_of(name, tmp_path / 'out' / name)
        assert sum(len(frame.refined.status) for frame in frames) == 28, name
    tracks = {row['track_id']: row for row in rows_in(tmp_path / 'out' / 'tracks.csv')}
    assert list(tracks['2'])[:6] == [
        'track_id', 'class_name', 'boxes', 'refined', 'kept', 'risk_m',
    ]  # fmt: skip
    assert (tracks['2']['boxes'], tracks['2']['filled']) == ('11', '3')
    assert tracks['9']['rejected'] == '1'


def test_recording_without_steps_is_as_before(tmp_path):
    path_ = Recorded(sweeps=8).write(tmp_path / 'drive')
    summary = relabel(Request((path_,), formats=('csv',), config=only()), tmp_path / 'out')
    assert summary.complete == {}
    assert summary.boxes_in == summary.boxes_out == 16


def test_tracks_are_not_completed_across_a_time_jump(tmp_path):
    first = Recorded(sweeps=12)
    again = Recorded(sweeps=12)
    for k in (4, 5):
        first.replace('/boxes', k, lambda message: message.detections.pop(1))
    shift = 13 * 100_000_000
    first.items += [(topic, received + shift, message) for topic, received, message in again.items]
    request = Request((first.write(tmp_path / 'drive'),), formats=('csv',), config=ALL_STEPS)
    summary = relabel(request, tmp_path / 'out')
    assert summary.time_jumps == 1
    assert summary.boxes_in == 46
    assert summary.status['interpolated'] == 2


def test_command_line(tmp_path, capsys):
    recording = tmp_path / 'street.mcap'
    words = ['simulate', '-o', str(recording), '--sweeps', '14', '--break', '--seed', '2']
    assert cli.main(words) == 0
    out = str(tmp_path / 'out')
    settings = ['--set', 'solver.rounds=1', '--formats', 'csv']
    assert cli.main(['relabel', str(recording), '-o', out, '--complete', *settings]) == 0
    line = capsys.readouterr().out
    assert ' interpolated' in line
    assert re.search(r'\d+ kept and \d+ rejected \(ghost \d+', line), line
    assert cli.main(['evaluate', out, str(tmp_path / 'street_truth.csv'), '--json']) == 0
    tracks = json.loads(capsys.readouterr().out)['tracks']
    assert tracks['added'] > 10


def test_estimates_of_the_node_can_be_completed():
    boxes = path((5, 6), (8, 0), 24)
    given = [[('a', box)] if not 9 <= k < 13 else [] for k, box in enumerate(boxes)]
    for estimate in ('early', 'final'):
        config = replace(only('fill'), estimate=estimate)
        rows, _ = complete(drive([[box] for box in boxes], given), config)
        assert steps_of(rows, 'a') == list(range(24))
