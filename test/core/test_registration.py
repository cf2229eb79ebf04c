"""Windows solved together, alone, and by torch's own L-BFGS; weights and acceptance tests."""

from dataclasses import fields, replace

from boxreg_ros.config import Config, KINDS
from boxreg_ros.core import batch, paper, registration, rounds, solver, terms
from boxreg_ros.core.batch import POSE_ERRORS, State
from boxreg_ros.core.expectation import CONSTANT_EXTENT_ERRORS, expect, InputEstimates
from boxreg_ros.core.face_support import FaceOffsets, observe_faces
from boxreg_ros.core.geometry import rotation_from_rpy
from boxreg_ros.core.input_model import InputModel
from boxreg_ros.core.input_noise import InputNoise
from boxreg_ros.core.lbfgs import minimize, Minimum, select
from boxreg_ros.core.metrics import iou_3d
from boxreg_ros.core.paper import solve_paper
from boxreg_ros.core.registration import register
from boxreg_ros.core.rounds import run_round
from boxreg_ros.core.terms import Objective, Term
from boxreg_ros.core.weights import parked_steps, weigh
from boxreg_ros.core.window import stack_windows
from boxreg_ros.structures import POSE
import numpy as np
import pytest
from scenes import changed, drive, EXTENT, problem_of, returns, track_of, window_of
import torch

D, NO_OFFSETS = torch.float64, FaceOffsets(*torch.zeros(3, 6))
# Labelling margins are fixed, so that windows are independent.
ALONE = Config().updated({'estimate': 'final', 'faces.learn': False})
PAPER = ALONE.updated({'objective': 'paper', 'sampling.points': 40, 'paper.nearest': 8})
WEIGHTS = replace(PAPER.paper, closeness=1.0, alignment=0.1)  # points against motion, about even
# Rounding errors change where a search ends at the kinks of the paper's terms: stop before that.
BRIEF = PAPER.updated({'paper.iterations': 5, 'paper.multiplier_rounds': 2})


def window(truth, seed=0, config=ALONE, name='1', **noise):
    return window_of(track_of(truth, np.random.default_rng(seed), name, **noise), config)


def windows(config=ALONE):
    """Return windows of different length, motion and place."""
    return [
        window(drive(10), 0, config, 'turning'),
        window(drive(6, speed=0, turn=0), 1, config, 'parked'),
        window(drive(8, turn=0, start=(20.0, -8.0, 2.5)), 2, config, 'straight'),
        window(drive(3, start=(-9.0, 3.0, -1.0)), 3, config, 'short'),
    ]


def given(window):
    return np.array([observation.box for observation in window.observations])


# --- against the truth --------------------------------------------------------------------------


def test_refined_boxes_are_closer_to_the_truth():
    # Input errors of 0.15 m and 0.05 rad give an IoU of some 0.8; 1 - IoU must fall in
    # each window, and by half on average.
    missing = []
    for seed in range(6):
        truth = drive(10)
        one = window(truth, seed)
        (found,) = register([one], ALONE, InputModel(ALONE.faces))
        missing.append([1 - iou_3d(boxes, truth).mean() for boxes in (given(one), found.boxes)])
        assert set(found.status) == {'refined'}
        assert set(found.reasons) == {''}
    before, after = np.array(missing).T
    assert (after < before).all()
    assert after.mean() < 0.5 * before.mean()


def test_covariances_are_as_large_as_the_errors():
    # Squared errors over covariances of x, y and yaw average to 1 where covariances are right.
    # Ours are for real detectors and sensors: points with a labelling margin known to 1 cm
    # leave smaller errors, by less than a factor of six in the deviation, and not larger ones.
    ratios = []
    for seed in range(8):
        truth = drive(10)
        (found,) = register([window(truth, seed)], ALONE, InputModel(ALONE.faces))
        error = (found.boxes - truth)[:, [0, 1, 8]]
        variance = found.covariances[:, [0, 1, 5], [0, 1, 5]]
        ratios.append((error**2 / variance).mean())
        np.testing.assert_allclose(found.covariances, found.covariances.swapaxes(1, 2), atol=1e-9)
        assert (np.linalg.eigvalsh(found.covariances) > 0).all()
    assert 1 / 36 < np.mean(ratios) < 2


# --- repeated boxes -----------------------------------------------------------------------------

WHOLE = ALONE.updated({'estimate': 'track'})


def test_constant_errors_of_extents_are_corrected():
    # Eight cars of one length pass the sensor, which sees their fronts first and their backs
    # later, so that the length is observable. The input is 6 % too long for one half of them
    # and too short for the other, always the same.
    truth = drive(40, turn=0, start=(-10.0, 6.0, 0.0))
    many = []
    for k in range(8):
        track = track_of(truth, np.random.default_rng(k), str(k))
        track.boxes[:, 3] *= 1.06 if k % 2 else 0.94
        many.append(window_of(track, WHOLE))
    lengths = [found.boxes[0, 3] for found in register(many, WHOLE, InputModel(WHOLE.faces))]
    before = 0.12 * truth[0, 3]
    assert np.mean(lengths[1::2]) - np.mean(lengths[::2]) < before / 2


def test_repeated_parked_boxes_are_not_taken_for_exact():
    # Nine parked cars, the box of each always the same, 0.2 m off along or across; and three
    # that move, whose boxes wander by 0.15 m: the noise of all is estimated from these.
    rng, many, truths, n = np.random.default_rng(0), [], [], 60
    for k in range(12):
        is_parked = k % 4 > 0
        truth = drive(n, turn=0, start=(4.0 * k - 22.0, 6.0, 0.0), speed=0 if is_parked else 5.0)
        track = track_of(truth, rng, str(k), position=0.0, heading=0.0)
        if is_parked:
            track.boxes[:, k % 2] += 0.2 * (-1) ** (k // 2)
            truths.append(truth)
        else:
            drift = np.zeros(2)
            for box in track.boxes:
                drift = 0.8 * drift + 0.6 * 0.15 * rng.normal(size=2)
                box[:2] += drift
        many.append(window_of(track, WHOLE))
    estimates = register(many, WHOLE, InputModel(WHOLE.faces))
    parked = [found.boxes for k, found in enumerate(estimates) if k % 4]
    off = np.linalg.norm((np.array(parked) - truths)[..., :2], axis=2)
    assert off.mean() < 0.2 / 2


# --- independence -------------------------------------------------------------------------------


@pytest.mark.parametrize('config', [ALONE, BRIEF], ids=['robust', 'paper'])
def test_a_batch_equals_single_windows(config):
    # Padded to the longest, and to the one with most points.
    many = windows(config)
    together = register(many, config, InputModel(config.faces))
    for one, found in zip(many, together, strict=True):
        (known,) = register([one], config, InputModel(config.faces))
        np.testing.assert_allclose(found.boxes, known.boxes, atol=1e-8)
        np.testing.assert_allclose(found.covariances, known.covariances, atol=1e-8)
        assert (found.status, found.reasons) == (known.status, known.reasons)


@pytest.mark.skipif(not torch.cuda.is_available(), reason='no CUDA device here')
@pytest.mark.parametrize('estimate', ['final', 'track'])
def test_a_gpu_gives_the_same_boxes(estimate):
    config = ALONE.updated({'estimate': estimate})
    there = config.updated({'device': 'cuda'})
    known = register(windows(), config, InputModel(config.faces))
    found = register(windows(), there, InputModel(config.faces))
    for a, b in zip(found, known, strict=True):
        assert a.status == b.status
        np.testing.assert_allclose(a.boxes, b.boxes, atol=1e-4)


@pytest.mark.parametrize('config', [ALONE, BRIEF], ids=['robust', 'paper'])
def test_the_order_of_windows_does_not_matter(config):
    many = windows(config)
    known = register(many, config, InputModel(config.faces))
    found = register(many[::-1], config, InputModel(config.faces))[::-1]
    for a, b in zip(found, known, strict=True):
        np.testing.assert_allclose(a.boxes, b.boxes, atol=1e-8)


def test_an_ill_conditioned_window_does_not_affect_others():
    # Stamps a nanosecond apart let the curvature lose its definiteness in rounding.
    many = windows()
    known = register(many, ALONE, InputModel(ALONE.faces))
    bad = [changed(o, stamps_ns=i) for i, o in enumerate(many[2].observations)]
    many[2] = many[2]._replace(observations=bad)
    found = register(many, ALONE, InputModel(ALONE.faces))
    for i in (0, 1, 3):
        np.testing.assert_allclose(found[i].boxes, known[i].boxes, atol=1e-6)
        assert found[i].status == known[i].status
    assert np.isfinite(found[2].boxes).all()
    assert np.isfinite(found[2].covariances).all()


def test_observations_update_the_margins_once():
    config = ALONE.updated({'faces.learn': True})
    model = InputModel(config.faces)
    many = [window(drive(12), seed, config, str(seed)) for seed in range(4)]
    register(many, config, model)
    known = model.offsets().gap_correction
    assert (known - InputModel(config.faces).offsets().gap_correction).abs().max() > 1e-4
    again = [
        w._replace(num_new=0, observations=w.observations[-4:], start=given(w)[-4:]) for w in many
    ]
    register(again, config, model)
    np.testing.assert_array_equal(model.offsets().gap_correction, known)


@pytest.mark.parametrize('length', [9, 13, 16])
def test_each_box_counts_once_in_the_noise(length):
    # Ten boxes a window: the first one is the best of its window from the tenth on.
    model = InputModel(ALONE.faces)
    whole = window(drive(length))
    for end in range(3, length + 1):
        seen = whole.observations[max(0, end - 10) : end]
        register([whole._replace(observations=seen, num_new=len(seen))], ALONE, model)
    counted = length - 9
    known = counted / (counted + 14) if counted >= 5 else 0.0
    np.testing.assert_allclose(model.noise().weight[0], known)


def test_short_windows_have_no_estimate():
    many = [window(drive(2), 0, name='a'), window(drive(3), 0, name='b')]
    short, long = register(many, ALONE, InputModel(ALONE.faces))
    assert short is None
    assert set(long.status) == {'refined'}


@pytest.mark.parametrize('many', [[], [window(drive(1))]], ids=['none', 'one box'])
def test_no_windows_to_solve(many):
    assert register(many, ALONE, InputModel(ALONE.faces)) == [None] * len(many)


# --- shared variables and parked objects --------------------------------------------------------


def test_expectation_of_shared_variables_by_hand():
    # Lengths of 4.0, 4.4 and 4.5 m are in the window, two of 4.3 m have left: 21.5 / 5 = 4.3 m;
    # padding, 9 m, does not count. The pivot is a quarter of that behind the centre.
    boxes = np.zeros((2, 4, 9))
    boxes[:, :, 3] = [4.0, 4.4, 4.5, 9.0]
    boxes[..., 4:6] = [2.0, 1.5]
    valid, seen = [[True, True, True, False]] * 2, [[8.6, 4.0, 3.0, 2.0], [0, 0, 0, 0]]
    kinds = {'pivot': [0.25, 0.2], 'gap_ends': [1, 2], 'gap_sides': [3, 4], 'gap_top': [5, 6]}
    kinds = {**kinds, 'gap_bottom': [7, 8]}
    kinds = {name: torch.tensor(values, dtype=D) for name, values in kinds.items()}
    kinds = {**dict(numbers(ALONE.vehicle)), **kinds}
    problem = problem_of(boxes, valid=valid, marginalised_extents=seen, class_numbers=kinds)
    gaps = torch.tensor([0.1, 0.2, 0.3, 0.4, 0.5, 0.6], dtype=D)  # beyond those of the classes
    found = expect(problem, InputEstimates(FaceOffsets(gaps, *torch.zeros(2, 6)))).shared
    known = np.zeros((2, batch.SHARED))
    known[:, batch.EXTENT] = [[4.3, 2.0, 1.5], [4.3, 2.0, 1.5]]
    known[:, batch.GAP] = [[1.1, 1.2, 3.3, 3.4, 5.5, 7.6], [2.1, 2.2, 4.3, 4.4, 6.5, 8.6]]
    known[:, batch.PIVOT] = [4.3 / 4, 4.3 / 5]
    np.testing.assert_allclose(found, known, atol=1e-12)


def parked(boxes, heading=0.0):
    kinds = {'heading': torch.tensor([ALONE.vehicle.heading])}
    return parked_steps(problem_of([boxes], class_numbers=kinds), torch.tensor([heading]))


def test_an_object_that_returns_is_not_parked():
    # 4 m forward and back: the mean speed is zero.
    boxes = drive(60, 0.0, 0.0)
    boxes[:, 0] += 2.0 * (1 - np.cos(np.linspace(0, 2 * np.pi, 60)))
    assert parked(drive(60, 0.0, 0.0)).all()
    assert not parked(boxes).any()


def test_an_object_that_turns_on_the_spot_is_not_parked():
    # 0.01 rad/s over 5.9 s are 0.059 rad, less than three errors of 0.04 rad of a heading.
    assert parked(drive(60, 0.0, 0.01)).all()
    assert not parked(drive(60, 0.0, 0.03)).any()
    assert parked(drive(60, 0.0, 0.03), heading=0.06).all()  # 0.177 rad: less than three errors


def test_a_parked_vehicle_that_drives_off_is_not_held_there():
    boxes = drive(80, 0.0, 0.0)
    since = (np.arange(80) - 68).clip(0) / 10
    boxes[:, 0] += since**2  # 2 m/s^2 for 1.1 s
    is_parked = parked(boxes)[0].numpy()
    # Middles of five boxes and the next five are 0.5 s apart: about step 72 by 0.7^2 - 0.2^2 =
    # 0.45 m, which is slower than 1 m/s, about step 73 by 0.8^2 - 0.3^2 = 0.55 m. So it drives
    # from step 73 on, and the zero-motion prior ends four steps before that.
    np.testing.assert_array_equal(is_parked, np.arange(79) < 69)
    np.testing.assert_array_equal(parked(boxes[::-1])[0], is_parked[::-1])


@pytest.mark.parametrize(
    ('speed', 'length', 'is_parked'),
    [
        (0.0, 10, True),
        (0.28, 10, True),  # 0.25 m in 0.9 s
        (0.32, 10, False),
        (0.28, 30, False),  # 0.81 m in 2.9 s
        (0.2, 30, True),  # 0.58 m
    ],
)
def test_parked_objects_by_speed_and_distance(speed, length, is_parked):
    # Slower than 0.3 m/s and moved less than 0.7 m. Of two windows the second is padded with
    # boxes far away, and errors that take turns do not make it move.
    boxes = drive(length, speed, 0.0)
    boxes[:, 1] += 0.2 * np.cos(
        np.pi * np.minimum(np.arange(length), length - 1 - np.arange(length))
    )
    padded = np.concatenate([boxes, 1e3 + boxes[:2]])
    many = np.stack([np.concatenate([boxes, boxes[-1:], boxes[-1:]]), padded])
    valid = np.arange(length + 2) < length
    kinds = {name: torch.full((2,), value) for name, value in numbers(ALONE.vehicle)}
    problem = problem_of(many, valid=np.stack([valid] * 2), class_numbers=kinds)
    expected = expect(problem, InputEstimates(NO_OFFSETS))
    state = State(problem.pose, expected.shared)
    observations = observe_faces(problem, state, NO_OFFSETS, ALONE)
    (rest,) = (
        term.weight
        for term in weigh(problem, state, observations, expected, ALONE)
        if term.function is terms.zero_motion
    )
    held = (rest.diagonal(dim1=-2, dim2=-1) > 0)[:, :, 0].all(-1)
    np.testing.assert_array_equal(held, np.stack([valid[1:] & is_parked] * 2))


@pytest.mark.parametrize(
    ('interval', 'speed', 'shown'),
    [(0.1, 0.25, 0.0), (0.5, 0.1, 0.0), (0.5, 0.12, 0.12**2 - 0.026 * 1.385 / 0.615 / 35.75)],
)
def test_parked_objects_drift_as_fast_as_their_input_shows(interval, speed, shown):
    # The noise of the input is .14 m and .08 m, with a total variance of .026, widened as errors
    # are correlated by .385. The times of twelve boxes at 2 Hz have 143 / 4 s^2 about their mean:
    # noise alone gives a slope of .040 m/s. 2.6 times as much, .106 m/s, is beyond chance.
    kinds = {name: torch.full((1,), value, dtype=D) for name, value in numbers(ALONE.vehicle)}
    times = interval * torch.arange(12, dtype=D)[None]
    boxes = np.repeat(drive(1)[None], 12, axis=1)
    boxes[0, :, 1] += speed * times[0].numpy()
    problem = problem_of(boxes, times=times, class_numbers=kinds)
    expected = expect(problem, InputEstimates(NO_OFFSETS))
    state = State(problem.pose, expected.shared)
    observations = observe_faces(problem, state, NO_OFFSETS, ALONE)
    (weight,) = (
        term.weight
        for term in weigh(problem, state, observations, expected, ALONE)
        if term.function is terms.zero_motion
    )
    deviation = weight.diagonal(dim1=-2, dim2=-1)[0, :, 0] ** -0.5
    np.testing.assert_allclose(deviation[:, :2], np.hypot(0.02, interval * shown**0.5))
    np.testing.assert_allclose(deviation[:, 2], 0.01)


@pytest.mark.parametrize(
    ('weight', 'fast', 'slow'),
    [
        (0.0, 0.235 / 0.3, 1.0),
        (0.5, 2.5**0.5 * 0.1425 / 0.3, 2.5**0.5),
        (1.0, 2 * 0.05 / 0.3, 2.0),
    ],
)
def test_expected_bias_by_hand(weight, fast, slow):
    # Twice as wide as expected, correlated by 0.2 where 0.385 is usual: weight 1/2 lies
    # between, at 0.2925, and at (1 + 4) / 2 times the power. A bias is in proportion to that
    # deviation and to what the correlation is above 0.15, up to 0.45, over a tenth of a second:
    # at 2 Hz the fifth root of all three is.
    kinds = {name: torch.full((2,), value, dtype=D) for name, value in numbers(ALONE.vehicle)}
    times = torch.arange(6, dtype=D) * torch.tensor([[0.1], [0.5]], dtype=D)
    boxes = np.broadcast_to(drive(6), (2, 6, 9)).copy()
    problem = problem_of(boxes, times=times, class_numbers=kinds)
    state = State(problem.pose, expect(problem, InputEstimates(NO_OFFSETS)).shared)
    observations = observe_faces(problem, state, NO_OFFSETS, ALONE)
    error = problem.of_class(*POSE_ERRORS)
    deviation = torch.full((9,), 2.0, dtype=D)
    noise = InputNoise(deviation, torch.full((9,), 0.2, dtype=D), weight=torch.tensor([weight]))
    expected = expect(problem, InputEstimates(NO_OFFSETS, noise))
    (information,) = (
        term.weight[:, 0, 0].diagonal(dim1=1, dim2=2)
        for term in weigh(problem, state, observations, expected, ALONE)
        if term.function is terms.shared_prior
    )
    bias = information[:, batch.BIAS] ** -0.5 / error
    known = torch.tensor([[fast], [slow]], dtype=D) * torch.tensor([1, 1, 1, 1, 1, 0.5])
    np.testing.assert_allclose(bias, known, rtol=1e-9)


def test_errors_of_the_input_by_hand():
    # The mean of six extents, correlated by 0.2, errs by sqrt(1.2 / 0.8 / 6) = 1/2 of the measured
    # error. Constant errors count by how far the correlation is above 0.15, of 0.3: 1/6. Biases
    # likewise. The error of low-noise input is not lowered here. Detectors set roll and pitch to
    # zero: how correlated their residuals are makes no difference.
    kinds = {name: torch.full((1,), value, dtype=D) for name, value in numbers(ALONE.vehicle)}
    problem = problem_of(drive(6)[None], class_numbers=kinds)
    for size in (2.0, 0.2):
        deviation = torch.full((9,), size, dtype=D)
        correlation = torch.full((9,), 0.2, dtype=D)
        correlation[3:5] = 0.9
        noise = InputNoise(deviation, correlation, weight=torch.tensor([1.0]))
        expected = expect(problem, InputEstimates(NO_OFFSETS, noise))
        constant = torch.tensor(CONSTANT_EXTENT_ERRORS['vehicle'], dtype=D) / 6
        of_mean = torch.full((3,), 0.5, dtype=D)
        extent = problem.boxes[:, 0, 3:6] * kinds['extent'] * torch.hypot(constant, of_mean)
        bias = problem.of_class(*POSE_ERRORS) * torch.tensor([1, 1, 1, 1, 1, 0.5]) / 6
        known = size * torch.cat([extent, bias], 1)
        measured = [0, 1, 2, 3, 4, 5, 8]
        np.testing.assert_allclose(expected.error[:, measured], known[:, measured], rtol=1e-9)


def test_held_extents_have_the_constant_errors_of_a_published_detector():
    # Their scatter shows none. Those of input with less than 0.4 of the usual noise are smaller.
    kinds = {name: torch.full((1,), value, dtype=D) for name, value in numbers(ALONE.pedestrian)}
    problem = problem_of(drive(6)[None], class_numbers=kinds)
    problem = problem._replace(kind=torch.tensor([KINDS.index('pedestrian')]))
    for size, constant in ((2.0, 2.0), (0.5, 1.0), (0.2, 0.5)):
        noise = InputNoise(torch.full((9,), size, dtype=D), weight=torch.tensor([1.0]))
        found = expect(problem, InputEstimates(NO_OFFSETS, noise)).error[:, batch.EXTENT]
        ratios = torch.tensor(CONSTANT_EXTENT_ERRORS['pedestrian'], dtype=D)
        usual = problem.boxes[:, 0, 3:6] * kinds['extent']
        known = usual * torch.hypot(constant * ratios, size / torch.tensor(6.0).sqrt())
        np.testing.assert_allclose(found, known, rtol=1e-6)


@pytest.mark.parametrize(
    ('offset', 'lasting'),
    [
        (0.0, 0.1),  # low-noise input: the smallest bias
        (0.3, 0.36),  # (0.3 / 0.5)^2
        (0.7, 0.7),  # smoothed by a filter: as of a detector that scatters as usual, not larger
    ],
)
def test_expected_bias_of_low_noise_input_by_hand(offset, lasting):
    # Boxes that scatter by a hundredth of what is usual, correlated by 0.9 over a tenth of a
    # second. Offsets of tracks along, across and in length free the bias of
    # positions and the extents from one half of the usual error on; not that of angles.
    kinds = {name: torch.full((1,), value, dtype=D) for name, value in numbers(ALONE.vehicle)}
    problem = problem_of(drive(6)[None], class_numbers=kinds)
    state = State(problem.pose, expect(problem, InputEstimates(NO_OFFSETS)).shared)
    observations = observe_faces(problem, state, NO_OFFSETS, ALONE)
    error, extent = problem.of_class(*POSE_ERRORS), kinds['extent'][:, None]
    parts = torch.tensor([1.5, 0.5, 9, 9, 9, 9, 1, 9, 9], dtype=D)  # 1 on average, of three
    noise = InputNoise(
        torch.full((9,), 0.01, dtype=D),
        torch.full((9,), 0.9, dtype=D),
        parts * offset,
        torch.ones(1, dtype=D),
    )
    expected = expect(problem, InputEstimates(NO_OFFSETS, noise))
    (weight,) = (
        term.weight[:, 0, 0].diagonal(dim1=1, dim2=2)
        for term in weigh(problem, state, observations, expected, ALONE)
        if term.function is terms.shared_prior
    )
    found = weight**-0.5
    bias = torch.tensor([[lasting] * 3 + [0.1, 0.1, 0.05]], dtype=D)
    np.testing.assert_allclose(found[:, batch.BIAS] / error, bias, rtol=1e-9)
    extents = found[:, batch.EXTENT] / state.shared[:, batch.EXTENT] / extent
    np.testing.assert_allclose(extents, np.full((1, 3), min(1.0, 2 * lasting)), rtol=1e-9)
    # Margins of low-noise input differ by up to twice as much.
    loose = found[:, batch.GAP] / ALONE.vehicle.gap_spread
    np.testing.assert_allclose(loose, np.full((1, 6), max(1.0, 2 - 2 * lasting)), rtol=1e-9)


def test_robust_prior_of_labelling_margins_by_hand():
    # Points 0.3 m above the roofs of two boxes of three, all of weight 1; the left side
    # has been found with a gap 0.1 m wider than expected, 2 of its deviations; on the other faces
    # all is as expected. An input correlated as usual, by 0.385, has biases of
    # (0.385 - 0.15) / 0.3 of its errors, and so for extents, half of which a face moves by.
    kinds = {name: torch.full((1,), value, dtype=D) for name, value in numbers(ALONE.vehicle)}
    problem = problem_of(drive(3)[None], class_numbers=kinds)
    expected = expect(problem, InputEstimates(NO_OFFSETS))
    left, top = batch.GAP.start + 2, batch.GAP.start + 4
    observations = observe_faces(problem, State(problem.pose, expected.shared), NO_OFFSETS, ALONE)
    distance = torch.zeros(1, 3, 6, dtype=D)
    distance[0, :, 4] = torch.tensor([0.3, 0.3, 9.0], dtype=D)
    face_weight = torch.ones(1, 3, 6, dtype=D)
    face_weight[0, 2, 4] = 0.0
    observations = observations._replace(distance=distance, weight=face_weight)
    state = State(problem.pose, expected.shared.clone())
    state.shared[0, left] += 2 * ALONE.vehicle.gap_spread
    (weight,) = (
        term.weight[0, 0, 0].diagonal()
        for term in weigh(problem, state, observations, expected, ALONE)
        if term.function is terms.shared_prior
    )
    part, height = (0.385 - 0.15) / 0.3, drive(1)[0, 5]
    z, half = part * ALONE.vehicle.height, part * ALONE.vehicle.extent * height / 2
    known = np.full(23, ALONE.vehicle.gap_spread)
    known[left] *= 2**0.5
    known[top] *= (1 + 0.3**2 / (ALONE.vehicle.gap_spread**2 + z**2 + half**2) / 4) ** 0.5
    np.testing.assert_allclose(weight[batch.GAP] ** -0.5, known[batch.GAP], rtol=1e-9)


def numbers(kind):
    return ((f.name, getattr(kind, f.name)) for f in fields(kind) if f.name != 'names')


# --- threads ------------------------------------------------------------------------------------


@pytest.mark.parametrize('estimate', ['final', 'track'])
@pytest.mark.parametrize('part', [1, 4000, 2**18])
def test_the_number_of_threads_does_not_change_results(monkeypatch, estimate, part):
    # One window at a time, a few, and all at once.
    config = ALONE.updated({'estimate': estimate})
    known = register(windows(), config, InputModel(config.faces))
    monkeypatch.setattr(solver, 'OBSERVATIONS_PER_THREAD', part)
    for threads in (0, 1, 3):
        more = config.updated({'solver.threads': threads})
        for a, b in zip(register(windows(), more, InputModel(more.faces)), known, strict=True):
            assert (a.status, a.reasons) == (b.status, b.reasons)
            np.testing.assert_allclose(a.boxes, b.boxes, rtol=0, atol=1e-9)
            np.testing.assert_allclose(a.covariances, b.covariances, rtol=0, atol=1e-9)
            assert (a.prior is None) == (b.prior is None)
            for one, other in zip(a.prior or (), b.prior or (), strict=True):
                np.testing.assert_allclose(one, other, rtol=1e-6, atol=1e-6)


def note_rounds(monkeypatch, note):
    """Call `note` with problem and state where margins are estimated, and of every round."""

    def observed(problem, state, *rest):
        note(problem, state)
        return observe_faces(problem, state, *rest)

    def taken(batch, *rest):
        note(batch.problem, batch.state)
        return run_round(batch, *rest)

    monkeypatch.setattr(registration, 'observe_faces', observed)
    monkeypatch.setattr(solver, 'run_round', taken)


@pytest.mark.parametrize('estimate', ['final', 'track'])
def test_all_points_are_used_in_the_last_round_only(monkeypatch, estimate):
    # About 256 of some 1,000 points until the boxes are settled, then all: the same accuracy.
    config = ALONE.updated({'estimate': estimate, 'sampling.points': 2000})
    rng, truth = np.random.default_rng(0), drive(10)
    points = [returns(box, rng, 1800) for box in truth]
    one = window_of(replace(track_of(truth, rng), points=points), config)
    most = max(len(observation.points) for observation in one.observations)
    few = -(-most // (most // rounds.COARSE_POINTS))
    seen = []
    note_rounds(monkeypatch, lambda problem, _: seen.append(problem.points.shape[2]))
    (found,) = register([one], config, InputModel(config.faces))
    assert most > 900 and few < 350
    assert seen.pop(0) == few  # margins are estimated from few, too
    assert seen == sorted(seen) and set(seen) == {few, most}
    assert seen.count(few) >= 2 and seen.count(most) <= 2
    for module in (registration, rounds):
        monkeypatch.setattr(module, 'COARSE_POINTS', most)
    seen.clear()
    (known,) = register([one], config, InputModel(config.faces))
    assert set(seen) == {most}
    iou = [iou_3d(boxes, truth).mean() for boxes in (given(one), found.boxes, known.boxes)]
    assert iou[1] > iou[0] + 0.05
    assert abs(iou[1] - iou[2]) < 0.01


@pytest.mark.parametrize('part', [1, 2**18])
def test_an_error_in_a_thread_is_raised(monkeypatch, part):
    monkeypatch.setattr(solver, 'OBSERVATIONS_PER_THREAD', part)
    threads = torch.get_num_threads()

    def broken(*_):
        raise RuntimeError('broken')

    monkeypatch.setattr(solver, 'run_round', broken)
    with pytest.raises(RuntimeError, match='broken'):
        register(windows(), ALONE, InputModel(ALONE.faces))
    assert torch.get_num_threads() == threads


# --- extents ------------------------------------------------------------------------------------


def test_shrunk_extents_are_corrected_by_the_population():
    # Lengths of 16 cars, which differ half as much in the input: a slope of -0.5 in logarithms.
    # Most drive by, every fourth one is seen from behind only. The population has more evidence of
    # each than each alone: the remaining slope shrinks by a quarter or more.
    config = ALONE.updated({'estimate': 'track'})
    rng, many, lengths = (
        np.random.default_rng(0),
        [],
        EXTENT[0] * np.exp(np.linspace(-0.18, 0.18, 16)),
    )
    for i, length in enumerate(lengths):
        start = (10.0, 0.3, 0.05) if i % 4 == 3 else (-6.0, 6.0, 0.1)
        truth = drive(20, turn=0.0, start=start)
        truth[:, 3] = length
        track = track_of(truth, rng, str(i))
        track.boxes[:, 3] = (EXTENT[0] * length) ** 0.5
        many.append(window_of(track, config))

    def slope(config):
        found = register(many, config, InputModel(config.faces))
        wrong = np.log([estimate.boxes[0, 3] for estimate in found]) - np.log(lengths)
        return np.polyfit(np.log(lengths), wrong, 1)[0]

    known = slope(config)
    alone = slope(config.updated({'ingredients.population_extents': False}))
    assert -0.3 < alone < -0.1
    assert abs(known) < 0.75 * abs(alone)


@pytest.fixture
def extents_used(monkeypatch):
    """Collect the extents (3,) at which faces of the first window are observed, round by round."""
    seen = []

    def noted(_, state):
        seen.append(state.shared[0, batch.EXTENT].numpy().copy())

    note_rounds(monkeypatch, noted)
    return seen


@pytest.mark.parametrize(
    ('changes', 'held'), [({'extent': 'fixed'}, [0, 1, 2]), ({'mode': 'bev'}, [2]), ({}, [])]
)
def test_a_warm_window_uses_the_extents_of_the_tick_before(extents_used, changes, held):
    # Extents that are held fixed are the mean of the input; free ones start from the tick before.
    config, found = ALONE.updated(changes), [4.0, 2.0, 1.3]
    whole = window(drive(6), extent=0.05)
    start = given(whole)[:-1]
    start[:, 3:6] = found
    register([whole._replace(num_new=1, start=start)], config, InputModel(config.faces))
    assert len(extents_used) == 2  # for the margins, and the one round of a tick
    known = np.where(np.isin(np.arange(3), held), given(whole)[:, 3:6].mean(0), found)
    np.testing.assert_allclose(extents_used[1], known)


@pytest.mark.parametrize('rounds', [1, 2])
def test_a_cold_window_starts_from_the_mean_extents_of_the_input(extents_used, rounds):
    config = ALONE.updated({'solver.rounds': rounds})
    whole = window(drive(6), extent=0.05)
    register([whole], config, InputModel(config.faces))
    assert len(extents_used) == 1 + rounds
    np.testing.assert_allclose(extents_used[1], given(whole)[:, 3:6].mean(0))


# --- marginalisation prior ----------------------------------------------------------------------


def test_full_windows_leave_a_marginalisation_prior():
    # A full window of ten observations marginalises the first; a shorter window leaves no prior.
    many = windows()
    found = register(many, ALONE, InputModel(ALONE.faces))
    assert [estimate.prior is not None for estimate in found] == [True, False, False, False]
    prior, boxes = found[0].prior, found[0].boxes
    first = given(many[0])[0]
    np.testing.assert_array_equal(prior.base, first[:3])
    np.testing.assert_array_equal(prior.marginalised_extents, [*first[3:6], 1])
    left = boxes[1:3] - [*first[:3], *np.zeros(6)]
    np.testing.assert_allclose(prior.state[:12], left[:, POSE].ravel(), atol=1e-9)
    np.testing.assert_allclose(prior.state[12:15], boxes[0, 3:6], atol=1e-9)
    np.testing.assert_allclose(prior.information, prior.information.T, atol=1e-6)
    assert np.linalg.eigvalsh(prior.information).min() > -1e-6 * prior.information.max()
    for config in (ALONE.updated({'estimate': 'track'}), BRIEF):
        found = register(windows(config), config, InputModel(config.faces))
        assert {estimate.prior for estimate in found} == {None}


def slid(whole, count, turns=0.0, config=ALONE):
    """Return the estimates of windows of ten of `whole`, one after the other; prior + `turns`."""
    estimates, prior, start = [], None, np.zeros((0, 9))
    for first in range(count):
        observations = whole.observations[first : first + 10]
        one = whole._replace(
            observations=observations, num_new=10 - len(start), start=start, prior=prior
        )
        estimates += register([one], config, InputModel(config.faces))
        prior, start = estimates[-1].prior, estimates[-1].boxes[1:]
        state = prior.state.copy()
        state[[5, 11]] += turns
        prior = prior._replace(state=state)
    return estimates


def test_marginalisation_prior_improves_the_newest_box():
    whole = window(drive(14))
    estimates = slid(whole, 5)
    boxes = given(whole)
    for i, estimate in enumerate(estimates):
        np.testing.assert_array_equal(estimate.prior.base, boxes[0, :3])
        known = [*boxes[: i + 1, 3:6].sum(0), i + 1]
        np.testing.assert_allclose(estimate.prior.marginalised_extents, known)
    # The prior has information about bias and extent: without it, the covariance is larger.
    last = whole._replace(
        observations=whole.observations[4:], num_new=1, start=estimates[3].boxes[1:]
    )
    (forgetful,) = register([last], ALONE, InputModel(ALONE.faces))
    spread = [np.trace(e.covariances[-1][:2, :2]) for e in (estimates[4], forgetful)]
    assert spread[0] < spread[1]


@pytest.mark.parametrize('turns', [2 * np.pi, -4 * np.pi])
def test_prior_is_invariant_to_whole_turns(turns):
    whole = window(drive(13, turn=0.4, start=(5.0, 6.0, 2.9)))  # across half a turn
    for found, known in zip(slid(whole, 4, turns), slid(whole, 4), strict=True):
        np.testing.assert_allclose(found.boxes, known.boxes, atol=1e-9)


def test_a_failed_window_leaves_no_prior():
    # All observations have one stamp, which the registrar refuses: no speed is finite. The other
    # window still leaves a prior.
    many = [window(drive(10), 0), window(drive(10, start=(-9.0, 3.0, -1.0)), 1)]
    bad = [changed(o, stamps_ns=0) for o in many[0].observations]
    many[0] = many[0]._replace(observations=bad)
    failed, found = register(many, ALONE, InputModel(ALONE.faces))
    assert set(failed.reasons) == {'not_finite'}
    assert failed.prior is None
    assert set(found.status) == {'refined'}
    assert found.prior is not None


# --- solver against torch's ---------------------------------------------------------------------


def oracle(function, start):
    """Return the least value torch.optim.LBFGS finds from `start` (D,), one window alone."""
    x = start.clone().requires_grad_()
    solver = torch.optim.LBFGS(
        [x], max_iter=150, history_size=20, tolerance_grad=1e-10, tolerance_change=1e-13,
        line_search_fn='strong_wolfe',
    )  # fmt: skip
    best = [float('inf')]

    def closure():
        solver.zero_grad()
        loss = function(x)
        loss.backward()
        best[0] = min(best[0], loss.item())
        return loss

    solver.step(closure)
    return best[0]


def test_minimum_of_the_default_objective_against_torch():
    # One round of terms: torch gets the sum of r' W r / 2 and its automatic gradient, ours gets
    # the written gradient and the Gauss-Newton curvature as metric, and all windows at once.
    problem, _ = stack_windows(windows(), ALONE)
    terms = robust_terms(problem)
    length = problem.valid.shape[1]
    shared = torch.cat([problem.boxes[:, 0, 3:6], torch.zeros(4, batch.SHARED - 3)], 1)
    x = State(problem.pose, shared.to(D)).pack()
    function = Objective(terms, x, length, torch.ones_like(x))
    found = minimize(function, x, 12, 6, 1e-6, function.newton)
    assert (found.value < 0.9 * function(x, torch.arange(4))[0]).all()
    for row in range(4):
        index = torch.tensor([row])
        own = select(terms, index)

        def loss(x, own=own):
            state = State.unpack(x[None], length)
            value = 0.0
            for term in own:
                r = term.linearise(state).residual
                value = value + 0.5 * torch.einsum('bnfr,bnfrs,bnfs->', r, term.weight, r)
            return value

        assert found.value[row] <= 1.01 * oracle(loss, x[row]) + 1e-9


def robust_terms(problem):
    """Return all terms of a problem, with weights of the usual size."""
    B, N = problem.valid.shape
    valid = problem.valid.to(D)

    def diagonal(weight, n):
        return torch.diag_embed(weight * n[..., None])[:, :, None]

    weight = torch.tensor([0.1, 0.1, 0.1, 0.02, 0.02, 0.04], dtype=D) ** -2
    motion = torch.tensor([1.5, 4.0, 1.0, 0.2, 0.2, 0.8], dtype=D) ** -2
    homogeneous = torch.cat([problem.points, torch.ones_like(problem.points[..., :1])], -1)
    homogeneous = (homogeneous * problem.mask[..., None]).to(D)
    moments = torch.einsum('bnmi,bnmj->bnij', homogeneous, homogeneous)
    moments = moments[:, :, None] * torch.tensor([1.0, 0, 1.0, 0, 1.0, 0])[:, None, None]
    expected = torch.zeros(B, batch.SHARED, dtype=D)
    expected[:, :3] = problem.boxes[:, 0, 3:6]
    expected[:, batch.PIVOT] = problem.boxes[:, 0, 3] / 4
    one = torch.ones(B, 1, dtype=D)
    axes = rotation_from_rpy(problem.pose[..., 3:])
    return [
        Term(terms.faces, moments, (problem.pose, torch.zeros(B, N, 6, dtype=D))),
        Term(terms.input_pose, diagonal(weight, valid), (problem.pose, axes)),
        Term(terms.acceleration, diagonal(motion, valid[:, 2:]), (problem.times,)),
        Term(
            terms.slip, diagonal(torch.tensor([40.0, 20.0]).to(D), valid[:, 1:]),
            (problem.times,),
        ),
        Term(
            terms.shared_prior,
            diagonal(torch.full((batch.SHARED,), 400.0, dtype=D), one), (expected,),
        ),
    ]  # fmt: skip


def paper_problem():
    problem, _ = stack_windows(windows(PAPER), PAPER)
    x = problem.pose.flatten(1)
    extent = problem.boxes[..., 3:6]

    def total(x, rows, multipliers, rounding=paper.EPSILON):
        pose = x.unflatten(1, (extent.shape[1], 6))
        boxes = torch.cat([pose[..., :3], extent[rows], pose[..., 3:]], -1)
        return paper.total(boxes, select(problem, rows), WEIGHTS, multipliers, rounding)

    return problem, x, total


def test_minimum_of_the_papers_objective_against_torch():
    # Eq. 8 has kinks, where quasi-Newton methods stop early. Ours comes from rounded ones, so it
    # must not be worse than torch's by more than a hundredth of the value.
    _, x, total = paper_problem()
    multipliers = torch.full((4, 2), 0.1, dtype=D)

    found = Minimum(x, *[None] * 3)
    for rounding in (0.3, 3e-3, 3e-5, paper.EPSILON):

        def function(x, rows, rounding=rounding):
            x = x.detach().requires_grad_()
            loss, _ = total(x, rows, multipliers[rows], rounding)
            (gradient,) = torch.autograd.grad(loss.sum(), x)
            return loss.detach(), gradient

        found = minimize(function, found.x, 100, 10, 1e-9)
    for row in range(4):
        index = torch.tensor([row])

        def loss(x, index=index):
            return total(x[None], index, multipliers[index])[0].sum()

        best = oracle(loss, x[row])
        assert best < 0.97 * loss(x[row]).item()
        assert found.value[row] <= 1.01 * best


def test_multipliers_reduce_constraint_violations():
    # Smoothness and alignment are constraints: after the rounds they are violated less than at
    # the input, and the objective at the multipliers of the first round is lower.
    problem, x, total = paper_problem()
    state, found, prior, *_ = solve_paper(problem, PAPER)
    assert prior is None
    assert found.poses.shape == (*problem.valid.shape, 6, 6)
    rows, none = torch.arange(4), torch.zeros(4, 2, dtype=D)
    before, violation = total(x, rows, none)
    after, rest = total(state.pose.flatten(1), rows, none)
    assert (after < before).all()
    assert (rest < violation).all()


# --- free variables -----------------------------------------------------------------------------


@pytest.mark.parametrize('name', ['robust', 'paper'])
def test_bev_keeps_height_roll_and_pitch(name):
    config = (ALONE if name == 'robust' else PAPER).updated({'mode': 'bev'})
    one = window(drive(6), 1, config)
    (found,) = register([one], config, InputModel(config.faces))
    np.testing.assert_allclose(found.boxes[:, [2, 6, 7]], given(one)[:, [2, 6, 7]], atol=1e-12)
    assert np.abs(found.boxes - given(one))[:, [0, 1, 8]].max() > 0.01


@pytest.mark.parametrize('name', ['robust', 'paper'])
def test_extents_are_one_per_track_or_fixed(name):
    config = ALONE if name == 'robust' else PAPER
    one = window(drive(6), 1, config, extent=0.05)
    (found,) = register([one], config, InputModel(config.faces))
    np.testing.assert_allclose(found.boxes[:, 3:6], found.boxes[:1, 3:6].repeat(6, 0))
    fixed = config.updated({'extent': 'fixed'})
    (found,) = register([one], fixed, InputModel(config.faces))
    np.testing.assert_array_equal(found.boxes[:, 3:6], given(one)[:, 3:6])
