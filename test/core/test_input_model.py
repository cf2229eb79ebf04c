"""The input model, from input whose labelling margins and noise are known."""

from boxreg_ros.config import Config, FaceConfig, KINDS
from boxreg_ros.core.batch import State
from boxreg_ros.core.expectation import evidence_of_extents, Expectation
from boxreg_ros.core.face_support import FaceObservations, FaceOffsets, observe_faces
from boxreg_ros.core.input_model import GAP_DEVIATIONS, InputModel, MAX_FITS_PER_TRACK, MAX_TRACKS
from boxreg_ros.core.input_noise import (
    input_residuals,
    InputNoise,
    MIN_OBSERVATIONS_FOR_NOISE,
    OBSERVATIONS_FOR_HALF_WEIGHT,
)
from boxreg_ros.core.margin_spread import GapScatter, margin_spread
from boxreg_ros.core.population import Population, population_factor
from boxreg_ros.core.smoothing import smoothed_angles
import numpy as np
import pytest
from scenes import problem_of, returns_of, shared_of
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
def test_noise_is_estimated(correlation):
    # 30 tracks of 60: some hundred independent values per column even at a correlation of 0.8.
    # Tracks lose their own mean, which lowers a slow noise: (1 + c) / (1 - c) / 60 of its power,
    # 15 % at 0.8.
    deviation = np.array([0.3, 0.1, 0.05, 0.01, 0.02, 0.03, 0.1, 0.2, 0.05])
    values = autoregressive(30, 60, deviation, correlation)
    noise = InputNoise.estimate(values)
    np.testing.assert_allclose(noise.deviation, deviation, rtol=0.2)
    np.testing.assert_allclose(noise.correlation, correlation, atol=0.1)


def test_noise_is_robust_to_outliers_and_bias():
    values = autoregressive(30, 60, np.ones(9), 0.0)
    known = InputNoise.estimate(values)
    rng = np.random.default_rng(1)
    spoilt = values + 7 * torch.from_numpy(rng.normal(size=(30, 1, 9)))  # one bias per track
    found = InputNoise.estimate(spoilt)
    np.testing.assert_allclose(found.deviation, known.deviation, rtol=1e-9)
    np.testing.assert_allclose(found.correlation, known.correlation, atol=1e-9)
    spoilt = values.clone()
    spoilt[:, 7] += 30.0  # one of 60 flips
    found = InputNoise.estimate(spoilt)
    np.testing.assert_allclose(found.deviation, known.deviation, rtol=0.25)


def test_offset_of_tracks_by_hand():
    # Five tracks with errors of +-0.3 about 0.1, -0.2, 0.4, 5 and 0: the median magnitude of these
    # means is 0.2. A sixth track is too short.
    means = torch.tensor([0.1, -0.2, 0.4, 5.0, 0.0, 9.0], dtype=D)
    values = means[:, None] + 0.3 * (-1.0) ** torch.arange(2 * MIN_OBSERVATIONS_FOR_NOISE, dtype=D)
    values[5, MIN_OBSERVATIONS_FOR_NOISE - 1 :] = torch.nan
    noise = InputNoise.estimate(values[..., None].repeat(1, 1, 9))
    np.testing.assert_allclose(noise.offset, 1.48 * 0.2)
    # The mean of n uncorrelated errors removes an n-th of their variance.
    np.testing.assert_allclose(
        noise.deviation, 1.48 * 0.3 / np.sqrt(1 - 1 / (2 * MIN_OBSERVATIONS_FOR_NOISE))
    )


def test_deviation_of_correlated_errors_of_short_tracks():
    # With a correlation of 0.6, a mean of 14 removes about 1.6 / 0.4 / 14 = 0.29 of the variance.
    noise = InputNoise.estimate(
        autoregressive(400, MIN_OBSERVATIONS_FOR_NOISE, np.ones(9), 0.6, seed=5)
    )
    np.testing.assert_allclose(noise.deviation, 1.0, rtol=0.12)


def test_correlation_stays_in_its_bounds():
    steady = torch.linspace(-1, 1, 50, dtype=D)[None, :, None].expand(2, 50, 9)
    np.testing.assert_allclose(InputNoise.estimate(steady).correlation, 0.9)
    zigzag = ((-1.0) ** torch.arange(50, dtype=D))[None, :, None].expand(2, 50, 9)
    np.testing.assert_allclose(InputNoise.estimate(zigzag).correlation, 0.0)
    nothing = torch.zeros(2, 50, 9, dtype=D)
    noise = InputNoise.estimate(nothing)
    np.testing.assert_array_equal(noise.deviation, 0)
    np.testing.assert_array_equal(noise.correlation, 0)


@pytest.mark.parametrize(('tracks', 'correlation'), [(1, 0), (2, 0), (4, 0.5), (30, 0.9)])
def test_constant_errors_are_correlated(tracks, correlation):
    # 1 - 2 / tracks, at most 0.9: in a single track it may be the labelling margin as well.
    values = autoregressive(tracks, 50, np.ones(9), 0.5)
    values[:, :, 6] = torch.linspace(-1, 1, tracks, dtype=D)[:, None]
    noise = InputNoise.estimate(values)
    assert noise.deviation[6] < 1e-12
    assert noise.correlation[6] == pytest.approx(correlation)


def test_short_tracks_and_padding_are_left_out():
    values = autoregressive(3, 40, np.ones(9), 0.3)
    assert InputNoise.estimate(values[:, : MIN_OBSERVATIONS_FOR_NOISE - 1]).weight == 0
    known = InputNoise.estimate(values[:2, :30])
    values[:2, 30:] = torch.nan
    values[2] *= 100  # too short
    values[2, MIN_OBSERVATIONS_FOR_NOISE - 1 :] = torch.nan
    found = InputNoise.estimate(values)
    np.testing.assert_allclose(found.deviation, known.deviation)
    np.testing.assert_allclose(found.correlation, known.correlation)
    assert found.weight == known.weight == 60 / (60 + OBSERVATIONS_FOR_HALF_WEIGHT)


def test_noise_of_a_kind_is_that_of_the_others_until_it_has_its_own():
    # Vehicles err as expected, pedestrians twice as much; of cyclists there are none, or a few
    # boxes that err three times as much: their own weight is 60 / 74.
    kind = torch.tensor([0] * 30 + [2] * 30)
    values = autoregressive(60, 40, np.ones(9), 0.0)
    values[30:] *= 2
    noise = InputNoise.estimate_by_kind(values, kind)
    np.testing.assert_allclose(noise.deviation[[0, 2]], [[1.0] * 9, [2.0] * 9], rtol=0.1)
    pooled = InputNoise.estimate(values)
    np.testing.assert_array_equal(noise.deviation[1], pooled.deviation)
    np.testing.assert_array_equal(noise.weight[1], pooled.weight)
    few = 3 * autoregressive(2, 40, np.ones(9), 0.0, seed=3)
    few[:, 30:] = torch.nan
    values = torch.cat([values, few])
    found = InputNoise.estimate_by_kind(values, torch.cat([kind, torch.tensor([1, 1])]))
    own = InputNoise.estimate(few)
    assert own.weight == 60 / (60 + OBSERVATIONS_FOR_HALF_WEIGHT)
    total = own.weight + (1 - own.weight) * pooled.weight
    share = own.weight / total
    known = share * own.deviation + (1 - share) * pooled.deviation
    np.testing.assert_allclose(found.deviation[1], known)
    np.testing.assert_allclose(found.weight[1], total)


def with_points(problem):
    points = torch.zeros(*problem.valid.shape, 1, 3)
    return problem._replace(**returns_of(points, problem.valid[..., None]))


def test_input_residuals_by_hand():
    # The fit heads along +y and is 0.3 m behind the input along y and 0.2 m to its right (+x),
    # so the input is 0.3 m ahead and 0.2 m to the left. 4.4 m given for 4 m is a tenth too long.
    box = [0.0, 0, 0, 4.4, 2, 1.5, 0.01, 0.02, np.pi / 2 + 0.05]
    problem = with_points(problem_of([[box, [1.0, *box[1:]]]]))  # a single box repeats itself
    pose = torch.tensor([[[0.2, -0.3, 0.1, 0.0, 0.0, np.pi / 2]] * 2], dtype=D)
    shared = shared_of()
    found = input_residuals(problem, State(pose, shared))[:, :1]
    known = [[[0.3, 0.2, -0.1, 0.01, 0.02, 0.05, 0.1, 0.0, -0.25]]]
    np.testing.assert_allclose(found, known, atol=1e-12)


def test_repeated_boxes_have_no_residual():
    # Moved, moved, moved, repeated, moved, padding.
    x = [0.0, 1.0, 2.0, 2.0, 3.0, 3.0]
    boxes = [[a, 0, 0, 4, 2, 1.5, 0, 0, 0] for a in x]
    problem = problem_of([boxes])
    problem.valid[0, -1] = False
    assert (
        not input_residuals(problem, State(problem.pose, shared_of())).isfinite().any()
    )  # no points
    problem = with_points(problem)
    found = input_residuals(problem, State(problem.pose, shared_of()))
    is_new = found.isfinite().all(2)
    assert is_new.tolist() == [[True, True, True, False, True, False]]
    # A change of the extent or of the yaw is a new box.
    for part in (3, 8):
        changed = problem._replace(boxes=problem.boxes.clone())
        changed.boxes[0, 3, part] += 0.01
        found = input_residuals(changed, State(problem.pose, shared_of()))
        assert found.isfinite().all(2).tolist() == [[True] * 5 + [False]]


def noise_of(model):
    """Return the noise of vehicles that `model` has estimated."""
    return InputNoise(*(part[0] for part in model.noise()))


def add_residuals(model, names, row):
    """Add one residual of each track to `model`, without evidence of extents."""
    kind = torch.zeros(len(names), dtype=torch.int64)
    model.add_fits(names, kind, row.numpy(), np.zeros((len(names), 3, 3)))


def test_noise_of_a_stream():
    # One observation after the other, tracks of different length, equals all at once.
    values = autoregressive(4, 40, np.ones(9), 0.5, seed=2)
    lengths = [40, 30, MIN_OBSERVATIONS_FOR_NOISE, MIN_OBSERVATIONS_FOR_NOISE - 1]
    model = InputModel(FACES)
    assert noise_of(model).weight == 0
    for i in range(40):
        alive = [b for b in range(4) if i < lengths[b]]
        add_residuals(model, [str(b) for b in alive], values[alive, i])
        if i == MIN_OBSERVATIONS_FOR_NOISE - 2:
            assert noise_of(model).weight == 0
    is_there = torch.arange(40) < torch.tensor(lengths)[:, None]
    known = InputNoise.estimate(torch.where(is_there[..., None], values, torch.nan))
    np.testing.assert_allclose(noise_of(model).deviation, known.deviation)
    np.testing.assert_allclose(noise_of(model).correlation, known.correlation)


def test_the_last_fits_of_a_track_are_kept():
    # Twice as many as are kept, the first half with ten times the errors: these are dropped.
    values = autoregressive(3, 2 * MAX_FITS_PER_TRACK, np.ones(9), 0.3, seed=6)
    values[:, :MAX_FITS_PER_TRACK] *= 10.0
    model = InputModel(FACES)
    for row in values.unbind(1):
        add_residuals(model, ['a', 'b', 'c'], row)
    known = InputNoise.estimate(values[:, MAX_FITS_PER_TRACK:])
    np.testing.assert_allclose(noise_of(model).deviation, known.deviation)
    np.testing.assert_allclose(noise_of(model).correlation, known.correlation)


def test_non_finite_residuals_are_left_out():
    # A window that failed has no residual; those before and after it are no neighbours.
    values = autoregressive(2, 40, np.ones(9), 0.5, seed=7)
    values[0, 20] = np.nan
    model = InputModel(FACES)
    for row in values.unbind(1):
        add_residuals(model, ['a', 'b'], row)
    known = InputNoise.estimate(values)
    np.testing.assert_allclose(noise_of(model).deviation, known.deviation)
    np.testing.assert_allclose(noise_of(model).correlation, known.correlation)


def test_residuals_of_the_tracks_seen_last_are_kept():
    # As many tracks as are kept with errors of 10, then as many others with errors of 1.
    old, new = (
        autoregressive(MAX_TRACKS, MIN_OBSERVATIONS_FOR_NOISE, d * np.ones(9), 0.0, d)
        for d in (10, 1)
    )
    model = InputModel(FACES)
    names = [[f'{kind} {b}' for b in range(MAX_TRACKS)] for kind in ('old', 'new')]
    for kind, values in zip(names, (old, new), strict=True):
        for row in values.unbind(1):
            add_residuals(model, kind, row)
    known = InputNoise.estimate(new)
    np.testing.assert_allclose(noise_of(model).deviation, known.deviation)


def test_more_tracks_at_once_than_are_kept_do_not_expel_each_other():
    names = [str(b) for b in range(MAX_TRACKS + 50)]
    values = autoregressive(len(names), MIN_OBSERVATIONS_FOR_NOISE, np.ones(9), 0.0, 8)
    model = InputModel(FACES)
    for row in values.unbind(1):
        add_residuals(model, names, row)
    known = InputNoise.estimate(values[:MAX_TRACKS])
    assert known.weight > 0.9  # 200 tracks of five fits each against 14: 0.986
    np.testing.assert_allclose(noise_of(model).deviation, known.deviation)


# --- extents ------------------------------------------------------------------------------------


def fitted(given, measured, own, part=0.05):
    """
    Return the evidence of a fit about extents expected as `given`, up to a `part` of each.

    Points give `measured` with deviations `own` [m]: the fit is the mean of both logarithms,
    weighted by their information.

    """
    given, measured, own = (torch.tensor([row], dtype=D) for row in (given, measured, own))
    error, precision = part * given, torch.ones(1, 23, dtype=D)
    precision[:, :3] = error**-2 + own**-2
    spread = torch.cat([error, torch.ones(1, 19, dtype=D)], 1)
    expected = Expectation(
        shared_of(given[0].tolist()), spread, *torch.ones(3, 1, 6), spread[:, :9]
    )
    known = own**-2 / precision[:, :3]
    shared = shared_of((given * (measured / given) ** known)[0].tolist())
    covariance = torch.diag_embed(1 / precision)
    state = State(torch.zeros(1, 1, 6), shared)
    return evidence_of_extents(given.log(), expected, state, covariance)[0]


def test_evidence_of_extents_by_hand():
    # Lengths are expected to 0.2 m and measured to 0.1 m: points provide 1 / (1 + 0.1^2 / 0.2^2)
    # = 0.8 of the information about them. Corrections count by the squared error, 0.05^2.
    correction, weight = fitted([4.0, 1.8, 1.5], [4.2, 1.8, 1.5], [0.1, 0.045, 0.0375])
    known = np.log([4.2 / 4.0, 1.0, 1.0]) / 0.05**2
    np.testing.assert_allclose(correction, known, atol=1e-4)  # shared_of has single precision
    np.testing.assert_allclose(weight, 0.8 * 0.05**2, rtol=1e-6)


@pytest.mark.parametrize('own', [0.5, np.nan, 1e9], ids=['vague', 'failed', 'not measured'])
def test_uncertain_extents_are_no_evidence(own):
    # For lengths measured to 0.5 m this part is only 1 / (1 + 0.5^2 / 0.2^2) = 0.14.
    evidence = fitted([4.0, 1.8, 1.5], [4.2, 1.9, 1.6], [own, 0.01, 0.01])
    np.testing.assert_array_equal(evidence[:, 0], 0)
    assert (evidence[1, 1:] > 0).all()


def sizes(n, seed=0):
    """Return logarithms of the extents of `n` cars, (n, 3)."""
    middle = np.log([4.4, 1.8, 1.5])
    return torch.from_numpy(np.random.default_rng(seed).normal(middle, [0.12, 0.05, 0.06], (n, 3)))


def evidence_of(true, given, error=0.05, weight=0.8):
    """Return the evidence of points that fix the `true` extents (n, 3), all in logarithms."""
    found = (true - given) / error**2
    return torch.stack([given, found, torch.full_like(given, weight * error**2)], 1)


@pytest.mark.parametrize('part', [0.5, 1.0, 1.5], ids=['shrunk', 'as they are', 'spread'])
def test_shrunk_extents_are_corrected(part):
    # The differences between the lengths of the input are a `part` of the true ones. The prior
    # on the slopes, 0.6 and half of that, is weaker than 400 cars. An object that is 0.12 longer
    # than most in logarithms has (0.12 / 0.5)^2 = 0.06 less of the correction.
    true = sizes(401)
    given = true.clone()
    middle = true.median(0).values
    given[:, 0] = middle[0] + part * (true - middle)[:, 0]
    error = torch.full_like(given, 0.05)
    found = population_factor(evidence_of(true, given), given.exp(), error).log()
    away = (given - middle).square().sum(1, keepdim=True) / 0.5**2
    np.testing.assert_allclose(found, (true - given) / (1 + away), atol=0.003)


def test_extents_of_low_noise_input_are_kept():
    # The correction is in proportion to the squared error of the input: with errors of 0.5 % it
    # is a hundredth of that with 5 %.
    true = sizes(100)
    given = 2 * true.median(0).values - true
    evidence = evidence_of(true, given)
    usual, careful = (
        population_factor(evidence, given.exp(), torch.full_like(given, error)).log()
        for error in (0.05, 0.005)
    )
    np.testing.assert_allclose(careful, usual / 100, atol=1e-12)


def test_cars_do_not_correct_trucks():
    # An object four times as long, twice as wide and twice as high gets 1 / (1 + 11.6) of the
    # correction of the regression.
    true = sizes(100)
    given = true.median(0).values + 0.5 * (true - true.median(0).values)
    truck = given.median(0).values + torch.tensor([[4.0, 2.0, 2.0]], dtype=D).log()
    found = population_factor(
        evidence_of(true, given), truck.exp(), torch.full((1, 3), 0.05, dtype=D)
    )
    assert 0 < found.log()[0, 0] < 0.12 * np.log(4.0)


@pytest.mark.parametrize('evidence', [torch.zeros(1, 3, 3), torch.zeros(5, 3, 3)])
def test_without_evidence_expected_extents_are_those_of_the_input(evidence):
    given = sizes(3).exp()
    np.testing.assert_array_equal(
        population_factor(evidence, given, torch.full_like(given, 0.05)), 1
    )


def test_the_last_fit_of_a_track_is_its_extent_evidence():
    model = InputModel(FACES)
    assert not len(model.population().evidence)
    nothing = np.full((2, 9), np.nan)
    for value in (1.0, 2.0):
        model.add_fits(['a', 'b'], torch.tensor([0, 1]), nothing, np.full((2, 3, 3), value))
    np.testing.assert_array_equal(model.population().evidence, np.full((2, 3, 3), 2.0))
    assert model.population().kind.tolist() == [0, 1]
    for i in range(MAX_TRACKS):
        model.add_fits([str(i)], torch.tensor([1]), nothing[:1], np.zeros((1, 3, 3)))
    is_own = model.population().kind == 1
    evidence = model.population().evidence[is_own]
    np.testing.assert_array_equal(evidence, np.zeros((MAX_TRACKS, 3, 3)))


def test_population_of_one_kind_does_not_correct_others():
    true = sizes(100)
    given = true.median(0).values + 0.5 * (true - true.median(0).values)
    population = Population(evidence_of(true, given), torch.zeros(100, dtype=torch.int64))
    problem = problem_of(np.zeros((2, 1, 9)), kind=[0, 1])
    error = torch.full((2, 3), 0.05, dtype=D)
    factors = population.factors(problem, given[[0, 0]].exp(), error)
    np.testing.assert_array_equal(
        factors[:1], population_factor(population.evidence, given[:1].exp(), error[:1])
    )
    np.testing.assert_array_equal(factors[1], 1)
    assert (factors[0] - 1).abs().max() > 1e-3


# --- labelling margins --------------------------------------------------------------------------


def offsets_of(model, kind='vehicle'):
    """Return the offsets of one kind of objects by `model`, (6,) each."""
    return FaceOffsets(*(part[KINDS.index(kind)] for part in model.offsets()))


def show_faces(
    model,
    names,
    shifts,
    n=5,
    count=100,
    seen=True,
    hidden=0.0,
    distant=0.0,
    further=0.0,
    of_kind='vehicle',
):
    """
    Show `model` tracks whose gaps are `shifts` (b, 6) larger than expected of their class.

    Points are further inside by the insets of `model` for shares `hidden` and `distant`, and by
    `further` [m]. Faces are turned away unless `seen`, and known before if that is None.

    """
    offsets = offsets_of(model, of_kind)
    b = len(names)
    shifts = torch.as_tensor(np.broadcast_to(shifts, (b, 6)).copy(), dtype=D)
    # Distance of the points from where they are expected: from the face less its margin.
    out = (offsets.gap_correction - shifts)[:, None].expand(b, n, 6) - further
    whole = torch.ones(b, n, 6, dtype=D)
    shares = torch.stack([hidden * whole, distant * whole], 2)
    inset = hidden * offsets.occlusion_inset + distant * offsets.range_inset + 0 * whole
    observations = FaceObservations(
        torch.zeros(b, n, 6, 4, 4, dtype=D), out, bool(seen) * whole, inset, shares,
        count * whole[..., 0],
    )  # fmt: skip
    kind = torch.full((b,), KINDS.index(of_kind))
    model.add_face_observations(
        names, kind, observations, torch.full((b, n), seen is not None), offsets
    )


def test_margins_of_one_kind_do_not_change_those_of_others():
    model = InputModel(FACES)
    show_faces(model, [str(i) for i in range(20)], 0.05)
    show_faces(model, [str(i) for i in range(20)], -0.1, of_kind='pedestrian')
    for kind, known in (('vehicle', 0.05), ('cyclist', 0.0), ('pedestrian', -0.1)):
        np.testing.assert_allclose(offsets_of(model, kind).gap_correction, known, atol=0.01)


def test_scatter_of_gaps_is_that_between_tracks():
    # 40 tracks of 10 observations, both sides count. The mean of the middle half of +-1 cm is 0.
    model = InputModel(FACES)
    gaps = np.zeros((40, 6))
    gaps[:, 2] = gaps[:, 3] = np.tile([-0.01, 0.01], 20)
    gaps[0, 4] = 5.0  # of another object: not within reach of the face
    show_faces(model, [str(i) for i in range(40)], gaps, n=10)
    variance, tracks, noise = (part[0] for part in model.gap_scatter())
    np.testing.assert_allclose(variance, np.array([0, 0, 80, 80, 0, 0]) / 79 * 1e-4, atol=1e-12)
    np.testing.assert_array_equal(tracks, [80, 80, 80, 80, 39, 40])
    np.testing.assert_allclose(noise, 0.1)
    np.testing.assert_array_equal(model.gap_scatter().tracks[1:], 0)  # of other kinds


def spread_of(variance, tracks, errors, usual=0.05, similarity=1.0):
    """Return the spread of margins [m] from gaps of this `variance` of errors of input [m^2]."""
    one = torch.ones(1, 6, dtype=D)
    scatter = GapScatter(variance * one, tracks * one, 0 * one)
    (spread,) = margin_spread(scatter, errors * one, usual * one, similarity * one[:, :1]).unique()
    return float(spread)


def test_spread_of_margins_follows_the_scatter_of_the_gaps():
    # Of errors of 6 cm and margins that spread by 4 cm, seen in ever more tracks: from the spread
    # of the settings to that one. Gaps that scatter no more than the input have equal margins.
    both = 0.06**2 + 0.04**2
    assert spread_of(both, 0, 0.06**2) == pytest.approx(0.05, rel=1e-4)
    assert spread_of(both, 400, 0.06**2) == pytest.approx(0.04, abs=0.003)
    spreads = [
        spread_of(variance, 40, 0.06**2) for variance in (0.04**2, 0.06**2, 0.07**2, 0.1**2)
    ]
    assert spreads == sorted(spreads)
    assert spreads[0] < 0.02
    assert spreads[-1] > 0.07
    # Few tracks, or errors far larger than margins, are little evidence.
    assert 0.04 < spread_of(0.04**2, 3, 0.06**2) < 0.05
    assert spread_of(0.3**2, 20, 0.3**2) == pytest.approx(0.05, rel=0.05)
    # Of an object unlike the others they are none.
    assert spread_of(0.04**2, 40, 0.06**2, similarity=0.0) == pytest.approx(0.05)


def test_spread_of_margins_is_a_half_normal_posterior():
    # The posterior mean of the square by numerical integration.
    s = np.linspace(0, 0.5, 20_001)
    total = 0.05**2 + s**2
    log = -6 * (np.log(total) + 0.006 / total) - s**2 / 2 / 0.05**2
    weight = np.exp(log - log.max())
    known = np.sqrt((weight * s**2).sum() / weight.sum())
    assert spread_of(0.006, 13, 0.05**2) == pytest.approx(known, rel=1e-4)


def test_insets_are_expected_from_the_settings():
    offsets = offsets_of(InputModel(FACES))
    np.testing.assert_array_equal(offsets.gap_correction, 0)  # relative to the class
    np.testing.assert_allclose(
        offsets.occlusion_inset[:4], [FACES.inset_ends] * 2 + [FACES.inset_sides] * 2
    )
    np.testing.assert_allclose(offsets.occlusion_inset[4:], 0)


def test_labelling_margins_are_estimated():
    # 200 tracks with margins of 0.02 m more than expected and a deviation of 0.05 m: the error of
    # a median of 400 values (two ends, two sides) is some 3 mm, far less than the prior deviation
    # of 0.05 m.
    rng = np.random.default_rng(3)
    model = InputModel(FACES)
    shifts = 0.02 + 0.05 * rng.normal(size=(200, 6))
    for start in range(0, 200, 20):
        part = slice(start, start + 20)
        show_faces(model, [str(i) for i in range(200)[part]], shifts[part])
    np.testing.assert_allclose(offsets_of(model).gap_correction, 0.02, atol=0.01)


def test_the_mean_of_a_track_does_not_depend_on_order():
    # Means are of the margin itself: they do not depend on the present correction.
    rng = np.random.default_rng(4)
    shifts = 0.1 * rng.normal(size=(30, 6))
    names = [str(i) for i in range(30)]
    at_once, in_parts = InputModel(FACES), InputModel(FACES)
    show_faces(at_once, names, shifts, n=10)
    for _ in range(2):
        for name, row in zip(names, shifts, strict=True):
            show_faces(in_parts, [name], row[None])
    np.testing.assert_allclose(
        offsets_of(in_parts).gap_correction, offsets_of(at_once).gap_correction, atol=1e-12
    )


def test_few_or_discordant_tracks_change_little():
    # The weight is d^2 / (d^2 + e^2 / n): d the prior deviation, e that of the tracks. Three
    # tracks at -0.4, 0.0 and 0.4 m around the expected gap plus 0.2 have e of 0.77 m at least.
    model = InputModel(FACES)
    show_faces(model, ['a', 'b', 'c'], np.array([[-0.2], [0.2], [0.4]]))
    change = offsets_of(model).gap_correction.numpy()
    assert (np.abs(change) < 0.2 * 0.75).all()
    assert (np.abs(change[:4]) < 0.2 * 0.25).all()
    assert max(GAP_DEVIATIONS['vehicle']) < 0.2


@pytest.mark.parametrize(
    'unfit',
    [
        {'seen': False},
        {'count': 29},
        {'seen': None},
        {'shifts': 0.6},
        {'n': 2},
    ],
    ids=['hidden', 'few points', 'known before', 'half a metre off', 'two observations'],
)
def test_unfit_observations_are_no_evidence(unfit):
    model = InputModel(FACES)
    given = {'shifts': 0.04, **unfit}
    show_faces(model, [str(i) for i in range(50)], **given)
    np.testing.assert_array_equal(offsets_of(model).gap_correction, 0)


def test_occlusion_insets_are_estimated_from_occluded_faces_only():
    # All faces are occluded. A distance of 0 confirms the occlusion inset, and is no evidence
    # for the margin of visible faces.
    model = InputModel(FACES)
    show_faces(model, [str(i) for i in range(50)], 0.0, hidden=1.0, further=-0.05)
    found = offsets_of(model)
    # Points 0.05 m further out than expected: the inset is nearly that much smaller.
    assert FACES.inset_ends - 0.05 <= found.occlusion_inset[0] < FACES.inset_ends - 0.045
    assert FACES.inset_sides - 0.05 <= found.occlusion_inset[2] < FACES.inset_sides - 0.045
    np.testing.assert_array_equal(found.gap_correction[:4], 0)


def far_and_near(model, gap, distant):
    """Show 50 tracks from near and from 45 m, with points further inside by half `distant`."""
    names = [str(i) for i in range(50)]
    show_faces(model, names, gap)
    show_faces(model, names, gap, count=10, distant=0.51, further=0.51 * distant)


def test_range_insets_are_estimated_from_distant_faces():
    # Few points are enough there. Near faces have a margin of 0.04 m, distant ones 0.06 m more at
    # 0.51 of the way from 20 to 70 m: 0.12 m at 70 m, nearly, by the weight of the evidence.
    # Distant faces alone are no evidence of the margin.
    model = InputModel(FACES)
    far_and_near(model, 0.04, 0.12)
    offsets = offsets_of(model)
    np.testing.assert_allclose(offsets.gap_correction, 0.04, atol=1e-3)
    np.testing.assert_allclose(offsets.range_inset[:4], 0.12, atol=5e-3)
    alone = InputModel(FACES)
    show_faces(alone, [str(i) for i in range(50)], 0.04, distant=0.51)
    np.testing.assert_array_equal(offsets_of(alone).gap_correction, 0)


def test_without_distant_objects_there_is_no_range_inset():
    model = InputModel(FACES)
    show_faces(model, [str(i) for i in range(50)], 0.04)
    np.testing.assert_array_equal(offsets_of(model).range_inset, 0)


def test_estimation_of_margins_can_be_switched_off():
    # Margins and occlusion insets are fixed then. The range inset is estimated all the same:
    # a common error of near and far boxes, such as a size error, cancels in it.
    model = InputModel(FaceConfig(learn=False))
    far_and_near(model, 0.04, 0.12)
    show_faces(model, [f'hidden {i}' for i in range(50)], 0.0, hidden=1.0, further=-0.05)
    offsets = offsets_of(model)
    np.testing.assert_array_equal(offsets.gap_correction, 0)
    np.testing.assert_allclose(
        offsets.occlusion_inset[:4], [FACES.inset_ends] * 2 + [FACES.inset_sides] * 2
    )
    np.testing.assert_allclose(offsets.range_inset[:4], 0.12, atol=5e-3)


def test_only_the_tracks_seen_last_are_kept():
    # As many tracks as are kept with +0.1 m, then as many others with -0.02 m: these count.
    model = InputModel(FACES)
    show_faces(model, [f'old {i}' for i in range(MAX_TRACKS)], 0.1)
    known = InputModel(FACES)
    new = [f'new {i}' for i in range(MAX_TRACKS)]
    for shown in (model, known):
        show_faces(shown, new, -0.02)
    np.testing.assert_allclose(offsets_of(model).gap_correction, offsets_of(known).gap_correction)
    assert offsets_of(model).gap_correction[0] == pytest.approx(-0.02, abs=1e-3)


def test_labelling_margins_are_estimated_from_face_observations():
    # Through `support` itself: boxes 0.11 m larger on every side than what their points show,
    # where the settings of their class expect 0.05 m, 0.03 m at the sides.
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
    model = InputModel(FaceConfig(inset_ends=0.0, inset_sides=0.0))
    offsets = offsets_of(model)
    car = Config().vehicle
    expected = [car.gap_ends] * 2 + [car.gap_sides] * 2 + [car.gap_top, car.gap_bottom]
    state = State(problem.pose, shared_of(B=B, GAP=expected))
    observations = observe_faces(problem, state, offsets, Config())
    names = [str(b) for b in range(B)]
    model.add_face_observations(names, problem.kind, observations, problem.valid, offsets)
    # The weight of the tracks is near 1: their error, 1.25 * 0.02 m / sqrt(12), against 0.05 m.
    found = np.array(expected) + offsets_of(model).gap_correction.numpy()
    np.testing.assert_allclose(found[:5], 0.11, atol=0.003)
    assert offsets_of(model).gap_correction[5] == 0


# --- angles of the margins ----------------------------------------------------------------------


def test_angles_are_smoothed_as_far_as_they_are_noisy():
    # A car turns at 0.5 rad/s. An exact heading stays as it is; noise of 0.2 rad is reduced to
    # that of a straight line through ten values: about 0.06 in its middle. Padding does not count.
    rng = np.random.default_rng(0)
    boxes = np.zeros((200, 12, 9))
    boxes[..., 8] = 0.05 * np.arange(12)
    exact = boxes[..., 8].copy()
    boxes[100:, :, 8] += 0.2 * rng.normal(size=(100, 12))
    boxes[:, 10:, 8] = boxes[:, 9:10, 8]
    valid = np.arange(12) < np.full((200, 1), 10)
    numbers = {'turning': 0.8, 'tilting': 0.2}
    problem = problem_of(boxes, valid=valid, class_numbers=numbers)
    off = smoothed_angles(problem)[..., 2].numpy() - exact
    np.testing.assert_allclose(off[:100, :10], 0, atol=1e-9)
    assert 0.04 < off[100:, 4:6].std() < 0.1
    assert off[100:, :10].std() < 0.14
