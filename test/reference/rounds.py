"""
One round of the solver: face observations, weights, and one minimisation.

A kernel takes the round, in one call for all windows, or its torch twin, the reference of the
tests.

"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import partial
from math import inf
from typing import NamedTuple

from boxreg_ros.config import Config
from boxreg_ros.core import lbfgs, terms
from boxreg_ros.core.arrowhead import InverseBlocks
from boxreg_ros.core.batch import (
    ANCHOR,
    MarginalPrior,
    POSE_ERRORS,
    PRIOR_SIZE,
    Problem,
    Solution,
    State,
)
from boxreg_ros.core.covariance import covariance_numbers, posterior
from boxreg_ros.core.expectation import (
    evidence_of_extents,
    expect,
    Expectation,
    expectation_numbers,
    InputEstimates,
    MIN_EXTENT_GAIN,
)
from boxreg_ros.core.face_support import (
    face_numbers,
    FaceObservations,
    observe_faces,
)
from boxreg_ros.core.kernels import compiled, contiguous
from boxreg_ros.core.kernels.arrays import (
    PosteriorArrays,
    PriorArrays,
    RoundNumbers,
    SearchNumbers,
    SolutionArrays,
)
from boxreg_ros.core.lbfgs import minimize, select
from boxreg_ros.core.prior import marginalise
from boxreg_ros.core.rigid_shape import agreement, shape_numbers
from boxreg_ros.core.terms import Objective, Term
from boxreg_ros.core.threads import one_torch_thread, run
from boxreg_ros.core.weights import (
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
class SolverPlan:
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
    def choose(cls, config: Config, is_warm: bool) -> 'SolverPlan':
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
    Data that all windows of a batch share in one round.

    Attributes
    ----------
    problem : Problem
        The windows, with the points of this round.
    solution : Solution
        Where the round begins; the round writes its end.
    inputs : InputEstimates
        Estimated errors of the input.
    free : Tensor, shape (B, D)
        1 for variables that are estimated.

    """

    problem: Problem
    solution: Solution
    inputs: InputEstimates
    free: Tensor

    @property
    def state(self) -> State:
        """Poses and shared variables at present."""
        return self.solution.state


@torch.inference_mode()
def run_round(batch: Round, plan: SolverPlan, turn: int, config: Config, rows: Tensor) -> Tensor:
    """
    Take one round with the windows `rows` (b,), and write its end to the solution of the batch.

    Returns which of these windows are done (b,): settled, or at the end of the last round. Only
    those have covariances and, if they are full, a prior for the next window.

    """
    by_kernel = compiled(batch.free) is not None
    take = run_round_compiled if by_kernel else run_round_torch
    return take(batch, plan, turn, config, rows)


def run_round_compiled(
    batch: Round, plan: SolverPlan, turn: int, config: Config, rows: Tensor
) -> Tensor:
    """Take a round by the kernel."""
    problem, solution, inputs, free = batch
    kernels = compiled(free)
    assert kernels is not None
    numbers = RoundNumbers(
        expectation_numbers(),
        face_numbers(problem, config),
        weight_numbers(config, _is_smooth(plan, turn)),
        shape_numbers(problem),
        _search_numbers(plan, turn, config),
        covariance_numbers(),
        MIN_EXTENT_GAIN,
    )
    prior = PriorArrays(
        contiguous(problem.prior_mean), contiguous(prior_information(problem, config))
    )
    is_done = np.empty(len(rows), bool)
    run(
        kernels.rounds.run_windows, len(rows), rows.numpy(), problem.arrays(),
        problem.thinned(SHAPE_POINTS).arrays(), inputs.arrays(), prior, contiguous(free),
        problem.class_arrays(), numbers,
        _solution_arrays(solution, plan.marginalises and config.window == problem.length), is_done,
    )  # fmt: skip
    return torch.from_numpy(is_done)


def _solution_arrays(solution: Solution, leaves_prior: bool) -> SolutionArrays:
    """Return the memory of a solution for the kernel, without prior if none is left."""
    prior = [np.empty((0, PRIOR_SIZE))] * 2 + [np.empty((0, PRIOR_SIZE, PRIOR_SIZE))]
    if leaves_prior and solution.prior is not None:
        prior = [part.numpy() for part in solution.prior]
    return SolutionArrays(
        solution.state.pose.numpy(),
        solution.state.shared.numpy(),
        solution.extent_evidence.numpy(),
        PosteriorArrays(*(part.numpy() for part in solution.posterior)),
        *prior,
    )


def _search_numbers(plan: SolverPlan, turn: int, config: Config) -> SearchNumbers:
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
        uses_shape=_uses_rigid_shape(plan, turn),
    )


@one_torch_thread()
def run_round_torch(
    batch: Round, plan: SolverPlan, turn: int, config: Config, rows: Tensor
) -> Tensor:
    """Take a round by torch."""
    solution = batch.solution
    problem, state, free, log_extent = select(
        (batch.problem, batch.state, batch.free, solution.extent_evidence[:, 0]), rows
    )
    expected = expect(problem, batch.inputs)
    shared = state.shared.clone()
    shared[:, ANCHOR] = 0.0
    state = State(state.pose, shared)
    observations = observe_faces(problem, state, batch.inputs.offsets, config)
    weighted = _weighted_terms(problem, state, expected, observations, plan, turn, config)
    x = state.pack()
    objective = Objective(weighted, x, problem.length, free)
    limits = config.solver.iterations, lbfgs.HISTORY, config.solver.tolerance
    found = State.unpack(minimize(objective, x, *limits, objective.newton).x, problem.length)
    step = (found.pose - state.pose) / problem.of_class(*POSE_ERRORS)[:, None]
    moved = step.square().mean(2).amax(1)
    is_done: Tensor = (moved <= SETTLED_STEP**2) & (turn > 0) | (turn + 1 >= plan.rounds)
    corner = torch.cholesky_inverse(objective.factor.corner)
    solution.state.pose[rows], solution.state.shared[rows] = found
    evidence = evidence_of_extents(log_extent, expected, found, corner)
    solution.extent_evidence[rows, 1:] = evidence
    done = is_done.nonzero()[:, 0]
    if len(done):
        ended = rows[done]
        inverse = InverseBlocks(*objective.factor.inverse_blocks(problem.length))
        of_done = partial(select, rows=done)
        covariances = posterior(
            of_done(problem), of_done(found), of_done(observations), of_done(expected),
            of_done(free), of_done(_shared_weight(weighted)), of_done(inverse), config,
        )  # fmt: skip
        _write(covariances, solution.posterior, ended)
        if plan.marginalises and problem.length == config.window and solution.prior is not None:
            prior = select(_prior_of_full(weighted, found, problem), done)
            _write(prior, solution.prior, ended)
    return is_done


def _write(parts: Iterable[Tensor], wholes: Iterable[Tensor], rows: Tensor) -> None:
    for part, whole in zip(parts, wholes, strict=True):
        whole[rows] = part


def _is_smooth(plan: SolverPlan, turn: int) -> bool:
    """Return whether motion terms are robust: at first a cold window moves as its noisy input."""
    return turn > 0 or plan.starts_from_fit


def _uses_rigid_shape(plan: SolverPlan, turn: int) -> bool:
    return turn > 0 and plan.uses_rigid_shape


def _weighted_terms(
    problem: Problem,
    state: State,
    expected: Expectation,
    observations: FaceObservations,
    plan: SolverPlan,
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


def _shared_weight(weighted: list[Term]) -> Tensor:
    """Return the weights of the shared variables (M22), shape (B, 23)."""
    (weight,) = (term.weight for term in weighted if term.function is terms.shared_prior)
    return weight[:, 0, 0].diagonal(dim1=1, dim2=2)


def _prior_of_full(weighted: list[Term], found: State, problem: Problem) -> MarginalPrior:
    """Return the prior of the windows after full ones, NaN for those that are padded."""
    prior = marginalise(weighted, found)
    is_padded = ~problem.valid.all(1)
    prior.state[is_padded] = torch.nan
    prior.step[is_padded] = torch.nan
    return prior
