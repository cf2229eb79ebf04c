"""Boxes in centimetres and millimetres are named, with what to do; those in metres are not."""

from boxreg_ros.io.checks.unit import UnitCheck
from boxreg_ros.structures import BoxArray, Sweep
import numpy as np
import pytest
from ros_messages import START

ORIGIN = np.eye(4)
ORIGIN[:3, 3] = 5e5, 4.6e6, 40.0  # as in UTM


def found_in(positions=1.0, sizes=1.0, points=1.0, count=20):
    """Return what is found in boxes and points of a street, each scaled."""
    rng = np.random.default_rng(0)
    cloud = points * rng.uniform(-80, 80, (5000, 3))
    boxes = np.zeros((count, 9))
    boxes[:, :3] = positions * rng.uniform(-60, 60, (count, 3)) + ORIGIN[:3, 3]
    boxes[:, 3:6] = (
        sizes * np.array([[4.5, 1.8, 1.5], [0.6, 0.6, 1.7], [11, 2.5, 3.5]])[np.arange(count) % 3]
    )
    names = tuple(map(str, range(count)))
    check = UnitCheck()
    check.add(Sweep(START, 'map', cloud, T_frame_points=ORIGIN), ORIGIN)
    check.add(BoxArray(START, 'map', names, ('car',) * count, np.ones(count), boxes), ORIGIN)
    return check.finding


def test_boxes_in_metres_are_not_named():
    assert not found_in()
    assert not found_in(positions=3.0)  # detections beyond the points
    assert not found_in(sizes=2.0)
    assert not found_in(100, 100, count=5)


@pytest.mark.parametrize(('scale', 'unit'), [(100, 'centimetres'), (1000, 'millimetres')])
def test_boxes_in_other_units_are_named(scale, unit):
    text = found_in(scale, scale)
    assert f'they are in {unit}' in text and f'extents and positions by {scale}' in text
    text = found_in(sizes=scale)
    assert f'they are in {unit}' in text and f'--size-scale {1 / scale:g}' in text
    assert 'positions in metres' in found_in(positions=scale)
    assert 'points are not in metres' in found_in(points=1 / scale)
