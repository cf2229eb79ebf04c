"""Windows solved together, alone, and by torch's own L-BFGS; and how they are stacked."""

from dataclasses import replace

from boxreg_ros import objective
from boxreg_ros.calibration import InputModel
from boxreg_ros.config import Config
from boxreg_ros.geometry import rotation_from_rpy
from boxreg_ros.lbfgs import minimize, Minimum, select
from boxreg_ros.metrics import iou_3d
from boxreg_ros.objective import State
from boxreg_ros.registration import register, solve_paper
from boxreg_ros.window import stack
import numpy as np
import pytest
from scenes import drive, track_of, window_of
import torch

D = torch.float64
# Nothing is learnt from the neighbours, so that windows are independent.
ALONE = Config().updated({'estimate': 'final', 'faces.learn': False})
PAPER = ALONE.updated({'objective': 'paper', 'sampling.points': 40, 'paper.nearest': 8})
WEIGHTS = replace(PAPER.paper, closeness=1.0, alignment=0.1)  # points against motion, about even
# The paper's terms have kinks, at which rounding is enough to end elsewhere: before it gets there.
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


def test_boxes_are_registered_to_their_points():
    # Input errors of 0.15 m and 0.05 rad give an IoU of some 0.8; half of what is missing to 1
    # must be gained, on average, and something every time.
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


def test_covariances_are_of_the_size_of_the_errors():
    # Squared errors over covariances of x, y and yaw average to 1 where covariances are right.
    # These are for detectors and sensors of the street: points that know their rule to 1 cm
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


# --- independence -------------------------------------------------------------------------------


@pytest.mark.parametrize('config', [ALONE, BRIEF], ids=['robust', 'paper'])
def test_a_batch_equals_its_windows_alone(config):
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
def test_a_gpu_gives_the_same(estimate):
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


def test_a_window_out_of_proportion_does_not_touch_its_neighbours():
    # Stamps a nanosecond apart let the curvature lose its definiteness in rounding.
    many = windows()
    known = register(many, ALONE, InputModel(ALONE.faces))
    bad = [o._replace(stamp_ns=i) for i, o in enumerate(many[2].observations)]
    many[2] = many[2]._replace(observations=bad)
    found = register(many, ALONE, InputModel(ALONE.faces))
    for i in (0, 1, 3):
        np.testing.assert_allclose(found[i].boxes, known[i].boxes, atol=1e-6)
        assert found[i].status == known[i].status
    assert np.isfinite(found[2].boxes).all()
    assert np.isfinite(found[2].covariances).all()


def test_what_was_seen_before_is_not_learnt_again():
    config = ALONE.updated({'faces.learn': True})
    model = InputModel(config.faces)
    many = [window(drive(12), seed, config, str(seed)) for seed in range(4)]
    register(many, config, model)
    known = model.rule().gaps
    assert (known - InputModel(config.faces).rule().gaps).abs().max() > 1e-4
    again = [
        w._replace(fresh=0, observations=w.observations[-4:], start=given(w)[-4:]) for w in many
    ]
    register(again, config, model)
    np.testing.assert_array_equal(model.rule().gaps, known)


def test_short_windows_are_kept():
    many = [window(drive(2), 0, name='a'), window(drive(3), 0, name='b')]
    short, long = register(many, ALONE, InputModel(ALONE.faces))
    assert short.status == ('kept',) * 2
    assert short.reasons == ('short_track',) * 2
    np.testing.assert_array_equal(short.boxes, given(many[0]))
    assert short.covariances.shape == (2, 6, 6)
    assert set(long.status) == {'refined'}


@pytest.mark.parametrize('many', [[], [window(drive(1))]], ids=['none', 'one box'])
def test_nothing_to_solve(many):
    found = register(many, ALONE, InputModel(ALONE.faces))
    assert [set(estimate.status) for estimate in found] == [{'kept'}] * len(many)


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


def test_the_robust_objective_against_torch():
    # One round of terms: torch gets the sum of r' W r / 2 and its automatic gradient, ours gets
    # the written gradient and the Gauss-Newton curvature as metric, and all windows at once.
    problem, _ = stack(windows(), ALONE)
    terms = robust_terms(problem)
    length = problem.valid.shape[1]
    shared = torch.cat([problem.boxes[:, 0, 3:6], torch.zeros(4, objective.SHARED - 3)], 1)
    x = State(problem.pose, shared.to(D)).pack()
    function = objective.Sum(terms, x, length, torch.ones_like(x))
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
    expected = torch.zeros(B, objective.SHARED, dtype=D)
    expected[:, :3], expected[:, objective.PIVOT] = problem.boxes[:, 0, 3:6], 0.25
    one = torch.ones(B, 1, dtype=D)
    axes = rotation_from_rpy(problem.pose[..., 3:])
    return [
        objective.Term(objective.faces, moments, (problem.pose, torch.zeros(B, N, 6, dtype=D))),
        objective.Term(objective.prior, diagonal(weight, valid), (problem.pose, axes)),
        objective.Term(objective.acceleration, diagonal(motion, valid[:, 2:]), (problem.times,)),
        objective.Term(
            objective.slip, diagonal(torch.tensor([40.0, 20.0]).to(D), valid[:, 1:]),
            (problem.times,),
        ),
        objective.Term(
            objective.shared_prior,
            diagonal(torch.full((objective.SHARED,), 400.0, dtype=D), one), (expected,),
        ),
    ]  # fmt: skip


def paper_problem():
    problem, _ = stack(windows(PAPER), PAPER)
    x = problem.pose.flatten(1)
    extent = problem.boxes[..., 3:6]

    def total(x, rows, multipliers, rounding=objective.EPSILON):
        pose = x.unflatten(1, (extent.shape[1], 6))
        boxes = torch.cat([pose[..., :3], extent[rows], pose[..., 3:]], -1)
        return objective.total(boxes, problem.select(rows), WEIGHTS, multipliers, rounding)

    return problem, x, total


def test_the_papers_objective_against_torch():
    # Eq. 8 has kinks, where quasi-Newton methods stop early. Ours comes from rounded ones, so it
    # must not be worse than torch's by more than a hundredth of the value.
    _, x, total = paper_problem()
    multipliers = torch.full((4, 2), 0.1, dtype=D)

    found = Minimum(x, *[None] * 3)
    for rounding in (0.3, 3e-3, 3e-5, objective.EPSILON):

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


def test_multipliers_lower_the_violation_of_the_constraints():
    # Smoothness and alignment are constraints: after the rounds they are violated less than at
    # the input, and the objective at the multipliers of the first round is lower.
    problem, x, total = paper_problem()
    state, covariances = solve_paper(problem, PAPER)
    assert covariances.shape == (*problem.valid.shape, 6, 6)
    rows, none = torch.arange(4), torch.zeros(4, 2, dtype=D)
    before, violation = total(x, rows, none)
    after, left = total(state.pose.flatten(1), rows, none)
    assert (after < before).all()
    assert (left < violation).all()


# --- what is free -------------------------------------------------------------------------------


@pytest.mark.parametrize('name', ['robust', 'paper'])
def test_bev_leaves_height_roll_and_pitch(name):
    config = (ALONE if name == 'robust' else PAPER).updated({'mode': 'bev'})
    one = window(drive(6), 1, config)
    (found,) = register([one], config, InputModel(config.faces))
    np.testing.assert_allclose(found.boxes[:, [2, 6, 7]], given(one)[:, [2, 6, 7]], atol=1e-12)
    assert np.abs(found.boxes - given(one))[:, [0, 1, 8]].max() > 0.01


@pytest.mark.parametrize('name', ['robust', 'paper'])
def test_extents_of_a_track_are_one_or_the_inputs(name):
    config = ALONE if name == 'robust' else PAPER
    one = window(drive(6), 1, config, extent=0.05)
    (found,) = register([one], config, InputModel(config.faces))
    np.testing.assert_allclose(found.boxes[:, 3:6], found.boxes[:1, 3:6].repeat(6, 0))
    fixed = config.updated({'extent': 'fixed'})
    (found,) = register([one], fixed, InputModel(config.faces))
    np.testing.assert_array_equal(found.boxes[:, 3:6], given(one)[:, 3:6])
