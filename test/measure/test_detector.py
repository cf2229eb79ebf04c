"""The pieces of `measure detector`: targets, frames, average precision, labels, streets."""

from dataclasses import replace

from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.rotations import wrap_angle
from boxreg_ros.structures import BoxArray, YAW
from measure.detector.frames import CHANNELS, frames_of, grid_of, REACH, turned
from measure.detector.labels import errors_of, smoothed_table, with_ids, with_points
from measure.detector.network import CLASSES, decoded, Labels, targets_of, without_overlaps
from measure.detector.precision import average_precision, Hits, hits_of, joined
from measure.detector.streets import CLUTTER, random_street
from measure.drives import Drive
import numpy as np
import pytest

CORNER = np.array([-REACH, -REACH])
SIZE = 120


@pytest.fixture(scope='module')
def drive():
    return Drive.from_scene(random_street(4, 3))


def _boxes():
    rows = [
        [3.1, -7.3, 0.8, 4.4, 1.8, 1.5, 0, 0, 0.3],
        [20.05, 11.9, 1.5, 8.0, 2.5, 3.1, 0, 0, -3.0],
        [-30.4, 0.2, 0.9, 0.6, 0.7, 1.8, 0, 0, 1.7],
    ]
    return np.array(rows)


def test_boxes_come_back_from_their_targets():
    labels = Labels(_boxes(), np.array([0, 1, 2]))
    heat, values, mask = targets_of(labels, CORNER, SIZE)
    kinds, rows, columns = np.nonzero(heat == 1)
    assert kinds.tolist() == [0, 1, 2]
    found = decoded(values[:, rows, columns].astype(float), rows, columns, CORNER)
    np.testing.assert_allclose(found, labels.boxes, atol=1e-5)
    # every cell of the mask has the same boxes, not only that of the centre
    rows, columns = np.nonzero(mask)
    assert len(rows) == 3 * 9
    boxes = decoded(values[:, rows, columns].astype(float), rows, columns, CORNER)
    np.testing.assert_allclose(np.unique(boxes.round(3), axis=0), labels.boxes[[2, 0, 1]])


def test_points_and_boxes_turn_together():
    points = np.array([[3.0, 1.0, 0.5]], np.float32)
    box = np.array([[3.0, 1.0, 0.5, 4, 2, 1, 0, 0, 0.4]])
    moved, boxes = turned(points, box, np.pi / 2, is_mirrored=True)
    np.testing.assert_allclose(moved, [[1.0, 3.0, 0.5]], atol=1e-6)
    np.testing.assert_allclose(boxes[0, :3], moved[0], atol=1e-6)
    assert boxes[0, YAW] == pytest.approx(np.pi / 2 - 0.4)


def test_cell_has_the_points_in_it():
    points = np.array([[-47.9, -47.9, 0.5], [-47.7, -47.9, 1.5], [60, 0, 1]], np.float32)
    grid = grid_of(points, CORNER, 240)
    assert grid.shape == (CHANNELS, 240, 240)
    assert np.count_nonzero(grid.any(axis=0)) == 1
    np.testing.assert_allclose(grid[:4, 0, 0], [np.log(3) / 2, 1.5, 1.0, 0.5])
    np.testing.assert_allclose(grid[4:6, 0, 0], [0.0, -0.25], atol=1e-5)


def test_frame_has_no_road_and_boxes_stand_on_it(drive):
    tilt = np.array([0.03, -0.02, 1.0])  # of the whole scene, about
    sweep = drive.sweeps[0].in_frame()
    points = sweep.points + np.outer(sweep.points[:, :2] @ tilt[:2], [0, 0, 1])
    origin = sweep.origin + np.array([0, 0, sweep.origin[:2] @ tilt[:2]])
    (frame,) = frames_of([replace(sweep, points=points, origin=origin)])
    truth = drive.truth.rows(drive.truth.stamps_ns == sweep.stamp_ns)
    is_near = np.abs(truth.boxes[:, :2] - origin[:2]).max(axis=1) < 30
    boxes = truth.boxes[is_near & (truth.num_points > 20)]
    boxes[:, 2] += boxes[:, :2] @ tilt[:2]
    bottoms = frame.local(boxes)[:, 2] - boxes[:, 5] / 2
    assert np.abs(np.median(bottoms)) < 0.1
    np.testing.assert_allclose(frame.fixed(frame.local(boxes)), boxes, atol=1e-9)
    assert len(frame.points) < 0.8 * len(points)


def test_average_precision_by_hand():
    # precisions at the three hits: 1, 2/3, 3/5; of four true boxes one is never found
    hits = Hits(np.array([0.9, 0.8, 0.7, 0.6, 0.5]), np.array([1, 0, 1, 0, 1], bool), 4)
    assert average_precision(hits) == pytest.approx((1 + 2 / 3 + 3 / 5) / 4)
    assert average_precision(joined([hits, hits])) == pytest.approx(average_precision(hits))
    assert np.isnan(average_precision(joined([])))


def test_hits_of_a_frame_by_hand():
    truth = _boxes()
    found = truth[[0, 0, 1, 2]].copy()
    found[0, 0] += 0.44  # IoU .82: a hit
    found[1, 0] += 0.1  # a second box of the same object, with a lower score: false
    found[2, 0] += 100  # nowhere
    scores = np.array([0.9, 0.8, 0.7, 0.6])  # the last is of an object out of scope
    hits = hits_of(found, scores, truth, np.array([True, True, False]))['3D 0.7']
    assert hits.count == 2
    assert hits.scores.tolist() == [0.9, 0.8, 0.7]
    assert hits.is_true.tolist() == [True, False, False]
    nothing = hits_of(found, scores, truth[:0], np.zeros(0, bool))['BEV 0.5']
    assert nothing.count == 0
    assert nothing.is_true.tolist() == [False] * 4
    assert without_overlaps(found).tolist() == [0, 2, 3]


def test_smoother_and_ids_of_detections(drive):
    boxes = BoxTable.from_arrays(drive.boxes)
    scores = np.random.default_rng(0).random(len(boxes.boxes))
    boxes = replace(boxes, scores=scores)
    unnamed = replace(boxes, track_ids=('',) * len(scores))
    tracked = replace(boxes, scores=scores.round(9))  # as in boxes.csv
    assert with_ids(unnamed, tracked).track_ids == boxes.track_ids
    smoothed = smoothed_table(boxes)
    lengths = {}
    for track_id, box in zip(smoothed.track_ids, smoothed.boxes, strict=True):
        lengths.setdefault(track_id, set()).add(box[3])
    assert {len(found) for found in lengths.values()} == {1}  # one extent for a track


def test_errors_of_labels_by_hand(drive):
    truth = with_points(drive.truth, frames_of(drive.sweeps))
    scoped = truth.rows(truth.num_points >= 5)
    turned_boxes = scoped.boxes.copy()
    turned_boxes[:, YAW] = wrap_angle(turned_boxes[:, YAW] + np.pi)
    first = np.arange(len(scoped.boxes)) > 0
    table = replace(scoped, boxes=turned_boxes, frame_id=truth.frame_id).rows(first)
    found = errors_of({'raw': [scoped], 'turned': [table]}, [truth])
    assert found['raw']['']['recall'] == 1
    errors = found['turned']['']
    assert errors['gain'] == pytest.approx(0, abs=1e-9)
    assert found['turned']['car']['boxes'] < errors['boxes']
    assert errors['boxes'] == len(first)
    assert errors['recall'] == pytest.approx(first.mean())
    assert errors['false'] == 0
    assert errors['iou_3d'] == pytest.approx(1)
    assert errors['flips'] == 1
    assert errors['yaw robust'] == pytest.approx(0, abs=1e-6)


def test_parts_of_labels_are_replaced_by_true_ones(drive):
    truth = with_points(drive.truth, frames_of(drive.sweeps))
    boxes = truth.boxes.copy()
    boxes[:, 2] += boxes[:, 5] / 4  # a quarter of the height: IoU 3/5
    boxes[:, 3] *= 1.25  # and of the extents alone 4/5
    found = errors_of({'raw': [replace(truth, boxes=boxes)]}, [truth])['raw']['']
    assert found['true extents'] == pytest.approx(0.6)
    assert found['true centre'] == pytest.approx(0.8)
    assert found['true yaw'] == pytest.approx(found['iou_3d'])


def test_streets_differ_and_have_unlabelled_objects(drive):
    scene = random_street(5, 1)
    assert len(scene.truth.boxes) != len(drive.truth.boxes) / 3
    assert CLUTTER not in scene.truth.class_names
    assert set(scene.truth.class_names) <= set(CLASSES)
    assert max(owner.max() for owner in scene.owners) >= len(scene.actors)
    assert isinstance(drive.boxes[0], BoxArray)
    again = Drive.from_scene(random_street(4, 3))
    np.testing.assert_array_equal(again.truth.boxes, drive.truth.boxes)
