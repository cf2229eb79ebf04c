"""Sweeps and boxes as callers give them: what is converted, and what is refused."""

from dataclasses import replace

from boxreg_ros import BoxArray, BoxRegistrar, Config, ShapeError, Sweep
from boxreg_ros.structures import is_valid_box
import numpy as np
import pytest

BOX = [8.0, 4.0, 0.75, 4.4, 1.8, 1.5, 0.0, 0.0, 0.0]


def sweep(**changes):
    return Sweep(**{'stamp_ns': 0, 'frame_id': 'odom', 'points': np.zeros((2, 3)), **changes})


def boxes(**changes):
    given = {'track_ids': ('7',), 'class_names': ('car',), 'scores': [1.0], 'boxes': [BOX]}
    return BoxArray(**{'stamp_ns': 0, 'frame_id': 'odom', **given, **changes})


def test_lists_become_arrays_and_tuples():
    array = boxes(track_ids=['7'], class_names=['car'], pinned=[True])
    assert array.boxes.dtype == array.scores.dtype == np.float64
    assert array.track_ids == ('7',)
    assert array.pinned.tolist() == [True]
    cloud = sweep(points=[[1, 2, 3]], times=[0], origin=[0, 0, 1])
    assert cloud.points.dtype == cloud.times.dtype == cloud.origin.dtype == np.float64
    assert boxes(track_ids=[], class_names=[], scores=[], boxes=[]).boxes.shape == (0, 9)


def test_clouds_of_either_precision_are_not_copied():
    for kind in (np.float32, np.float64):
        points = np.zeros((5, 3), kind)
        assert sweep(points=points).points is points
    assert sweep(points=np.zeros((5, 3), np.float16)).points.dtype == np.float64


@pytest.mark.parametrize('kind', [np.float32, int])
def test_a_stream_takes_boxes_of_any_precision(kind):
    registrar = BoxRegistrar(Config(estimate='final'))
    rng = np.random.default_rng(0)
    points = np.array(BOX[:3]) + rng.uniform(-0.5, 0.5, (100, 3)) * [4.3, 1.7, 1.5]
    results = []
    for stamp_ns in range(0, 5 * 10**8, 10**8):
        results += registrar.add_sweep(sweep(stamp_ns=stamp_ns, points=points))
        given = np.array([BOX]).astype(kind).clip([*[-100] * 3, *[1] * 3, *[-4] * 3])
        results += registrar.add_boxes(boxes(stamp_ns=stamp_ns, boxes=given))
    results += registrar.flush()
    assert registrar.counts['boxes'] == 5
    assert all(np.isfinite(result.boxes.boxes).all() for result in results)


@pytest.mark.parametrize(
    ('make', 'changes', 'words'),
    [
        (boxes, {'boxes': np.zeros((1, 7))}, ['boxes', '(1, 7)', 'height roll pitch yaw']),
        (boxes, {'boxes': BOX}, ['boxes', '(9,)']),
        (boxes, {'scores': None}, ['scores']),
        (boxes, {'track_ids': (0,)}, ['track_ids', 'text', '0']),
        (boxes, {'class_names': 'c'}, ['class_names', "'c'"]),
        (boxes, {'class_names': ()}, ['class_names', '1', '0']),
        (boxes, {'pinned': [True, False]}, ['pinned', '(2,)']),
        (boxes, {'attributes': ({}, {})}, ['attributes', '(1,)', '(2,)']),
        (boxes, {'stamp_ns': 0.1}, ['stamp_ns', '0.1', '1e9']),
        (sweep, {'stamp_ns': 0.1}, ['stamp_ns', '0.1', '1e9']),
        (sweep, {'points': np.zeros((2, 4))}, ['points', '(2, 4)', 'x y z']),
        (sweep, {'points': 'cloud'}, ['points', 'numbers']),
        (sweep, {'origin': np.zeros(2)}, ['origin', '(2,)']),
        (sweep, {'times': np.zeros(3)}, ['times', '(2,)', '(3,)']),
        (sweep, {'origins': np.zeros((1, 3))}, ['origins and sensors']),
        (sweep, {'origins': np.zeros((1, 3)), 'sensors': np.zeros(3, np.uint8)}, ['sensors']),
    ],
)
def test_other_shapes_and_types_are_refused(make, changes, words):
    with pytest.raises(ShapeError) as error:
        make(**changes)
    assert all(word in str(error.value) for word in words)


@pytest.mark.parametrize('column', range(9))
def test_boxes_of_no_object_are_invalid(column):
    box = np.array([1.0, 2, 3, 4, 2, 1.5, 0.1, 0.2, 0.3])
    limit = 3e7 if column < 3 else 1e3 if column < 6 else np.inf  # [m], [m], [rad]
    at, below = limit, np.nextafter(limit, 0)
    values = [np.nan, at, -at, below, *([0.0] if 3 <= column < 6 else [])]
    boxes = np.tile(box, (len(values), 1))
    boxes[:, column] = values
    assert is_valid_box(boxes).tolist() == [value == below for value in values]
    assert is_valid_box(box)


def test_rows_are_taken_with_all_their_columns():
    values = np.arange(27.0).reshape(3, 9)
    pinned = np.array([True, False, False])
    array = BoxArray(0, 'odom', ('a', 'b', 'c'), ('car', 'van', 'bus'), np.arange(3.0), values)
    array = replace(array, pinned=pinned)
    taken = array.take([2, 0])
    assert (taken.track_ids, taken.class_names) == (('c', 'a'), ('bus', 'car'))
    assert (taken.scores.tolist(), taken.pinned.tolist()) == ([2.0, 0.0], [False, True])
    np.testing.assert_array_equal(taken.boxes, values[[2, 0]])
