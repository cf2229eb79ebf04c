"""Interpolated boxes in short gaps of tracks."""

from collections import Counter
import csv
import json

from boxreg_ros import cli
from boxreg_ros.config import Config
from boxreg_ros.errors import ConfigError
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.labels import frames_of
from boxreg_ros.offline.evaluate import match
from boxreg_ros.offline.relabel import relabel, Request
from boxreg_ros.simulation.recorder import write_recording
from boxreg_ros.simulation.simulate import simulate
from boxreg_ros.structures import BoxArray, RefinedBoxes
from boxreg_ros.tracks.bridge import Bridge
from mcap.reader import make_reader
import numpy as np
import pytest
from ros_messages import Drive

STEP = 100_000_000
QUICK = Config().updated({'solver.rounds': 1, 'solver.iterations': 3, 'sampling.points': 64})


def box_at(x, yaw=0.0, y=2.0, length=4.0):
    return [x, y, 1.0, length, 2.0, 1.5, 0.0, 0.0, yaw]


def result(step, boxes, frame_id='odom', spread=0.01, class_name='car'):
    """Return the result at stamp number `step`; `boxes` by track id."""
    n = len(boxes)
    table = np.array(list(boxes.values()), float).reshape(n, 9)
    array = BoxArray(
        step * STEP, frame_id, tuple(boxes), (class_name,) * n, np.linspace(0.5, 0.9, n), table
    )
    covariances = np.tile(spread * np.eye(6), (n, 1, 1))
    return RefinedBoxes(array, ('refined',) * n, ('',) * n, np.full(n, 9), covariances)


def bridged(results, seconds=0.5):
    """Return the results in their order, and after how many added ones each was returned."""
    bridge = Bridge(seconds, 'odom', Config())
    out = []
    for count, item in enumerate(results, 1):
        out += [(whole, place, count) for whole, place in bridge.add(item, count - 1)]
    out += [(whole, place, len(results)) for whole, place in bridge.flush()]
    assert [place for _, place, _ in out] == list(range(len(results)))
    return [whole for whole, _, _ in out], [count for _, _, count in out]


def test_missing_box_is_interpolated():
    others = {'b': box_at(0.0)}
    given = [result(0, {'a': box_at(10.0, 0.2, length=4.0)} | others), result(1, others)]
    given += [result(4, {'a': box_at(14.0, 0.6, length=4.4), **others}, spread=0.05)]
    out, _ = bridged(given)
    assert [len(whole.status) for whole in out] == [2, 2, 2]
    added = out[1]
    assert added.boxes.track_ids == ('b', 'a')
    assert added.status == ('refined', 'interpolated')
    assert added.reasons == ('', '')
    assert added.num_points.tolist() == [9, 0]
    # A quarter of the way from 0 to 4 steps.
    np.testing.assert_allclose(added.boxes.boxes[1], box_at(11.0, 0.3, length=4.1), atol=1e-12)
    assert added.boxes.scores[1] == pytest.approx(0.5)
    # 0.02 is a quarter of the way from 0.01 to 0.05. The acceleration adds a s t / 2 with
    # s = 0.1 s, t = 0.3 s.
    car = Config().vehicle
    half_product = 0.1 * 0.3 / 2
    expected = 0.02 + (half_product * np.array([car.cornering, car.vertical, car.turning])) ** 2
    np.testing.assert_allclose(added.covariances[1].diagonal()[[0, 2, 5]], expected)
    np.testing.assert_array_equal(out[0].boxes.boxes, given[0].boxes.boxes)


def test_heading_takes_the_short_way_without_flips():
    for first, last in ((3.1, -3.1), (3.1, -3.1 + np.pi)):
        out, _ = bridged([
            result(0, {'a': box_at(0, first)}), result(1, {}), result(2, {'a': box_at(2, last)}),
        ])  # fmt: skip
        assert abs(out[1].boxes.boxes[0, 8]) == pytest.approx(np.pi)


def test_longer_gaps_stay_empty():
    steps = [result(k, {'a': box_at(k)} if k in (0, 5, 11) else {}) for k in range(12)]
    out, _ = bridged(steps, 0.5)
    assert [len(whole.status) for whole in out] == [1, 1, 1, 1, 1, 1, 0, 0, 0, 0, 0, 1]
    np.testing.assert_allclose([w.boxes.boxes[0, 0] for w in out[:6]], range(6))


def test_results_wait_for_the_longest_gap_only():
    steps = [result(k, {'a': box_at(k)}) for k in range(8)]
    # Without a bridge no result waits; with 0.3 s the first is returned with the fourth.
    assert bridged(steps, 0.0)[1] == list(range(1, 9))
    assert bridged(steps, 0.3)[1] == [4, 5, 6, 7, 8, 8, 8, 8]


def test_stamps_with_an_unusable_box_are_no_gap():
    nan = {'a': [np.nan] * 9}
    ends = result(0, {'a': box_at(0)}), result(2, {'a': box_at(2)})
    # An invalid box; a box in a second array of the stamp; an array in another frame.
    assert [len(w.status) for w in bridged([ends[0], result(1, nan), ends[1]])[0]] == [1, 1, 1]
    two = [ends[0], result(1, {'b': box_at(1)}), result(1, {'a': box_at(1)}), ends[1]]
    assert [len(w.status) for w in bridged(two)[0]] == [1, 1, 1, 1]
    lost = [ends[0], result(1, {}, frame_id='lidar'), ends[1]]
    assert [len(w.status) for w in bridged(lost)[0]] == [1, 0, 1]
    # Of two arrays of one stamp without the track, one gets the box.
    both = [ends[0], result(1, {}), result(1, {'b': box_at(1)}), ends[1]]
    assert [len(w.status) for w in bridged(both)[0]] == [1, 1, 1, 1]


def test_results_with_an_old_stamp_pass_unchanged():
    late = result(1, {'a': box_at(50)})
    out, _ = bridged(
        [result(0, {'a': box_at(0)}), result(2, {}), late, result(4, {'a': box_at(4)})]
    )
    assert [len(whole.status) for whole in out] == [1, 1, 1, 1]
    # Interpolated from the stamps 0 and 4, not from the late result.
    np.testing.assert_allclose(out[1].boxes.boxes, [box_at(2)])


FORMATS = ('csv', 'openlabel', 'tracklets', 'nuscenes', 'sustechpoints', 'xtreme1', 'mcap')


def test_every_format_has_the_interpolated_boxes(tmp_path):
    drive = Drive(sweeps=7)
    for k in (2, 4):  # the parked car is missing twice, then both cars once
        drive.replace('/boxes', k, lambda message: message.detections.pop(0))
    drive.replace('/boxes', 5, lambda message: message.detections.clear())
    path = drive.write(tmp_path / 'drive')
    request = Request((path,), formats=FORMATS, config=QUICK, bridge=0.4)
    summary = relabel(request, tmp_path / 'out')
    assert (summary['boxes_in'], summary['boxes_out']) == (10, 14)
    assert summary['status']['interpolated'] == 4
    for name in FORMATS[:-1]:
        folder = tmp_path / 'out' / ('' if name == 'csv' else name)
        seen = Counter(len(frame.refined.status) for frame in frames_of(name, folder))
        assert seen == {2: 7}, name
    with (tmp_path / 'out' / 'boxes.csv').open(newline='') as file:
        rows = list(csv.DictReader(file))
    added = [row for row in rows if row['status'] == 'interpolated']
    assert [(drive.stamps.index(int(row['stamp_ns'])), row['track_id']) for row in added] == [
        (2, '1'), (4, '1'), (5, '1'), (5, '2'),
    ]  # fmt: skip
    for row in added:
        true = drive.truth[int(row['stamp_ns'])][int(row['track_id']) - 1]
        found = [float(row[name]) for name in ('x', 'y', 'z')]
        np.testing.assert_allclose(found, true[:3], atol=0.35)
    # A message of the overlay keeps its own boxes and gets no others.
    with (tmp_path / 'out' / 'overlay.mcap').open('rb') as file:
        topics = Counter(c.topic for _, c, _ in make_reader(file).iter_messages())
    assert topics['/boxes_refined'] == 7


def test_bridge_longer_than_max_gap_is_refused(tmp_path):
    for seconds in (-0.1, 1.7, float('nan')):
        with pytest.raises(ConfigError, match='bridge: expected 0 to max_gap'):
            Request((tmp_path,), bridge=seconds)


@pytest.fixture(scope='module')
def street(tmp_path_factory):
    folder = tmp_path_factory.mktemp('street')
    scene = simulate('street', seed=4, sweeps=24)
    intensities = [np.zeros(len(owner)) for owner in scene.owners]
    path = folder / 'street.mcap'
    write_recording(
        path, scene.sweeps, intensities, scene.detections, scene.T_fixed_sensor, 'odom'
    )
    return path, scene


def test_closing_line_counts_flips_and_interpolated_boxes(street, tmp_path, capsys):
    path, scene = street
    assert cli.main(['relabel', str(path), '-o', str(tmp_path / 'out'), '--bridge', '0.5']) == 0
    line = capsys.readouterr().out
    summary = json.loads((tmp_path / 'out' / 'summary.json').read_text())
    found = BoxTable.read(tmp_path / 'out' / 'boxes.csv')
    # Exactly the boxes that the simulated detector missed: all gaps are shorter than 0.5 s.
    given = BoxTable.from_arrays(scene.fixed_detections())
    keys = set(zip(given.stamps_ns.tolist(), given.track_ids, strict=True))
    missing = 0
    for track in set(given.track_ids):
        stamps = sorted(stamp for stamp, name in keys if name == track)
        steps = np.diff(stamps) // STEP
        missing += int((steps - 1)[steps <= 5].sum())
    assert missing > 10
    assert summary['status']['interpolated'] == missing == found.status.count('interpolated')
    assert f', {missing} interpolated from' in line
    # Corrected flips: flipped in the input and no longer in the result.
    flipped = match(given, scene.truth).is_flipped
    left = match(found, scene.truth).is_flipped[match(given, scene.truth).is_matched]
    assert summary['heading_flips'] == flipped.sum() - left.sum() > 3
    assert f', {summary["heading_flips"]} heading flips corrected' in line
    # Interpolated boxes are about as accurate as refined ones.
    matches = match(found, scene.truth)
    status = dict(zip(zip(found.stamps_ns.tolist(), found.track_ids, strict=True), found.status,
                      strict=True))  # fmt: skip
    truth = scene.truth
    rows = zip(truth.stamps_ns[matches.rows].tolist(), truth.track_ids, strict=True)
    added = np.array([status.get(key) == 'interpolated' for key in rows])
    assert added.sum() == missing
    assert matches.iou_bev[added].mean() > 0.75
