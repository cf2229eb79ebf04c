"""Windows of observations, and their batches as padded tensors."""

from boxreg_ros.config import Config
from boxreg_ros.window import batches, one_heading, stack
import numpy as np
import pytest
from scenes import drive, track_of, window_of

CONFIG = Config()


def windows(lengths):
    rng = np.random.default_rng(0)
    return [window_of(track_of(drive(n), rng, str(n)), CONFIG) for n in lengths]


def given(window):
    return np.array([observation.box for observation in window.observations])


def test_stack_pads():
    lengths = [10, 6, 8, 3]
    many = windows(lengths)
    problem, base = stack(many, CONFIG)
    assert problem.valid.sum(1).tolist() == lengths
    np.testing.assert_allclose(problem.boxes[:, 0, :3], 0)
    assert (problem.times.diff(dim=1) > 0).all()
    for b, (one, n) in enumerate(zip(many, lengths, strict=True)):
        centers = problem.boxes[b, :n, :3].numpy() + base[b]
        np.testing.assert_allclose(centers, given(one)[:, :3])
        np.testing.assert_allclose(problem.times[b, :n], 0.1 * np.arange(n), atol=1e-12)
        for i, observation in enumerate(one.observations):
            mask = problem.mask[b, i]
            np.testing.assert_array_equal(problem.points[b, i][mask], observation.points)
            np.testing.assert_array_equal(problem.origins[b, i], observation.origin)
        assert not problem.mask[b, n:].any()
    assert problem.deviations['position'].tolist() == [CONFIG.vehicle.position] * 4


@pytest.mark.parametrize(
    'yaw, known',
    [
        ([0.0, 0.1, 0.2], [0.0, 0.1, 0.2]),
        ([3.0, -3.2, -3.1], [3.0, 2 * np.pi - 3.2, 2 * np.pi - 3.1]),  # across half a turn
        ([0.0, np.pi + 0.1, 0.2], [0.0, 0.1, 0.2]),  # one flip of three
        ([np.pi, 0.1, 0.2], [0.0, 0.1, 0.2]),  # the first is the flipped one
        ([0.0, 0.1 - np.pi, 0.2 - np.pi, 0.3, 0.4], [0.0, 0.1, 0.2, 0.3, 0.4]),
        ([2.0], [2.0]),
    ],
)
def test_one_heading(yaw, known):
    # Up to whole turns; steps are small whatever the input.
    # What is padded, here by half turns, has no say.
    padded = np.array([yaw + [yaw[-1] + np.pi] * 9])
    (found,) = one_heading(padded, np.arange(padded.size)[None] < len(yaw))[:, : len(yaw)]
    np.testing.assert_allclose(np.cos(found - known), 1, atol=1e-12)
    assert (np.abs(np.diff(found)) < np.pi / 2).all()


def test_a_solved_window_starts_where_it_was():
    # The first three of four boxes were solved before, 0.2 m off and a whole turn away.
    (window,) = windows([4])
    solved = given(window)[:3] + np.array([0.2, 0, 0, 0, 0, 0, 0, 0, -2 * np.pi])
    window = window._replace(fresh=1, start=solved)
    assert window.is_warm
    problem, _ = stack([window], CONFIG)
    known = np.zeros((4, 9))
    known[:3, 0] = 0.2
    np.testing.assert_allclose(problem.start[0] - problem.boxes[0], known, atol=1e-12)
    fresh = window.fresh_part()
    assert fresh.observations == window.observations[3:]
    np.testing.assert_array_equal(stack([fresh], CONFIG)[0].start, stack([fresh], CONFIG)[0].boxes)


def test_batches_hold_every_window_that_is_long_enough_once():
    many = windows([10, 2, 6, 3, 1, 6])
    rows = batches(many, CONFIG)
    assert sorted(i for group in rows for i in group) == [0, 2, 3, 5]


def test_batches_are_bounded_and_equally_warm(monkeypatch):
    many = windows([5, 6, 7, 8])
    many[1] = many[1]._replace(fresh=1, start=given(many[1])[:5])
    monkeypatch.setattr('boxreg_ros.window.BATCH_VALUES', 2 * 8 * 256 * 18)
    assert batches(many, CONFIG) == [[0, 2], [3], [1]]
