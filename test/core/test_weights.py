"""Expectation and weights of one window, from input whose noise is known."""

from boxreg_ros.config import Config
from boxreg_ros.core.method.arrays import BIAS, COMMON, EXTENT, GAP, PIVOT
from boxreg_ros.core.method.assemble import empty_axes, weigh
from boxreg_ros.core.method.constants import CONSTANTS, RESIDUAL_NAMES
from boxreg_ros.core.method.expectation import expect, EXTENT_TAILS
from boxreg_ros.core.method.residuals import empty_linearised, TERMS
from boxreg_ros.core.method.weights import fill_parked, robustify
import numpy as np
import pytest
from scenes import drive, no_inputs, problem_of, settings_of

CONFIG = Config()
RECORD = CONSTANTS.with_settings(CONFIG).record()[0]


def expected_of(problem, inputs=None, b=0):
    """Return the record `COMMON` of window `b` before its points are used."""
    common = np.zeros(len(problem.boxes), COMMON)
    inputs = no_inputs() if inputs is None else inputs
    mean = problem.mean_extents()[b]
    expect(b, problem, inputs[problem.kind[b]], RECORD, mean, common[b])
    return common[b]


def weighed(problem, common, shared=None, **fields):
    """Return the weighed `TERMS` (N,) of the first window at its input boxes."""
    poses = np.ascontiguousarray(problem.boxes[0][:, [0, 1, 2, 6, 7, 8]])
    terms, N = np.zeros(len(poses), TERMS), len(poses)
    for name, value in fields.items():
        terms[name] = value
    shared = common['shared'].copy() if shared is None else shared
    record = CONSTANTS.with_settings(CONFIG).in_round(False, False).record()[0]
    holder = np.array([common], COMMON)
    weigh(0, problem, poses, shared, record, empty_axes(N), empty_linearised(), terms, holder[0])
    return terms, holder[0]


def car_problem(boxes, **changes):
    return problem_of(boxes, of_class=settings_of(CONFIG.vehicle), **changes)


# --- expectation --------------------------------------------------------------------------------


def test_means_of_shared_variables_by_hand():
    # Lengths of 4.0, 4.4 and 4.5 m are in the window, two of 4.3 m have left: 21.5 / 5 = 4.3 m;
    # padding, 9 m, does not count. The pivot is a quarter of that behind the centre.
    boxes = np.zeros((1, 4, 9))
    boxes[:, :, 3] = [4.0, 4.4, 4.5, 9.0]
    boxes[..., 4:6] = [2.0, 1.5]
    gaps = [1, 1, 3, 3, 5, 7]
    problem = car_problem(boxes, lengths=[3], marginalised_extents=[[8.6, 4.0, 3.0, 2.0]])
    problem.of_class['gaps'] = gaps
    beyond = np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.6])
    found = expected_of(problem, no_inputs(margin=beyond))['shared']
    known = np.zeros(23)
    known[EXTENT:BIAS] = [4.3, 2.0, 1.5]
    known[GAP:PIVOT] = gaps + beyond
    known[PIVOT] = 4.3 / 4
    np.testing.assert_allclose(found, known, atol=1e-12)


def test_errors_of_the_input_by_hand():
    # Twice as wide as usual, correlated by 0.5 over 0.1 s: the deviation of the mean of many is
    # widened by sqrt(1.5 / 0.5), and biases are as large as errors that change, for yaw half as
    # large. At 2 Hz what is correlated by 0.5^5 over 0.5 s was correlated by 0.5 over 0.1 s.
    times = np.arange(6) * np.array([[0.1], [0.5]])
    problem = car_problem(np.broadcast_to(drive(6), (2, 6, 9)), times=times)
    usual, extent = problem.of_class['pose'][0], CONFIG.vehicle.extent
    for b, correlation in enumerate((0.5, 0.5**5)):
        inputs = no_inputs(deviation=2.0, correlation=correlation, extent_error=[0.5, 1.0, 2.0])
        found = expected_of(problem, inputs, b)
        wide = 2 * np.sqrt((1 + correlation) / (1 - correlation))
        np.testing.assert_allclose(found['pose_deviation'], 2 * usual)
        np.testing.assert_allclose(found['widened_deviation'], wide * usual)
        np.testing.assert_allclose(found['deviation'][BIAS:GAP], usual * [2, 2, 2, 2, 2, 1])
        known = drive(1)[0, 3:6] * extent * [0.5, 1.0, 2.0]
        np.testing.assert_allclose(found['deviation'][EXTENT:BIAS], known)
        # The mean of six errs by more: long tails, and errors that change.
        of_mean = (wide * drive(1)[0, 3:6] * extent) ** 2 / 6
        beyond = (np.square(EXTENT_TAILS) - 1) * known**2 + of_mean
        np.testing.assert_allclose(found['unclaimed'][:BIAS], beyond)


def test_low_noise_input_is_held_closer_than_it_errs():
    problem = car_problem(drive(6)[None])
    usual, low = (expected_of(problem, no_inputs(low_noise=part)) for part in (1.0, 0.5))
    for name in ('pose_deviation', 'widened_deviation'):
        np.testing.assert_allclose(low[name], usual[name] / 4)
    bias = usual['deviation'][BIAS:GAP]
    np.testing.assert_allclose(low['deviation'][BIAS:GAP], bias / 4)
    np.testing.assert_allclose(low['unclaimed'][BIAS:], bias**2 * (1 - 1 / 16))
    extents = usual['deviation'][EXTENT:BIAS]
    np.testing.assert_allclose(low['deviation'][EXTENT:BIAS], extents / 2)
    total = [c['unclaimed'][:BIAS] + c['deviation'][EXTENT:BIAS] ** 2 for c in (usual, low)]
    np.testing.assert_allclose(*total)


def test_independent_errors_have_nearly_no_constant_part():
    problem = car_problem(drive(6)[None])
    found = expected_of(problem, no_inputs(correlation=0.0))['deviation'][BIAS:GAP]
    usual = problem.of_class['pose'][0]
    np.testing.assert_allclose(found, usual * [0.1, 0.1, 0.1, 0.1, 0.1, 0.05])


def test_margins_differ_as_those_of_like_objects_do():
    # Margins of cars that differ half as much as expected: those of a car do, too, the one of the
    # road included; those of a truck as the settings say, since its squared distance from cars
    # counts 12 times.
    problem = car_problem(np.concatenate([drive(6)[None], drive(6)[None]]))
    problem.boxes[1, :, 3:6] *= np.array([4.0, 2.0, 2.0])
    median = np.log(problem.boxes[0, 0, 3:6])
    inputs = no_inputs(spread=0.5, median=median, margin_variance=0.02**2)
    usual = np.array([CONFIG.vehicle.gap_spread] * 5 + [CONSTANTS.road_spread])
    car, truck = (expected_of(problem, inputs, b)['deviation'][GAP:PIVOT] for b in (0, 1))
    np.testing.assert_allclose(car, usual / 2)
    np.testing.assert_allclose(truck, usual * np.sqrt(1 - 0.75 / 12.53), rtol=1e-3)


def test_a_pinned_box_holds_extents_and_leaves_no_bias():
    boxes = drive(6)[None].copy()
    boxes[0, 2, 3] = 9.0
    pinned = np.arange(6)[None] == 2
    found = expected_of(car_problem(boxes, pinned=pinned))
    assert found['shared'][0] == 9.0
    np.testing.assert_allclose(found['deviation'][:GAP], 0.01)
    usual = expected_of(car_problem(boxes))['deviation'][BIAS:GAP]
    np.testing.assert_allclose(found['unmodelled_bias'], usual)


# --- weights ------------------------------------------------------------------------------------


def test_robust_prior_of_labelling_margins_by_hand():
    # Points 0.3 m above the roofs of two boxes of three, all of weight 1; the left side
    # has been found with a gap 0.1 m wider than expected, 2 of its deviations; on the other faces
    # all is as expected. An input correlated as usual, by 0.385, has biases as large
    # as its errors; a face moves by half of the error of an extent.
    problem, car = car_problem(drive(3)[None]), CONFIG.vehicle
    common = expected_of(problem)
    visibility, distance = np.ones((3, 6)), np.zeros((3, 6))
    visibility[2, 4], distance[:, 4] = 0.0, [0.3, 0.3, 9.0]
    shared = common['shared'].copy()
    shared[GAP + 2] += 2 * car.gap_spread
    _, found = weighed(problem, common, shared, visibility=visibility, distance=distance)
    z, half = car.height, car.extent * drive(1)[0, 5] / 2
    known = np.array([car.gap_spread] * 5 + [CONSTANTS.road_spread])
    known[2] *= 2**0.5
    known[4] *= (1 + 0.3**2 / (car.gap_spread**2 + z**2 + half**2) / 4) ** 0.5
    np.testing.assert_allclose(found['W_shared'][GAP:PIVOT] ** -0.5, known, rtol=1e-9)


def test_weights_of_faces_by_hand():
    # 0.15 m off, the outlier distance, a face has weight 1/4 of its information; one that is
    # turned away a quarter of that. An object with legs deviates by `shape` from all but the road.
    visibility, distance = np.ones((3, 6)), np.zeros((3, 6))
    distance[1], visibility[2] = 0.15, 0.25
    problem = car_problem(drive(3)[None])
    moments = np.tile(np.eye(4), (3, 6, 1, 1))
    fields = {'visibility': visibility, 'distance': distance, 'W_faces': moments}
    terms, _ = weighed(problem, expected_of(problem), **fields)
    information = np.array([0.12, 0.12, 0.08, 0.08, 0.08, 0.05]) ** -2
    np.testing.assert_allclose(terms['W_faces'][0, :, 3, 3], information)
    np.testing.assert_allclose(terms['W_faces'][1:, :, 3, 3], [information / 4] * 2)
    problem.of_class['roughness'] = 0.2
    terms, _ = weighed(problem, expected_of(problem), **fields)
    np.testing.assert_allclose(terms['W_faces'][0, :, 3, 3], [*[0.2**-2] * 5, 0.05**-2])


def test_weights_of_input_and_motion_by_hand():
    # At its input a pose has the inverse variance of the widened error; accelerations and slip
    # that of the settings; a moving car no zero motion. Padding has no weight, nor have stencils
    # that reach into it.
    problem, car = car_problem(drive(6)[None], lengths=[5]), CONFIG.vehicle
    common = expected_of(problem)
    terms, _ = weighed(problem, common)
    W = {name: terms['W'][:, i] for i, name in enumerate(RESIDUAL_NAMES)}
    np.testing.assert_allclose(W['input'][:5], [common['widened_deviation'] ** -2.0] * 5)
    motion = [car.acceleration, car.cornering, 1.0, 0.2, 0.2, car.turning]
    np.testing.assert_allclose(W['acceleration'][:3], [np.array(motion) ** -2.0] * 3)
    np.testing.assert_allclose(W['slip'][:4, :2], [[car.slip**-2, 0.25**-2]] * 4)
    assert not W['input'][5:].any() and not W['acceleration'][3:].any()
    assert not W['slip'][4:].any() and not W['zero motion'].any()
    rest, _ = weighed(car_problem(np.repeat(drive(1)[None], 6, axis=1)), common)
    known = [np.array(CONSTANTS.drift) ** -2.0] * 5 + [np.zeros(6)]
    np.testing.assert_allclose(rest['W'][:, RESIDUAL_NAMES.index('zero motion')], known)


def test_an_input_pose_three_errors_off_has_half_its_weight():
    problem = car_problem(drive(6)[None])
    common = expected_of(problem)
    shared = common['shared'].copy()
    shared[BIAS] = 3 * common['pose_deviation'][0]  # all are off by a bias that is not expected
    terms, _ = weighed(problem, common, shared)
    found = terms['W'][:, 0, :2] * common['widened_deviation'][:2] ** 2
    np.testing.assert_allclose(found, [[0.5, 1.0]] * 6)


def test_motion_residuals_far_off_are_down_weighted():
    # As the square of Cauchy's weight beyond three deviations, and no more than the two before.
    terms = np.zeros(5, TERMS)
    terms['W'] = 1.0
    robustify(2, 5, np.array([9.0, 0.0, 81.0, 81.0, 81.0]), 3.0, terms)
    known = np.array([1 / 4, 1, 1, 1, 1 / 100])
    np.testing.assert_allclose(terms['W'][:, 2], known[:, None].repeat(6, 1))
    np.testing.assert_array_equal(terms['W'][:, 1], 1)


# --- parked objects -----------------------------------------------------------------------------


def parked(boxes, heading=CONFIG.vehicle.heading):
    """Return whether an object is parked from each box to the next, (N - 1,)."""
    found = np.empty(len(boxes), bool)
    fill_parked(boxes, 0.1 * np.arange(len(boxes)), len(boxes), heading, RECORD, found)
    return found[:-1]


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
    # Middles of five boxes and the next five are 0.5 s apart: about step 72 by 0.7^2 - 0.2^2 =
    # 0.45 m, which is slower than 1 m/s, about step 73 by 0.8^2 - 0.3^2 = 0.55 m. So it drives
    # from step 73 on, and the zero-motion prior ends four steps before that.
    np.testing.assert_array_equal(parked(boxes), np.arange(79) < 69)
    np.testing.assert_array_equal(parked(boxes[::-1].copy())[::-1], parked(boxes))


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
    # Slower than 0.3 m/s and moved less than 0.7 m; errors that take turns do not make it move.
    boxes = drive(length, speed, 0.0)
    place = np.minimum(np.arange(length), length - 1 - np.arange(length))
    boxes[:, 1] += 0.2 * np.cos(np.pi * place)
    assert (parked(boxes) == is_parked).all()
