"""Headings by points on two sides of an object."""

from boxreg_ros.core.l_shape import closest_heading
import numpy as np
import pytest

YAWS = np.radians(np.arange(0, 90, 2))


@pytest.mark.parametrize('degrees', [0, 14, 46, 88])
@pytest.mark.parametrize('seen', ['two sides', 'one side'])
def test_heading_is_that_of_the_sides(degrees, seen):
    along = np.linspace(0, 4.4, 40)
    across = np.linspace(0, 1.8, 20) if seen == 'two sides' else np.zeros(0)
    points = np.vstack([np.c_[along, 0 * along], np.c_[0 * across, across]])
    points += np.random.default_rng(0).normal(0, 0.01, points.shape)
    yaw = np.radians(degrees)
    R = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    found = closest_heading(points @ R.T + [20, -30], YAWS)
    off = (found - yaw + np.pi / 4) % (np.pi / 2) - np.pi / 4  # of a quarter turn
    assert abs(off) <= np.radians(2)
