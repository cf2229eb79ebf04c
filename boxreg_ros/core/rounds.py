"""
One round of the solver: face observations, weights, and one minimisation.

By a kernel, one call for all windows, or by its torch twin, which is the reference of the tests.

"""

from dataclasses import dataclass, replace
from math import inf
from typing import NamedTuple

from boxreg_ros.config import Config
from boxreg_ros.core import lbfgs, terms
from boxreg_ros.core.arrowhead import InverseBlocks, LINK
from boxreg_ros.core.batch import (
    ANCHOR,
    MarginalPrior,
    POSE_ERRORS,
    Posterior,
    PRIOR_SIZE,
    Problem,
    SHARED,
    State,
)
from boxreg_ros.core.covariance import posterior
from boxreg_ros.core.face_support import (
    empty_faces,
    face_numbers,
    FaceObservations,
    FaceOffsets,
    observe_faces,
)
from boxreg_ros.core.input_model import evidence_of_extents, Expectation
from boxreg_ros.core.kernels import compiled, contiguous, run
from boxreg_ros.core.kernels.arrays import (
    ExpectedArrays,
    RoundNumbers,
    RoundResults,
    SearchNumbers,
    ShapeArrays,
    StartArrays,
)
from boxreg_ros.core.lbfgs import minimize, select
from boxreg_ros.core.prior import marginalise
from boxreg_ros.core.rigid_shape import agreement
from boxreg_ros.core.terms import Objective, Term
from boxreg_ros.core.weights import (
    class_deviations,
    prior_information,
    robustify_motion,
    weigh,
    weight_numbers,
)
import numpy as np
import torch
from torch import Tensor

# Constants whose origin is not stated are chosen; `boxreg bench sensitivity` halves and doubles
# each of them.
SETTLED_STEP = 0.1
"""A window is settled when its boxes move less than this in a round [errors of the input]."""
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
def run_round(
    batch: Round, offsets: FaceOffsets, plan: Plan, turn: int, config: Config, rows: Tensor
) -> RoundResult:
    """Take one round with the windows `rows`; nothing is written but the result."""
    part = select(batch, rows)
    shared = part.state.shared.clone()
    shared[:, ANCHOR] = 0.0
    part = part._replace(state=State(part.state.pose, shared))
    take = run_round_torch
    if compiled(shared) is not None:
        take = run_round_compiled
    fit = take(part, offsets, plan, turn, config)
    done = fit.is_done.nonzero()[:, 0]
    found = fit.observations
    moments, inset, weight = select((found.moments, found.inset, found.weight), done)
    problem, state, expected, free, inverse = select(
        (part.problem, fit.state, part.expected, part.free, fit.inverse), done
    )
    covariances = posterior(
        problem, state, moments, inset, weight, expected, free, inverse, config
    )
    evidence = evidence_of_extents(part.log_extent, part.expected, fit.state, fit.inverse.corner)
    return RoundResult(rows, fit.state, fit.is_done, evidence, covariances, fit.prior)


class Fit(NamedTuple):
    """
    The end of a round of b windows.

    Attributes
    ----------
    state : State
        Poses and shared variables.
    is_done : Tensor, shape (b,)
        Whether a window is settled, or this was the last round.
    observations : FaceObservations
        Of this round.
    inverse : InverseBlocks
        Of the curvature; blocks of the poses only of windows that are done.
    prior : MarginalPrior or None
        What full windows that are done leave to the next ones, NaN for others.

    """

    state: State
    is_done: Tensor
    observations: FaceObservations
    inverse: InverseBlocks
    prior: MarginalPrior | None


def run_round_compiled(
    part: Round, offsets: FaceOffsets, plan: Plan, turn: int, config: Config
) -> Fit:
    """Take a round by the kernel."""
    problem, state, expected, free, _ = part
    kernels = compiled(state.pose)
    assert kernels is not None
    B, N = problem.valid.shape
    _, *insets = map(contiguous, offsets.of(problem))
    start = StartArrays(
        contiguous(state.pose),
        contiguous(state.shared),
        contiguous(free),
        contiguous(problem.prior_mean),
        contiguous(prior_information(problem, config)),
    )
    numbers = RoundNumbers(
        face_numbers(problem, config),
        weight_numbers(config, _is_smooth(plan, turn)),
        _search_numbers(plan, turn, config),
    )
    columns = {name: contiguous(getattr(expected, name)) for name in ExpectedArrays._fields}
    shape = ShapeArrays(np.zeros((B, 0, 6, 6)), np.zeros((B, 0, 6)))
    if _uses_rigid_shape(plan, turn):
        shape = ShapeArrays(*map(contiguous, agreement(problem.thinned(SHAPE_POINTS), state)))
    faces = empty_faces(B, N)
    num_priors = B if plan.marginalises and config.window == N else 0
    results = RoundResults(
        x=np.empty(tuple(free.shape)),
        is_done=np.zeros(B, bool),
        pose_blocks=np.empty((B, N, LINK, LINK)),
        border_blocks=np.empty((B, N, LINK, SHARED)),
        corner=np.empty((B, SHARED, SHARED)),
        prior_mean=np.full((num_priors, PRIOR_SIZE), np.nan),
        prior_step=np.full((num_priors, PRIOR_SIZE), np.nan),
        prior_information=np.full((num_priors, PRIOR_SIZE, PRIOR_SIZE), np.nan),
    )
    run(
        kernels.rounds.run_windows, B, problem.arrays(), start, tuple(insets),
        ExpectedArrays(**columns), class_deviations(problem, config), shape, numbers, faces,
        results,
    )  # fmt: skip
    x, is_done, links, border, corner, *prior = map(torch.from_numpy, results)
    return Fit(
        State.unpack(x, N),
        is_done,
        FaceObservations(*map(torch.from_numpy, faces)),
        InverseBlocks(links, border, corner),
        MarginalPrior(*prior) if num_priors else None,
    )


def _search_numbers(plan: Plan, turn: int, config: Config) -> SearchNumbers:
    return SearchNumbers(
        iterations=config.solver.iterations,
        history=lbfgs.HISTORY if config.solver.iterations > 1 else 0,
        tolerance=config.solver.tolerance,
        sufficient_decrease=lbfgs.SUFFICIENT_DECREASE,
        min_curvature=lbfgs.MIN_CURVATURE,
        step_bounds=lbfgs.STEP_BOUNDS,
        max_backtracks=lbfgs.MAX_BACKTRACKS,
        settled_step=SETTLED_STEP,
        may_settle=turn > 0,
        is_last=turn + 1 >= plan.rounds,
    )


def run_round_torch(
    part: Round, offsets: FaceOffsets, plan: Plan, turn: int, config: Config
) -> Fit:
    """Take a round by torch."""
    problem, state, expected, free, _ = part
    observations = observe_faces(problem, state, offsets, config)
    weighted = _weighted_terms(problem, state, expected, observations, plan, turn, config)
    x = state.pack()
    objective = Objective(weighted, x, problem.length, free)
    limits = config.solver.iterations, lbfgs.HISTORY, config.solver.tolerance
    found = State.unpack(minimize(objective, x, *limits, objective.newton).x, problem.length)
    step = (found.pose - state.pose) / problem.of_class(*POSE_ERRORS)[:, None]
    moved = step.square().mean(2).amax(1)
    is_done = (moved <= SETTLED_STEP**2) & (turn > 0) | (turn + 1 >= plan.rounds)
    inverse = InverseBlocks(
        x.new_zeros(*problem.valid.shape, LINK, LINK),
        x.new_zeros(*problem.valid.shape, LINK, SHARED),
        torch.cholesky_inverse(objective.factor.corner),
    )
    prior = None
    if is_done.any():
        factor = select(objective.factor, is_done.nonzero()[:, 0])
        for whole, part_of_done in zip(
            inverse, factor.inverse_blocks(problem.length), strict=True
        ):
            whole[is_done] = part_of_done
        if plan.marginalises and problem.length == config.window:
            prior = _prior_of_full(weighted, found, problem)
    return Fit(found, is_done, observations, inverse, prior)


def _is_smooth(plan: Plan, turn: int) -> bool:
    """Return whether motion terms are robust: at first a cold window moves as its noisy input."""
    return turn > 0 or plan.starts_from_fit


def _uses_rigid_shape(plan: Plan, turn: int) -> bool:
    return turn > 0 and plan.uses_rigid_shape


def _weighted_terms(
    problem: Problem,
    state: State,
    expected: Expectation,
    observations: FaceObservations,
    plan: Plan,
    turn: int,
    config: Config,
) -> list[Term]:
    """Return the terms of one round: weights, robust motion, rigid shape."""
    weighted = weigh(problem, state, observations, expected, config)
    # Terms without any weight, such as zero motion, are dropped (`any` takes three times as long).
    weighted = [term for term in weighted if term.weight.norm()]
    if _is_smooth(plan, turn) and config.ingredients.robust_motion:
        weighted = [
            robustify_motion(term, state) if term.function in MOTION_TERMS else term
            for term in weighted
        ]
    if _uses_rigid_shape(plan, turn):
        information, wanted = agreement(problem.thinned(SHAPE_POINTS), state)
        data = state.pose, wanted
        weighted.append(Term(terms.rigid_shape, information[:, :, None], data))
    return weighted


def _prior_of_full(weighted: list[Term], found: State, problem: Problem) -> MarginalPrior:
    """Return the prior of the windows after full ones, NaN for those that are padded."""
    prior = marginalise(weighted, found)
    is_padded = ~problem.valid.all(1)
    prior.state[is_padded] = torch.nan
    prior.step[is_padded] = torch.nan
    return prior
