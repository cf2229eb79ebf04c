"""Rows of arrays for the tracks that were seen last."""

from boxreg_ros.core.track_rows import TrackRows
import numpy as np


def add(rows, track_ids, values):
    places, kept = rows.seen(track_ids)
    rows.arrays[kept] += np.array(values, float)[places]
    return [track_ids[place] for place in places]


def test_a_track_has_one_array():
    rows = TrackRows(np.zeros(()), 3)
    add(rows, ['a', 'b'], [1, 10])
    add(rows, ['b', 'c'], [20, 100])
    assert rows.in_order.tolist() == [1, 30, 100]
    add(rows, ['a'], [2])
    assert rows.in_order.tolist() == [30, 100, 3]  # seen last: at the end


def test_a_new_track_takes_the_place_of_the_one_seen_longest_ago():
    rows = TrackRows(np.zeros(()), 2)
    add(rows, ['a', 'b'], [1, 10])
    add(rows, ['a'], [2])
    add(rows, ['c'], [100])
    assert rows.in_order.tolist() == [3, 100]
    add(rows, ['b'], [20])  # begins anew
    assert rows.in_order.tolist() == [100, 20]


def test_tracks_that_are_seen_together_do_not_expel_each_other():
    rows = TrackRows(np.zeros(()), 2)
    for _ in range(3):
        assert add(rows, ['a', 'b', 'c'], [1, 10, 100]) == ['a', 'b']
    assert rows.in_order.tolist() == [3, 30]
    # Track a has ended: c, the next without a row, takes its place.
    assert add(rows, ['b', 'c', 'd'], [10, 100, 1000]) == ['b', 'c']
    assert rows.in_order.tolist() == [40, 100]
