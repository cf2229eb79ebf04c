"""Windows of observations, and batches of windows as padded arrays."""

from boxreg_ros.config import Config
from boxreg_ros.core.estimation import margin_columns
from boxreg_ros.core.method import headings
from boxreg_ros.core.method.arrays import PRIOR as PRIOR_SIZE
from boxreg_ros.core.method.constants import CONSTANTS
from boxreg_ros.core.problem import group_windows, NO_RANGE, Problem
from boxreg_ros.core.problem import stack_windows as stack
from boxreg_ros.core.window import MarginalisationPrior
from boxreg_ros.structures import POSE, ROLL, YAW
import numpy as np
import pytest
from scenes import changed, drive, row_of, track_of, window_of

CONFIG = Config()


def stack_windows(windows, config):
    return stack(windows, config, CONSTANTS.prior_decay)


def windows(lengths):
    rng = np.random.default_rng(0)
    return [window_of(track_of(drive(n), rng, str(n)), CONFIG) for n in lengths]


def given(window):
    return np.array([observation.box for observation in window.observations])


def with_prior(window, yaw=0.0):
    """Return a window with a prior whose base is 1 m before the first box; headings + `yaw`."""
    boxes = given(window)
    base = boxes[0, :3] - [1.0, 0, 0]
    pose = boxes[:2, POSE] - [*base, 0, 0, 0]
    pose[:, 5] += yaw
    shared = [*boxes[0, 3:6], *np.zeros(PRIOR_SIZE - 15)]
    step = np.random.default_rng(3).normal(size=PRIOR_SIZE)
    information = np.diag(1.0 + np.arange(PRIOR_SIZE))
    state, extents = np.r_[pose.ravel(), shared], np.array([4, 2, 1, 1])
    columns = base, state, step, information, extents, NO_RANGE
    prior = MarginalisationPrior(*(np.array([column]) for column in columns))
    start = boxes[:-1] + 0.01 * np.eye(9)[8]
    return window._replace(num_new=1, start=start, prior=(prior, 0))


def flipped(window):
    """Return `window` with the heading signs of all input boxes changed."""
    boxes = [o.box + np.pi * np.eye(9)[8] for o in window.observations]
    pairs = zip(window.observations, boxes, strict=True)
    return window._replace(observations=[changed(o, boxes=box) for o, box in pairs])


def resolve_headings(boxes, times, valid, known_yaw):
    """Return the resolved headings (B, N) of windows."""
    yaw = np.empty(valid.shape)
    headings.resolve_headings(boxes, times, valid.sum(1), known_yaw, yaw)
    return yaw


def test_windows_are_padded():
    lengths = [10, 6, 8, 3]
    many = windows(lengths)
    problem, priors = stack_windows(many, CONFIG)
    assert problem.valid.sum(1).tolist() == lengths
    np.testing.assert_allclose(problem.boxes[:, 0, :3], 0)
    assert (np.diff(problem.times) > 0).all()
    for b, (one, n) in enumerate(zip(many, lengths, strict=True)):
        centers = problem.boxes[b, :n, :3] + priors.base[b]
        np.testing.assert_allclose(centers, given(one)[:, :3])
        np.testing.assert_allclose(problem.times[b, :n], 0.1 * np.arange(n), atol=1e-12)
        for i, observation in enumerate(one.observations):
            np.testing.assert_array_equal(points_of(problem, b, i), observation.points)
            np.testing.assert_array_equal(problem.origins[b, i], observation.origins)
        assert not problem.counts[b, n:].any()
    assert problem.of_class['pose'][:, 0].tolist() == [CONFIG.vehicle.position] * 4


def points_of(problem, b, i):
    """Return the points of one observation."""
    first = problem.first[b, i]
    return problem.points[first : first + problem.counts[b, i]]


def seconds(boxes):
    """Return the times of `boxes` (1, N, 9) at 10 Hz."""
    return 0.1 * np.arange(boxes.shape[1])[None]


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
def test_flips_of_a_minority_are_corrected(yaw, known):
    # Equal up to whole turns; steps are small for any input. Padding, here flipped, is ignored.
    boxes = np.zeros((1, len(yaw) + 9, 9))
    boxes[0, :, YAW] = yaw + [yaw[-1] + np.pi] * 9
    times, valid = seconds(boxes), np.arange(boxes.shape[1])[None] < len(yaw)
    (found,) = resolve_headings(boxes, times, valid, np.array([np.nan]))[:, : len(yaw)]
    np.testing.assert_allclose(np.cos(found - known), 1, atol=1e-12)
    assert (np.abs(np.diff(found)) < np.pi / 2).all()


def test_a_quarter_turn_does_not_affect_other_boxes():
    yaw = np.zeros(60)
    yaw[29:32] = -0.05, 1.54, -0.05  # nearer to -pi / 2 than to pi / 2, seen from the next one
    boxes = yaw[None, :, None] * np.eye(9)[YAW]
    (found,) = resolve_headings(boxes, seconds(boxes), np.ones((1, 60), bool), np.array([np.nan]))
    np.testing.assert_allclose(np.delete(found, 30), np.delete(yaw, 30), atol=1e-12)


def test_a_flip_changes_the_signs_of_roll_and_pitch():
    # With the opposite heading, roll to the left is roll to the right and nose up is nose down.
    truth = drive(9, turn=0) + np.array([0, 0, 0, 0, 0, 0, 0.1, -0.2, 0])
    track = track_of(truth, np.random.default_rng(0), position=0.0, heading=0.0)
    track.boxes[::3, ROLL:] = track.boxes[::3, ROLL:] * [-1, -1, 1] + [0, 0, np.pi]
    problem, _ = stack_windows([window_of(track, CONFIG)], CONFIG)
    np.testing.assert_allclose(problem.boxes[0, :, ROLL:YAW], truth[:, ROLL:YAW], atol=1e-9)


@pytest.mark.parametrize('turns', [0.0, 2 * np.pi, -6 * np.pi])
@pytest.mark.parametrize('is_first_turned', [False, True])
@pytest.mark.parametrize(
    ('contrary', 'unknown', 'known'),
    [
        (1, 0, 0),
        (3, 0, 0),
        (5, np.pi, 0),  # more than half, less than three quarters of eight
        (7, np.pi, np.pi),  # more than three quarters
        (8, np.pi, np.pi),
    ],
)
def test_a_known_heading_sign_is_kept_unless_three_quarters_contradict(
    turns, is_first_turned, contrary, unknown, known
):
    # Eight boxes that turn slowly from 0, of which `contrary` are flipped, the first or the last
    # ones. The heading known from before is 0 plus whole turns.
    steps = 0.01 * np.arange(8)
    is_contrary = np.arange(8) < contrary if is_first_turned else np.arange(8) >= 8 - contrary
    boxes, valid = np.zeros((1, 8, 9)), np.ones((1, 8), dtype=bool)
    boxes[0, :, YAW] = steps + np.pi * is_contrary
    for heading, base in ((np.nan, unknown), (0.02 + turns, known)):
        (found,) = resolve_headings(boxes, seconds(boxes), valid, np.array([heading]))
        np.testing.assert_allclose(np.cos(found - steps - base), 1, atol=1e-12)
        assert (np.abs(np.diff(found)) < np.pi / 2).all()


@pytest.mark.parametrize('heading', [np.nan, 0.3, 0.3 + np.pi])
@pytest.mark.parametrize('speed', [7.0, 5.0, 0.0, -5.0, -7.0])
def test_fast_objects_move_forward(speed, heading):
    # Ten boxes with heading 0.3 that move along it at `speed`; the last is 1 km off, as after an
    # id switch, and one is missing. Slower objects may reverse: the majority decides.
    times = np.delete(0.1 * np.arange(11), 4)[None]
    boxes, valid = np.zeros((1, 10, 9)), np.ones((1, 10), dtype=bool)
    boxes[..., YAW] = 0.3
    boxes[..., :2] = speed * times[..., None] * [np.cos(0.3), np.sin(0.3)]
    boxes[0, -1, :2] -= 1000.0
    found = resolve_headings(boxes, times, valid, np.array([heading]))
    np.testing.assert_allclose(np.cos(found - 0.3), -1 if speed == -7.0 else 1)


def test_priors_are_stacked():
    one, other = windows([5, 4])
    problem, priors = stack_windows([with_prior(one), other], CONFIG)
    prior = row_of(with_prior(one).prior)
    np.testing.assert_array_equal(priors.base, [prior.base, given(other)[0, :3]])
    np.testing.assert_allclose(problem.boxes[:, 0, :3], [[1, 0, 0], [0, 0, 0]])
    np.testing.assert_allclose(problem.prior_mean[0], prior.state + prior.step, atol=1e-12)
    np.testing.assert_allclose(
        problem.prior_information[0], CONSTANTS.prior_decay * prior.information
    )
    np.testing.assert_array_equal(problem.marginalised_extents, [[4, 2, 1, 1], [0, 0, 0, 0]])
    np.testing.assert_array_equal(problem.prior_mean[1], 0)
    np.testing.assert_array_equal(problem.prior_information[1], 0)
    assert prior.information[3, 3] == 4  # the input is not changed


@pytest.mark.parametrize('turns', [2 * np.pi, -2 * np.pi, 6 * np.pi])
def test_whole_turns_between_prior_and_start_are_removed(turns):
    # The minimum of the prior is moved to the turn of the starting angles.
    (window,) = windows([5])
    known, _ = stack_windows([with_prior(window)], CONFIG)
    found, _ = stack_windows([with_prior(window, turns)], CONFIG)
    for name in Problem._fields:
        if name != 'of_class':
            np.testing.assert_allclose(getattr(found, name), getattr(known, name), atol=1e-9)


def test_a_prior_of_the_opposite_heading_is_dropped():
    # All boxes have the other heading sign: the prior does not hold for them.
    (window,) = windows([5])
    for one in (flipped(with_prior(window)), with_prior(window, np.pi)):
        problem, _ = stack_windows([one], CONFIG)
        np.testing.assert_array_equal(problem.prior_information, 0)
        assert np.isfinite(problem.prior_mean).all()
        np.testing.assert_array_equal(problem.marginalised_extents, [[4, 2, 1, 1]])
    kept, _ = stack_windows([flipped(with_prior(window, np.pi))], CONFIG)
    assert (kept.prior_information[0].diagonal() > 0).all()


def test_a_solved_window_starts_from_its_estimates():
    # The first three of four boxes were solved before, 0.2 m off and a whole turn away.
    (window,) = windows([4])
    solved = given(window)[:3] + np.array([0.2, 0, 0, 0, 0, 0, 0, 0, -2 * np.pi])
    window = window._replace(num_new=1, start=solved)
    assert window.is_warm
    problem, _ = stack_windows([window], CONFIG)
    known = np.zeros((4, 9))
    known[:3, 0] = 0.2
    np.testing.assert_allclose(problem.start[0] - problem.boxes[0], known, atol=1e-12)
    # The newest of the window before updates the margins now, at its estimate.
    new = window._replace(num_new=4, start=solved[:0])
    first, step, counts = margin_columns([window, new], np.array([4, 4]))
    assert (first.tolist(), step.tolist(), counts.tolist()) == ([2, 0], [1, 1], [1, 3])


def test_a_part_of_a_problem_has_the_observations_asked_for():
    # Of five and four boxes: two of the first window, one of the second, which is padded.
    one, other = windows([5, 4])
    problem, _ = stack_windows([with_prior(one), other], CONFIG)
    part = problem.part(*map(np.array, ([1, 0], [2, 1], [1, 2], [1, 2])))
    np.testing.assert_array_equal(part.valid, [[True, False], [True, True]])
    for name in ('boxes', 'start', 'first', 'counts', 'origins', 'ground', 'pinned'):
        whole = getattr(problem, name)
        np.testing.assert_array_equal(getattr(part, name)[0, 0], whole[1, 2])
        np.testing.assert_array_equal(getattr(part, name)[1], whole[0, [1, 3]])
    assert (np.diff(part.times) > 0).all()
    np.testing.assert_array_equal(points_of(part, 0, 0), points_of(problem, 1, 2))
    for name in ('prior_mean', 'prior_information', 'marginalised_extents'):
        assert not getattr(part, name).any()
    np.testing.assert_array_equal(part.kind, problem.kind[[1, 0]])


def test_groups_contain_each_window_that_is_long_enough_once():
    many = windows([10, 2, 6, 3, 1, 6])
    rows = group_windows(many, CONFIG)
    assert sorted(i for group in rows for i in group) == [0, 2, 3, 5]


def test_groups_are_bounded_and_either_warm_or_cold(monkeypatch):
    many = windows([5, 6, 7, 8])
    many[1] = many[1]._replace(num_new=1, start=given(many[1])[:5])
    monkeypatch.setattr(
        'boxreg_ros.core.problem.MAX_BATCH_VALUES', 2 * 8 * CONFIG.sampling.points * 18
    )
    assert group_windows(many, CONFIG) == [[0, 2], [3], [1]]
