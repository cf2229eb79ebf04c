"""Ids by association: an object keeps its id through gaps, crossings and noise."""

from dataclasses import replace

from boxreg_ros.io.id_assignment import IdCheck, Tracker
from boxreg_ros.structures import BoxArray
import numpy as np
from paths import SHARED
import pytest
from ros_messages import SECOND, START

CAR, PERSON = (4.5, 1.9, 1.6), (0.6, 0.6, 1.75)


def array_of(stamp_ns, *boxes):
    """Return boxes of (x, y, extent)."""
    rows = np.array([[x, y, 0.8, *extent, 0, 0, 0] for x, y, extent in boxes]).reshape(-1, 9)
    n = len(boxes)
    return BoxArray(stamp_ns, 'map', ('?',) * n, ('car',) * n, np.ones(n), rows)


def ids_over_time(objects_at, steps=30, period=0.1, noise=0.0, tracker=None):
    """
    Return the ids (steps, n) of n objects.

    `objects_at(seconds)` returns them as (x, y, extent). The tracker gets them in random order.

    """
    rng = np.random.default_rng(2)
    tracker = tracker or Tracker(max_gap=1.0)
    rows = []
    for k in range(steps):
        objects = objects_at(k * period)
        order = rng.permutation(len(objects))
        jitter = rng.normal(0, noise, (len(objects), 2))
        observed = []
        for number, (dx, dy) in zip(order, jitter, strict=True):
            x, y, extent = objects[number]
            observed.append((x + dx, y + dy, extent))
        stamp_ns = START + round(k * period * SECOND)
        ids = tracker.identify(array_of(stamp_ns, *observed)).track_ids
        rows.append([ids[list(order).index(i)] for i in range(len(objects))])
    return np.array(rows)


def test_fast_slow_and_oncoming_objects_keep_their_ids():
    def objects_at(t):
        return [
            (5.0 + 15 * t, 0.0, CAR),  # 15 m/s
            (60.0 - 15 * t, 3.5, CAR),  # oncoming, in the next lane
            (30.0, 7.0, CAR),
            (33.0, 7.0 + 1.2 * t, PERSON),  # a pedestrian beside the parked car
        ]

    ids = ids_over_time(objects_at, noise=0.15)
    assert (ids == ids[0]).all()
    assert sorted(ids[0]) == ['1', '2', '3', '4']


def test_ids_are_kept_at_a_low_rate_by_prediction_with_the_velocity():
    """At 20 m/s and 2 Hz a step is 10 m, more than the gap between the cars."""

    def objects_at(t):
        return [(20 * t, 0.0, CAR), (20 * t + 25.0, 0.0, CAR), (3.0, 9.0, CAR)]

    ids = ids_over_time(objects_at, steps=12, period=0.5, noise=0.1)
    assert (ids == ids[0]).all()


def test_ids_of_objects_that_disappear_and_return():
    tracker = Tracker(max_gap=1.0)

    def ids(tenths, *boxes):
        stamp_ns = START + tenths * SECOND // 10
        return tracker.identify(array_of(stamp_ns, *boxes)).track_ids

    assert ids(0, (0, 0, CAR)) == ('1',)
    assert ids(1, (10, 0, CAR), (0, 0, CAR)) == ('2', '1')  # a second object
    assert ids(2) == ()
    assert ids(9, (0.2, 0, CAR)) == ('1',)  # after a gap of 0.8 s
    assert ids(25, (0.2, 0, CAR)) == ('3',)  # after a gap longer than max_gap
    assert ids(26, (0.2, 0, PERSON)) == ('4',)  # the extent of another class
    assert ids(24, (0.2, 0, CAR), (50, 0, CAR)) == ('3', '5')  # late: matched, state unchanged
    assert ids(26, (50, 0, CAR)) == ('6',)
    assert ids(27, (50, 0, CAR), (0.2, 0, CAR)) == ('7', '3')
    assert ids(0, (0, 0, CAR)) == ('8',)  # after a time jump
    assert ids(1, (0, 0, CAR)) == ('8',)
    assert tracker.count == 8


def test_late_boxes_change_no_track():
    trackers = Tracker(max_gap=1.0), Tracker(max_gap=1.0)
    for k in range(8):
        for tracker in trackers:
            tracker.identify(array_of(START + k * SECOND // 10, (k, 0, CAR)))
    late = array_of(START + SECOND // 2, (5.6, 0.5, CAR))
    assert trackers[0].identify(late).track_ids == ('1',)
    after = START + 7 * SECOND // 10 + SECOND  # max_gap later, and no more
    places = [tracker._tracks.predicted(after) for tracker in trackers]
    for one, other in zip(*places, strict=True):
        np.testing.assert_array_equal(one, other)
    for tracker in trackers:
        assert tracker.identify(array_of(after, (17, 0, CAR))).track_ids == ('1',)


def test_neighbours_are_not_swapped_when_one_is_missing():
    """Four cars are parked 2.4 m apart; one is not detected at four stamps."""
    tracker = Tracker(max_gap=1.0)
    row = [(0.0, 2.4 * k, CAR) for k in range(4)]
    for k in range(5):
        assert tracker.identify(array_of(START + k * SECOND // 10, *row)).track_ids == (
            '1', '2', '3', '4',
        )  # fmt: skip
    for k in range(5, 9):
        fewer = array_of(START + k * SECOND // 10, *row[:1], *row[2:])
        assert tracker.identify(fewer).track_ids == ('1', '3', '4')


def test_invalid_boxes_get_no_id_and_do_not_affect_the_others():
    tracker = Tracker(max_gap=1.0)
    boxes = array_of(START, (0, 0, CAR), (np.nan, 0, CAR), (9, 0, (0, 1, 1)), (20, 0, CAR))
    assert tracker.identify(boxes).track_ids == ('1', '', '', '2')


def test_ids_of_a_real_drive():
    """Boxes of parked and moving cars with detector noise: no id changes."""
    path = SHARED / 'data' / 'kitti_raw_0001.npz'
    if not path.exists():
        pytest.skip('the real data is not available')
    data = np.load(path)
    order = np.lexsort((data['obs_track'], data['obs_frame']))
    rng = np.random.default_rng(4)
    boxes = data['obs_box'] + rng.normal(0, 1, data['obs_box'].shape) * [0.2, 0.1, 0.1, *[0] * 6]
    boxes[:, 3:6] *= np.exp(rng.normal(0, 0.06, (len(boxes), 3)))
    tracker, given = Tracker(max_gap=1.0), {}
    for frame in np.unique(data['obs_frame']):
        rows = order[data['obs_frame'][order] == frame]
        stamp_ns = START + round(data['obs_t'][rows[0]] * SECOND)
        n = len(rows)
        array = BoxArray(stamp_ns, 'map', ('',) * n, ('',) * n, np.ones(n), boxes[rows])
        for track, track_id in zip(
            data['obs_track'][rows], tracker.identify(array).track_ids, strict=True
        ):
            given.setdefault(int(track), set()).add(track_id)
    assert all(len(ids) == 1 for ids in given.values()), given
    assert len(set.union(*given.values())) == len(given) == 15


def test_boxes_that_do_not_keep_their_tracks_are_still_the_newest_of_these():
    def array(seconds, *ids):
        boxes = array_of(round(seconds * 1e9), (10 * seconds, 0, CAR), (30 + 10 * seconds, 0, CAR))
        return BoxArray(boxes.stamp_ns, 'map', ids, ('car',) * 2, np.ones(2), boxes.boxes)

    tracker = Tracker(max_gap=0.5)
    given = tracker.identify(array(0.0, 'a', 'b')).track_ids
    own = dict(zip('ab', given, strict=True))
    assert tracker.keep(array(0.1, 'b', 'a'), own) is None
    assert tracker.identify(array(0.1, 'b', 'a')).track_ids == given
    # Tracks that had no box since the first array have ended by now.
    kept = tracker.keep(array(0.55, 'a', 'b'), own)
    assert kept == given


def test_ids_of_boxes_that_hold_what_is_seen_do_not_jump():
    """Of a tram now the rear is seen, now all of it; the ids of two cars that change do jump."""
    check = IdCheck(max_gap=1.0)
    swapping = IdCheck(max_gap=1.0)
    for k in range(60):
        length = 12.0 if k % 6 > 3 else 3.0
        tram = 8.0 + 0.8 * k + length / 2, 5.0, (length, 2.6, 3.4)
        boxes = array_of(START + k * SECOND // 10, tram, (20.0, -3.0, CAR), (27.0, -3.0, CAR))
        check.add(replace(boxes, track_ids=('tram', 'one', 'other')))
        ids = ('one', 'other') if k % 6 > 3 else ('other', 'one')
        swapping.add(replace(boxes, track_ids=('tram', *ids)))
    assert check.jumps == 0
    assert not check.finding
    assert swapping.jumps == 2 * 19
    assert 'jump from object to object' in swapping.finding
