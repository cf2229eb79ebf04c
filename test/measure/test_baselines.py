"""The baselines on known answers: a smoother, a rectangle fit per sweep, and ICP."""

from boxreg_ros.core.refine import Track
from measure.methods import ctra_smoothed, icp, l_shaped, smoothed, smoothed_live
import numpy as np
import pytest


def make_track(boxes, points=None, origins=None):
    n = len(boxes)
    stamps = np.arange(n) * 100_000_000
    return Track('1', 'car', stamps, boxes, points or [np.zeros((0, 3))] * n, origins)


def car(n, speed):
    boxes = np.tile([0, 0, 0.75, 4.4, 1.8, 1.5, 0, 0, 0.6], (n, 1))
    boxes[:, :2] += np.outer(np.arange(n) * 0.1 * speed, [np.cos(0.6), np.sin(0.6)])
    return boxes


@pytest.mark.parametrize('speed', [0.0, 8.0])
def test_smoother_removes_noise_flips_and_outliers(speed):
    truth = car(60, speed)
    rng = np.random.default_rng(0)
    noisy = truth.copy()
    noisy[:, [0, 1, 2, 8]] += rng.normal(0, (0.2, 0.2, 0.1, 0.1), (60, 4))
    noisy[:, 3:6] += rng.normal(0, 0.1, (60, 3))
    noisy[[3, 30, 31], 8] += np.pi
    noisy[20, :2] += 3  # one gross outlier
    found = smoothed(make_track(noisy))
    error = np.abs(found - truth)
    assert error[:, :2].mean() < 0.06
    assert error[:, 8].max() < 0.1
    assert np.ptp(found[:, 3:6], axis=0).max() == 0
    assert error[20, :2].max() < 0.15
    assert (np.ptp(found[:, 0]) == 0) == (speed == 0)


def test_smoother_keeps_perfect_and_short_tracks():
    truth = car(40, 6.0)
    np.testing.assert_allclose(smoothed(make_track(truth)), truth, atol=1e-6)
    np.testing.assert_allclose(smoothed(make_track(truth[:2])), truth[:2], atol=1e-6)


def test_smoother_handles_yaw_near_pi():
    truth = car(30, 0.0)
    truth[:, 8] = np.pi + np.random.default_rng(1).normal(0, 0.05, 30)
    truth[:, 8] = (truth[:, 8] + np.pi) % (2 * np.pi) - np.pi
    found = smoothed(make_track(truth))[:, 8]
    assert np.abs(np.cos(found) + 1).max() < 1e-2


def bend(n, speed=8.0, turn_rate=0.4):
    """Return the boxes of a car on a circle."""
    boxes = car(n, 0.0)
    boxes[:, 8] = turn_rate * 0.1 * np.arange(n)
    radius = speed / turn_rate
    boxes[:, :2] = radius * np.column_stack([np.sin(boxes[:, 8]), 1 - np.cos(boxes[:, 8])])
    return boxes


def test_ctra_takes_the_heading_from_the_path():
    truth = bend(40)
    noisy = truth.copy()
    rng = np.random.default_rng(4)
    noisy[:, :2] += rng.normal(0, 0.05, (40, 2))
    noisy[:, 8] += 0.1 + rng.normal(0, 0.05, 40)  # a constant error: no smoother of yaw removes it
    noisy[7, 8] += np.pi
    found, plain = (smoother(make_track(noisy)) for smoother in (ctra_smoothed, smoothed))
    assert np.abs(found - truth)[:, 8].mean() < 0.05
    assert np.abs(plain - truth)[:, 8].mean() > 0.08
    assert np.abs(found - truth)[:, :2].mean() < 0.05


def test_ctra_keeps_perfect_short_and_parked_tracks():
    truth = bend(30)
    np.testing.assert_allclose(ctra_smoothed(make_track(truth)), truth, atol=1e-3)
    for boxes in (truth[:2], car(20, 0.0)):
        np.testing.assert_allclose(ctra_smoothed(make_track(boxes)), smoothed(make_track(boxes)))


def test_live_smoother_uses_past_boxes_only():
    truth = car(30, 8.0)
    noisy = truth.copy()
    noisy[:, :2] += np.random.default_rng(3).normal(0, 0.2, (30, 2))
    newest, lagged = smoothed_live(make_track(noisy), lag=5)
    np.testing.assert_allclose(newest[12], smoothed(make_track(noisy[:13]))[-1])
    np.testing.assert_allclose(lagged[12], smoothed(make_track(noisy[:18]))[12])
    np.testing.assert_allclose(lagged[24:], smoothed(make_track(noisy))[24:])
    # More observations, smaller errors. Inner boxes only: all three estimates are settled there.
    errors = [
        np.abs(found - truth)[10:25, :2].mean()
        for found in (newest, lagged, smoothed(make_track(noisy)))
    ]
    assert errors[0] > 1.2 * errors[1] > 1.2 * errors[2]


def corner_points(box, rng):
    """Return points on the rear and the right side of an upright box."""
    x, _, _, length, width, height, *_, yaw = box
    del x
    rear = np.c_[np.full(150, -length / 2), rng.uniform(-width / 2, width / 2, 150)]
    right = np.c_[rng.uniform(-length / 2, length / 2, 250), np.full(250, -width / 2)]
    flat = np.concatenate([rear, right])
    R = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    z = rng.uniform(-0.4 * height, 0.5 * height, len(flat))
    return np.c_[flat @ R.T + box[:2], box[2] + z]


def observed_track(shift):
    """Return the track of a car observed from its rear right, off by `shift`, and its truth."""
    truth = car(3, 0.0)
    rng = np.random.default_rng(2)
    points = [corner_points(box, rng) for box in truth]
    sensor = np.array(
        [-12 * np.cos(0.6) + 8 * np.sin(0.6), -12 * np.sin(0.6) - 8 * np.cos(0.6), 1.0]
    )
    return make_track(truth + shift, points, np.tile(sensor, (3, 1))), truth


def test_rectangle_fit_recovers_position_and_yaw():
    track, truth = observed_track(np.array([0.25, -0.2, 0, 0, 0, 0, 0, 0, 0.15]))
    found = l_shaped(track)
    np.testing.assert_allclose(found[:, :2], truth[:, :2], atol=0.06)
    np.testing.assert_allclose(found[:, 8], truth[:, 8], atol=np.radians(1))
    np.testing.assert_allclose(found[:, 2:8], track.boxes[:, 2:8])


def test_icp_reduces_the_position_error():
    pytest.importorskip('small_gicp', reason='small_gicp is not installed')
    track, truth = observed_track(np.array([0.1, -0.1, 0, 0, 0, 0, 0, 0, 0.05]))
    found = icp(track)
    before = np.linalg.norm((track.boxes - truth)[:, :2], axis=1)
    assert (np.linalg.norm((found - truth)[:, :2], axis=1) < 0.6 * before).all()
    assert np.abs(found[:, 8] - truth[:, 8]).max() < 0.03


@pytest.mark.parametrize('method', [l_shaped, icp])
def test_boxes_without_points_are_unchanged(method):
    if method is icp:
        pytest.importorskip('small_gicp', reason='small_gicp is not installed')
    truth = car(3, 5.0)
    np.testing.assert_array_equal(method(make_track(truth)), truth)
