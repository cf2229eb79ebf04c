"""Scores of tracks by overlap, against values derived by hand."""

from dataclasses import replace
import math

from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.offline import track_scores as module
from boxreg_ros.offline.box_scores import (
    best_pairs,
    by_id,
    by_overlap,
    match,
    pairwise_iou,
    summarise,
)
from boxreg_ros.offline.track_scores import track_scores
from boxreg_ros.structures import BoxArray
import numpy as np
import pytest

STEP = 100_000_000
CAR = [0, 0, 1, 4, 2, 1.5, 0, 0, 0]


def table(frames):
    """Return a table; each frame is a list of (id, x) or (id, x, status) of cars along x."""
    arrays = []
    status = []
    for number, boxes in enumerate(frames):
        rows = np.array([np.add(CAR, np.eye(9)[0] * box[1]) for box in boxes]).reshape(-1, 9)
        ids = tuple(box[0] for box in boxes)
        classes = ('car',) * len(ids)
        arrays.append(BoxArray(number * STEP, 'odom', ids, classes, np.ones(len(ids)), rows))
        status += [box[2] if len(box) > 2 else 'refined' for box in boxes]
    return replace(BoxTable.from_arrays(arrays), status=tuple(status))


TRUTH = table([[('a', 0), ('b', 20)]] * 4)


def test_perfect_tracks_may_have_other_ids():
    scores = track_scores(table([[('7', 20), ('9', 0)]] * 4), TRUTH)
    assert (scores.recall, scores.precision, scores.misses, scores.ghosts) == (1, 1, 0, 0)
    assert scores.ids_per_object == 1
    assert (scores.added, math.isnan(scores.added_iou)) == (0, True)


def test_boxes_of_one_id_at_a_stamp_are_not_found_twice():
    pytest.importorskip('trackeval')
    scores = track_scores(table([[('a', 0), ('b', 20), ('a', 0), ('b', 20)]] * 4), TRUTH)
    assert (scores.misses, scores.ghosts) == (0, 8)
    assert scores.idf1 == pytest.approx(2 * 8 / (8 + 16))
    assert scores.det_a == pytest.approx(8 / 16)


def test_misses_ghosts_and_added_boxes_are_counted():
    # a is missing once, and once 3 m off: an IoU of 1 / 7; x is nothing.
    predicted = table([
        [('a', 0), ('b', 20)],
        [('b', 20)],
        [('a', 3, 'interpolated'), ('b', 20, 'extended')],
        [('a', 0), ('b', 20), ('x', 60, 'interpolated')],
    ])  # fmt: skip
    scores = track_scores(predicted, TRUTH)
    assert (scores.misses, scores.ghosts) == (2, 2)
    assert scores.recall == pytest.approx(6 / 8)
    assert scores.precision == pytest.approx(6 / 8)
    assert (scores.added, scores.added_ghosts) == (3, 1)
    assert scores.added_iou == pytest.approx((1 / 7 + 1 + 0) / 3, abs=1e-6)
    assert scores.given_iou == pytest.approx(1)


def test_ids_per_object():
    predicted = table([
        [('1', 0), ('2', 20)], [('1', 0), ('2', 20)], [('3', 0), ('2', 20)], [('3', 0), ('2', 20)],
    ])  # fmt: skip
    assert track_scores(predicted, TRUTH).ids_per_object == 1.5


def test_ids_of_two_boxes_of_one_object_do_not_change_places():
    # The truth has the object twice, 0.4 m apart; the nearer prediction alternates.
    truth = table([[('a', 0), ('b', 0.4)]] * 4)
    predicted = table([[('1', 0), ('2', 0.4)], [('1', 0.4), ('2', 0)]] * 2)
    assert track_scores(predicted, truth).ids_per_object == 1
    gone = table([[('1', 0), ('2', 0.4)], [('2', 0)], [('2', 0)], [('2', 0)]])
    assert track_scores(gone, truth).ids_per_object == 1


def test_hota_and_idf1_of_an_id_switch():
    pytest.importorskip('trackeval')
    predicted = table([
        [('1', 0), ('2', 20)], [('1', 0), ('2', 20)], [('3', 0), ('2', 20)], [('3', 0), ('2', 20)],
    ])  # fmt: skip
    scores = track_scores(predicted, TRUTH)
    # Each true positive of a has 2 of 4 boxes in common with its id, those of b have 4 of 4.
    assert scores.det_a == pytest.approx(1)
    assert scores.ass_a == pytest.approx((4 * 0.5 + 4 * 1) / 8)
    assert scores.hota == pytest.approx(math.sqrt(0.75))
    # Ids 1 and 2 keep 2 + 4 of the 8 true and 8 predicted boxes.
    assert scores.idf1 == pytest.approx(2 * 6 / 16)


def test_hota_of_misses_and_ghosts():
    pytest.importorskip('trackeval')
    predicted = table([[('1', 0)], [('1', 0)], [('1', 0), ('x', 60)], [('1', 0), ('x', 60)]])
    scores = track_scores(predicted, TRUTH)
    assert scores.det_a == pytest.approx(4 / (4 + 4 + 2))
    assert scores.ass_a == pytest.approx(1)
    assert scores.idf1 == pytest.approx(2 * 4 / (8 + 6))


def test_without_trackeval_the_other_scores_remain(monkeypatch):
    monkeypatch.setattr(module, 'has_trackeval', lambda: False)
    scores = track_scores(TRUTH, TRUTH)
    assert scores.recall == 1
    assert math.isnan(scores.hota)


def test_boxes_out_of_scope_are_neither_missed_nor_ghosts():
    scope = np.flatnonzero([name == 'a' for name in TRUTH.track_ids])
    scores = track_scores(TRUTH, TRUTH, scope)
    assert (scores.recall, scores.precision, scores.ghosts) == (1, 1, 0)


def test_pairs_have_the_greatest_sum_of_overlap():
    first = np.array([np.add(CAR, np.eye(9)[0] * x) for x in (0, 1)])
    second = np.array([np.add(CAR, np.eye(9)[0] * x) for x in (1, 2, 50)])
    iou = pairwise_iou(first, second)
    np.testing.assert_allclose(iou, [[3 / 5, 2 / 6, 0], [1, 3 / 5, 0]], atol=1e-6)
    # 0-1 and 1-0 have 1.33, 0-0 and 1-1 have 1.2.
    assert [pair.tolist() for pair in best_pairs(iou)] == [[0, 1], [1, 0]]
    assert [pair.tolist() for pair in best_pairs(iou, 0.5)] == [[0, 1], [0, 1]]
    assert best_pairs(np.zeros((2, 0)))[0].tolist() == []


def test_boxes_are_paired_by_overlap_or_by_id():
    swapped = table([[('b', 0), ('a', 20)]] * 4)
    assert by_overlap(swapped, TRUTH).tolist() == list(range(8))
    assert by_id(swapped, TRUTH).tolist() == [1, 0, 3, 2, 5, 4, 7, 6]
    assert summarise(match(swapped, TRUTH, pair=by_overlap)).iou_3d == pytest.approx(1)
    assert summarise(match(swapped, TRUTH)).iou_3d == 0
    nothing = table([[]])
    assert by_overlap(nothing, TRUTH).tolist() == [-1] * 8
    assert by_overlap(TRUTH, nothing).tolist() == []
