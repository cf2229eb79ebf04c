"""What is learnt of the input, from input whose rule and noise are known."""

from boxreg_ros.config import Config, FaceConfig
from boxreg_ros.core.arrowhead import Factor
from boxreg_ros.core.face_support import Support, support
from boxreg_ros.core.input_model import (
    Expected,
    extent_factor,
    extents_told,
    InputModel,
    InputNoise,
    LEAST,
    RULE_ERROR,
    scatter,
    SCATTERS,
    TRACKS,
)
from boxreg_ros.core.objective import State
import numpy as np
import pytest
from scenes import problem_of, shared_of
import torch

D = torch.float64
FACES = FaceConfig()


# --- noise --------------------------------------------------------------------------------------


def autoregressive(B, N, deviation, correlation, seed=0):
    rng = np.random.default_rng(seed)
    state = rng.normal(size=(B, 9))
    values = np.empty((B, N, 9))
    for i in range(N):
        fresh = rng.normal(size=(B, 9))
        state = correlation * state + np.sqrt(1 - correlation**2) * fresh if i else fresh
        values[:, i] = state
    return torch.from_numpy(values * deviation)


@pytest.mark.parametrize('correlation', [0.0, 0.5, 0.8])
def test_noise_is_measured(correlation):
    # 30 tracks of 60: some hundred independent values per column even at a correlation of 0.8.
    # Tracks lose their own mean, which lowers a slow noise: (1 + c) / (1 - c) / 60 of its power,
    # 15 % at 0.8.
    deviation = np.array([0.3, 0.1, 0.05, 0.01, 0.02, 0.03, 0.1, 0.2, 0.05])
    values = autoregressive(30, 60, deviation, correlation)
    noise = InputNoise.measure(values)
    np.testing.assert_allclose(noise.deviation, deviation, rtol=0.2)
    np.testing.assert_allclose(noise.correlation, correlation, atol=0.1)


def test_noise_does_not_hang_on_outliers_or_on_bias():
    values = autoregressive(30, 60, np.ones(9), 0.0)
    known = InputNoise.measure(values)
    rng = np.random.default_rng(1)
    spoilt = values + 7 * torch.from_numpy(rng.normal(size=(30, 1, 9)))  # one bias per track
    found = InputNoise.measure(spoilt)
    np.testing.assert_allclose(found.deviation, known.deviation, rtol=1e-9)
    np.testing.assert_allclose(found.correlation, known.correlation, atol=1e-9)
    spoilt = values.clone()
    spoilt[:, 7] += 30.0  # one of 60 flips
    found = InputNoise.measure(spoilt)
    np.testing.assert_allclose(found.deviation, known.deviation, rtol=0.25)


def test_how_far_tracks_are_off_by_hand():
    # Five tracks that scatter by +-0.3 about 0.1, -0.2, 0.4, 5 and 0: the median of what they are
    # off by is 0.2. A sixth is too short.
    means = torch.tensor([0.1, -0.2, 0.4, 5.0, 0.0, 9.0], dtype=D)
    values = means[:, None] + 0.3 * (-1.0) ** torch.arange(2 * LEAST, dtype=D)
    values[5, LEAST - 1 :] = torch.nan
    noise = InputNoise.measure(values[..., None].repeat(1, 1, 9))
    np.testing.assert_allclose(noise.offset, 1.48 * 0.2)
    # A mean of n that are not correlated takes an n-th of their power.
    np.testing.assert_allclose(noise.deviation, 1.48 * 0.3 / np.sqrt(1 - 1 / (2 * LEAST)))


def test_short_tracks_tell_the_size_of_slow_errors_too():
    # Correlated by 0.6, a mean of 14 takes some 1.6 / 0.4 / 14 = 0.29 of their power.
    noise = InputNoise.measure(autoregressive(400, LEAST, np.ones(9), 0.6, seed=5))
    np.testing.assert_allclose(noise.deviation, 1.0, rtol=0.12)


def test_correlation_stays_in_its_bounds():
    steady = torch.linspace(-1, 1, 50, dtype=D)[None, :, None].expand(2, 50, 9)
    np.testing.assert_allclose(InputNoise.measure(steady).correlation, 0.9)
    zigzag = ((-1.0) ** torch.arange(50, dtype=D))[None, :, None].expand(2, 50, 9)
    np.testing.assert_allclose(InputNoise.measure(zigzag).correlation, 0.0)
    nothing = torch.zeros(2, 50, 9, dtype=D)
    noise = InputNoise.measure(nothing)
    np.testing.assert_array_equal(noise.deviation, 0)
    np.testing.assert_array_equal(noise.correlation, 0)


@pytest.mark.parametrize(('tracks', 'correlation'), [(1, 0), (2, 0), (4, 0.5), (30, 0.9)])
def test_what_never_changes_errs_by_the_same_all_along(tracks, correlation):
    # 1 - 2 / tracks, at most 0.9: of one track alone it may be the gap of the faces as well.
    values = autoregressive(tracks, 50, np.ones(9), 0.5)
    values[:, :, 6] = torch.linspace(-1, 1, tracks, dtype=D)[:, None]
    noise = InputNoise.measure(values)
    assert noise.deviation[6] < 1e-12
    assert noise.correlation[6] == pytest.approx(correlation)


def test_short_tracks_do_not_tell_and_padding_does_not_count():
    values = autoregressive(3, 40, np.ones(9), 0.3)
    assert InputNoise.measure(values[:, : LEAST - 1]).trust == 0
    known = InputNoise.measure(values[:2, :30])
    values[:2, 30:] = torch.nan
    values[2] *= 100  # too short to be heard
    values[2, LEAST - 1 :] = torch.nan
    found = InputNoise.measure(values)
    np.testing.assert_allclose(found.deviation, known.deviation)
    np.testing.assert_allclose(found.correlation, known.correlation)
    assert found.trust == known.trust == 60 / (60 + LEAST)


def seen(problem):
    return problem._replace(mask=problem.valid[..., None])


def test_scatter_by_hand():
    # The fit heads along +y and is 0.3 m behind the input along y and 0.2 m to its right (+x),
    # so the input is 0.3 m ahead and 0.2 m to the left. 4.4 m given for 4 m is a tenth too long.
    box = [0.0, 0, 0, 4.4, 2, 1.5, 0.01, 0.02, np.pi / 2 + 0.05]
    problem = seen(problem_of([[box, [1.0, *box[1:]]]]))  # one alone repeats itself
    pose = torch.tensor([[[0.2, -0.3, 0.1, 0.0, 0.0, np.pi / 2]] * 2], dtype=D)
    shared = shared_of()
    found = scatter(problem, State(pose, shared))[:, :1]
    known = [[[0.3, 0.2, -0.1, 0.01, 0.02, 0.05, 0.1, 0.0, -0.25]]]
    np.testing.assert_allclose(found, known, atol=1e-12)


def test_boxes_that_a_tracker_holds_do_not_tell_how_it_errs():
    # Moved, moved, moved, held, moved: what repeats the one before tells nothing; padding neither.
    x = [0.0, 1.0, 2.0, 2.0, 3.0, 3.0]
    boxes = [[a, 0, 0, 4, 2, 1.5, 0, 0, 0] for a in x]
    problem = problem_of([boxes])
    problem.valid[0, -1] = False
    assert not scatter(problem, State(problem.pose, shared_of())).isfinite().any()  # no points
    problem = seen(problem)
    found = scatter(problem, State(problem.pose, shared_of()))
    tells = found.isfinite().all(2)
    assert tells.tolist() == [[True, True, True, False, True, False]]
    # An extent that changes is news, and so is a turn.
    for part in (3, 8):
        changed = problem._replace(boxes=problem.boxes.clone())
        changed.boxes[0, 3, part] += 0.01
        found = scatter(changed, State(problem.pose, shared_of()))
        assert found.isfinite().all(2).tolist() == [[True] * 5 + [False]]


def scattered(model, names, row):
    """Show `model` what one observation of each track scatters, and nothing of extents."""
    model.learn_fits(names, row.numpy(), np.zeros((len(names), 3, 3)))


def test_noise_of_a_stream():
    # One observation after the other, tracks of different length, equals all at once.
    values = autoregressive(4, 40, np.ones(9), 0.5, seed=2)
    lengths = [40, 30, LEAST, LEAST - 1]
    model = InputModel(FACES)
    assert model.noise().trust == 0
    for i in range(40):
        alive = [b for b in range(4) if i < lengths[b]]
        scattered(model, [str(b) for b in alive], values[alive, i])
        if i == LEAST - 2:
            assert model.noise().trust == 0
    is_there = torch.arange(40) < torch.tensor(lengths)[:, None]
    known = InputNoise.measure(torch.where(is_there[..., None], values, torch.nan))
    np.testing.assert_allclose(model.noise().deviation, known.deviation)
    np.testing.assert_allclose(model.noise().correlation, known.correlation)


def test_of_a_track_its_last_observations_count():
    # Twice as many as are remembered, the first half ten times as far off: these are forgotten.
    values = autoregressive(3, 2 * SCATTERS, np.ones(9), 0.3, seed=6)
    values[:, :SCATTERS] *= 10.0
    model = InputModel(FACES)
    for row in values.unbind(1):
        scattered(model, ['a', 'b', 'c'], row)
    known = InputNoise.measure(values[:, SCATTERS:])
    np.testing.assert_allclose(model.noise().deviation, known.deviation)
    np.testing.assert_allclose(model.noise().correlation, known.correlation)


def test_noise_of_what_is_not_finite_is_left_out():
    # A window that failed tells nothing; those before and after it are no neighbours of it.
    values = autoregressive(2, 40, np.ones(9), 0.5, seed=7)
    values[0, 20] = np.nan
    model = InputModel(FACES)
    for row in values.unbind(1):
        scattered(model, ['a', 'b'], row)
    known = InputNoise.measure(values)
    np.testing.assert_allclose(model.noise().deviation, known.deviation)
    np.testing.assert_allclose(model.noise().correlation, known.correlation)


def test_scatters_of_the_tracks_seen_last_are_remembered():
    # As many tracks as are remembered with errors of 10, then as many others with errors of 1.
    old, new = (autoregressive(TRACKS, LEAST, d * np.ones(9), 0.0, d) for d in (10, 1))
    model = InputModel(FACES)
    names = [[f'{kind} {b}' for b in range(TRACKS)] for kind in ('old', 'new')]
    for kind, values in zip(names, (old, new), strict=True):
        for row in values.unbind(1):
            scattered(model, kind, row)
    known = InputNoise.measure(new)
    np.testing.assert_allclose(model.noise().deviation, known.deviation)


# --- extents ------------------------------------------------------------------------------------


def fitted(given, measured, own, part=0.05):
    """
    Return what a fit tells of extents that are expected as `given`, to a `part` of each.

    Points say `measured` with deviations `own` [m]: the fit is the mean of both logarithms,
    weighted by what they know.

    """
    given, measured, own = (torch.tensor([row], dtype=D) for row in (given, measured, own))
    error, precision = part * given, torch.ones(1, 22, dtype=D)
    precision[:, :3] = error**-2 + own**-2
    spread = torch.cat([error, torch.ones(1, 19, dtype=D)], 1)
    expected = Expected(shared_of(given[0].tolist()), spread, torch.ones(1, 6), torch.ones(1, 6))
    known = own**-2 / precision[:, :3]
    shared = shared_of((given * (measured / given) ** known)[0].tolist())
    factor = Factor([], torch.diag_embed(precision.sqrt()))
    return extents_told(given.log(), expected, State(torch.zeros(1, 1, 6), shared), factor)[0]


def test_what_the_points_tell_of_extents_by_hand():
    # Lengths are expected to 0.2 m and measured to 0.1 m: of what is known of them the points
    # have 1 / (1 + 0.1^2 / 0.2^2) = 0.8. Corrections count by the squared error, 0.05^2.
    correction, weight = fitted([4.0, 1.8, 1.5], [4.2, 1.8, 1.5], [0.1, 0.045, 0.0375])
    known = np.log([4.2 / 4.0, 1.0, 1.0]) / 0.05**2
    np.testing.assert_allclose(correction, known, atol=1e-4)  # shared_of has single precision
    np.testing.assert_allclose(weight, 0.8 * 0.05**2, rtol=1e-6)


@pytest.mark.parametrize('own', [0.5, np.nan, 1e9], ids=['vague', 'failed', 'not measured'])
def test_points_that_do_not_tell_extents_have_no_weight(own):
    # Of lengths measured to 0.5 m the points have 1 / (1 + 0.5^2 / 0.2^2) = 0.14.
    told = fitted([4.0, 1.8, 1.5], [4.2, 1.9, 1.6], [own, 0.01, 0.01])
    np.testing.assert_array_equal(told[:, 0], 0)
    assert (told[1, 1:] > 0).all()


def sizes(n, seed=0):
    """Return logarithms of the extents of `n` cars, (n, 3)."""
    middle = np.log([4.4, 1.8, 1.5])
    return torch.from_numpy(np.random.default_rng(seed).normal(middle, [0.12, 0.05, 0.06], (n, 3)))


def told_of(true, given, error=0.05, weight=0.8):
    """Return what points tell that know the `true` extents (n, 3), logarithms as `given`."""
    found = (true - given) / error**2
    return torch.stack([given, found, torch.full_like(given, weight * error**2)], 1)


@pytest.mark.parametrize('part', [0.5, 1.0, 1.5], ids=['shrunk', 'as they are', 'spread'])
def test_extents_that_were_shrunk_are_expected_to_be_larger(part):
    # The input has a `part` of what cars differ by in length, and all else as it is. What is
    # expected of the slopes, 0.6 and half of that, is weaker than 400 cars; and an object that is
    # 0.12 longer than most in logarithms has (0.12 / 0.5)^2 = 0.06 less of the correction.
    true = sizes(401)
    given = true.clone()
    middle = true.median(0).values
    given[:, 0] = middle[0] + part * (true - middle)[:, 0]
    error = torch.full_like(given, 0.05)
    found = extent_factor(told_of(true, given), given.exp(), error).log()
    away = (given - middle).square().sum(1, keepdim=True) / 0.5**2
    np.testing.assert_allclose(found, (true - given) / (1 + away), atol=0.003)


def test_extents_drawn_with_care_are_left_as_they_are():
    # What is true of an input that errs by 5 % is corrected by a hundredth of it where one errs
    # by 0.5 %: by squares.
    true = sizes(100)
    given = 2 * true.median(0).values - true
    told = told_of(true, given)
    usual, careful = (
        extent_factor(told, given.exp(), torch.full_like(given, error)).log()
        for error in (0.05, 0.005)
    )
    np.testing.assert_allclose(careful, usual / 100, atol=1e-12)


def test_cars_tell_nothing_of_trucks():
    # Of what is four times as long, twice as wide and twice as high, 1 / (1 + 11.6) is said of
    # what a regression would.
    true = sizes(100)
    given = true.median(0).values + 0.5 * (true - true.median(0).values)
    truck = given.median(0).values + torch.tensor([[4.0, 2.0, 2.0]], dtype=D).log()
    found = extent_factor(told_of(true, given), truck.exp(), torch.full((1, 3), 0.05, dtype=D))
    assert 0 < found.log()[0, 0] < 0.12 * np.log(4.0)


@pytest.mark.parametrize('told', [torch.zeros(1, 3, 3), torch.zeros(5, 3, 3)])
def test_without_what_points_tell_extents_are_expected_as_given(told):
    given = sizes(3).exp()
    np.testing.assert_array_equal(extent_factor(told, given, torch.full_like(given, 0.05)), 1)


def test_of_a_track_the_last_fit_tells_its_extents():
    model = InputModel(FACES)
    assert not model.noise().told.any()
    nothing = np.full((2, 9), np.nan)
    for value in (1.0, 2.0):
        model.learn_fits(['a', 'b'], nothing, np.full((2, 3, 3), value))
    np.testing.assert_array_equal(model.noise().told, np.full((2, 3, 3), 2.0))
    for i in range(TRACKS):
        model.learn_fits([str(i)], nothing[:1], np.zeros((1, 3, 3)))
    np.testing.assert_array_equal(model.noise().told, np.zeros((TRACKS, 3, 3)))


# --- rule ---------------------------------------------------------------------------------------


def sighted(
    model,
    names,
    shifts,
    n=5,
    count=100,
    seen=1.0,
    fresh=True,
    hidden=0.0,
    distant=0.0,
    further=0.0,
):
    """
    Show `model` tracks whose gaps are `shifts` (b, 6) larger than expected of their class.

    Points stand as much further in as `model` expects for what is `hidden` and `distant`, and
    `further` [m].

    """
    rule = model.rule()
    b = len(names)
    shifts = torch.as_tensor(np.broadcast_to(shifts, (b, 6)).copy(), dtype=D)
    # Outwardness is how far points stand out of the box less the gap expected of them.
    out = (rule.gaps - shifts)[:, None].expand(b, n, 6) - further
    whole = torch.ones(b, n, 6, dtype=D)
    shares = torch.stack([hidden * whole, distant * whole])
    retreat = hidden * rule.depths + distant * rule.distant + 0 * whole
    sights = Support(
        torch.zeros(b, n, 6, 4, 4, dtype=D), out, seen * whole, retreat, shares,
        count * whole[..., 0],
    )  # fmt: skip
    model.learn_rule(names, sights, torch.full((b, n), fresh), rule)


def test_the_expected_rule_comes_from_the_settings():
    rule = InputModel(FACES).rule()
    np.testing.assert_array_equal(rule.gaps, 0)  # nothing beside what is expected of a class
    np.testing.assert_allclose(rule.depths[:4], [FACES.depth_ends] * 2 + [FACES.depth_sides] * 2)
    np.testing.assert_allclose(rule.depths[4:], 0)


def test_the_rule_of_the_input_is_learnt():
    # 200 tracks agree on 0.02 m more than expected but for 0.05 m of noise that is their own:
    # the error of a median of 400 sights (two ends, two sides) is some 3 mm, far less than the
    # 0.05 m by which the rule may be off.
    rng = np.random.default_rng(3)
    model = InputModel(FACES)
    shifts = 0.02 + 0.05 * rng.normal(size=(200, 6))
    for start in range(0, 200, 20):
        part = slice(start, start + 20)
        sighted(model, [str(i) for i in range(200)[part]], shifts[part])
    np.testing.assert_allclose(model.rule().gaps, 0.02, atol=0.01)


def test_the_mean_of_a_track_does_not_hang_on_how_it_comes():
    # Sights are of the gap itself: the rule of the moment must not leave traces.
    rng = np.random.default_rng(4)
    shifts = 0.1 * rng.normal(size=(30, 6))
    names = [str(i) for i in range(30)]
    at_once, in_parts = InputModel(FACES), InputModel(FACES)
    sighted(at_once, names, shifts, n=10)
    for _ in range(2):
        for name, row in zip(names, shifts, strict=True):
            sighted(in_parts, [name], row[None])
    np.testing.assert_allclose(in_parts.rule().gaps, at_once.rule().gaps, atol=1e-12)


def test_few_or_discordant_sights_change_little():
    # Trust is d^2 / (d^2 + e^2 / n): d how far a rule may be off, e how sights scatter. Three
    # tracks at -0.4, 0.0 and 0.4 m around the expected gap plus 0.2 have e of 0.77 m at least.
    model = InputModel(FACES)
    sighted(model, ['a', 'b', 'c'], np.array([[-0.2], [0.2], [0.4]]))
    change = model.rule().gaps.numpy()
    assert (np.abs(change) < 0.2 * 0.75).all()
    assert (np.abs(change[:4]) < 0.2 * 0.25).all()
    assert max(RULE_ERROR) < 0.2


@pytest.mark.parametrize(
    'unfit',
    [
        {'seen': 0.0},
        {'count': 29},
        {'fresh': False},
        {'shifts': 0.6},
        {'n': 2},
    ],
    ids=['hidden', 'few points', 'known before', 'half a metre off', 'two sights'],
)
def test_what_tells_nothing_of_the_rule(unfit):
    model = InputModel(FACES)
    given = {'shifts': 0.04, **unfit}
    sighted(model, [str(i) for i in range(50)], **given)
    np.testing.assert_array_equal(model.rule().gaps, 0)


def test_depths_are_learnt_from_faces_seen_from_behind_alone():
    # The whole expected depth of retreat: faces hidden. Outwardness 0 confirms the depth, and
    # tells nothing of the gap of open faces.
    model = InputModel(FACES)
    sighted(model, [str(i) for i in range(50)], 0.0, hidden=1.0, further=-0.05)
    found = model.rule()
    # Points 0.05 m further out than expected: the depth is that much less, but for trust.
    assert FACES.depth_ends - 0.05 <= found.depths[0] < FACES.depth_ends - 0.045
    assert FACES.depth_sides - 0.05 <= found.depths[2] < FACES.depth_sides - 0.045
    np.testing.assert_array_equal(found.gaps[:4], 0)


def far_and_near(model, gap, distant):
    """Show 50 tracks from near and from 45 m, where points stand further in by half `distant`."""
    names = [str(i) for i in range(50)]
    sighted(model, names, gap)
    sighted(model, names, gap, count=10, distant=0.51, further=0.51 * distant)


def test_what_is_far_tells_how_far_in_points_stand_there():
    # Few points are enough there. Near faces tell 0.04 m of gap, far ones 0.06 m more at 0.51 of
    # the way from 20 to 70 m: 0.12 m at 70 m, but for trust. Nothing is told of faces of neither
    # kind, nor by far ones of the gap.
    model = InputModel(FACES)
    far_and_near(model, 0.04, 0.12)
    rule = model.rule()
    np.testing.assert_allclose(rule.gaps, 0.04, atol=1e-3)
    np.testing.assert_allclose(rule.distant[:4], 0.12, atol=5e-3)
    alone = InputModel(FACES)
    sighted(alone, [str(i) for i in range(50)], 0.04, distant=0.51)
    np.testing.assert_array_equal(alone.rule().gaps, 0)


def test_without_far_objects_those_are_as_near_ones():
    model = InputModel(FACES)
    sighted(model, [str(i) for i in range(50)], 0.04)
    np.testing.assert_array_equal(model.rule().distant, 0)


def test_learning_can_be_switched_off():
    # What is stated are gaps and depths. How much further in far points stand is learnt still:
    # what near and far boxes have in common, such as being too large, does not matter for that.
    model = InputModel(FaceConfig(learn=False))
    far_and_near(model, 0.04, 0.12)
    sighted(model, [f'hidden {i}' for i in range(50)], 0.0, hidden=1.0, further=-0.05)
    rule = model.rule()
    np.testing.assert_array_equal(rule.gaps, 0)
    np.testing.assert_allclose(rule.depths[:4], [FACES.depth_ends] * 2 + [FACES.depth_sides] * 2)
    np.testing.assert_allclose(rule.distant[:4], 0.12, atol=5e-3)


def test_only_the_tracks_seen_last_are_remembered():
    # As many tracks as are remembered say +0.1, then as many others say -0.02: these count.
    model = InputModel(FACES)
    sighted(model, [f'old {i}' for i in range(TRACKS)], 0.1)
    known = InputModel(FACES)
    new = [f'new {i}' for i in range(TRACKS)]
    for learner in (model, known):
        sighted(learner, new, -0.02)
    np.testing.assert_allclose(model.rule().gaps, known.rule().gaps)
    assert model.rule().gaps[0] == pytest.approx(-0.02, abs=1e-3)


def test_support_of_boxes_drawn_by_a_rule_teaches_it():
    # Through `support` itself: boxes 0.11 m larger on every side than what their points show,
    # of which their class lets expect 0.05 m, 0.03 m at the sides.
    rng = np.random.default_rng(5)
    B, N, half = 12, 6, np.array([2.0, 1.0, 1.0])
    n = 300
    axis = rng.integers(0, 3, (B, N, n))
    points = rng.uniform(-1, 1, (B, N, n, 3)) * (half - 0.11)
    on = axis[..., None] == np.arange(3)
    points = np.where(on, np.sign(points) * (half - 0.11), points)
    origins = np.tile([[30.0, 30.0, 2.0], [-30.0, -30.0, 2.0]], (6, 1))
    boxes = np.zeros((B, N, 9))
    boxes[..., 3:6] = 2 * half
    problem = problem_of(boxes, points=points, origins=np.repeat(origins[:, None], N, 1))
    model = InputModel(FaceConfig(depth_ends=0.0, depth_sides=0.0))
    rule = model.rule()
    car = Config().vehicle
    expected = [car.gap_ends] * 2 + [car.gap_sides] * 2 + [car.gap_top, car.gap_bottom]
    state = State(problem.pose, shared_of(B=B, GAP=expected))
    sights = support(problem, state, 0.05, rule)
    model.learn_rule([str(b) for b in range(B)], sights, problem.valid, rule)
    # The median moves but for trust: its error, 1.25 * 0.02 m / sqrt(12), against 0.05 m.
    found = np.array(expected) + model.rule().gaps.numpy()
    np.testing.assert_allclose(found[:5], 0.11, atol=0.003)
    assert model.rule().gaps[5] == 0
