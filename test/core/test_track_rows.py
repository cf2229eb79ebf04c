"""Rows of arrays for the tracks that were seen last."""

from boxreg_ros.core.track_rows import TrackRows
import numpy as np


def test_a_new_track_takes_the_place_of_the_one_seen_longest_ago():
    rows = TrackRows(np.zeros(()), 2)
    for track_ids, values in (('ab', [1, 10]), ('a', [2]), ('c', [100])):
        places, kept = rows.seen(list(track_ids))
        rows.arrays[kept] += np.array(values, float)[places]
    assert rows.in_order.tolist() == [3, 100]  # seen last: at the end


def test_a_new_track_that_is_seen_twice_at_once_has_one_row():
    rows = TrackRows(np.zeros(()), 9)
    places, kept = rows.seen(['a', 'b', 'a'])
    assert (places.tolist(), kept.tolist()) == ([0, 1, 2], [0, 1, 0])
    assert len(rows.arrays) == 2
