"""The terms: the paper's equations by hand, ours against automatic differentiation."""

from boxreg_ros.config import PaperConfig
from boxreg_ros.core import objective
from boxreg_ros.core.arrowhead import Chain
from boxreg_ros.core.geometry import face_distances, rotation_from_rpy
from boxreg_ros.core.objective import EPSILON, MEMORY, SHARED, State, Term
import numpy as np
import pytest
from scenes import dense, problem_of, shared_of
import torch

D = torch.float64
NIL = objective.EPSILON**0.5  # what a norm is at zero, with the small number inside its root


def tensor(values):
    return torch.tensor(values, dtype=D)


def at(*poses, extent=(4.0, 2.0, 2.0)):
    """Return boxes (1, N, 9) of poses (x, y, z, roll, pitch, yaw); what is left out is 0."""
    rows = [[*p[:3], *extent, *p[3:]] for p in ((*p, *[0.0] * (6 - len(p))) for p in poses)]
    return tensor([rows])


def real(boxes):
    return torch.ones(boxes.shape[:2], dtype=torch.bool)


def random_problem(B=3, N=6, M=20, seed=0):
    rng = np.random.default_rng(seed)
    boxes = rng.normal(size=(B, N, 9))
    boxes[..., 3:6] = [4, 2, 1.5] + 0.1 * rng.random((B, N, 3))
    boxes[..., 6:8] *= 0.1
    valid = np.arange(N) < np.array([N, N - 1, N - 2])[:B, None]
    return problem_of(
        boxes,
        valid=valid,
        times=np.cumsum(rng.random((B, N)) + 0.05, 1),
        points=rng.normal(size=(B, N, M, 3)),
        mask=(rng.random((B, N, M)) < 0.8) & valid[..., None],
    )


# --- Eq. 4 --------------------------------------------------------------------------------------

# In a box of 4 x 2 x 2 m; their centre of mass is ahead, left and up, so front, left and top are
# seen. Distances to the front: 0.1 and 1.0; left: 0.5 and 0.1; top: 0.8 and 0.6.
TWO = tensor([[[[1.9, 0.5, 0.2], [1.0, 0.9, 0.4]]]])


def closeness(boxes, points, nearest, mask=None):
    mask = torch.ones(points.shape[:-1], dtype=torch.bool) if mask is None else mask
    return objective.closeness(boxes, points, mask, nearest)


@pytest.mark.parametrize(
    'nearest, known',
    [
        (1, 0.1**2 + 0.1**2 + 0.6**2),
        (2, (0.1**2 + 1.0**2 + 0.5**2 + 0.1**2 + 0.8**2 + 0.6**2) / 2),
        (99, (0.1**2 + 1.0**2 + 0.5**2 + 0.1**2 + 0.8**2 + 0.6**2) / 2),
    ],
)
def test_closeness_by_hand(nearest, known):
    assert closeness(at((0, 0, 0)), TWO, nearest).item() == pytest.approx(known)


def test_closeness_takes_the_faces_on_the_side_of_the_centre_of_mass():
    # Mirrored points see the opposite faces, at the same distances.
    mirrored = closeness(at((0, 0, 0)), -TWO, 2)
    assert mirrored.item() == pytest.approx(closeness(at((0, 0, 0)), TWO, 2).item())


def test_closeness_is_zero_for_points_in_the_visible_corner():
    # Front, left, top corner of the box; seen from outside or inside makes no difference.
    box = at((5, -3, 1, 0, 0, 0.4))
    corner = tensor([5, -3, 1]) + torch.stack(
        [
            2 * torch.cos(tensor(0.4)) - torch.sin(tensor(0.4)),
            2 * torch.sin(tensor(0.4)) + torch.cos(tensor(0.4)),
            tensor(1.0),
        ]
    )
    assert closeness(box, corner.expand(1, 1, 3, 3), 2).item() == pytest.approx(0, abs=1e-25)


def test_closeness_is_the_mean_over_observations_with_points():
    boxes = at((0, 0, 0), (0, 0, 0), (0, 0, 0))
    points = torch.cat([TWO, TWO, 1e3 + TWO], 1)
    mask = torch.tensor([[[True, True], [True, False], [False, False]]])
    # Of the second box only the first point is real: 0.1^2 + 0.5^2 + 0.8^2 = 0.9.
    both = (0.1**2 + 1.0**2 + 0.5**2 + 0.1**2 + 0.8**2 + 0.6**2) / 2
    assert closeness(boxes, points, 2, mask).item() == pytest.approx((both + 0.9) / 2)


# --- Eq. 5 --------------------------------------------------------------------------------------


def enclosure(boxes, points, mask=None):
    mask = torch.ones(points.shape[:-1], dtype=torch.bool) if mask is None else mask
    return objective.enclosure(boxes, points, mask)


def test_enclosure_is_constant_inside():
    # Two opposite faces are together one extent away: (4 + 2 + 2) / 6, wherever inside.
    for point in ([0.0, 0, 0], [1.9, -0.9, 0.99], [-2.0, 1.0, 1.0]):
        value = enclosure(at((0, 0, 0)), tensor([[[point]]]))
        assert value.item() == pytest.approx(8 / 6)


def test_enclosure_grows_linearly_outside():
    # 0.5 m out of one face is 0.5 m further from it and from the opposite one: 2 * 0.5 / 6 more.
    # One of two points, so half of that.
    points = tensor([[[[2.5, 0, 0], [0, 0, 0]]]])
    assert enclosure(at((0, 0, 0)), points).item() == pytest.approx(8 / 6 + 0.5 / 6)


def test_points_inside_do_not_pull():
    boxes = at((0.1, 0.2, 0.1, 0.02, 0.01, 0.1)).requires_grad_()
    inside = tensor([[[[0.3, 0.2, 0.1], [-1.0, 0.3, -0.4]]]])
    enclosure(boxes, inside).sum().backward()
    np.testing.assert_allclose(boxes.grad[..., [0, 1, 2, 6, 7, 8]], 0, atol=1e-15)


# --- Eq. 6 --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    'poses, known',
    [
        ([(0, 0, 0), (1, 2, 0), (2, 4, 0)], NIL),  # equal steps
        ([(0, 0, 0), (1, 0, 0), (3, 0, 0)], 1.0),  # steps of 1 and 2
        ([(0, 0, 0), (3, 0, 0), (6, 4, 0)], 4.0),  # 4 more in y alone
        ([(0, 0, 0), (1, 0, 0), (0, 0, 0)], NIL),  # the equation compares magnitudes
        ([(0, 0, 0), (0, 0, 0, 0, 0, 0.3), (0, 0, 0, 0, 0.4, 0.6)], 0.4),  # pitch alone
        ([(0, 0, 0), (1, 0, 0), (3, 0, 0), (5, 0, 0)], (1.0 + NIL) / 2),  # mean of two
        ([(0, 0, 0), (5, 0, 0)], 0.0),  # too few to tell
        ([(0, 0, 0)], 0.0),
    ],
)
def test_smoothness_by_hand(poses, known):
    boxes = at(*poses)
    assert objective.smoothness(boxes, real(boxes)).item() == pytest.approx(known, rel=1e-6)


def test_smoothness_wraps_angles():
    # A constant turn of 0.3 rad across half a turn, yaw given wrapped.
    yaw = np.array([2.8, 3.1, 3.4 - 2 * np.pi, 3.7 - 2 * np.pi])
    boxes = at(*[(0, 0, 0, 0, 0, y) for y in yaw])
    assert objective.smoothness(boxes, real(boxes)).item() == pytest.approx(NIL, rel=1e-6)


# --- Eq. 7 --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    'poses, known',
    [
        ([(0, 0, 0), (1, 0, 0)], NIL),  # where it heads
        ([(0, 0, 0), (-1, 0, 0)], NIL),  # reversing
        ([(0, 0, 0), (0, 1, 0)], 2**0.5),  # sideways: unit vectors at a right angle
        ([(0, 0, 0, 0, 0, np.pi / 3), (1, 0, 0)], 1.0),  # 60 degrees off
        ([(0, 0, 0, 0, 0, np.pi), (-2, 0, 0)], NIL),
        ([(0, 0, 0, 0, -np.pi / 4, 0), (1, 0, 1)], NIL),  # uphill: a negative pitch looks up
        ([(0, 0, 0), (0, 0.05, 0)], 2**0.5 / 2),  # a step of half the full length
        ([(0, 0, 0), (0, 0, 0)], 0.0),  # at rest
        ([(0, 0, 0), (1, 0, 0), (1, 1, 0)], (NIL + 2**0.5) / 2),  # mean of two
        ([(0, 0, 0), (3, 0, 0), (2, 0, 0)], (NIL + 2) / 2),  # forward on the whole, once back
        ([(0, 0, 0), (-3, 0, 0), (-2, 0, 0)], (NIL + 2) / 2),  # backward on the whole
        ([(0, 0, 0)], 0.0),
    ],
)
def test_alignment_by_hand(poses, known):
    boxes = at(*poses)
    # At rest the root's small number leaves NIL / 0.1 of the full weight: 3e-4.
    assert objective.alignment(boxes, real(boxes)).item() == pytest.approx(known, abs=5e-4)


# --- all of the paper's -------------------------------------------------------------------------


def poses_of(boxes):
    return boxes[..., objective.POSE].clone().requires_grad_()


def with_poses(boxes, pose):
    return torch.cat([pose[..., :3], boxes[..., 3:6], pose[..., 3:]], -1)


PAPER = {
    'closeness': lambda b, p: objective.closeness(b, p.points, p.mask, 5),
    'enclosure': lambda b, p: objective.enclosure(b, p.points, p.mask),
    'smoothness': lambda b, p: objective.smoothness(b, p.valid),
    'alignment': lambda b, p: objective.alignment(b, p.valid),
    'total': lambda b, p: objective.total(b, p, PaperConfig(nearest=5), MULTIPLIERS, EPSILON)[0],
}
MULTIPLIERS = tensor([[0.1, 0.2], [0.3, 0.4], [0.5, 0.6]])
each_term = pytest.mark.parametrize('term', PAPER.values(), ids=PAPER)


@each_term
def test_gradients_of_the_paper(term):
    problem = random_problem(M=8)
    pose = poses_of(problem.boxes)
    assert torch.autograd.gradcheck(
        lambda pose: term(with_poses(problem.boxes, pose), problem), pose, eps=1e-7, atol=1e-5
    )


@each_term
@pytest.mark.parametrize('moving', [False, True])
def test_the_gradient_is_finite_where_the_paper_has_none(term, moving):
    # At rest all poses coincide; in even motion all steps are equal, along the heading. Points
    # lie on faces, on edges, at the centre and upon each other.
    boxes = at(*[(0.5 * i * moving, 0, 0) for i in range(6)])
    points = tensor([[2, 1, 1], [2, 0, 0], [0, 0, 0], [0, 0, 0]]).expand(1, 6, 4, 3)
    problem = problem_of(boxes, points=points)
    pose = poses_of(boxes)
    value = term(with_poses(boxes, pose), problem)
    value.sum().backward()
    assert value.isfinite().all()
    assert pose.grad.isfinite().all()


@each_term
def test_nothing_real_gives_zero_and_no_gradient(term):
    problem = random_problem()
    nothing = problem._replace(
        mask=torch.zeros_like(problem.mask), valid=torch.zeros_like(problem.valid)
    )
    pose = poses_of(problem.boxes)
    value = term(with_poses(problem.boxes, pose), nothing)
    value.sum().backward()
    np.testing.assert_array_equal(value.detach(), 0)
    np.testing.assert_array_equal(pose.grad, 0)


@each_term
def test_padding_order_and_batch_do_not_matter(term):
    problem = random_problem()
    known = term(problem.boxes, problem)
    # Other order of points, and padding filled with other numbers.
    order = torch.from_numpy(np.random.default_rng(1).permutation(problem.points.shape[2]))
    points = torch.where(problem.mask[..., None], problem.points, -1e4)[:, :, order]
    other = problem._replace(points=points, mask=problem.mask[:, :, order])
    boxes = torch.where(problem.valid[..., None], problem.boxes, 77.0)
    np.testing.assert_allclose(term(problem.boxes, other), known, rtol=1e-12)
    if term is not PAPER['total']:  # whose points are relative to the boxes
        np.testing.assert_allclose(term(boxes, other), known, rtol=1e-12)


@pytest.mark.parametrize('name', ['closeness', 'enclosure'])
def test_duplicates_do_not_matter(name):
    # Every point three times, and three times the K: the same means.
    problem = random_problem()
    term = getattr(objective, name)
    more = [5] if name == 'closeness' else []
    known = term(problem.boxes, problem.points, problem.mask, *more)
    points, mask = problem.points.repeat(1, 1, 3, 1), problem.mask.repeat(1, 1, 3)
    found = term(problem.boxes, points, mask, *[3 * k for k in more])
    np.testing.assert_allclose(found, known, rtol=1e-12)


def test_total_is_the_weighted_sum_with_multipliers():
    # Eq. 8 with c the two constraints: closeness and enclosure weighted, m c + w c^2 / 2.
    problem = random_problem()
    weights = PaperConfig(closeness=2.0, enclosure=3.0, smoothness=0.5, alignment=0.7, nearest=5)
    boxes = problem.boxes + 0.1
    points = problem.points + problem.boxes[..., None, :3]
    loss, violation = objective.total(boxes, problem, weights, MULTIPLIERS, EPSILON)
    c = [objective.smoothness(boxes, problem.valid), objective.alignment(boxes, problem.valid)]
    known = 2 * objective.closeness(boxes, points, problem.mask, 5)
    known += 3 * objective.enclosure(boxes, points, problem.mask)
    known += MULTIPLIERS[:, 0] * c[0] + 0.5 * c[0] ** 2 / 2
    known += MULTIPLIERS[:, 1] * c[1] + 0.7 * c[1] ** 2 / 2
    np.testing.assert_allclose(loss, known)
    np.testing.assert_allclose(violation, torch.stack(c, -1))


# --- ours: derivatives --------------------------------------------------------------------------


def spd(rng, *shape):
    """Return random symmetric positive definite weights (*shape, shape[-1])."""
    root = torch.from_numpy(rng.normal(size=(*shape, shape[-1])))
    return root @ root.mT


def terms_of(problem, seed=1):
    rng = np.random.default_rng(seed)
    B, N = problem.valid.shape
    inset = torch.from_numpy(rng.random((B, N, 6)))
    expected = torch.from_numpy(rng.normal(size=(B, SHARED)))
    axes = rotation_from_rpy(problem.pose[..., 3:] + 0.1)
    wanted = torch.from_numpy(rng.normal(size=(B, N, 6)))
    recalled = torch.from_numpy(rng.normal(size=(B, 1, MEMORY)))
    return {
        'faces': Term(objective.faces, spd(rng, B, N, 6, 4), (problem.pose, inset)),
        'prior': Term(objective.prior, spd(rng, B, N, 1, 6), (problem.pose, axes)),
        'shape': Term(objective.shape, spd(rng, B, N, 1, 6), (0.9 * problem.pose, wanted)),
        'acceleration': Term(objective.acceleration, spd(rng, B, N - 2, 1, 6), (problem.times,)),
        'rest': Term(objective.rest, spd(rng, B, N - 1, 1, 6)),
        'slip': Term(objective.slip, spd(rng, B, N - 1, 1, 2), (problem.times,)),
        'shared_prior': Term(objective.shared_prior, spd(rng, B, 1, 1, SHARED), (expected,)),
        'memory': Term(objective.memory, spd(rng, B, 1, 1, MEMORY), (recalled,)),
    }


def variables(problem, seed=2):
    rng = np.random.default_rng(seed)
    B, N = problem.valid.shape
    pose = problem.pose + 0.1 * torch.from_numpy(rng.normal(size=(B, N, 6)))
    shared = 3 + torch.from_numpy(rng.normal(size=(B, SHARED)))
    return State(pose, shared).pack()


NAMES = ['faces', 'prior', 'shape', 'acceleration', 'rest', 'slip', 'shared_prior', 'memory']


def test_state_packs_and_unpacks():
    problem = random_problem()
    x = variables(problem)
    state = State.unpack(x, 6)
    assert state.pose.shape == (3, 6, 6)
    assert state.shared.shape == (3, SHARED)
    np.testing.assert_array_equal(state.pack(), x)


@pytest.mark.parametrize('name', NAMES)
def test_jacobians_equal_automatic_differentiation(name):
    problem = random_problem()
    term, x = terms_of(problem)[name], variables(problem)
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
    x = variables(problem)
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
    value, gradient = objective.value_and_gradient(terms, x, N, form)
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


def test_a_sum_is_that_of_its_terms_anywhere():
    # Where it was made, away from there, and for some windows alone.
    problem = random_problem()
    terms, x = list(terms_of(problem).values()), variables(problem)
    free = (torch.rand(x.shape, generator=torch.Generator().manual_seed(5)) < 0.9).to(x)
    start = variables(problem, seed=7)
    found = objective.Sum(terms, start, 6, free)
    known, _ = objective.value_and_gradient(terms, start, 6)
    np.testing.assert_allclose(found(start, torch.arange(3))[0], known, rtol=1e-12)
    value, gradient = objective.value_and_gradient(terms, x, 6)
    for rows in (torch.arange(3), torch.tensor([2, 0])):
        found_value, found_gradient = found(x[rows], rows)
        np.testing.assert_allclose(found_value, value[rows], rtol=1e-9)
        known = (gradient * free)[rows]
        np.testing.assert_allclose(found_gradient, known, atol=1e-9 * float(known.abs().max()))


def test_newton_takes_the_inverse_of_the_curvature():
    problem = random_problem()
    terms, x = list(terms_of(problem).values()), variables(problem)
    found = objective.Sum(terms, x, 6, torch.ones_like(x))
    vector, form = variables(problem, seed=8), Chain.zeros(x, 6)
    objective.value_and_gradient(terms, x, 6, form)
    solved = found.newton(vector, torch.arange(3))
    product = (dense(form, 6) @ solved[..., None])[..., 0]
    np.testing.assert_allclose(product, vector, atol=1e-6)
    rows = torch.tensor([2, 0])
    np.testing.assert_allclose(found.newton(vector[rows], rows), solved[rows], rtol=1e-9)
    identity = torch.eye(x.shape[1], dtype=D)
    columns = [found.newton(column.expand(3, -1), torch.arange(3)) for column in identity[:12]]
    inverse = torch.stack(columns, -1)
    np.testing.assert_allclose(
        found.factor.inverse_of_links(6)[:, 1], inverse[:, 6:12, 6:12], rtol=1e-6
    )


# --- ours: what is remembered -------------------------------------------------------------------


def linear_terms(problem, seed=1):
    """Return terms that are linear, of the usual size: 0.1 m and rad, 1 m/s^2."""
    rng = np.random.default_rng(seed)
    B, N = problem.valid.shape
    axes = rotation_from_rpy(problem.pose[..., 3:])
    expected = torch.from_numpy(rng.normal(size=(B, SHARED)))
    recalled = State(problem.pose[:, :2] + 0.1, expected + 0.1).pack()

    def weight(n, size):
        return spd(rng, B, n, 1, size) + torch.eye(size, dtype=D)

    return [
        Term(objective.prior, 100 * weight(N, 6), (problem.pose, axes)),
        Term(objective.acceleration, weight(N - 2, 6), (problem.times,)),
        Term(objective.rest, 100 * weight(N - 1, 6)),
        Term(objective.shared_prior, 100 * weight(1, SHARED), (expected,)),
        Term(objective.memory, 100 * weight(1, MEMORY), (recalled[:, None],)),
    ]


def without_oldest(terms, state):
    """Return the terms of the window without its oldest observation, which is remembered."""
    where, step, information = objective.remembered(terms, state)
    kept = [
        term
        if term.function is objective.shared_prior
        else Term(term.function, term.weight[:, 1:], tuple(part[:, 1:] for part in term.data))
        for term in terms
        if term.function is not objective.memory
    ]
    left = Term(objective.memory, information[:, None, None], ((where + step)[:, None],))
    return [*kept, left]


def least(terms, N):
    """Return where the sum of linear terms is least, (B, D)."""
    x = torch.zeros(len(terms[0].weight), 6 * N + SHARED, dtype=D)
    form = Chain.zeros(x, N)
    _, gradient = objective.value_and_gradient(terms, x, N, form)
    return torch.linalg.solve(dense(form, N), -gradient)


@pytest.mark.parametrize('N', [4, 7])
@pytest.mark.parametrize('is_first', [True, False], ids=['nothing before', 'remembering'])
def test_what_has_left_is_remembered_exactly(N, is_first):
    # Where terms are linear nothing is lost: once an observation has left, and then another, the
    # window is least where all observations together are, wherever it was when these left. The
    # ridge on what is not known at all, 1e-6 of curvatures of 100, is seen in 1e-8 of the step.
    problem = random_problem(N=N)
    terms = linear_terms(problem)[: 4 if is_first else 5]
    known = least(terms, N)
    rng = np.random.default_rng(9)
    for n in (N - 1, N - 2):
        whole = State.unpack(known[:, -6 * (n + 1) - SHARED :], n + 1)
        away = State(
            *(part + 0.1 * torch.from_numpy(rng.normal(size=part.shape)) for part in whole)
        )
        terms = without_oldest(terms, away)
        np.testing.assert_allclose(least(terms, n), known[:, -6 * n - SHARED :], atol=1e-8)


def test_the_memory_is_a_quadratic_form_of_all_terms_of_the_oldest():
    # To first order of the residuals: the dense Schur complement of all terms that the oldest
    # observation takes part in, but for what is expected of the shared, which stays.
    problem, N = random_problem(), 6
    terms, x = terms_of(problem), variables(problem)
    state = State.unpack(x, N)
    where, step, information = objective.remembered(list(terms.values()), state)
    np.testing.assert_array_equal(where, State(state.pose[:, 1:3], state.shared).pack())
    form, gradient = Chain.zeros(x, N), torch.zeros_like(x)
    for name, term in terms.items():
        if name != 'shared_prior':
            weight = torch.zeros_like(term.weight)
            weight[:, 0] = term.weight[:, 0]
            gradient += objective.value_and_gradient([term._replace(weight=weight)], x, N, form)[1]
    H = dense(form, N)
    first, others = slice(0, 6), [*range(6, 18), *range(6 * N, 6 * N + SHARED)]
    across = torch.linalg.solve(H[:, first, first], H[:, first])
    known = (H - H[:, :, first] @ across)[:, others][:, :, others]
    scale = float(known.abs().max())
    np.testing.assert_allclose(information, known, atol=1e-8 * scale)
    pull = gradient - (across.mT @ gradient[:, first, None])[..., 0]
    found = -(information @ step[..., None])[..., 0]
    np.testing.assert_allclose(found, pull[:, others], atol=1e-4 * float(pull.abs().max()))


def test_a_hard_window_does_not_touch_what_others_remember():
    problem = random_problem()
    terms, state = list(terms_of(problem).values()), State.unpack(variables(problem), 6)
    known = objective.remembered(terms, state)
    state.pose[1, 0] = torch.nan
    for found, right in zip(objective.remembered(terms, state), known, strict=True):
        np.testing.assert_allclose(found[[0, 2]], right[[0, 2]], rtol=1e-9)
    assert not objective.remembered(terms, state)[1][1].isfinite().all()


def test_memory_by_hand():
    # Two poses, 0.1 m and 0.2 rad off what is recalled of them, and what is shared, 0.3 off; the
    # third pose has no part in it.
    problem = problem_at(
        [[0.1, 0, 0, 0, 0, 0], [1, 0, 0, 0, 0, 0.2], [9, 9, 9, 0, 0, 0]], [0, 1, 2]
    )
    recalled = torch.zeros(1, 1, MEMORY, dtype=D)
    recalled[..., 6], recalled[..., 12:15] = 1.0, tensor([4.0, 2.0, 1.7])
    found = objective.memory(State(problem.pose, shared_of()), recalled).residual
    known = np.zeros((1, 1, 1, MEMORY))
    known[..., 0], known[..., 11], known[..., 14] = 0.1, 0.2, 0.3
    np.testing.assert_allclose(found, known, atol=1e-15)


# --- ours: values -------------------------------------------------------------------------------


def test_faces_by_moments_equal_the_sum_over_points():
    # The weight is the mean of (p, 1)(p, 1)' over the points of a face, so r' W r must be the
    # mean squared distance out of that face, plus what is expected of it (gap and inset).
    problem = random_problem()
    state = State.unpack(variables(problem), 6)
    rng = np.random.default_rng(3)
    inset = torch.from_numpy(rng.random((3, 6, 6)))
    homogeneous = torch.cat([problem.points, torch.ones_like(problem.points[..., :1])], -1)
    moment = torch.einsum('bnmi,bnmj->bnij', homogeneous, homogeneous) / 20
    term = Term(
        objective.faces, moment[:, :, None].expand(-1, -1, 6, -1, -1), (problem.pose, inset)
    )
    r = term.linearise(state).residual
    found = torch.einsum('bnfr,bnfrs,bnfs->bnf', r, term.weight, r)
    extent = state.shared[:, None, :3].expand(-1, 6, -1)
    boxes = torch.cat([state.pose[..., :3], extent, state.pose[..., 3:]], -1)
    out = face_distances(problem.points + problem.boxes[..., None, :3], boxes)
    out = out + (inset + state.shared[:, None, objective.GAP])[..., None, :]
    np.testing.assert_allclose(found, out.square().mean(2), rtol=1e-9)


def problem_at(pose, times):
    """Return a problem of one window of 4 x 2 x 2 m boxes at `pose` (N, 6) [m, rad]."""
    return problem_of(at(*pose), times=[times])


def test_acceleration_by_hand():
    # x = a t^2 / 2 at uneven times: the second difference over true time steps is a, exactly;
    # uniform motion in y and an even turn have none.
    t = np.array([0.0, 0.1, 0.3, 0.35])
    pose = np.c_[1.5 * t**2, 7 * t, 0 * t, 0 * t, 0 * t, 0.4 * t]
    problem = problem_at(pose, t.tolist())
    found = objective.acceleration(State(problem.pose, shared_of()), problem.times).residual
    known = np.tile([3.0, 0, 0, 0, 0, 0], (1, 2, 1, 1))
    np.testing.assert_allclose(found, known, atol=1e-12)


def test_rest_by_hand():
    pose = [[0, 0, 0, 0, 0, 0], [1, 2, 3, 0.1, 0.2, 0.3], [1, 2, 3, 0.1, 0.2, 0.4]]
    problem = problem_at(pose, [0, 0.1, 0.2])
    found = objective.rest(State(problem.pose, shared_of())).residual
    known = [[[[1, 2, 3, 0.1, 0.2, 0.3]], [[0, 0, 0, 0, 0, 0.1]]]]
    np.testing.assert_allclose(found, known, atol=1e-15)


def test_prior_by_hand():
    # The input heads along +y: a pose 0.3 m further along y is 0.3 m ahead; one 0.2 m further
    # along x is 0.2 m to its right. Less the bias, 0.1 m ahead and 0.05 rad of yaw.
    problem = problem_at([[0, 0, 0, 0, 0, np.pi / 2]], [0.0])
    pose = problem.pose + tensor([0.2, 0.3, 0.5, 0.01, 0.02, 0.06])
    axes = rotation_from_rpy(problem.pose[..., 3:])
    state = State(pose, shared_of(BIAS=[0.1, 0, 0, 0, 0, 0.05]))
    found = objective.prior(state, problem.pose, axes)
    known = [[[[0.2, -0.2, 0.5, 0.01, 0.02, 0.01]]]]
    np.testing.assert_allclose(found.residual, known, atol=1e-15)


def test_shape_by_hand():
    # Boxes head along +y: a step of 0.3 m along y and 0.2 m along x is 0.3 m ahead and 0.2 m to
    # the right, and yaw is a turn about z. The shape stands 0.1 m ahead in its box.
    problem = problem_at([[0, 0, 0, 0, 0, np.pi / 2]], [0.0])
    wanted = tensor([[[0.05, 0, 0, 0, 0, 0.01]]])
    state = State(
        problem.pose + tensor([0.2, 0.3, 0.5, 0, 0, 0.06]), shared_of(ANCHOR=[0.1, 0, 0, 0, 0, 0])
    )
    found = objective.shape(state, problem.pose, wanted).residual
    np.testing.assert_allclose(found, [[[[0.15, -0.2, 0.5, 0, 0, 0.05]]]], atol=1e-15)


def test_shared_prior_by_hand():
    problem = problem_at([[0.0] * 6], [0.0])
    state = State(problem.pose, shared_of(BIAS=[0.1, 0, 0, 0, 0, 0]))
    expected = shared_of(EXTENT=[3.5, 2, 2])
    found = objective.shared_prior(state, expected).residual
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
    np.testing.assert_allclose(objective.slip(state, problem.times).residual, 0, atol=1e-12)
    # Its centre does: 1 m before the axle, it swings out to the left by twice the sine of half
    # the turn.
    state = State(problem.pose, shared_of(PIVOT=0.0))
    known = 2 * np.sin(np.diff(yaw) / 2) / [0.1, 0.2, 0.1]
    np.testing.assert_allclose(objective.slip(state, problem.times).residual[0, :, 0, 0], known)


@pytest.mark.parametrize('yaw', [0.0, np.pi / 2, 3.0])
def test_slip_by_hand(yaw):
    # 0.1 m to its left and 0.02 m up in 0.1 s, beside 1 m ahead: 1 m/s and 0.2 m/s; reversing
    # does not count as slip.
    ahead, left = np.array([np.cos(yaw), np.sin(yaw)]), np.array([-np.sin(yaw), np.cos(yaw)])
    for way in (1.0, -1.0):
        x, y = way * ahead + 0.1 * left
        problem = problem_at([[0, 0, 0, 0, 0, yaw], [x, y, 0.02, 0, 0, yaw]], [0.0, 0.1])
        found = objective.slip(State(problem.pose, shared_of(PIVOT=1.0)), problem.times).residual
        np.testing.assert_allclose(found, [[[[1.0, 0.2]]]], atol=1e-12)
