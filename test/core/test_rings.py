"""The rings of a LiDAR, found in the points of an object."""

import time

from boxreg_ros.core.method.rings import covering_gap, MOST_RANKED, ring_heights, sort
import numpy as np
import pytest


def wall(rises, distance=20.0, columns=12):
    """Return points around the centre of a wall `distance` m ahead, on rings of some `rises`."""
    rng = np.random.default_rng(1)
    across = np.linspace(-1, 1, columns)
    points = [(rng.normal(0, 0.02), y, rise * distance) for rise in rises for y in across]
    return np.array(points, np.float32)


def heights_of(points, *origins):
    return ring_heights(points, np.array([len(points)]), np.array([origins], float))


@pytest.mark.parametrize('columns', [1, 12])
def test_height_between_rings_is_their_angle_times_the_distance(columns):
    # Rings 0.01 apart per metre, 0.2 m at 20 m. Range noise moves points along their rays.
    points = wall(np.arange(-5, 3) * 0.01, columns=columns)
    assert heights_of(points, [-20, 0, 0]) == pytest.approx(0.2, abs=0.005)


def test_rings_without_returns_leave_the_height_as_it_is():
    # A window at three of ten rings: one gap of four rings, six gaps of one.
    points = wall(np.delete(np.arange(10), [4, 5, 6]) * 0.01)
    assert heights_of(points, [-20, 0, 0]) == pytest.approx(0.2, abs=0.005)


def test_a_roof_that_several_rings_meet_is_seen():
    # From 1 m above a roof of 2 m, 10 m ahead, at the slopes -1/10 to -1/12, every 0.005.
    down = np.arange(-0.1, -1 / 12, 0.005)
    roof = np.array([(-1 / slope - 10, y, 0) for slope in down for y in (-0.5, 0.5)])
    side = np.array([(0, y, 1 - 0.005 * k - 1) for k in range(1, 20) for y in (-0.5, 0.5)])
    assert heights_of(np.concatenate([side, roof]), [-10, 0, 1]) == pytest.approx(0, abs=1e-6)


def test_of_several_sensors_the_densest_rings_count():
    # Seen from 1 m higher the rings of the first one are no rings: their points have all slopes.
    points = wall(np.arange(-5, 3) * 0.01)
    first, second = [-20, 0, 0], [-20, 3, 1]
    both = heights_of(points, first, second)
    assert both == min(heights_of(points, first), heights_of(points, second))


def test_without_a_sensor_or_points_the_height_is_unknown():
    points = wall([0.0, 0.01])
    assert heights_of(points, [np.nan] * 3) == 0
    assert heights_of(points[:1], [-20, 0, 0]) == 0
    assert heights_of(points[:0], [-20, 0, 0]) == 0
    assert len(ring_heights(points[:0], np.zeros(0, int), np.zeros((0, 1, 3)))) == 0


def test_each_object_has_its_own_points():
    rises = np.arange(5) * 0.01
    near, far = wall(rises, 10.0), wall(rises, 40.0)
    counts = np.array([len(near), len(far)])
    origins = np.array([[[-10.0, 0, 0]], [[-40.0, 0, 0]]])
    found = ring_heights(np.concatenate([near, far]), counts, origins)
    np.testing.assert_allclose(found, [0.1, 0.4], rtol=0.02)


def test_half_of_the_range_is_covered_by_smaller_gaps():
    # Gaps .1 .1 .1 .3 .4 of a range of 1: sorted, half of it is reached with the .3.
    values = np.cumsum([0, 0.4, 0.1, 0.3, 0.1, 0.1])
    values = np.random.default_rng(0).permutation(values)
    assert covering_gap(values, *np.empty((3, 6))) == pytest.approx(0.3)


@pytest.mark.parametrize('number', [100, MOST_RANKED + 1])
def test_equal_values_are_sorted_too(number):
    values = np.random.default_rng(0).normal(0, 1, number).round(1)
    ordered = np.empty(number)
    sort(values, np.empty(number), ordered)
    np.testing.assert_array_equal(ordered, np.sort(values))


def test_the_time_of_many_points_grows_as_they_do():
    points = wall(np.arange(-40, 40) * 0.002, columns=100)

    def seconds(n):
        begin = time.thread_time()
        heights_of(points[:n], [-20, 0, 0])
        return time.thread_time() - begin

    seconds(len(points))
    few, many = (min(seconds(n) for _ in range(5)) for n in (1000, 8000))
    assert many < 30 * few
