from boxreg_ros.io.cloud_check import CloudCheck
from boxreg_ros.structures import Sweep
import numpy as np
import pytest
from ros_messages import START


def found_in(clouds, is_merged=False):
    """Return what is found in clouds, in one text."""
    check = CloudCheck(is_merged)
    for k, points in enumerate(clouds):
        check.add(Sweep(START + k, 'lidar', points))
    return ' '.join(check.findings)


def test_coordinates_that_float32_rounds_to_centimetres_are_named():
    points = np.array([[500_000.0, 4_600_000.0, 3.0]], np.float32)
    text = found_in([points])
    assert "clouds in 'lidar'" in text
    assert '0.5 m apart' in text
    for near in (points.astype(np.float64), points - points, points[:0]):
        assert not found_in([near])


@pytest.mark.parametrize('is_merged', [False, True])
@pytest.mark.parametrize('parts', [1, 10])
def test_clouds_that_are_parts_of_a_sweep_are_named(parts, is_merged):
    clouds = []
    for k in range(30):
        angles = 2 * np.pi * (np.linspace(0, 1, 500, endpoint=False) + k) / parts
        clouds.append(9 * np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1))
    named = 'each covers about 40 degrees of azimuth, and 30 together 360'
    assert (named in found_in(clouds, is_merged)) == (parts == 10 and not is_merged)


def test_points_in_millimetres_are_named():
    points = np.random.default_rng(0).uniform(-80, 80, (1000, 3))
    assert not found_in([points + 5e6])
    assert 'they are in millimetres' in found_in([1000 * points])
