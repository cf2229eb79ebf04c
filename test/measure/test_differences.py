"""Differences between methods and their standard errors, by hand."""

from dataclasses import replace

from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.offline.box_scores import match
from measure.real import clustered_error, differences, PairedBoxes, scopes_of
import numpy as np
import pytest


def truth():
    """Return a parked and a moving car with four boxes each."""
    boxes = np.tile([0, 0, 1.0, 4, 2, 1.5, 0, 0, 0], (8, 1))
    boxes[4:, 0] = 10 + np.arange(4)
    return BoxTable(
        np.tile(np.arange(4), 2), 'odom', ('a',) * 4 + ('b',) * 4, ('car',) * 8, np.ones(8), boxes,
        ('given',) * 8, np.full(8, 100),
    )  # fmt: skip


def shifted(table, rows, metres):
    boxes = table.boxes.copy()
    boxes[rows, 1] += metres
    return replace(table, boxes=boxes)


def test_error_of_independent_clusters_is_that_of_the_mean():
    values = np.array([1.0, 2.0, 4.0, 9.0])
    known = values.std(ddof=1) / 2
    assert clustered_error(values, list('abcd')) == pytest.approx(known)


def test_boxes_of_one_track_count_once():
    values = np.array([1.0, 2.0, 4.0, 9.0])
    known = values.std(ddof=1) / 2
    repeated = clustered_error(np.repeat(values, 5), np.repeat(list('abcd'), 5))
    assert repeated == pytest.approx(known)


def test_one_cluster_has_no_error():
    assert np.isnan(clustered_error(np.array([1.0, 2.0]), ['a', 'a']))


def test_differences_by_hand():
    # A shift of 1 m of boxes 2 m wide: IoU 1/3. The second method is off at all boxes of `a`.
    true = truth()
    found = {
        'ours, track': match(shifted(true, [4], 1.0), true),
        'ours, final': match(shifted(true, slice(4), 1.0), true),
    }
    everywhere = np.ones(8, bool)
    difference = differences('ours, track', found, true, everywhere)['ours, final']
    assert difference.iou_bev == pytest.approx((4 - 1) / 8 * 2 / 3)
    assert difference.iou_3d == pytest.approx(difference.iou_bev)
    # Sums of the deviations of two tracks: +s and -s.
    s = 4 * 2 / 3 - 4 * difference.iou_bev
    assert difference.iou_bev_error == pytest.approx(np.sqrt(2 * 2 * s**2) / 8)
    assert (difference.tracks, difference.tracks_ahead) == (2, 1)
    assert differences('ours, final', found, true, everywhere) == {}


def test_tracks_of_pooled_drives_are_not_mixed():
    # Both drives have a track `a`: with two boxes each, off by 1 and by 3.
    parts = {
        name: PairedBoxes(('a', 'a'), np.full(2, value), np.full(2, -value))
        for name, value in (('first', 1.0), ('second', 3.0))
    }
    difference = PairedBoxes.pooled(parts).difference()
    assert (difference.boxes, difference.tracks) == (4, 2)
    assert (difference.iou_bev, difference.iou_3d) == (2.0, -2.0)
    assert difference.iou_bev_error == pytest.approx(1.0)


def test_scopes_of_parked_and_moving_objects():
    true = truth()
    scopes = scopes_of(match(true, true), true)
    assert scopes['all'].all()
    np.testing.assert_array_equal(scopes['moving'], [False] * 4 + [True] * 4)
    parked = true.rows(np.arange(8) < 4)
    assert list(scopes_of(match(parked, parked), parked)) == ['all']
