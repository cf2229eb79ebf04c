"""
The solver of the default objective: rounds of expectation, observation, weighting and L-BFGS.

As in ICP, correspondences and weights are renewed in every round and held while the sum is
minimised. How many rounds there are, and what they use, is a `Plan`, chosen once per batch.

"""

from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from math import inf
from multiprocessing import cpu_count
from typing import NamedTuple

from boxreg_ros.config import Config
from boxreg_ros.core import terms
from boxreg_ros.core.batch import (
    ANCHOR,
    EXTENT,
    free_variables,
    MarginalPrior,
    POSE_ERRORS,
    Posterior,
    Problem,
    SHARED,
    Solution,
    State,
)
from boxreg_ros.core.covariance import posterior
from boxreg_ros.core.face_support import FaceObservations, FaceOffsets, observe_faces
from boxreg_ros.core.input_model import (
    evidence_of_extents,
    expect,
    Expectation,
    expected_shared,
    InputModel,
    InputNoise,
    mean_input_extents,
    normalised_residuals,
    UNKNOWN_NOISE,
    UNKNOWN_POPULATION,
)
from boxreg_ros.core.kernels import compiled, shared_by
from boxreg_ros.core.kernels.arrays import TermArrays
from boxreg_ros.core.lbfgs import HISTORY, minimize, select
from boxreg_ros.core.prior import marginalise
from boxreg_ros.core.rigid_shape import agreement, with_rigid_shape
from boxreg_ros.core.terms import Objective, Term
from boxreg_ros.core.weights import robustify_motion, weigh, weigh_compiled
from boxreg_ros.structures import POSE
import torch
from torch import Tensor
from torch.nn.functional import pad

# Constants whose origin is not stated are chosen; `boxreg bench sensitivity` halves and doubles
# each of them.
NOISE_ROUNDS = 2
"""First rounds of a whole track whose residuals give the input noise. Later fits follow the
input: the noise would be estimated smaller in every round."""
SETTLED_STEP = 0.1
"""A window is settled when its boxes move less than this in a round [errors of the input]."""
OBSERVATIONS_PER_THREAD = 2500
"""Observations that a thread solves at once: more save calls, fewer save memory traffic."""
COARSE_POINTS = 256
"""Points of each box in all rounds but the last ones."""
SHAPE_POINTS = 64
"""Points of each box that make the rigid shape of its track."""
MOTION_TERMS = (terms.acceleration, terms.slip)


@dataclass(frozen=True, slots=True)
class Plan:
    """
    How a batch is solved.

    Attributes
    ----------
    rounds : int
        Most rounds.
    coarse_points : float
        Points per box until the boxes are settled; then all.
    starts_from_fit : bool
        Whether the start is the fit of the tick before: faces are judged by its extents, and its
        motion is good enough for robust weights in the first round.
    uses_rigid_shape : bool
        Whether observations are tied by the rigid shape of their track, from the second round on.
    estimates_noise : bool
        Whether the noise of the input is estimated from this batch and not taken from the model.
    marginalises : bool
        Whether full windows leave a prior to the next ones.

    """

    rounds: int
    coarse_points: float
    starts_from_fit: bool = False
    uses_rigid_shape: bool = False
    estimates_noise: bool = False
    marginalises: bool = False

    @classmethod
    def choose(cls, config: Config, is_warm: bool) -> 'Plan':
        """
        Return the plan for windows that are warm: all but their newest box have been solved.

        A warm window takes one round with all points, a cold one as many as it needs. For whole
        tracks noise comes from the batch: the model has one residual a window of theirs, seconds
        apart, from which no correlation can be estimated.

        """
        plan = cls(1, inf, starts_from_fit=True)
        if not is_warm:
            plan = cls(config.solver.rounds, COARSE_POINTS)
        if config.estimate == 'track':
            return replace(plan, uses_rigid_shape=True, estimates_noise=True)
        return replace(plan, marginalises=True)


class Round(NamedTuple):
    """
    What all windows of a batch share in one round; `rows` of it can be selected.

    Attributes
    ----------
    problem : Problem
        The windows, with the points of this round.
    state : State
        Start of the round.
    expected : Expectation
        Means and deviations of input and shared variables.
    free : Tensor, shape (B, D)
        1 for variables that are estimated.
    log_extent : Tensor, shape (B, 3)
        Logarithms of the mean extents of the input.

    """

    problem: Problem
    state: State
    expected: Expectation
    free: Tensor
    log_extent: Tensor


class RoundResult(NamedTuple):
    """
    What a round makes of the windows `rows` (b,).

    Attributes
    ----------
    rows : Tensor, shape (b,)
        Indices of the windows in the batch.
    state : State
        End of the round.
    is_done : Tensor, shape (b,)
        Whether a window is settled, or this was the last round.
    extent_evidence : Tensor, shape (b, 2, 3)
        Corrections of extents by the points alone, and their weights.
    posterior : Posterior
        Of the d windows that are done.
    prior : MarginalPrior or None
        What the full ones among these leave to the next window, NaN for others.

    """

    rows: Tensor
    state: State
    is_done: Tensor
    extent_evidence: Tensor
    posterior: Posterior
    prior: MarginalPrior | None


@torch.inference_mode()
def solve(problem: Problem, config: Config, model: InputModel, is_warm: bool) -> Solution:
    """
    Minimise the robust objective (M1) of a batch: rounds until every window is settled.

    Parameters
    ----------
    problem : Problem
        B windows, all warm or all cold.
    config : Config
        Settings.
    model : InputModel
        Labelling margins and noise of the input.
    is_warm : bool
        Whether all boxes but the newest start from an earlier fit.

    Returns
    -------
    solution : Solution
        Poses, shared variables, covariances; for sliding windows, the prior of the next ones.

    Notes
    -----
    Settled windows take no part in further rounds. Within a round windows do not depend on each
    other: threads share them.

    """
    plan = Plan.choose(config, is_warm)
    offsets = model.offsets()
    learns_noise = config.ingredients.noise_estimation
    learns_extents = config.ingredients.population_extents
    noise = model.noise() if learns_noise and not plan.estimates_noise else UNKNOWN_NOISE
    known = model.population() if learns_extents else UNKNOWN_POPULATION
    population = known
    solution = _start(problem, config, offsets, plan)
    free = free_variables(problem, config)
    every = torch.arange(len(free), device=free.device)
    rows, turn, points = every, 0, plan.coarse_points
    workers = config.solver.threads or cpu_count()
    with (
        ThreadPoolExecutor(workers, '', torch.set_num_threads, (1,)) as pool,
        shared_by(pool, workers),
    ):
        while len(rows):
            expected = expect(problem, offsets, noise, population)
            log_extent = solution.extent_evidence[:, 0]
            batch = Round(problem.thinned(points), solution.state, expected, free, log_extent)
            work = partial(run_round, batch, offsets, plan, turn, config)
            parts = _split(rows, problem.length, workers)
            results: Iterable[RoundResult] = map(work, parts)
            if len(parts) > 1:
                results = pool.map(work, parts)
            unfinished = [_store(result, solution) for result in list(results)]
            rows = torch.cat(unfinished)
            turn += 1
            if plan.estimates_noise and learns_noise and turn <= NOISE_ROUNDS:
                residuals = normalised_residuals(problem, solution.state)
                noise = InputNoise.estimate_by_kind(residuals, problem.kind)
            if plan.estimates_noise and learns_extents:
                population = known.joined(solution.extent_evidence, problem.kind)
            if not len(rows) and 2 * points <= problem.returns.width:
                rows, points = every, inf  # settled on few points: once more with all
    return solution


@torch.inference_mode()
def run_round(
    batch: Round, offsets: FaceOffsets, plan: Plan, turn: int, config: Config, rows: Tensor
) -> RoundResult:
    """Take one round with the windows `rows`; nothing is written but the result."""
    problem, state, expected, free, log_extent = select(batch, rows)
    shared = state.shared.clone()
    shared[:, ANCHOR] = 0.0
    state = State(state.pose, shared)
    observations = observe_faces(problem, state, offsets, config)
    weighted = _weighted_terms(problem, state, expected, observations, plan, turn, config)

    x = state.pack()
    objective = Objective(weighted, x, problem.length, free)
    limits = config.solver.iterations, HISTORY, config.solver.tolerance
    found = State.unpack(minimize(objective, x, *limits, objective.newton).x, problem.length)

    step = (found.pose - state.pose) / problem.of_class(*POSE_ERRORS)[:, None]
    moved = step.square().mean(2).amax(1)
    is_settled = (moved <= SETTLED_STEP**2) & (turn > 0)
    is_done = is_settled | (turn + 1 >= plan.rounds)
    done = is_done.nonzero()[:, 0]
    faces = observations.moments, observations.inset, observations.weight
    covariance = torch.cholesky_inverse(objective.factor.corner)
    settled = select((problem, found, *faces, expected, free, objective.factor, covariance), done)
    prior = None
    is_full = plan.marginalises and problem.length == config.window
    if is_full and len(done):
        prior = _prior_of_full(objective, found, problem)
    evidence = evidence_of_extents(log_extent, expected, found, covariance)
    return RoundResult(rows, found, is_done, evidence, posterior(*settled), prior)


def _weighted_terms(
    problem: Problem,
    state: State,
    expected: Expectation,
    observations: FaceObservations,
    plan: Plan,
    turn: int,
    config: Config,
) -> list[Term] | TermArrays:
    """Return the terms of one round: weights, robust motion, rigid shape."""
    # The motion of a cold window is at first as noisy as its input.
    is_smooth = turn > 0 or plan.starts_from_fit
    uses_rigid_shape = turn > 0 and plan.uses_rigid_shape
    if compiled(state.pose) is not None:
        arrays = weigh_compiled(problem, state, observations, expected, config, is_smooth)
        if uses_rigid_shape:
            arrays = with_rigid_shape(arrays, problem.thinned(SHAPE_POINTS), state)
        return arrays
    weighted = weigh(problem, state, observations, expected, config)
    # Terms without any weight, such as zero motion, are dropped (`any` takes three times as long).
    weighted = [term for term in weighted if term.weight.norm()]
    if is_smooth and config.ingredients.robust_motion:
        weighted = [
            robustify_motion(term, state) if term.function in MOTION_TERMS else term
            for term in weighted
        ]
    if uses_rigid_shape:
        information, wanted = agreement(problem.thinned(SHAPE_POINTS), state)
        data = state.pose, wanted
        weighted.append(Term(terms.rigid_shape, information[:, :, None], data))
    return weighted


def _prior_of_full(objective: Objective, found: State, problem: Problem) -> MarginalPrior:
    """Return what full windows leave to the next ones, NaN for those that are padded."""
    prior = marginalise(objective, found)
    is_padded = ~problem.valid.all(1)
    prior.state[is_padded] = torch.nan
    prior.step[is_padded] = torch.nan
    return prior


def _start(problem: Problem, config: Config, offsets: FaceOffsets, plan: Plan) -> Solution:
    """Return the state that the first round starts from, without covariances and prior."""
    pose = problem.start[..., POSE].clone()
    shared = expected_shared(problem, offsets, mean_input_extents(problem))
    log_extent = shared[:, EXTENT].log()
    if plan.starts_from_fit:
        is_free = free_variables(problem, config)[:, -SHARED:][:, EXTENT]
        shared[:, EXTENT].lerp_(problem.start[:, 0, 3:6], is_free)
    prior = extents = None
    if plan.marginalises:
        unknown = torch.full_like(problem.prior_mean, torch.nan)
        prior = MarginalPrior(unknown, unknown.clone(), problem.prior_information.clone())
        first = pad(problem.boxes[:, 0, 3:6], (0, 1), value=1.0)
        extents = problem.marginalised_extents + first
    evidence = pad(log_extent[:, None], (0, 0, 0, 2))  # (B, 3, 3)
    return Solution(State(pose, shared), Posterior.zeros(pose), prior, extents, evidence)


def _store(result: RoundResult, solution: Solution) -> Tensor:
    """Write the result of a round to its rows of `solution`; return those that are not done."""
    rows = result.rows
    solution.state.pose[rows] = result.state.pose
    solution.state.shared[rows] = result.state.shared
    solution.extent_evidence[rows, 1:] = result.extent_evidence
    done = rows[result.is_done]
    for whole, part in zip(solution.posterior, result.posterior, strict=True):
        whole[done] = part
    if result.prior is not None and solution.prior is not None:
        for whole, part in zip(solution.prior, result.prior, strict=True):
            whole[done] = part[result.is_done]
    return rows[~result.is_done]


def _split(rows: Tensor, length: int, workers: int) -> tuple[Tensor, ...]:
    """Return parts of `rows` for threads: one on a GPU, or if there are few observations."""
    size = (OBSERVATIONS_PER_THREAD if rows.is_cpu else inf) / length
    if len(rows) <= size:
        return (rows,)
    parts = workers * int(1 + len(rows) / size / workers)
    return rows.tensor_split(min(len(rows), parts))
