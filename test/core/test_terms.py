"""The residuals: their Jacobians against automatic differentiation, their values by hand."""

from boxreg_ros.core import batch, terms
from boxreg_ros.core.arrowhead import Chain
from boxreg_ros.core.batch import SHARED, State
from boxreg_ros.core.geometry import face_distances, rotation_from_rpy
from boxreg_ros.core.terms import Objective, Term, value_and_gradient
import numpy as np
import pytest
from scenes import (
    boxes_at,
    dense,
    problem_of,
    random_problem,
    random_variables,
    shared_of,
    terms_of,
)
import torch

D = torch.float64


def tensor(values):
    return torch.tensor(values, dtype=D)


# --- derivatives --------------------------------------------------------------------------------

NAMES = list(terms_of(random_problem()))


def test_state_packs_and_unpacks():
    problem = random_problem()
    x = random_variables(problem)
    state = State.unpack(x, 6)
    assert state.pose.shape == (3, 6, 6)
    assert state.shared.shape == (3, SHARED)
    np.testing.assert_array_equal(state.pack(), x)


@pytest.mark.parametrize('name', NAMES)
def test_jacobians_equal_automatic_differentiation(name):
    problem = random_problem()
    term, x = terms_of(problem)[name], random_variables(problem)
    B, N = problem.valid.shape

    def residual(x):
        return term.linearise(State.unpack(x, N)).residual

    known = torch.autograd.functional.jacobian(residual, x)
    r, by_pose, by_shared = term.linearise(State.unpack(x, N))
    found = torch.zeros_like(known)
    for b in range(B):
        pose, shared = State.unpack(found[b, ..., b, :].flatten(0, -2), N)
        pose = pose.unflatten(0, r.shape[1:])
        for i in range(r.shape[1]):
            span = by_pose.shape[-1] // 6
            pose[i, :, :, i : i + span] = by_pose[b, i].unflatten(-1, (span, 6))
        shared[:, : by_shared.shape[-1]] = by_shared.expand(*r.shape, -1)[b].flatten(0, -2)
        found[b, ..., b, :] = State(pose.flatten(0, 2), shared).pack().unflatten(0, r.shape[1:])
    np.testing.assert_allclose(found, known, atol=1e-9)


@pytest.mark.parametrize('names', [[name] for name in NAMES] + [NAMES], ids=[*NAMES, 'all'])
def test_value_gradient_and_curvature(names):
    # sum of r' W r / 2 by automatic differentiation; J' W J by the Jacobian of the residuals.
    problem = random_problem()
    terms = [terms_of(problem)[name] for name in names]
    x = random_variables(problem)
    B, N = problem.valid.shape

    def loss(x):
        value = 0.0
        for term in terms:
            r = term.linearise(State.unpack(x, N)).residual
            value = value + 0.5 * torch.einsum('bnfr,bnfrs,bnfs->b', r, term.weight, r)
        return value

    given = x.clone().requires_grad_()
    (known,) = torch.autograd.grad(loss(given).sum(), given)
    form = Chain.zeros(x, N)
    value, gradient = value_and_gradient(terms, x, N, form)
    np.testing.assert_allclose(value, loss(x), rtol=1e-12)
    np.testing.assert_allclose(gradient, known, atol=1e-9 * known.abs().max())

    curvature = torch.zeros(B, x.shape[1], x.shape[1], dtype=D)
    for term in terms:
        J = torch.autograd.functional.jacobian(
            lambda x, term=term: term.linearise(State.unpack(x, N)).residual, x
        )
        for b in range(B):
            own = J[b, ..., b, :]
            curvature[b] += torch.einsum('nfrd,nfrs,nfse->de', own, term.weight[b], own)
    np.testing.assert_allclose(dense(form, N), curvature, atol=1e-9 * float(curvature.abs().max()))


def test_the_objective_is_the_sum_of_its_terms():
    # At its linearisation point, away from it, and for some windows alone.
    problem = random_problem()
    terms, x = list(terms_of(problem).values()), random_variables(problem)
    free = (torch.rand(x.shape, generator=torch.Generator().manual_seed(5)) < 0.9).to(x)
    start = random_variables(problem, seed=7)
    found = Objective(terms, start, 6, free)
    known, _ = value_and_gradient(terms, start, 6)
    np.testing.assert_allclose(found(start, torch.arange(3))[0], known, rtol=1e-12)
    value, gradient = value_and_gradient(terms, x, 6)
    for rows in (torch.arange(3), torch.tensor([2, 0])):
        found_value, found_gradient = found(x[rows], rows)
        np.testing.assert_allclose(found_value, value[rows], rtol=1e-9)
        known = (gradient * free)[rows]
        np.testing.assert_allclose(found_gradient, known, atol=1e-9 * float(known.abs().max()))


def test_newton_applies_the_inverse_curvature():
    problem = random_problem()
    terms, x = list(terms_of(problem).values()), random_variables(problem)
    found = Objective(terms, x, 6, torch.ones_like(x))
    vector, form = random_variables(problem, seed=8), Chain.zeros(x, 6)
    value_and_gradient(terms, x, 6, form)
    solved = found.newton(vector, torch.arange(3))
    product = (dense(form, 6) @ solved[..., None])[..., 0]
    np.testing.assert_allclose(product, vector, atol=1e-6)
    rows = torch.tensor([2, 0])
    np.testing.assert_allclose(found.newton(vector[rows], rows), solved[rows], rtol=1e-9)
    identity = torch.eye(x.shape[1], dtype=D)
    columns = [found.newton(column.expand(3, -1), torch.arange(3)) for column in identity[:12]]
    inverse = torch.stack(columns, -1)
    np.testing.assert_allclose(
        found.factor.inverse_blocks(6).links[:, 1], inverse[:, 6:12, 6:12], rtol=1e-6
    )


# --- values -------------------------------------------------------------------------------------


def test_faces_by_moments_equal_the_sum_over_points():
    # The weight is the mean of (p, 1)(p, 1)' over the points of a face, so r' W r must be the
    # mean squared distance from that face less margin and inset.
    problem = random_problem()
    state = State.unpack(random_variables(problem), 6)
    rng = np.random.default_rng(3)
    inset = torch.from_numpy(rng.random((3, 6, 6)))
    homogeneous = torch.cat([problem.points, torch.ones_like(problem.points[..., :1])], -1)
    moment = torch.einsum('bnmi,bnmj->bnij', homogeneous, homogeneous) / problem.returns.width
    term = Term(terms.faces, moment[:, :, None].expand(-1, -1, 6, -1, -1), (problem.pose, inset))
    r = term.linearise(state).residual
    found = torch.einsum('bnfr,bnfrs,bnfs->bnf', r, term.weight, r)
    extent = state.shared[:, None, :3].expand(-1, 6, -1)
    boxes = torch.cat([state.pose[..., :3], extent, state.pose[..., 3:]], -1)
    out = face_distances(problem.points + problem.boxes[..., None, :3], boxes)
    out = out + (inset + state.shared[:, None, batch.GAP])[..., None, :]
    np.testing.assert_allclose(found, out.square().mean(2), rtol=1e-9)


def problem_at(pose, times):
    """Return a problem of one window of 4 x 2 x 2 m boxes at `pose` (N, 6) [m, rad]."""
    return problem_of(boxes_at(*pose), times=[times])


def test_acceleration_by_hand():
    # x = a t^2 / 2 at uneven times: the second difference over true time steps is a, exactly;
    # uniform motion in y and an even turn have none.
    t = np.array([0.0, 0.1, 0.3, 0.35])
    pose = np.c_[1.5 * t**2, 7 * t, 0 * t, 0 * t, 0 * t, 0.4 * t]
    problem = problem_at(pose, t.tolist())
    found = terms.acceleration(State(problem.pose, shared_of()), problem.times).residual
    known = np.tile([3.0, 0, 0, 0, 0, 0], (1, 2, 1, 1))
    np.testing.assert_allclose(found, known, atol=1e-12)


def test_zero_motion_by_hand():
    pose = [[0, 0, 0, 0, 0, 0], [1, 2, 3, 0.1, 0.2, 0.3], [1, 2, 3, 0.1, 0.2, 0.4]]
    problem = problem_at(pose, [0, 0.1, 0.2])
    found = terms.zero_motion(State(problem.pose, shared_of())).residual
    known = [[[[1, 2, 3, 0.1, 0.2, 0.3]], [[0, 0, 0, 0, 0, 0.1]]]]
    np.testing.assert_allclose(found, known, atol=1e-15)


def test_input_pose_by_hand():
    # The input heads along +y: a pose 0.3 m further along y is 0.3 m ahead; one 0.2 m further
    # along x is 0.2 m to its right. Less the bias, 0.1 m ahead and 0.05 rad of yaw.
    problem = problem_at([[0, 0, 0, 0, 0, np.pi / 2]], [0.0])
    pose = problem.pose + tensor([0.2, 0.3, 0.5, 0.01, 0.02, 0.06])
    axes = rotation_from_rpy(problem.pose[..., 3:])
    state = State(pose, shared_of(BIAS=[0.1, 0, 0, 0, 0, 0.05]))
    found = terms.input_pose(state, problem.pose, axes)
    known = [[[[0.2, -0.2, 0.5, 0.01, 0.02, 0.01]]]]
    np.testing.assert_allclose(found.residual, known, atol=1e-15)


def test_rigid_shape_by_hand():
    # Boxes head along +y: a step of 0.3 m along y and 0.2 m along x is 0.3 m ahead and 0.2 m to
    # the right, and yaw is a turn about z. The shape is 0.1 m ahead in its box.
    problem = problem_at([[0, 0, 0, 0, 0, np.pi / 2]], [0.0])
    wanted = tensor([[[0.05, 0, 0, 0, 0, 0.01]]])
    state = State(
        problem.pose + tensor([0.2, 0.3, 0.5, 0, 0, 0.06]), shared_of(ANCHOR=[0.1, 0, 0, 0, 0, 0])
    )
    found = terms.rigid_shape(state, problem.pose, wanted).residual
    np.testing.assert_allclose(found, [[[[0.15, -0.2, 0.5, 0, 0, 0.05]]]], atol=1e-15)


def test_shared_prior_by_hand():
    problem = problem_at([[0.0] * 6], [0.0])
    state = State(problem.pose, shared_of(BIAS=[0.1, 0, 0, 0, 0, 0]))
    expected = shared_of(EXTENT=[3.5, 2, 2])
    found = terms.shared_prior(state, expected).residual
    known = np.zeros((1, 1, 1, SHARED))
    known[..., 0], known[..., 3] = 0.5, 0.1
    np.testing.assert_allclose(found, known, atol=1e-15)


def test_a_vehicle_on_a_circle_does_not_slip():
    # Its rear axle, 1 m behind the centre, moves on a circle of 8 m: every chord
    # of a circle lies along the mean of the headings at its ends.
    yaw = np.array([0.0, 0.2, 0.5, 0.6])
    axle = 8 * np.c_[np.sin(yaw), -np.cos(yaw)]
    center = axle + 1.0 * np.c_[np.cos(yaw), np.sin(yaw)]
    pose = np.c_[center, np.zeros((4, 3)), yaw]
    problem = problem_at(pose, [0, 0.1, 0.3, 0.4])
    state = State(problem.pose, shared_of(PIVOT=1.0))
    np.testing.assert_allclose(terms.slip(state, problem.times).residual, 0, atol=1e-12)
    # Its centre does: 1 m before the axle, it swings out to the left by twice the sine of half
    # the turn.
    state = State(problem.pose, shared_of(PIVOT=0.0))
    known = 2 * np.sin(np.diff(yaw) / 2) / [0.1, 0.2, 0.1]
    np.testing.assert_allclose(terms.slip(state, problem.times).residual[0, :, 0, 0], known)


def test_a_track_with_its_sideslip_does_not_slip():
    # Its heading is off its path by a constant angle, forward as in reverse.
    angle = 0.05
    for way in (1.0, -1.0):
        distance = way * np.array([0.0, 1.0, 3.0])
        pose = np.c_[distance, np.zeros((3, 4)), np.full(3, -angle)]
        problem = problem_at(pose, [0.0, 0.1, 0.3])
        state = State(problem.pose, shared_of(PIVOT=1.0, SIDESLIP=np.tan(angle)))
        np.testing.assert_allclose(terms.slip(state, problem.times).residual, 0, atol=1e-12)


@pytest.mark.parametrize('yaw', [0.0, np.pi / 2, 3.0])
def test_slip_by_hand(yaw):
    # 0.1 m to its left and 0.02 m up in 0.1 s, beside 1 m ahead: 1 m/s and 0.2 m/s; reversing
    # does not count as slip.
    ahead, left = np.array([np.cos(yaw), np.sin(yaw)]), np.array([-np.sin(yaw), np.cos(yaw)])
    for way in (1.0, -1.0):
        x, y = way * ahead + 0.1 * left
        problem = problem_at([[0, 0, 0, 0, 0, yaw], [x, y, 0.02, 0, 0, yaw]], [0.0, 0.1])
        found = terms.slip(State(problem.pose, shared_of(PIVOT=1.0)), problem.times).residual
        np.testing.assert_allclose(found, [[[[1.0, 0.2]]]], atol=1e-12)
