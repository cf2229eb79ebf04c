"""The input model, from input whose labelling margins and noise are known."""

from boxreg_ros.config import Config, FaceConfig, KINDS
from boxreg_ros.core.following import person
from boxreg_ros.core.input_model import GAP_DEVIATIONS, InputModel
from boxreg_ros.core.input_noise import noise_of as estimate
from boxreg_ros.core.input_noise import normalised_residuals, set_noise
from boxreg_ros.core.input_statistics import NOISE
from boxreg_ros.core.method.arrays import BOX_POSE, COMMON
from boxreg_ros.core.method.constants import CONSTANTS
from boxreg_ros.core.method.expectation import fill_evidence, population_factor
from boxreg_ros.core.method.margins import pooled
from boxreg_ros.core.method.noise import EXTENT_ERRORS
from boxreg_ros.core.method.population import population_slopes
from boxreg_ros.core.method.residuals import TERMS
import numpy as np
import pytest
from scenes import no_inputs, problem_of, returns_of, settings_of, shared_of

MIN_OBSERVATIONS = CONSTANTS.min_observations
MAX_TRACKS, MAX_FITS = CONSTANTS.max_tracks, CONSTANTS.max_fits
HALF_WEIGHT = CONSTANTS.half_weight
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
    return values * deviation


def noise_of(residuals):
    return estimate(np.array(residuals), CONSTANTS).view(np.recarray)


@pytest.mark.parametrize('correlation', [0.0, 0.5, 0.8])
def test_noise_is_estimated(correlation):
    # 30 tracks of 60: some hundred independent values per column even at a correlation of 0.8.
    # Tracks lose their own mean, which lowers a slow noise: (1 + c) / (1 - c) / 60 of its power,
    # 15 % at 0.8.
    deviation = np.array([0.3, 0.1, 0.05, 0.01, 0.02, 0.03, 0.1, 0.2, 0.05])
    values = autoregressive(30, 60, deviation, correlation)
    noise = noise_of(values)
    np.testing.assert_allclose(noise.deviation, deviation, rtol=0.2)
    np.testing.assert_allclose(noise.correlation, correlation, atol=0.1)


def test_noise_is_robust_to_outliers_and_bias():
    values = autoregressive(30, 60, np.ones(9), 0.0)
    known = noise_of(values)
    rng = np.random.default_rng(1)
    spoilt = values + 7 * rng.normal(size=(30, 1, 9))  # one bias per track
    found = noise_of(spoilt)
    np.testing.assert_allclose(found.deviation, known.deviation, rtol=1e-9)
    np.testing.assert_allclose(found.correlation, known.correlation, atol=1e-9)
    spoilt = values.copy()
    spoilt[:, 7] += 30.0  # one of 60 flips
    found = noise_of(spoilt)
    np.testing.assert_allclose(found.deviation, known.deviation, rtol=0.25)


def test_deviation_about_the_mean_by_hand():
    # Five tracks with errors of +-0.3 about means of their own; a sixth track is too short. The
    # mean of n uncorrelated errors removes an n-th of their variance.
    n = 2 * MIN_OBSERVATIONS
    means = np.array([0.1, -0.2, 0.4, 5.0, 0.0, 9.0])
    values = means[:, None] + 0.3 * (-1.0) ** np.arange(n)
    values[5, MIN_OBSERVATIONS - 1 :] = np.nan
    noise = noise_of(values[..., None].repeat(9, axis=2))
    np.testing.assert_allclose(noise.deviation, 1.48 * 0.3 / np.sqrt(1 - 1 / n))


def test_deviation_of_correlated_errors_of_short_tracks():
    # With a correlation of 0.6, a mean of 14 removes about 1.6 / 0.4 / 14 = 0.29 of the variance.
    noise = noise_of(autoregressive(400, MIN_OBSERVATIONS, np.ones(9), 0.6, seed=5))
    np.testing.assert_allclose(noise.deviation, 1.0, rtol=0.12)


def test_correlation_stays_in_its_bounds():
    steady = np.tile(np.linspace(-1, 1, 50)[:, None], (2, 1, 9))
    np.testing.assert_allclose(noise_of(steady).correlation, 0.9)
    zigzag = np.tile(((-1.0) ** np.arange(50))[:, None], (2, 1, 9))
    np.testing.assert_allclose(noise_of(zigzag).correlation, 0.0)
    nothing = np.zeros((2, 50, 9))
    noise = noise_of(nothing)
    np.testing.assert_array_equal(noise.deviation, 0)
    np.testing.assert_array_equal(noise.correlation, 0)


@pytest.mark.parametrize(('tracks', 'correlation'), [(1, 0), (2, 0), (4, 0.5), (30, 0.9)])
def test_constant_errors_are_correlated(tracks, correlation):
    # 1 - 2 / tracks, at most 0.9: in a single track it may be the labelling margin as well.
    values = autoregressive(tracks, 50, np.ones(9), 0.5)
    values[:, :, 6] = np.linspace(-1, 1, tracks)[:, None]
    noise = noise_of(values)
    assert noise.deviation[6] < 1e-12
    assert noise.correlation[6] == pytest.approx(correlation)


def test_short_tracks_and_padding_are_left_out():
    values = autoregressive(3, 40, np.ones(9), 0.3)
    assert noise_of(values[:, : MIN_OBSERVATIONS - 1]).boxes == 0
    known = noise_of(values[:2, :30])
    values[:2, 30:] = np.nan
    values[2] *= 100  # too short
    values[2, MIN_OBSERVATIONS - 1 :] = np.nan
    found = noise_of(values)
    np.testing.assert_allclose(found.deviation, known.deviation)
    np.testing.assert_allclose(found.correlation, known.correlation)
    assert found.boxes == known.boxes == 60


def noise_by_kind(values, kind, past=None, constants=CONSTANTS):
    """Return the records `INPUTS` (K,) with the noise of tracks (B, N, 9) of a kind (B,)."""
    inputs = no_inputs()
    past = np.zeros(len(KINDS), NOISE) if past is None else past
    set_noise(inputs, [values[np.asarray(kind) == k] for k in range(len(KINDS))], past, constants)
    return inputs


def test_boxes_followed_from_keyframes_are_no_low_noise_input():
    values = autoregressive(30, 40, np.full(9, 0.2), 0.3)
    assert noise_by_kind(values, [0] * 30)['low_noise'][0] < 0.6
    keyframes = person.numbers(person.DEVIATIONS)
    assert noise_by_kind(values, [0] * 30, None, keyframes)['low_noise'][0] == 1.0


def posterior(prior, boxes, square):
    """Return a variance of boxes pooled with a prior that counts for 14."""
    return (HALF_WEIGHT * prior + boxes * square) / (HALF_WEIGHT + boxes)


def test_noise_of_a_kind_is_that_of_the_others_until_it_has_its_own():
    # Vehicles err as expected, pedestrians twice as much; of cyclists there are none, or a few
    # boxes that err three times as much: the others are their prior, worth 14 boxes.
    kind = np.array([0] * 30 + [2] * 30)
    values = autoregressive(60, 40, np.ones(9), 0.0)
    values[30:] *= 2
    found = noise_by_kind(values, kind)
    np.testing.assert_allclose(found['deviation'][[0, 2]], [[1.0] * 9, [2.0] * 9], rtol=0.1)
    squares = [noise_of(part).deviation ** 2 for part in (values[:30], values[30:])]
    others = posterior(1.0, 2400, np.mean(squares, axis=0))
    np.testing.assert_allclose(found['deviation'][1] ** 2, others)
    few = 3 * autoregressive(2, 40, np.ones(9), 0.0, seed=3)
    few[:, 30:] = np.nan
    found = noise_by_kind(np.concatenate([values, few]), np.append(kind, [1, 1]))
    known = posterior(others, 60, noise_of(few).deviation ** 2)
    np.testing.assert_allclose(found['deviation'][1] ** 2, known)


def test_few_boxes_that_agree_with_their_fit_are_not_taken_for_exact():
    # The fit follows them, too: the settings count for 14 of 44 boxes.
    deviation = noise_by_kind(1e-3 * autoregressive(1, 30, np.ones(9), 0.0), [2])['deviation'][2]
    np.testing.assert_allclose(deviation, np.sqrt(14 / 44), rtol=1e-4)


def test_noise_of_other_drives_counts_by_its_boxes():
    # 1,200 boxes of other drives err three times as much, of this one 1,200 as expected: the
    # settings count for 14.
    values = autoregressive(30, 40, np.ones(9), 0.0)
    past = np.zeros(len(KINDS), NOISE)
    past['deviation'][0], past['correlation'][0], past['boxes'][0] = 3.0, 0.8, 1200
    both = noise_by_kind(values, [0] * 30, past)
    square = (noise_of(values).deviation ** 2 + 9) / 2
    np.testing.assert_allclose(both['deviation'][0] ** 2, posterior(1.0, 2400, square))
    assert (both['correlation'][0] > 0.35).all()
    unseen = noise_by_kind(values[:0], [], past)
    np.testing.assert_allclose(unseen['deviation'][0] ** 2, posterior(1.0, 1200, 9.0))
    past['boxes'][0] = 0.5  # a model file may state any number
    unseen = noise_by_kind(values[:0], [], past)
    np.testing.assert_allclose(unseen['deviation'][0] ** 2, posterior(1.0, 0.5, 9.0))


def test_extents_err_as_much_as_centres_do():
    # A tracker that holds extents shows no error of them; human labels, with a tenth of the usual
    # error of the centre, have a fifth of it, and fits follow them.
    values = autoregressive(60, 200, np.ones(9), 0.5)
    values[..., 6:] = np.linspace(-1, 1, 60)[:, None, None]
    usual = np.array(EXTENT_ERRORS)
    np.testing.assert_allclose(noise_by_kind(values, [0] * 60)['extent_error'], usual)
    careful = noise_by_kind(0.1 * values, [0] * 60)['extent_error'][0]
    np.testing.assert_allclose(careful, 0.2 * usual[0], rtol=0.1)


def with_points(problem):
    mask = problem.valid[..., None]
    return problem._replace(**returns_of(np.zeros((*mask.shape, 3)), mask))


def residuals_of(problem, poses=None):
    """Return input minus fit; by default of a fit of 4 x 2 x 2 m at the input."""
    poses = problem.boxes[..., BOX_POSE] if poses is None else poses
    found = normalised_residuals(problem, poses, shared_of()[:, :3])
    return found * problem.errors[:, None]


def test_input_residuals_by_hand():
    # The fit heads along +y and is 0.3 m behind the input along y and 0.2 m to its right (+x),
    # so the input is 0.3 m ahead and 0.2 m to the left. 4.4 m given for 4 m is a tenth too long.
    box = [0.0, 0, 0, 4.4, 2, 1.5, 0.01, 0.02, np.pi / 2 + 0.05]
    of_class = settings_of(Config().vehicle)
    problem = with_points(problem_of([[box, [1.0, *box[1:]]]], of_class=of_class))
    poses = np.array([[[0.2, -0.3, 0.1, 0.0, 0.0, np.pi / 2]] * 2])
    found = residuals_of(problem, poses)[:, :1]  # a single box would repeat itself
    known = [[[0.3, 0.2, -0.1, 0.01, 0.02, 0.05, 0.1, 0.0, -0.25]]]
    np.testing.assert_allclose(found, known, atol=1e-12)


def test_repeated_boxes_have_no_residual():
    # Moved, moved, moved, repeated, moved, padding.
    boxes = [[[a, 0, 0, 4, 2, 1.5, 0, 0, 0] for a in [0.0, 1.0, 2.0, 2.0, 3.0, 3.0]]]
    problem = problem_of(boxes, lengths=[5], of_class=settings_of(Config().vehicle))
    assert not np.isfinite(residuals_of(problem)).any()  # no points
    problem = with_points(problem)
    is_new = np.isfinite(residuals_of(problem)).all(2)
    assert is_new.tolist() == [[True, True, True, False, True, False]]
    # A change of the extent or of the yaw is a new box.
    for part in (3, 8):
        changed = problem._replace(boxes=problem.boxes.copy())
        changed.boxes[0, 3, part] += 0.01
        assert np.isfinite(residuals_of(changed)).all(2).tolist() == [[True] * 5 + [False]]


def of_vehicles(model):
    """Return the noise of vehicles that `model` has estimated, a record `NOISE`."""
    drives = model.statistics('drive')
    return drives['drive'][0].noise if drives else np.zeros((), NOISE)


def assert_noise(model, known):
    """Compare the noise of vehicles, which statistics round, with a known one."""
    found = of_vehicles(model)
    np.testing.assert_allclose(found['deviation'], known.deviation, rtol=1e-5)
    np.testing.assert_allclose(found['correlation'], known.correlation, rtol=1e-5, atol=1e-9)


def add_residuals(model, names, row):
    """Add one residual of each track to `model`, without evidence of extents."""
    kinds = np.zeros(len(names), int)
    model.add_fits(names, kinds, row, np.zeros((len(names), 3, 3)))


def test_noise_of_a_stream():
    # One observation after the other, tracks of different length, equals all at once.
    values = autoregressive(4, 40, np.ones(9), 0.5, seed=2)
    lengths = [40, 30, MIN_OBSERVATIONS, MIN_OBSERVATIONS - 1]
    model = InputModel(FACES)
    assert of_vehicles(model)['boxes'] == 0
    for i in range(40):
        alive = [b for b in range(4) if i < lengths[b]]
        add_residuals(model, [str(b) for b in alive], values[alive, i])
        if i == MIN_OBSERVATIONS - 2:
            assert of_vehicles(model)['boxes'] == 0
    is_there = np.arange(40) < np.array(lengths)[:, None]
    known = noise_of(np.where(is_there[..., None], values, np.nan))
    assert_noise(model, known)


def test_the_last_fits_of_a_track_are_kept():
    # Twice as many as are kept, the first half with ten times the errors: these are dropped.
    values = autoregressive(3, 2 * MAX_FITS, np.ones(9), 0.3, seed=6)
    values[:, :MAX_FITS] *= 10.0
    model = InputModel(FACES)
    for row in np.moveaxis(values, 1, 0):
        add_residuals(model, ['a', 'b', 'c'], row)
    known = noise_of(values[:, MAX_FITS:])
    assert_noise(model, known)


def test_non_finite_residuals_are_left_out():
    # A window that failed has no residual; those before and after it are no neighbours.
    values = autoregressive(2, 40, np.ones(9), 0.5, seed=7)
    values[0, 20] = np.nan
    model = InputModel(FACES)
    for row in np.moveaxis(values, 1, 0):
        add_residuals(model, ['a', 'b'], row)
    known = noise_of(values)
    assert_noise(model, known)


def test_residuals_of_the_tracks_seen_last_are_kept():
    # As many tracks as are kept with errors of 10, then as many others with errors of 1.
    old, new = (
        autoregressive(MAX_TRACKS, MIN_OBSERVATIONS, d * np.ones(9), 0.0, d) for d in (10, 1)
    )
    model = InputModel(FACES)
    names = [[f'{kind} {b}' for b in range(MAX_TRACKS)] for kind in ('old', 'new')]
    for kind, values in zip(names, (old, new), strict=True):
        for row in np.moveaxis(values, 1, 0):
            add_residuals(model, kind, row)
    known = noise_of(new)
    assert_noise(model, known)


def test_more_tracks_at_once_than_are_kept_do_not_expel_each_other():
    names = [str(b) for b in range(MAX_TRACKS + 50)]
    values = autoregressive(len(names), MIN_OBSERVATIONS, np.ones(9), 0.0, 8)
    model = InputModel(FACES)
    for row in np.moveaxis(values, 1, 0):
        add_residuals(model, names, row)
    known = noise_of(values[:MAX_TRACKS])
    assert known.boxes == MAX_TRACKS * MIN_OBSERVATIONS
    assert_noise(model, known)


# --- extents ------------------------------------------------------------------------------------


def fitted(given, measured, own, part=0.05):
    """
    Return the evidence of a fit about extents expected as `given`, up to a `part` of each.

    Points give `measured` with deviations `own` [m]: the fit is the mean of both logarithms,
    weighted by their information.

    """
    given, measured, own = (np.array(row, float) for row in (given, measured, own))
    common = np.zeros((), COMMON)[()]
    common['shared'][:3], common['deviation'][:3] = given, part * given
    precision = (part * given) ** -2 + own**-2
    shared = shared_of(given * (measured / given) ** (own**-2 / precision))[0]
    covariance = np.eye(23)
    covariance[:3, :3] = np.diag(1 / precision)
    evidence = np.zeros((3, 3))
    evidence[0] = np.log(given)
    fill_evidence(common, shared, covariance, CONSTANTS.min_extent_gain, evidence)
    return evidence[1:]


def test_evidence_of_extents_by_hand():
    # Lengths are expected to 0.2 m and measured to 0.1 m: points provide 1 / (1 + 0.1^2 / 0.2^2)
    # = 0.8 of the information about them. Corrections count by the squared error, 0.05^2.
    correction, weight = fitted([4.0, 1.8, 1.5], [4.2, 1.8, 1.5], [0.1, 0.045, 0.0375])
    known = np.log([4.2 / 4.0, 1.0, 1.0]) / 0.05**2
    np.testing.assert_allclose(correction, known, atol=1e-9)
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
    return np.random.default_rng(seed).normal(middle, [0.12, 0.05, 0.06], (n, 3))


def evidence_of(true, given, error=0.05, weight=0.8):
    """Return the evidence of points that fix the `true` extents (n, 3), all in logarithms."""
    found = (true - given) / error**2
    return np.stack([given, found, np.full_like(given, weight * error**2)], 1)


def slopes_of(evidence):
    """Return medians (3,) and slopes (3, 3) of the population with some `evidence` (n, 3, 3)."""
    median, slopes = np.empty(3), np.empty((3, 3))
    population_slopes(np.array(evidence, float), CONSTANTS.record(), median, slopes)
    return median, slopes


def corrections(evidence, given, error):
    """Return the logarithms of the factors (B, 3) on extents whose logarithms are `given`."""
    median, slopes = slopes_of(evidence)
    radius = CONSTANTS.population_radius
    return np.log(
        [
            [population_factor(k, np.exp(row), error, median, slopes, radius) for k in range(3)]
            for row in given
        ]
    )


@pytest.mark.parametrize('part', [0.5, 1.0, 1.5], ids=['shrunk', 'as they are', 'spread'])
def test_shrunk_extents_are_corrected(part):
    # The differences between the lengths of the input are a `part` of the true ones. The prior
    # on the slopes, 0.6 and half of that, is weaker than 400 cars. An object that is 0.12 longer
    # than most in logarithms has (0.12 / 0.5)^2 = 0.06 less of the correction.
    true = sizes(401)
    given = true.copy()
    middle = np.median(true, axis=0)
    given[:, 0] = middle[0] + part * (true - middle)[:, 0]
    found = corrections(evidence_of(true, given), given, 0.05)
    away = ((given - middle) ** 2).sum(1, keepdims=True) / 0.5**2
    np.testing.assert_allclose(found, (true - given) / (1 + away), atol=0.003)


def test_extents_of_low_noise_input_are_kept():
    # The correction is in proportion to the squared error of the input: with errors of 0.5 % it
    # is a hundredth of that with 5 %.
    true = sizes(101)
    given = 2 * np.median(true, axis=0) - true
    usual, careful = (corrections(evidence_of(true, given), given, e) for e in (0.05, 0.005))
    np.testing.assert_allclose(careful, usual / 100, atol=1e-12)


def test_cars_do_not_correct_trucks():
    # An object four times as long, twice as wide and twice as high gets 1 / (1 + 11.6) of the
    # correction of the regression.
    true = sizes(101)
    given = np.median(true, axis=0) + 0.5 * (true - np.median(true, axis=0))
    truck = np.median(given, axis=0) + np.log([[4.0, 2.0, 2.0]])
    found = corrections(evidence_of(true, given), truck, 0.05)
    assert 0 < found[0, 0] < 0.12 * np.log(4.0)


@pytest.mark.parametrize('tracks', [1, 5])
def test_without_evidence_expected_extents_are_those_of_the_input(tracks):
    np.testing.assert_array_equal(corrections(np.zeros((tracks, 3, 3)), sizes(3), 0.05), 0)


def test_the_last_fit_of_a_track_is_its_extent_evidence():
    model = InputModel(FACES)
    nothing = np.full((2, 9), np.nan)
    for value in (1.0, 2.0):
        model.add_fits(['a', 'b'], np.array([0, 1]), nothing, np.full((2, 3, 3), value))
    for kind in (0, 1):
        np.testing.assert_array_equal(
            model._tracks[kind].in_order['evidence'], np.full((1, 3, 3), 2.0)
        )
    for i in range(MAX_TRACKS):
        model.add_fits([str(i)], np.array([1]), nothing[:1], np.zeros((1, 3, 3)))
    np.testing.assert_array_equal(
        model._tracks[1].in_order['evidence'], np.zeros((MAX_TRACKS, 3, 3))
    )


def test_population_of_one_kind_does_not_correct_others():
    true = sizes(101)
    given = np.median(true, axis=0) + 0.5 * (true - np.median(true, axis=0))
    evidence, model = evidence_of(true, given), InputModel(FACES)
    kinds = np.zeros(101, int)
    model.add_fits([str(i) for i in range(101)], kinds, np.full((101, 9), np.nan), evidence)
    inputs = model.inputs(Config())
    median, slopes = slopes_of(evidence)
    np.testing.assert_array_equal(inputs['median'][0], median)
    np.testing.assert_array_equal(inputs['slopes'][0], slopes)
    assert np.abs(slopes).max() > 1
    assert not inputs['slopes'][1:].any()


# --- labelling margins --------------------------------------------------------------------------


def offsets_of(model, kind='vehicle'):
    """Return the margins and insets of one kind of objects by `model`, a record."""
    return model.inputs(Config())[KINDS.index(kind)]


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
    `further` [m]. Faces are turned away unless `seen`.

    """
    inputs = model.inputs(Config())
    offsets = inputs[KINDS.index(of_kind)]
    b = len(names)
    shifts = np.broadcast_to(np.asarray(shifts, float), (b, 6))
    terms = np.zeros((b, n), TERMS)
    # Distance of the points from where they are expected: from the face less its margin.
    terms['distance'] = (offsets['margin'] - shifts)[:, None] - further
    terms['visibility'], terms['num_points'] = float(seen), count
    terms['inset_shares'] = np.array([hidden, distant])[:, None]
    kind = np.full(b, KINDS.index(of_kind))
    model._add(names, problem_of(np.zeros((b, n, 9)), kind=kind), terms, inputs)


def test_margins_of_one_kind_do_not_change_those_of_others():
    model, alone = InputModel(FACES), InputModel(FACES)
    for one in (model, alone):
        show_faces(one, [str(i) for i in range(20)], 0.05)
    show_faces(model, [str(i) for i in range(20)], -0.1, of_kind='pedestrian')
    known = offsets_of(alone)['margin']
    assert (known > 0.03).all()
    np.testing.assert_array_equal(offsets_of(model)['margin'], known)
    np.testing.assert_array_equal(offsets_of(model, 'cyclist')['margin'], 0)
    np.testing.assert_allclose(offsets_of(model, 'pedestrian')['margin'], -0.1, atol=0.02)


def posterior_of_gaps(gaps, *prior):
    """Return mean, its variance and that of tracks of the `gaps` of a face, given a `prior`."""
    return pooled(np.array(gaps, float), *prior, HALF_WEIGHT)


def test_gaps_of_many_tracks_give_margin_and_scatter():
    # 800 tracks with margins of 0.04 m scatter by 0.078 m, as is expected: they show the mean to
    # 1.1 * 0.078 / sqrt(800) m. Twice the scatter is found as well.
    gaps = np.random.default_rng(0).normal(0.04, 0.078, 800)
    mean, variance, between = posterior_of_gaps(gaps, 0.0, 0.05**2, 0.078**2)
    np.testing.assert_allclose(mean, 0.04, atol=3 * variance**0.5)
    np.testing.assert_allclose(variance**0.5, 1.1 * 0.078 / 800**0.5, rtol=0.1)
    np.testing.assert_allclose(between**0.5, 0.078, rtol=0.1)
    _, _, between = posterior_of_gaps(2 * gaps, 0.0, 0.05**2, 0.078**2)
    np.testing.assert_allclose(between**0.5, 0.156, rtol=0.1)


def test_the_posterior_of_gaps_by_hand():
    # Quartiles of 0 and 0.2 m: a deviation of 0.148 m. The prior counts for 14 tracks, these for
    # 8. The mean has precisions of 1 / .05^2 before and of 8 tracks after.
    prior = (0.02, 0.05**2, 0.1**2)
    mean, variance, found = posterior_of_gaps([0.0, 0.2] * 4, *prior)
    between = (14 * 0.1**2 + 8 * 0.148**2) / 22
    weight = 8 / 1.2 / between
    np.testing.assert_allclose(found, between)
    np.testing.assert_allclose(variance, 1 / (400 + weight))
    np.testing.assert_allclose(mean, (400 * 0.02 + weight * 0.1) / (400 + weight))
    assert posterior_of_gaps(np.zeros(2), *prior) == prior


def test_the_middle_half_of_the_gaps_gives_the_mean():
    # Of nine, two on each side are left out, in whatever order they are.
    gaps = np.array([9.0, 0.1, -5.0, 0.2, 0.3, 7.0, 0.4, -8.0, 0.5])
    mean, _, _ = posterior_of_gaps(gaps, 0.0, 1e6, 1.0)
    np.testing.assert_allclose(mean, 0.3, rtol=1e-5)


def test_a_bad_track_costs_little():
    gaps = np.random.default_rng(1).normal(0.0, 0.078, 30)
    prior = (0.0, 0.05**2, 0.078**2)
    mean, _, between = posterior_of_gaps(gaps, *prior)
    gaps[0] = 0.5
    spoilt, _, spread = posterior_of_gaps(gaps, *prior)
    assert abs(spoilt - mean) < 0.008
    assert abs(spread / between - 1) < 0.2


def test_insets_are_expected_from_the_settings():
    offsets = offsets_of(InputModel(FACES))
    np.testing.assert_array_equal(offsets['margin'], 0)  # relative to the class
    np.testing.assert_allclose(
        offsets['occlusion_inset'][:4], [FACES.inset_ends] * 2 + [FACES.inset_sides] * 2
    )
    np.testing.assert_allclose(offsets['occlusion_inset'][4:], 0)


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
    np.testing.assert_allclose(offsets_of(model)['margin'], 0.02, atol=0.01)


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
    pairs = zip(in_parts.gaps_of_tracks([0, 3]), at_once.gaps_of_tracks([0, 3]), strict=True)
    for ours, known in pairs:
        np.testing.assert_allclose(ours, known, atol=1e-12)


def test_few_or_discordant_tracks_change_little():
    # The weight is d^2 / (d^2 + e^2 / n): d the prior deviation, e that of the tracks.
    model = InputModel(FACES)
    show_faces(model, ['a', 'b', 'c'], np.array([[-0.2], [0.2], [0.4]]))
    agreed = InputModel(FACES)
    show_faces(agreed, ['a', 'b', 'c'], np.full((3, 1), 0.4 / 3))
    change, known = (offsets_of(one)['margin'] for one in (model, agreed))
    assert (np.abs(change[:5]) < 0.6 * known[:5]).all()
    assert (known < 0.4 / 3).all()
    assert max(GAP_DEVIATIONS['vehicle']) < 0.2


@pytest.mark.parametrize(
    'unfit',
    [
        {'seen': False},
        {'count': 29},
        {'shifts': 0.6},
        {'n': 1},  # of each of two ends, and sides
    ],
    ids=['hidden', 'few points', 'half a metre off', 'two observations'],
)
def test_unfit_observations_are_no_evidence(unfit):
    model = InputModel(FACES)
    given = {'shifts': 0.04, **unfit}
    show_faces(model, [str(i) for i in range(50)], **given)
    np.testing.assert_array_equal(offsets_of(model)['margin'], 0)


def test_occlusion_insets_are_estimated_from_occluded_faces_only():
    # All faces are occluded. A distance of 0 confirms the occlusion inset, and is no evidence
    # for the margin of visible faces.
    model = InputModel(FACES)
    show_faces(model, [str(i) for i in range(50)], 0.0, hidden=1.0, further=-0.05)
    found = offsets_of(model)
    # Points 0.05 m further out than expected: the inset is nearly that much smaller.
    assert FACES.inset_ends - 0.05 <= found['occlusion_inset'][0] < FACES.inset_ends - 0.045
    assert FACES.inset_sides - 0.05 <= found['occlusion_inset'][2] < FACES.inset_sides - 0.045
    np.testing.assert_array_equal(found['margin'][:4], 0)


def far_and_near(model, gap, distant):
    """Show 200 tracks from near and from 45 m, with points further inside by half `distant`."""
    names = [str(i) for i in range(200)]
    show_faces(model, names, gap)
    show_faces(model, names, gap, count=10, distant=0.51, further=0.51 * distant)


def test_range_insets_are_estimated_from_distant_faces():
    # Few points are enough there. Near faces have a margin of 0.04 m, distant ones 0.06 m more at
    # 0.51 of the way from 20 to 70 m: 0.12 m at 70 m, nearly, by the weight of the evidence.
    # Distant faces alone are no evidence of the margin.
    model = InputModel(FACES)
    far_and_near(model, 0.04, 0.12)
    offsets = offsets_of(model)
    np.testing.assert_allclose(offsets['margin'], 0.04, atol=1e-3)
    np.testing.assert_allclose(offsets['range_inset'][:4], 0.12, atol=5e-3)
    alone = InputModel(FACES)
    show_faces(alone, [str(i) for i in range(50)], 0.04, distant=0.51)
    np.testing.assert_array_equal(offsets_of(alone)['margin'], 0)


def test_without_distant_objects_there_is_no_range_inset():
    model = InputModel(FACES)
    show_faces(model, [str(i) for i in range(50)], 0.04)
    np.testing.assert_array_equal(offsets_of(model)['range_inset'], 0)


def test_estimation_of_margins_can_be_switched_off():
    # Margins and occlusion insets are fixed then. The range inset is estimated all the same:
    # a common error of near and far boxes, such as a size error, cancels in it.
    model = InputModel(FaceConfig(learn=False))
    far_and_near(model, 0.04, 0.12)
    show_faces(model, [f'hidden {i}' for i in range(50)], 0.0, hidden=1.0, further=-0.05)
    offsets = offsets_of(model)
    np.testing.assert_array_equal(offsets['margin'], 0)
    np.testing.assert_allclose(
        offsets['occlusion_inset'][:4], [FACES.inset_ends] * 2 + [FACES.inset_sides] * 2
    )
    np.testing.assert_allclose(offsets['range_inset'][:4], 0.12, atol=5e-3)


def test_only_the_tracks_seen_last_are_kept():
    # As many tracks as are kept with +0.1 m, then as many others with -0.02 m: these count.
    model = InputModel(FACES)
    show_faces(model, [f'old {i}' for i in range(MAX_TRACKS)], 0.1)
    known = InputModel(FACES)
    new = [f'new {i}' for i in range(MAX_TRACKS)]
    for shown in (model, known):
        show_faces(shown, new, -0.02)
    np.testing.assert_allclose(offsets_of(model)['margin'], offsets_of(known)['margin'])
    assert offsets_of(model)['margin'][0] == pytest.approx(-0.02, abs=1e-3)


def test_labelling_margins_are_estimated_from_face_observations():
    # Through `support` itself: boxes 0.11 m larger on every side than what their points show,
    # where the settings of their class expect 0.05 m, 0.03 m at the sides.
    rng = np.random.default_rng(5)
    B, N, half = 24, 6, np.array([2.0, 1.0, 1.0])
    n = 300
    axis = rng.integers(0, 3, (B, N, n))
    points = rng.uniform(-1, 1, (B, N, n, 3)) * (half - 0.11)
    on = axis[..., None] == np.arange(3)
    points = np.where(on, np.sign(points) * (half - 0.11), points)
    origins = np.tile([[30.0, 30.0, 2.0], [-30.0, -30.0, 2.0]], (12, 1))
    boxes = np.zeros((B, N, 9))
    boxes[..., 3:6] = 2 * half
    car = settings_of(Config().vehicle)
    problem = problem_of(
        boxes, points=points, origins=np.repeat(origins[:, None], N, 1), of_class=car
    )
    model = InputModel(FaceConfig(inset_ends=0.0, inset_sides=0.0))
    names = [str(b) for b in range(B)]
    model.observe_margins(names, problem, problem.boxes[..., BOX_POSE], Config())
    # All gaps agree, but boxes are expected to err by as much as the settings say, 0.2 m at ends,
    # to which 14 tracks count: 24 tracks show three quarters of the difference.
    found = np.array(car['gaps']) + offsets_of(model)['margin']
    expected = np.array(car['gaps']).ravel()[:5]
    share = (found[:5] - expected) / (0.11 - expected)
    assert ((share > 0.7) & (share < 1)).all()
    assert offsets_of(model)['margin'][5] == 0


def test_observations_at_the_angles_of_the_input_are_replaced():
    """Those of a fit count once; until there is one, those of the input do."""
    x, z = (part.ravel() for part in np.meshgrid(np.linspace(-1.9, 1.9, 20), [-0.5, 0.0, 0.5]))
    side = np.c_[x, 0 * x + 0.9, z]  # 0.1 m inside of the left side of a box of 4 x 2 x 2 m
    problem = problem_of(
        np.tile([0, 0, 0, 4.0, 2, 2, 0, 0, 0], (4, 6, 1)), points=np.tile(side, (4, 6, 1, 1)),
        origins=np.tile([0.0, 30.0, 2.0], (4, 6, 1)), of_class=settings_of(Config().vehicle),
    )  # fmt: skip
    names = ['a', 'b', 'c', 'd']
    fits = problem.boxes[..., BOX_POSE].copy()
    turned = fits.copy()
    turned[..., 5] = 0.1
    once, again = (InputModel(FaceConfig()) for _ in range(2))
    once.observe_margins(names, problem, fits, Config())
    again.observe_margins(names, problem, turned, Config(), is_input=True)
    of_input = again.gaps_of_tracks([2])
    again.observe_margins(names, problem, fits, Config())
    np.testing.assert_allclose(again.gaps_of_tracks([2]), once.gaps_of_tracks([2]), atol=1e-11)
    assert np.abs(np.subtract(of_input, once.gaps_of_tracks([2]))).min() > 0.02
