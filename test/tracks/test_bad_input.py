"""Faulty ids, classes and rates: all boxes are returned, added ones are marked."""

from collections import Counter
from dataclasses import replace

from boxreg_ros.core.metrics import iou_3d
from boxreg_ros.structures import ADDED
from drives import complete, drive, path, steps_of
import numpy as np


def given_count(given):
    return sum(len(boxes) for boxes in given if boxes)


def own_rows(rows):
    return [row for row in rows if row[3] not in ADDED]


def test_two_objects_with_one_id_in_each_message():
    first = path((5, 6), (4, 0), 12)
    second = path((5, -6), (4, 0), 12)
    truth = list(zip(first, second, strict=True))
    given = [[('7', a), ('7', b)] if k % 2 else [('7', b), ('7', a)]
             for k, (a, b) in enumerate(truth)]  # fmt: skip
    rows, _ = complete(drive(truth, given))
    assert len(rows) == given_count(given) == 24
    assert Counter(row[1] for row in rows) == {'7': 12, '7_2': 12}
    for track_id in ('7', '7_2'):
        sides = {row[4][1] > 0 for row in rows if row[1] == track_id}
        assert len(sides) == 1, 'one object each'
    assert {row[3] for row in rows} == {'refined'}


def test_id_reused_after_a_minute_is_another_object():
    first = path((5, 6), (4, 0), 10)
    second = path((9, -6), (4, 0), 10)
    pause = 600  # steps of 0.1 s
    truth = [[box] for box in first] + [[]] * pause + [[box] for box in second]
    given = [[('7', box[0])] if box else [] for box in truth]
    rows, _ = complete(drive(truth, given))
    assert len(own_rows(rows)) == 20
    assert steps_of(rows, '7')[:10] == list(range(10))
    assert max(steps_of(rows, '7')) < 10 + pause
    again = 10 + pause
    assert [k for k in steps_of(rows, '7_2') if k >= again] == list(range(again, again + 10))


def test_tracks_that_cross_keep_their_objects():
    east = path((2, 8), (10, 0), 24)
    north = path((12, -2), (0, 10), 24)
    truth = list(zip(east, north, strict=True))
    # Both are hidden at the crossing, and get new ids after it.
    given = [
        [('e' if k < 9 else 'x', a), ('n' if k < 9 else 'y', b)] if not 9 <= k < 14 else []
        for k, (a, b) in enumerate(truth)
    ]
    rows, tracks = complete(drive(truth, given))
    assert len(own_rows(rows)) == given_count(given)
    assert len(tracks) == 2
    for track in tracks.values():
        assert (track.fragments, track.filled, track.ambiguous) == (2, 5, ())
        found = {row[0]: row[4] for row in rows if row[1] == track.track_id}
        true = east if abs(found[0][1] - 8) < 1 else north
        errors = [np.linalg.norm((box - true[step])[:2]) for step, box in found.items()]
        assert len(errors) == 24
        assert max(errors) < 0.5


def test_detector_at_2_hz_under_a_lidar_at_20_hz():
    boxes = path((5, 6), (4, 0), 61)
    truth = [[box] for box in boxes]
    given = [[('7', box)] if k % 10 == 0 else None for k, box in enumerate(boxes)]
    # Sweeps of the helper are 0.1 s apart, these 0.05 s: 8 m/s.
    items = [replace(item, stamp_ns=item.stamp_ns // 2) for item in drive(truth, given)]
    rows, tracks = complete(items)
    assert steps_of(rows, '7') == list(range(0, 31, 5)), 'no box at stamps without a message'
    assert {row[3] for row in rows} == {'refined'}
    assert (tracks['7'].filled, tracks['7'].extended) == (0, 0)
    assert iou_3d(np.array([row[4] for row in rows]), boxes[::10]).min() > 0.9


def test_detector_at_2_hz_that_misses_a_box():
    """The missing box is added at the stamp of its message."""
    boxes = path((5, 6), (4, 0), 61)
    truth = [[box] for box in boxes]
    given = [[('7', box)] if k % 10 == 0 else None for k, box in enumerate(boxes)]
    given[30] = []
    items = [replace(item, stamp_ns=item.stamp_ns // 2) for item in drive(truth, given)]
    rows, _ = complete(items)
    assert steps_of(rows, '7') == list(range(0, 31, 5))
    (added,) = [row for row in rows if row[3] == 'interpolated']
    assert added[0] == 15
    assert iou_3d(added[4][None], boxes[[30]]) > 0.85


def test_class_that_changes_along_a_track_becomes_the_majority():
    boxes = path((5, 6), (4, 0), 12)
    names = ['car'] * 7 + ['truck'] * 3 + ['car'] * 2
    given = [[('7', box, name)] for box, name in zip(boxes, names, strict=True)]
    rows, tracks = complete(drive([[box] for box in boxes], given))
    assert {row[2] for row in rows} == {'car'}
    assert tracks['7'].reclassified == 3


def test_boxes_that_cannot_be_completed_are_returned():
    boxes = path((5, 6), (4, 0), 12)
    given = [[('7', box), ('', box + 1)] for box in boxes]
    given[4].append(('8', np.full(9, np.nan)))
    rows, _ = complete(drive([[box] for box in boxes], given))
    assert Counter(row[1] for row in rows) == {'7': 12, '': 12, '8': 1}
    assert {row[3] for row in rows if row[1] != '7'} == {'kept'}
