"""The compiled method: residuals and their sum against automatic differentiation, and by hand."""

from boxreg_ros.core.method.arrays import (
    ANCHOR,
    Arrowhead,
    BLOCK,
    Factor,
    padded,
    PIVOT,
    POSE,
    PRIOR,
    SHARED,
    SIDESLIP,
)
from boxreg_ros.core.method.arrowhead import (
    factorise,
    fix_variables,
    invert_poses,
    NEXT,
    solve,
)
from boxreg_ros.core.method.assemble import accumulate, empty_axes, marginalise, no_matrix
from boxreg_ros.core.method.constants import RESIDUAL_NAMES
from boxreg_ros.core.method.covariance import empty_inverse, fill_shared_covariance
from boxreg_ros.core.method.kinematics import fill_combination, RATES
from boxreg_ros.core.method.residuals import (
    empty_linearised,
    fill_axes,
    fill_plane,
    level_of,
    RESIDUALS,
    TERMS,
)
from boxreg_ros.core.method.rotation import fill_rotation
import numpy as np
import pytest
from reference import objective
from scenes import dense, random_terms, random_variables, shared_of


def matrix(N, S=SHARED):
    """Return room for the curvature of a window of N observations and S shared variables."""
    return Arrowhead(np.zeros(N + 2, BLOCK), np.zeros((S, S)))


def empty_factor(N, S=SHARED):
    """Return room for the factor of a window of N observations and S shared variables."""
    shapes = (N, POSE, POSE), (N, POSE, padded(S + NEXT)), (S, S)
    return Factor(*(np.empty(shape) for shape in shapes))


def summed(x, terms, common, prior, last=None, A=None):
    """Return value and gradient of the sum, and write the curvature `A`."""
    N = len(terms)
    gradient = np.empty(len(x))
    A = no_matrix() if A is None else A
    last = N if last is None else last
    room = empty_axes(N), empty_linearised()
    value = accumulate(x, last, terms, common, *prior, *room, gradient, A)
    return value, gradient


# --- the sum ------------------------------------------------------------------------------------


def test_every_residual_has_a_name_of_its_own():
    assert len({row.name for row in RESIDUALS}) == len(RESIDUALS)
    assert all(1 <= row.poses <= 3 for row in RESIDUALS)


@pytest.mark.parametrize('N', [2, 3, 6])
def test_value_gradient_and_curvature_are_those_of_automatic_differentiation(N):
    terms, common, prior = random_terms(N)
    x, A = random_variables(N), matrix(N)
    value, gradient = summed(x, terms, common, prior, A=A)
    known = objective.linearise(x, terms, common, prior)
    scale = np.abs(known[2]).max()
    np.testing.assert_allclose(value, known[0], rtol=1e-12)
    np.testing.assert_allclose(gradient, known[1], atol=1e-9 * scale)
    np.testing.assert_allclose(dense(A, N), known[2], atol=1e-9 * scale)
    alone = summed(x, terms, common, prior)
    np.testing.assert_allclose(alone[0], value, rtol=1e-14)
    np.testing.assert_allclose(alone[1], gradient, rtol=1e-12, atol=1e-12 * scale)


@pytest.mark.parametrize('i', range(len(RESIDUALS)), ids=RESIDUAL_NAMES)
def test_each_residual_alone(i):
    # Its weight is the only one: a wrong row of the table cannot hide behind the others.
    N = 4
    terms, common, prior = random_terms(N)
    keep = terms['W'][:, i].copy()
    terms['W'], terms['W_faces'] = 0.0, 0.0
    terms['W'][:, i] = keep
    common['W_shared'] = prior[1][:] = 0.0
    x, A = random_variables(N), matrix(N)
    value, gradient = summed(x, terms, common, prior, A=A)
    known = objective.linearise(x, terms, common, prior)
    assert value > 0
    np.testing.assert_allclose(value, known[0], rtol=1e-12)
    np.testing.assert_allclose(gradient, known[1], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(dense(A, N), known[2], rtol=1e-9, atol=1e-9)


def test_residuals_without_weight_are_left_out():
    terms, common, prior = random_terms()
    whole, _ = summed(random_variables(), terms, common, prior)
    terms['W'][:, 2] = 0.0
    less, _ = summed(random_variables(), terms, common, prior)
    assert 0 < less < whole


# --- the factor ---------------------------------------------------------------------------------


@pytest.mark.parametrize('is_held', [False, True], ids=['free', 'some held'])
def test_the_factor_solves_and_inverts(is_held):
    N = 6
    terms, common, prior = random_terms(N)
    A, x = matrix(N), random_variables(N)
    summed(x, terms, common, prior, A=A)
    whole = dense(A, N)
    free = np.ones(len(x))
    if is_held:
        free[[2, 9, 6 * N + 1]] = 0.0
        whole *= free[:, None] * free
        whole += np.diag(1 - free)
    fix_variables(A, free)
    factor = empty_factor(N)
    assert factorise(A, factor)
    right = random_variables(N, 5)
    found = right.copy()
    solve(factor, found)
    np.testing.assert_allclose(whole @ found, right, atol=1e-6)
    inverse = np.linalg.inv(whole)
    parts = empty_inverse(N, SHARED)
    invert_poses(factor, parts.poses, parts.links, parts.response)
    C, response = factor.corner, parts.response
    np.testing.assert_allclose(C, inverse[6 * N :, 6 * N :], rtol=1e-6, atol=1e-9)
    for n in range(N):
        rows = slice(6 * n, 6 * n + 6)
        own = parts.poses[n] + response[n] @ C @ response[n].T
        np.testing.assert_allclose(own, inverse[rows, rows], rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(response[n] @ C, inverse[rows, 6 * N :], rtol=1e-6, atol=1e-9)
    for n in range(N - 2):
        known = inverse[6 * n : 6 * n + 6, 6 * n + 6 : 6 * n + 18]
        after = parts.links[n] + response[n] @ C @ response[n + 1 : n + 3].reshape(-1, SHARED).T
        np.testing.assert_allclose(after, known, rtol=1e-6, atol=1e-9)
    # The covariance of a sum of three poses, with that of the gradient by shared variables.
    factors, G = np.array([2.0, -3.0, 0.5]), np.diag(np.linspace(0.1, 1.0, PIVOT))
    found = np.empty((4, 4))
    fill_shared_covariance(C, G, parts)
    fill_combination(2, factors, parts, found)
    J = np.hstack([factor * np.eye(6) for factor in factors])
    rows = slice(12, 30)
    through = (J @ inverse[rows, 6 * N :])[:, :PIVOT]
    expected = J @ inverse[rows, rows] @ J.T + through @ G @ through.T
    np.testing.assert_allclose(found, expected[np.ix_(RATES, RATES)], rtol=1e-6, atol=1e-9)


def test_a_weak_direction_of_a_strong_link_is_not_lost():
    # The first pose has an error of 1 in each direction, the second one moves with it: by errors
    # of 1e-4 to 1 along six directions that are no axes.
    A, N, variances = matrix(2), 2, np.logspace(-8, 0, POSE)
    axes, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(POSE, POSE)))
    link = axes / variances @ axes.T
    A.poses['links'][0, :, : 2 * POSE] = np.hstack([link + np.eye(POSE), -link])
    A.poses['links'][1, :, :POSE] = link
    A.corner[:] = np.eye(SHARED)
    factor, inverse = empty_factor(N), empty_inverse(N, SHARED)
    assert factorise(A, factor)
    invert_poses(factor, inverse.poses, inverse.links, inverse.response)
    blocks = inverse.poses  # the shared variables have no part in them
    np.testing.assert_allclose(blocks[0], np.eye(POSE), atol=1e-6)
    np.testing.assert_allclose(blocks[1], np.eye(POSE) + axes * variances @ axes.T, atol=1e-6)


def test_a_matrix_that_is_not_positive_definite_has_no_factor():
    A = matrix(2)
    A.corner[3, 3] = -1.0
    fix_variables(A, np.ones(2 * POSE + SHARED))
    assert not factorise(A, empty_factor(2))


# --- marginalisation ----------------------------------------------------------------------------


def test_the_prior_is_the_schur_complement_of_the_oldest_residuals():
    # All residuals that the oldest observation has a part in, but the prior on shared variables.
    N = 6
    terms, common, prior = random_terms(N)
    terms['W'][:, 1] = 0.0  # a sliding window has no rigid shape
    x, A = random_variables(N)[: 6 * N + ANCHOR], matrix(N, ANCHOR)
    _, gradient = summed(x, terms, common, prior, last=1, A=A)
    first = terms.copy()
    first['W'][1:], first['W_faces'][1:] = 0.0, 0.0
    only = common.copy()
    only['W_shared'] = 0.0
    _, pull, H = objective.linearise(x, first, only, prior)
    np.testing.assert_allclose(dense(A, N), H, atol=1e-9 * np.abs(H).max())
    mean, step, information = np.empty(PRIOR), np.empty(PRIOR), np.empty((PRIOR, PRIOR))
    marginalise(x, gradient, A, empty_factor(N, ANCHOR), mean, step, information)
    left = [*range(6, 18), *range(6 * N, 6 * N + ANCHOR)]
    across = np.linalg.solve(H[:6, :6], H[:6])
    schur = (H - H[:, :6] @ across)[np.ix_(left, left)]
    np.testing.assert_array_equal(mean, x[left])
    np.testing.assert_allclose(information, schur, atol=1e-7 * np.abs(schur).max())
    rest = (pull - across.T @ pull[:6])[left]
    np.testing.assert_allclose(-schur @ step, rest, atol=1e-4 * np.abs(rest).max())


def test_the_prior_is_exact_for_linear_residuals():
    # Input, acceleration, zero motion and priors are linear: after one observation has left, and
    # then another, the minimum of the window is that of all observations, wherever it is
    # linearised. Ridges of 1e-6 beside curvatures of 100 change 1e-8 of the step.
    N = 7
    terms, common, prior = random_terms(N)
    others = [RESIDUAL_NAMES.index(name) for name in ('rigid shape', 'slip')]
    terms['W'][:, others], terms['W_faces'] = 0.0, 0.0
    terms['W'] *= 100
    common['W_shared'] *= 100
    prior[1][:] += 100 * np.eye(PRIOR)
    known = minimum(terms, common, prior)
    rng = np.random.default_rng(9)
    for n in (N - 1, N - 2):
        away = known[-6 * (n + 1) - ANCHOR :] + 0.1 * rng.normal(size=6 * (n + 1) + ANCHOR)
        A = matrix(n + 1, ANCHOR)
        _, gradient = summed(away, terms, common, prior, last=1, A=A)
        mean, step, information = np.empty(PRIOR), np.empty(PRIOR), np.empty((PRIOR, PRIOR))
        factor = empty_factor(n + 1, ANCHOR)
        marginalise(away, gradient, A, factor, mean, step, information)
        terms = terms[1:]
        found = minimum(terms, common, prior := (mean + step, information))
        np.testing.assert_allclose(found, known[-6 * n - ANCHOR :], atol=1e-7)


def minimum(terms, common, prior):
    """Return where the sum of linear residuals of a sliding window is least."""
    N = len(terms)
    x, A = np.zeros(6 * N + ANCHOR), matrix(N, ANCHOR)
    _, gradient = summed(x, terms, common, prior, A=A)
    return np.linalg.solve(dense(A, N), -gradient)


# --- residuals by hand --------------------------------------------------------------------------


def residual(name, poses, shared=None, times=None, **fields):
    """Return the residual of the first observation of poses (N, 6) [m, rad]."""
    poses = np.array(poses, float)
    terms = np.zeros(len(poses), TERMS)
    terms['time'] = 0.1 * np.arange(len(poses)) if times is None else times
    for n, pose in enumerate(poses):
        fill_rotation(*pose[3:], terms['axes'][n])
    for field, value in fields.items():
        terms[field] = value
    (row,) = (row for row in RESIDUALS if row.name == name)
    at, out = empty_axes(len(poses)), empty_linearised()[0]
    fill_axes(poses, 0, len(poses), at)
    shared = shared_of()[0] if shared is None else shared
    rows, _ = row.function(0, poses, shared, terms, at, out)
    return out['r'][:rows]


def test_acceleration_by_hand():
    # x = a t^2 / 2 at uneven times: the second difference over true time steps is a, exactly;
    # uniform motion in y and an even turn have none. Along the axes of the second pose.
    t = np.array([0.0, 0.1, 0.3])
    poses = np.c_[1.5 * t**2, 7 * t, 0 * t, 0 * t, 0 * t, 0.4 * t]
    found = residual('acceleration', poses, times=t)
    known = 3.0 * np.array([np.cos(0.04), -np.sin(0.04), 0, 0, 0, 0])
    np.testing.assert_allclose(found, known, atol=1e-12)


def test_zero_motion_by_hand():
    poses = [[0, 0, 0, 0, 0, 0], [1, 2, 3, 0.1, 0.2, 0.3]]
    np.testing.assert_allclose(residual('zero motion', poses), [1, 2, 3, 0.1, 0.2, 0.3])


def test_input_by_hand():
    # The box heads along +y: a pose 0.3 m further along y is 0.3 m ahead; one 0.2 m further along
    # x is 0.2 m to its right. Less the bias, 0.1 m ahead and 0.05 rad of yaw.
    given = np.array([0, 0, 0, 0, 0, np.pi / 2])
    axes = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    pose = given + np.array([0.2, 0.3, 0.5, 0.01, 0.02, 0.06])
    shared = shared_of(BIAS=[0.1, 0, 0, 0, 0, 0.05])[0]
    found = residual('input', [pose], shared, given=given, axes=axes)
    np.testing.assert_allclose(found, [0.2, -0.2, 0.5, 0.01, 0.02, 0.01], atol=1e-15)


def test_rigid_shape_by_hand():
    # As before; the shape is 0.1 m ahead in its box, and a step of 0.05 m and .01 rad is wanted.
    start = np.array([0, 0, 0, 0, 0, np.pi / 2])
    axes = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    found = residual(
        'rigid shape', [start + np.array([0.2, 0.3, 0.5, 0, 0, 0.06])],
        shared_of(ANCHOR=[0.1, 0, 0, 0, 0, 0])[0], start=start, axes=axes, root=2 * np.eye(6),
        wanted=[0.05, 0, 0, 0, 0, 0.01],
    )  # fmt: skip
    np.testing.assert_allclose(found, 2 * np.array([0.15, -0.2, 0.5, 0, 0, 0.05]), atol=1e-15)


def test_a_vehicle_on_a_circle_does_not_slip():
    # Its rear axle, 1 m behind the centre, moves on a circle of 8 m: every chord of a circle lies
    # along the mean of the headings at its ends.
    yaw = np.array([0.0, 0.2])
    axle = 8 * np.c_[np.sin(yaw), -np.cos(yaw)]
    center = axle + np.c_[np.cos(yaw), np.sin(yaw)]
    poses = np.c_[center, np.zeros((2, 3)), yaw]
    np.testing.assert_allclose(residual('slip', poses, shared_of(PIVOT=1.0)[0]), 0, atol=1e-12)
    # Its centre does: 1 m before the axle, it swings out to the left by twice the sine of half
    # the turn.
    found = residual('slip', poses, shared_of(PIVOT=0.0)[0])
    np.testing.assert_allclose(found, [2 * np.sin(0.1) / 0.1, 0], atol=1e-12)


@pytest.mark.parametrize('way', [1.0, -1.0])
def test_a_track_with_its_sideslip_does_not_slip(way):
    # Its heading is off its path by a constant angle, forward as in reverse.
    poses = np.zeros((2, 6))
    poses[:, 0], poses[:, 5] = [0.0, way], -0.05
    shared = shared_of(PIVOT=1.0, SIDESLIP=np.tan(0.05))[0]
    np.testing.assert_allclose(residual('slip', poses, shared), 0, atol=1e-12)


@pytest.mark.parametrize('yaw', [0.0, np.pi / 2, 3.0])
def test_slip_by_hand(yaw):
    # 0.1 m to its left and 0.02 m up in 0.1 s, beside 1 m ahead: 1 m/s and 0.2 m/s; reversing
    # does not count as slip.
    ahead, left = np.array([np.cos(yaw), np.sin(yaw)]), np.array([-np.sin(yaw), np.cos(yaw)])
    for way in (1.0, -1.0):
        x, y = way * ahead + 0.1 * left
        poses = [[0, 0, 0, 0, 0, yaw], [x, y, 0.02, 0, 0, yaw]]
        found = residual('slip', poses, shared_of(PIVOT=1.0)[0])
        np.testing.assert_allclose(found, [1.0, 0.2], atol=1e-12)


def test_planes_are_signed_distances_of_points():
    # A box of 4 x 2 x 2 m that heads along +y, 1 m further along y than its input. Margin 0.1 m
    # and inset 0.05 m are 0.15 m inside of each face.
    poses = np.array([[0.0, 1, 0, 0, 0, np.pi / 2]])
    terms = np.zeros(1, TERMS)
    terms['inset'] = 0.05
    at, plane, by_angles = empty_axes(1), np.empty(4), np.empty((4, 3))
    fill_axes(poses, 0, 1, at)
    point = np.array([0.3, 2.5, 0.2, 1.0])  # from the input centre: 1.5 m ahead, 0.3 m right
    shared = shared_of(GAP=0.1)[0]
    for face, known in enumerate([1.5 - 1.85, -1.5 - 1.85, -0.3 - 0.85, 0.3 - 0.85, -0.65, -1.05]):
        fill_plane(0, face // 2, poses, terms, at, plane, by_angles)
        found = (1 - 2 * (face % 2)) * plane @ point + level_of(0, face, shared, terms)
        np.testing.assert_allclose(found, known, atol=1e-12)


def test_shared_columns_are_those_of_their_variables():
    # The table of `method.arrays`: a pivot of 1 m more moves the rear axle, nothing else.
    yaw = np.array([0.0, 0.2])
    poses = np.c_[np.zeros((2, 5)), yaw]
    shared = shared_of(PIVOT=0.0)[0]
    moved = shared.copy()
    moved[PIVOT] += 1.0
    change = residual('slip', poses, moved) - residual('slip', poses, shared)
    np.testing.assert_allclose(change, [-2 * np.sin(0.1) / 0.1, 0], atol=1e-12)
    moved = shared.copy()
    moved[SIDESLIP] += 0.1
    np.testing.assert_allclose(residual('slip', poses, moved), 0, atol=1e-12)
