"""Stamps of clouds as drivers write them."""

from boxreg_ros.io.checks.stamps import regularity, StampCheck
from boxreg_ros.structures import Sweep
import numpy as np
import pytest

COUNT = 100


def regular(rng, period=0.1, jitter=0.0, part=1.0):
    """Return the stamps [s] of the part of clouds that is not lost."""
    count = round(COUNT / part)
    stamps = period * np.arange(count) + rng.normal(0, jitter, count)
    return rng.permutation(stamps)[:COUNT]


def ns(seconds):
    return 1_700_000_000 * 10**9 + np.round(1e9 * np.asarray(seconds)).astype(np.int64)


@pytest.mark.parametrize(
    ('period', 'jitter', 'part'),
    [(0.1, 0.003, 0.9), (0.1, 0.01, 1), (0.1, 0.015, 0.6), (0.05, 0.009, 1), (0.2, 0.02, 1)],
)
def test_deviation_from_the_period_is_that_of_the_stamps(period, jitter, part):
    """By Monte Carlo: its own deviation is about jitter / sqrt(200)."""
    rng = np.random.default_rng(3)
    found = [regularity(ns(regular(rng, period, jitter, part))) for _ in range(30)]
    assert np.median([one.period for one in found]) == pytest.approx(period, rel=2e-3)
    assert np.median([one.deviation for one in found]) == pytest.approx(jitter, rel=0.1)


def triggered(rng):
    return np.cumsum(rng.normal(0.1, 0.007, COUNT))


def throttled(_):
    return np.cumsum(np.resize([0.1, 0.15], COUNT))


def two_lidars(_):
    return np.cumsum(np.resize([0.03, 0.07], COUNT))


def key_frames(rng):
    return 0.5 * np.arange(COUNT) + rng.choice([-0.05, 0, 0.05], COUNT)


def bursts(_):
    return (0.1 * np.arange(25)[:, None] + 1e-6 * np.arange(4)).ravel()


def with_a_gap(_):
    return 0.1 * np.arange(COUNT) + 1e6 * (np.arange(COUNT) > 50)


def of_one_time(_):
    return np.zeros(COUNT)


@pytest.mark.parametrize(
    'stamps',
    [regular, triggered, throttled, two_lidars, key_frames, bursts, with_a_gap, of_one_time],
)
def test_other_stamps_are_right(stamps):
    found = regularity(ns(stamps(np.random.default_rng(1))))
    assert found.deviation == pytest.approx(0, abs=0.002)


@pytest.mark.parametrize('jitter', [0.0, 0.004, 0.015])
def test_a_driver_that_stamps_on_receipt_is_named_with_the_way(jitter):
    check = StampCheck()
    stamps = ns(0.1 * np.arange(COUNT) + np.random.default_rng(0).normal(0, jitter, COUNT))
    for k, stamp in enumerate(stamps.tolist()):
        assert not check.finding
        cloud = Sweep(stamp, 'lidar', np.zeros((0, 3)), topic='/front')
        check.add(cloud, np.array([1.0 * k, 0, 0]))
    expected = 'stamps of clouds of /front: expected one every 0.100 s, got ones that are off by'
    assert (expected in check.finding) == (jitter > 0.008)
    assert ('m off at 10 m/s' in check.finding) == (jitter > 0.008)
