"""Rules on labels, each with labels of one known fault."""

from boxreg_ros.config import Config
from boxreg_ros.review.label_tracks import LabelTrack
from boxreg_ros.review.rules import counts, ERROR, RULES, violations, WARNING
import numpy as np
import pytest

N = 30
STAMPS = np.arange(N, dtype=np.int64) * 10**8


def track(name='1', y=0.0, class_name='car', points=100, n=N):
    """Return a car that drives straight along x at 10 m/s."""
    boxes = np.tile([0.0, y, 0.75, 4.5, 1.8, 1.5, 0.0, 0.0, 0.0], (n, 1))
    boxes[:, 0] = np.arange(n)
    numbers = np.full(n, points)
    return LabelTrack.of(name, class_name, Config(), STAMPS[:n], boxes, numbers)


def changed(rows, column, value, **kwargs):
    """Return that track with some values changed."""
    found = track(**kwargs)
    found.boxes[rows, column] += value
    return found


def test_good_labels_violate_no_rule():
    good = [track(str(i), y=4.0 * i) for i in range(5)]
    assert violations(good) == {}
    assert counts(violations(good)) == dict.fromkeys(RULES, 0)
    assert counts(violations([])) == dict.fromkeys(RULES, 0)


def sideways():
    found = track()
    found.boxes[:, 1] = found.boxes[:, 0]
    return found


def backward():
    found = track()
    found.boxes[:, 8] = np.pi
    return found


def twice():
    found = track()
    found.stamps_ns[1:] = found.stamps_ns[:-1].copy()
    return found


ROAD = [track(str(i), y=3.0 * i) for i in range(4)]

FAULTS = {
    'size-outside-class': ([changed(slice(None), 3, 30.0)], 0),
    'size-changes': ([changed(7, 3, 1.0)], 7),
    'jump': ([changed(8, 1, 2.0)], 8),
    'spin': ([changed(9, 8, np.pi)], 9),
    'sliding': ([sideways()], None),
    'floating': ([*ROAD, changed(5, 2, 2.0, name='f', y=-3.0)], 5),
    'overlap': ([track('a'), track('b', y=1.0)], None),
    'duplicate': ([track('a'), track('b', y=0.1)], 0),
    'few-points': ([track(points=2)], 0),
    'backward': ([backward()], 0),
    'ends-in-view': ([track('a'), track('b', y=9.0, n=10)], 9),
}  # fmt: skip


@pytest.mark.parametrize('name', RULES)
def test_each_rule_finds_its_fault_at_its_stamp(name):
    tracks, row = FAULTS[name]
    found = violations(tracks)
    assert name in found
    if row is not None:
        assert found[name][0].stamp_ns == STAMPS[row]
    assert RULES[name].severity in (ERROR, WARNING)
    assert RULES[name].rule_id == name


def timed(seconds, rows, column, value):
    """Return the car with other times between its boxes [s], and with some values changed."""
    found = changed(rows, column, value)
    stamps = np.round(np.arange(N) * seconds * 1e9).astype(np.int64)
    found.boxes[:, 0] = stamps * 1e-8
    return LabelTrack.of('1', 'car', Config(), stamps, found.boxes, found.num_points)


def pointed(numbers, n=N):
    """Return the car with numbers of points, beside one that goes on to the end."""
    found = track('b', y=9.0, n=n)
    found.num_points[-len(numbers) :] = numbers
    return [track('a'), found]


@pytest.mark.parametrize(
    ('name', 'below', 'beyond'),
    [
        ('jump', [timed(0.1, 8, 1, 0.24)], [timed(0.1, 8, 1, 0.26)]),  # 0.5 m off
        ('jump', [timed(0.5, 8, 1, 3.6)], [timed(0.5, 8, 1, 3.9)]),  # 30 m/s^2
        ('jump', [timed(2.0, 8, 1, 300.0)], [timed(0.9, 8, 1, 300.0)]),  # of steps up to 1 s
        ('spin', [timed(0.1, 9, 8, 0.19)], [timed(0.1, 9, 8, 0.21)]),  # 2 rad/s
        ('spin', [timed(0.02, 9, 8, 0.09)], [timed(0.02, 9, 8, 0.11)]),  # 0.1 rad
        ('few-points', pointed([4] * (N // 2)), pointed([4] * (N // 2 + 1))),
        ('ends-in-view', pointed([49], n=10), pointed([50], n=10)),
    ],
)
def test_rules_have_limits(name, below, beyond):
    assert name not in violations(below)
    assert name in violations(beyond)


def test_an_id_that_occurs_twice_at_a_stamp_is_a_duplicate():
    (first,) = violations([twice()])['duplicate']
    assert 'occurs twice' in first.text


def test_invalid_boxes_are_left_out():
    boxes = np.full((3, 9), np.nan)
    empty = LabelTrack.of('1', 'car', Config(), STAMPS[:3], boxes, np.zeros(3, int))
    assert len(empty.boxes) == 0
    assert violations([empty]) == {}
