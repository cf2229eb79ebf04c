from boxreg_ros.io.checks.cloud import CloudCheck
from boxreg_ros.structures import Sweep
import numpy as np
import pytest
from ros_messages import START


def found_in(clouds, is_merged=False, stamps_ns=None):
    """Return what is found in clouds, in one text."""
    check = CloudCheck(is_merged)
    for k, points in enumerate(clouds):
        check.add(Sweep(START + (k if stamps_ns is None else stamps_ns[k]), 'lidar', points))
    return ' '.join(check.findings)


def test_coordinates_that_float32_rounds_to_centimetres_are_named():
    points = np.array([[500_000.0, 4_600_000.0, 3.0]], np.float32)
    text = found_in([points])
    assert "clouds in 'lidar'" in text
    assert '0.5 m apart' in text
    without_return = np.tile(np.array([5.0, 4.0, 3.0], np.float32), (1000, 1))
    without_return[::3] = 1e10
    for near in (points.astype(np.float64), points - points, points[:0], without_return):
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


def test_parts_of_a_sweep_are_named_whichever_rings_see_nothing():
    # 16 rings, a point of each after another: every sixteenth point is of the one to the sky.
    clouds = []
    for k in range(30):
        angles = 2 * np.pi * (np.linspace(0, 1, 160_000, endpoint=False) + k) / 10
        points = 9 * np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
        points[::16] = np.nan
        clouds.append(points)
    assert 'each covers about 40 degrees of azimuth' in found_in(clouds)


@pytest.mark.parametrize('apart_ns', [0, 400_000, 10_000_000])
@pytest.mark.parametrize('lidars', [1, 2, 4])
def test_several_lidars_on_one_topic_are_named(apart_ns, lidars):
    """As Livox publishes them by default: one after the other, each with stamps of its own."""
    rng = np.random.default_rng(0)
    clouds, stamps_ns = [], []
    for k in range(40):
        angles = rng.uniform(0, 1.5, 500) + 1.5 * (k % lidars)
        clouds.append(9 * np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1))
        jitter_ns = int(rng.integers(0, 5_000_000)) * (apart_ns > 0)
        stamps_ns.append(k // lidars * 100_000_000 + k % lidars * apart_ns + jitter_ns)
    text = found_in(clouds, stamps_ns=stamps_ns)
    assert ('several LiDARs publish on one topic' in text) == (lidars > 1)
    assert not found_in(clouds, is_merged=True, stamps_ns=stamps_ns)


@pytest.mark.parametrize('apart_ns', [30_000_000, 50_000_000])
@pytest.mark.parametrize('views', [2, 1])
def test_two_views_that_take_turns_are_named(apart_ns, views):
    """Two LiDARs of half a view each, with one frame, that are not triggered at the same time."""
    rng = np.random.default_rng(0)
    clouds, stamps_ns = [], []
    for k in range(40):
        angles = rng.uniform(0, 3.3, 3000) + np.pi * (k % views)
        clouds.append(9 * np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1))
        stamps_ns.append(k // 2 * 100_000_000 + k % 2 * apart_ns)
    text = found_in(clouds, stamps_ns=stamps_ns)
    assert ('got two by turns, of about 190 and 190' in text) == (views == 2), text
    assert ('several LiDARs publish on one topic' in text) == (views == 2)
    assert not found_in(clouds, is_merged=True, stamps_ns=stamps_ns)


@pytest.mark.parametrize('frames', [('front', 'rear'), ('front',), ('', *('front',) * 9)])
def test_lidars_that_take_turns_on_one_topic_are_named_by_their_frames(frames):
    cloud = np.random.default_rng(0).uniform(-9, 9, (5000, 3))
    check = CloudCheck(is_merged=False)
    for k in range(10):
        check.add(Sweep(START + k * 50_000_000, frames[k % len(frames)], cloud))
    text = ' '.join(check.findings)
    assert ("got 'front' and 'rear': several LiDARs" in text) == (len(frames) == 2)
    assert not text or len(frames) == 2


@pytest.mark.parametrize('is_recorded_twice', [True, False])
def test_clouds_one_by_one_are_of_one_lidar(is_recorded_twice):
    clouds = [np.random.default_rng(k).uniform(-9, 9, (5000, 3)) for k in range(40)]
    stamps_ns = [k * 100_000_000 for k in range(40)]
    stamps_ns[20:] = [stamp_ns + 10**12 for stamp_ns in stamps_ns[20:]]  # a jump
    if is_recorded_twice:
        clouds = [cloud for cloud in clouds for _ in range(2)]
        stamps_ns = np.repeat(stamps_ns, 2).tolist()
    assert not found_in(clouds, stamps_ns=stamps_ns)


@pytest.mark.parametrize('kept', [range(0, 120, 3), [k for k in range(300) if k % 9 in (0, 1, 2)]])
def test_clouds_of_one_lidar_may_be_lost(kept):
    clouds = [np.random.default_rng(k).uniform(-9, 9, (5000, 3)) for k in kept]
    assert not found_in(clouds, stamps_ns=[k * 100_000_000 for k in kept])


def test_points_in_millimetres_are_named():
    points = np.random.default_rng(0).uniform(-80, 80, (1000, 3))
    assert not found_in([points + 5e6])
    assert 'they are in millimetres' in found_in([1000 * points])
    assert 'or centimetres' in found_in([100 * points / 20])
