"""Windows solved together, alone, and by torch's own L-BFGS; weights and acceptance tests."""

from dataclasses import replace
from threading import Event

from boxreg_ros.config import Config
from boxreg_ros.core import paper, solver
from boxreg_ros.core.input_model import InputModel
from boxreg_ros.core.lbfgs import minimize, Minimum
from boxreg_ros.core.method import round as method
from boxreg_ros.core.method.constants import CONSTANTS
from boxreg_ros.core.paper import Observed, solve_paper
from boxreg_ros.core.problem import stack_windows as stack
from boxreg_ros.core.solver import Objective, observe, run_round, SolverPlan, start
from boxreg_ros.core.threads import mapped, shared_between
from boxreg_ros.structures import POSE
import numpy as np
import pytest
from reference import objective
from scenes import changed, drive, EXTENT, row_of, solved, track_of, window_of
import torch

D = torch.float64
# Labelling margins are fixed, so that windows are independent.
ALONE = Config().updated({'estimate': 'final', 'faces.learn': False})
PAPER = ALONE.updated({'objective': 'paper', 'sampling.points': 40})
WEIGHTS = replace(PAPER.paper, closeness=1.0, alignment=0.1)  # points against motion, about even
# Rounding errors change where a search ends at the kinks of the paper's terms: stop before that.
BRIEF = PAPER.updated({'paper.iterations': 5})


def stack_windows(windows, config):
    return stack(windows, config, CONSTANTS.prior_decay)


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
    lengths = [found.boxes[0, 3] for found in solved(many, WHOLE, InputModel(WHOLE.faces))]
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
    estimates = solved(many, WHOLE, InputModel(WHOLE.faces))
    parked = [found.boxes for k, found in enumerate(estimates) if k % 4]
    off = np.linalg.norm((np.array(parked) - truths)[..., :2], axis=2)
    assert off.mean() < 0.2 / 2


# --- independence -------------------------------------------------------------------------------


@pytest.mark.parametrize('config', [ALONE, BRIEF], ids=['robust', 'paper'])
def test_a_batch_equals_single_windows(config):
    # Padded to the longest, and to the one with most points.
    many = windows(config)
    together = solved(many, config, InputModel(config.faces))
    for one, found in zip(many, together, strict=True):
        (known,) = solved([one], config, InputModel(config.faces))
        np.testing.assert_allclose(found.boxes, known.boxes, atol=1e-8)
        np.testing.assert_allclose(found.covariances, known.covariances, atol=1e-8)
        assert (found.status, found.reasons) == (known.status, known.reasons)


def test_an_ill_conditioned_window_does_not_affect_others():
    # Stamps a nanosecond apart let the curvature lose its definiteness in rounding.
    many = windows()
    known = solved(many, ALONE, InputModel(ALONE.faces))
    bad = [changed(o, stamps_ns=i) for i, o in enumerate(many[2].observations)]
    many[2] = many[2]._replace(observations=bad)
    found = solved(many, ALONE, InputModel(ALONE.faces))
    for i in (0, 1, 3):
        np.testing.assert_allclose(found[i].boxes, known[i].boxes, atol=1e-6)
        assert found[i].status == known[i].status
    assert np.isfinite(found[2].boxes).all()
    assert np.isfinite(found[2].covariances).all()


def test_observations_update_the_margins_once():
    config = ALONE.updated({'faces.learn': True})
    model = InputModel(config.faces)
    many = [window(drive(12), seed, config, str(seed)) for seed in range(4)]
    solved(many, config, model)
    known = [row.tolist() for row in model.gaps_of_tracks(range(6))]
    unknown = InputModel(config.faces).inputs(config)['margin']
    assert np.abs(model.inputs(config)['margin'] - unknown).max() > 1e-4
    again = [
        w._replace(num_new=0, observations=w.observations[-4:], start=given(w)[-4:]) for w in many
    ]
    solved(again, config, model)
    assert [row.tolist() for row in model.gaps_of_tracks(range(6))] == known


@pytest.mark.parametrize('length', [9, 13, 16])
def test_each_box_counts_once_in_the_noise(length):
    # Ten boxes a window: the first one is the best of its window from the tenth on.
    model = InputModel(ALONE.faces)
    whole = window(drive(length))
    for end in range(3, length + 1):
        seen = whole.observations[max(0, end - 10) : end]
        solved([whole._replace(observations=seen, num_new=len(seen))], ALONE, model)
    counted = length - 9
    known = counted if counted >= 5 else 0
    (taught,) = model.statistics('one').values()
    np.testing.assert_allclose(taught[0].noise['boxes'], known)


def test_short_windows_have_no_estimate():
    many = [window(drive(2), 0, name='a'), window(drive(3), 0, name='b')]
    short, long = solved(many, ALONE, InputModel(ALONE.faces))
    assert short is None
    assert set(long.status) == {'refined'}


@pytest.mark.parametrize('many', [[], [window(drive(1))]], ids=['none', 'one box'])
def test_no_windows_to_solve(many):
    assert solved(many, ALONE, InputModel(ALONE.faces)) == [None] * len(many)


# --- threads ------------------------------------------------------------------------------------


@pytest.mark.parametrize('estimate', ['final', 'track'])
def test_the_number_of_threads_does_not_change_results(estimate):
    config = ALONE.updated({'estimate': estimate})
    known = solved(windows(), config, InputModel(config.faces))
    for threads in (0, 1, 3):
        more = config.updated({'solver.threads': threads})
        for a, b in zip(solved(windows(), more, InputModel(more.faces)), known, strict=True):
            assert (a.status, a.reasons) == (b.status, b.reasons)
            np.testing.assert_array_equal(a.boxes, b.boxes)
            np.testing.assert_array_equal(a.covariances, b.covariances)
            assert (a.prior is None) == (b.prior is None)
            if a.prior is not None:
                for one, other in zip(row_of(a.prior), row_of(b.prior), strict=True):
                    np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize('estimate', ['final', 'track'])
def test_windows_that_pass_a_round_in_parts_have_the_same_boxes(monkeypatch, estimate):
    config = ALONE.updated({'estimate': estimate})
    known = solved(windows(), config, InputModel(config.faces))
    monkeypatch.setattr(solver, 'POSES_AT_ONCE', 1)
    found = solved(windows(), config, InputModel(config.faces))
    for a, b in zip(found, known, strict=True):
        np.testing.assert_array_equal(a.boxes, b.boxes)
        np.testing.assert_array_equal(a.covariances, b.covariances)


def note_rounds(monkeypatch, note):
    """Call `note` with the extents of the first window in every round."""

    def taken(batch, *rest):
        note(batch.solution.shared[0, :3].copy())
        return run_round(batch, *rest)

    monkeypatch.setattr(solver, 'run_round', taken)


@pytest.mark.parametrize('estimate', ['final', 'track'])
def test_every_window_passes_through_lbfgs(monkeypatch, estimate):
    # By default, cold and warm: each window of each round is minimised by torch, and pairs of
    # steps and gradients are formed.
    rounds, searches = [], []

    def minimised(function, start, iterations, history, *rest):
        assert isinstance(start, torch.Tensor) and iterations > 1 and history > 0
        searches.append(len(start))
        return minimize(function, start, iterations, history, *rest)

    def taken(batch, inputs, rows, *rest):
        rounds.append(len(rows))
        return run_round(batch, inputs, rows, *rest)

    monkeypatch.setattr(solver, 'minimize', minimised)
    monkeypatch.setattr(solver, 'run_round', taken)
    config = Config(estimate=estimate)
    model = InputModel(config.faces)
    whole = window(drive(12), config=config)
    many = [*windows(config), whole._replace(track_id='warm')]
    many[-1] = many[-1]._replace(num_new=1, start=given(whole)[:-1])
    solved(many, config, model)
    assert searches == rounds
    assert rounds[-1] == 1 and rounds[0] == 4  # warm windows come last, in one round


def test_an_error_in_a_thread_is_raised(monkeypatch):
    threads = torch.get_num_threads()

    def broken(*_):
        raise RuntimeError('broken')

    monkeypatch.setattr(method, 'evaluate', broken)
    with pytest.raises(RuntimeError, match='broken'):
        solved(windows(), ALONE, InputModel(ALONE.faces))
    assert torch.get_num_threads() == threads


# --- extents ------------------------------------------------------------------------------------


def test_a_signal_does_not_wait_for_threads():
    """One may compile for a minute."""
    is_interrupted, ended = Event(), Event()

    def work(part):
        if part == 0:
            raise KeyboardInterrupt
        is_interrupted.wait(5.0)
        ended.set()

    with pytest.raises(KeyboardInterrupt), shared_between(2):
        mapped(work, [0, 1])
    assert not ended.is_set()
    is_interrupted.set()


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
        found = solved(many, config, InputModel(config.faces))
        wrong = np.log([estimate.boxes[0, 3] for estimate in found]) - np.log(lengths)
        return np.polyfit(np.log(lengths), wrong, 1)[0]

    known = slope(config)
    alone = slope(config.updated({'ingredients.population_extents': False}))
    assert -0.3 < alone < -0.1
    assert abs(known) < 0.75 * abs(alone)


@pytest.fixture
def extents_used(monkeypatch):
    """Collect the extents (3,) at which each round of the first window begins."""
    seen = []

    note_rounds(monkeypatch, seen.append)
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
    solved([whole._replace(num_new=1, start=start)], config, InputModel(config.faces))
    assert len(extents_used) == 1  # the one round of a tick
    known = np.where(np.isin(np.arange(3), held), given(whole)[:, 3:6].mean(0), found)
    np.testing.assert_allclose(extents_used[0], known)


@pytest.mark.parametrize('rounds', [1, 2])
def test_a_cold_window_starts_from_the_mean_extents_of_the_input(extents_used, rounds):
    config = ALONE.updated({'solver.rounds': rounds})
    whole = window(drive(6), extent=0.05)
    solved([whole], config, InputModel(config.faces))
    assert len(extents_used) == rounds
    np.testing.assert_allclose(extents_used[0], given(whole)[:, 3:6].mean(0))


# --- marginalisation prior ----------------------------------------------------------------------


def test_full_windows_leave_a_marginalisation_prior():
    # A full window of ten observations marginalises the first; a shorter window leaves no prior.
    many = windows()
    found = solved(many, ALONE, InputModel(ALONE.faces))
    assert [estimate.prior is not None for estimate in found] == [True, False, False, False]
    prior, boxes = row_of(found[0].prior), found[0].boxes
    first = given(many[0])[0]
    np.testing.assert_array_equal(prior.base, first[:3])
    np.testing.assert_array_equal(prior.marginalised_extents, [*first[3:6], 1])
    left = boxes[1:3] - [*first[:3], *np.zeros(6)]
    np.testing.assert_allclose(prior.state[:12], left[:, POSE].ravel(), atol=1e-9)
    np.testing.assert_allclose(prior.state[12:15], boxes[0, 3:6], atol=1e-9)
    np.testing.assert_allclose(prior.information, prior.information.T, atol=1e-6)
    assert np.linalg.eigvalsh(prior.information).min() > -1e-6 * prior.information.max()
    for config in (ALONE.updated({'estimate': 'track'}), BRIEF):
        found = solved(windows(config), config, InputModel(config.faces))
        assert {estimate.prior for estimate in found} == {None}


def slid(whole, count, turns=0.0, config=ALONE):
    """Return the estimates of windows of ten of `whole`, one after the other; prior + `turns`."""
    estimates, prior, start = [], None, np.zeros((0, 9))
    for first in range(count):
        observations = whole.observations[first : first + 10]
        one = whole._replace(
            observations=observations, num_new=10 - len(start), start=start, prior=prior
        )
        estimates += solved([one], config, InputModel(config.faces))
        prior, start = estimates[-1].prior, estimates[-1].boxes[1:]
        table, row = prior
        state = table.state.copy()
        state[row, [5, 11]] += turns
        prior = table._replace(state=state), row
    return estimates


def test_marginalisation_prior_improves_the_newest_box():
    whole = window(drive(14))
    estimates = slid(whole, 5)
    boxes = given(whole)
    for i, estimate in enumerate(estimates):
        np.testing.assert_array_equal(row_of(estimate.prior).base, boxes[0, :3])
        known = [*boxes[: i + 1, 3:6].sum(0), i + 1]
        np.testing.assert_allclose(row_of(estimate.prior).marginalised_extents, known)
    # The prior has information about bias and extent: without it, the covariance is larger.
    last = whole._replace(
        observations=whole.observations[4:], num_new=1, start=estimates[3].boxes[1:]
    )
    (forgetful,) = solved([last], ALONE, InputModel(ALONE.faces))
    spread = [np.trace(e.covariances[-1][:2, :2]) for e in (estimates[4], forgetful)]
    assert spread[0] < spread[1]


@pytest.mark.parametrize('turns', [2 * np.pi, -4 * np.pi])
def test_prior_is_invariant_to_whole_turns(turns):
    whole = window(drive(13, turn=0.4, start=(5.0, 6.0, 2.9)))  # across half a turn
    for found, known in zip(slid(whole, 4, turns), slid(whole, 4), strict=True):
        np.testing.assert_allclose(found.boxes, known.boxes, atol=1e-9)


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
    # The sums of one round: torch gets them by automatic differentiation, one window at a time;
    # ours are compiled, with the Gauss-Newton curvature as metric, and all windows at once.
    problem, _ = stack_windows(windows(), ALONE)
    constants = CONSTANTS.with_settings(ALONE).in_round(False, True)
    inputs = InputModel(ALONE.faces).inputs(ALONE)
    batch = start(problem, ALONE, SolverPlan.choose(ALONE, False), inputs)
    rows, x = np.arange(4), np.empty((2, *batch.free.shape))
    batch.free[:] = 1.0
    sums = observe(batch, inputs, rows, constants)
    function = Objective(batch, sums, inputs, constants.record(), rows)
    points = torch.from_numpy(x)
    first, trial = zip(points, *function.sum(x, method.START), strict=True)
    start_x, value = first[0], first[1]
    found = minimize(function.at, start_x, 12, 6, 1e-6, first[1:], trial)
    for known in (first, trial):
        for part, again in zip(known[1:], function.at(known[0], torch.arange(4)), strict=True):
            np.testing.assert_allclose(again, part)
    unknown = minimize(function.at, start_x, 12, 6, 1e-6)
    for part, again in zip(found, unknown, strict=True):
        np.testing.assert_array_equal(part, again)
    assert (found.value < 0.9 * value).all()
    for row in (0, 3):  # a full window, and a padded one
        terms = objective.tensors(sums.terms[row])
        common = objective.tensors(sums.common[row])

        prior = problem.prior_mean[row], problem.prior_information[row]
        prior = [*map(torch.from_numpy, prior)]

        def loss(x, terms=terms, common=common, prior=prior):
            return objective.whitened(x, terms, common, prior).square().sum() / 2

        assert found.value[row] <= 1.01 * oracle(loss, start_x[row]) + 1e-9


def paper_problem():
    problem, _ = stack_windows(windows(PAPER), PAPER)
    seen = Observed.of(problem)
    x = torch.from_numpy(problem.boxes[..., POSE]).flatten(1)
    extent = torch.from_numpy(problem.boxes[..., 3:6])

    def total(x, rows, multipliers, rounding=paper.EPSILON):
        pose = x.unflatten(1, (extent.shape[1], 6))
        boxes = torch.cat([pose[..., :3], extent[rows], pose[..., 3:]], -1)
        part = Observed(*(of_all[rows] for of_all in seen))
        return paper.total(boxes, part, WEIGHTS, multipliers, rounding)

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

        found = minimize(function, found.x, 50, 10, 1e-9)
    for row in (0, 3):  # a full window, and a padded one
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
    found = solve_paper(problem, PAPER.updated({'paper.iterations': 20}))
    assert not len(found.left.state)
    assert found.posterior.poses.shape == (*problem.valid.shape, 6, 6)
    rows, none = torch.arange(4), torch.zeros(4, 2, dtype=D)
    before, violation = total(x, rows, none)
    after, rest = total(torch.from_numpy(found.poses).flatten(1), rows, none)
    assert (after < before).all()
    assert (rest < violation).all()
