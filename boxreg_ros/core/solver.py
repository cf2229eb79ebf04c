"""
The solver of the default objective: rounds of expectation, face observations, weights and L-BFGS.

As in ICP, correspondences and weights are renewed in every round and held while the sum (M1) is
minimised. How many rounds there are, and what they use, is a `SolverPlan`, chosen once per batch.

"""

from collections.abc import Callable
from math import ceil
from typing import NamedTuple

from boxreg_ros.config import Config
from boxreg_ros.core.input_model import InputModel, Inputs
from boxreg_ros.core.input_noise import normalised_residuals
from boxreg_ros.core.lbfgs import HISTORY, minimize
from boxreg_ros.core.method import round as method
from boxreg_ros.core.method.arrays import (
    ANCHOR,
    BIAS,
    EXTENT,
    no_priors,
    Posterior,
    SHARED,
    Solution,
)
from boxreg_ros.core.method.constants import Constants
from boxreg_ros.core.method.faces import observe_faces
from boxreg_ros.core.method.rigid_shape import observe_shapes
from boxreg_ros.core.problem import Problem
from boxreg_ros.core.threads import num_workers, run, shared_between
from boxreg_ros.structures import Floats, Ints, KINEMATICS, POSE
import numpy as np
from numpy.typing import NDArray
import torch
from torch import Tensor

TOLERANCE = 0.05
"""Predicted relative decrease of the sum that ends the search of a round. Chosen: the next round
renews the weights anyway."""
ITERATIONS = 2
"""Most L-BFGS iterations of a round. Measured: rounds of 1 and of 4 are as accurate, in the same
time."""
NOISE_ROUNDS = 2
"""First rounds of a whole track whose residuals give the input noise. Chosen: later fits follow
the input, and the noise would be estimated smaller in every round."""
POSES_AT_ONCE = 960
"""Most poses, or those of one window, that a thread takes through the steps of a round together,
so that their data stay in the nearer caches of the processor. Measured: a sweep of 512 tracks, of
ten poses each, took 0.89 of the time, as it did with 640 and with 1,280."""


class SolverPlan(NamedTuple):
    """How a batch is solved."""

    rounds: int
    """Most rounds."""
    starts_from_fit: bool = False
    """Whether the start is the fit of the tick before: faces are judged by its extents, and its
    motion is good enough for robust weights in the first round."""
    uses_rigid_shape: bool = False
    """Whether observations are tied by the rigid shape of their track, from the second round
    on."""
    estimates_noise: bool = False
    """Whether the noise of the input is estimated from this batch and not taken from the model."""
    marginalises: bool = False
    """Whether full windows leave a prior to the next ones."""

    @classmethod
    def choose(cls, config: Config, is_warm: bool) -> 'SolverPlan':
        """
        Return the plan for windows that are warm: all but their newest box have been solved.

        A warm window takes one round, a cold one as many as it needs. For whole tracks noise comes
        from the batch: the model has one residual a window of theirs, seconds apart, from which no
        correlation can be estimated.

        """
        plan = cls(1, starts_from_fit=True) if is_warm else cls(config.solver.rounds)
        if config.estimate == 'track':
            return plan._replace(uses_rigid_shape=True, estimates_noise=True)
        return plan._replace(marginalises=True)


class Batch(NamedTuple):
    """Windows that are being solved."""

    problem: Problem
    free: Floats
    """(B, 6 N + S), 1 for variables that are estimated."""
    mean_extents: Floats
    """(B, 3), of the input [m]."""
    solution: Solution
    """Where the round begins; the round writes its end."""


def solve(
    problem: Problem,
    config: Config,
    model: InputModel,
    inputs: Inputs,
    is_warm: bool,
    observe_margins: Callable[[Floats], None] | None = None,
) -> Solution:
    """
    Minimise the robust objective (M1) of a batch: rounds until every window is settled.

    Settled windows take no part in further rounds. Within a round windows do not depend on each
    other: threads share them.

    Parameters
    ----------
    problem : Problem
        B windows, all warm or all cold.
    config : Config
        Settings.
    model : InputModel
        Has the constants of the method, and what it estimates of the errors of the input. That is
        updated with the noise of whole tracks.
    inputs : Inputs
        These errors, where the rounds begin.
    is_warm : bool
        Whether all boxes but the newest start from an earlier fit.
    observe_margins : callable, optional
        Called with the poses (B, N, 6) of whole tracks after their first round: it adds what these
        show of the labelling margins.

    Returns
    -------
    solution : Solution
        Poses, shared variables and covariances; for sliding windows also the prior of the next
        ones.

    """
    constants = model.constants.with_settings(config)
    plan = SolverPlan.choose(config, is_warm)
    batch = start(problem, config, plan, inputs)
    rows, turn = np.arange(len(batch.free)), 0
    with shared_between(config.solver.threads):
        while len(rows):
            is_done = run_round(batch, inputs, rows, plan, turn, config, constants)
            rows = rows[~is_done]
            turn += 1
            if plan.estimates_noise:
                evidence, kind = batch.solution.evidence, problem.kind
                if turn > NOISE_ROUNDS:
                    model.set_population(inputs, config, evidence, kind)
                    continue
                if turn == 1 and observe_margins:
                    observe_margins(batch.solution.poses)
                extents = batch.solution.shared[:, EXTENT:BIAS]
                residuals = normalised_residuals(problem, batch.solution.poses, extents)
                if turn == NOISE_ROUNDS:
                    model.add_noise(residuals, kind)
                inputs = model.inputs(config, fits=(residuals, evidence, kind))
    model.latest = inputs
    return batch.solution


def start(problem: Problem, config: Config, plan: SolverPlan, inputs: Inputs) -> Batch:
    """Return a batch where the first round starts, without covariances and prior."""
    B, N = problem.counts.shape
    number = SHARED if plan.uses_rigid_shape else ANCHOR
    free = problem.free_variables(config, number)
    shared = problem.expected_shared(inputs, number)
    mean_extents = shared[:, EXTENT:BIAS].copy()
    evidence = np.zeros((B, 3, 3))
    evidence[:, 0] = np.log(mean_extents)
    if plan.starts_from_fit:
        is_free = free[:, -number:][:, EXTENT:BIAS]
        shared[:, EXTENT:BIAS] += is_free * (problem.start[:, 0, 3:6] - shared[:, EXTENT:BIAS])
    leaving = B if plan.marginalises and config.window == N else 0
    solution = Solution(
        problem.start[..., POSE].copy(), shared, evidence,
        Posterior(
            np.zeros((B, N, 6, 6)), np.zeros((B, 3, 3)), np.zeros((B, N, 6)),
            np.zeros((B, N), KINEMATICS),
        ),
        no_priors(leaving),
    )  # fmt: skip
    return Batch(problem, free, mean_extents, solution)


def run_round(
    batch: Batch,
    inputs: Inputs,
    rows: Ints,
    plan: SolverPlan,
    turn: int,
    config: Config,
    constants: Constants,
) -> NDArray[np.bool_]:
    """
    Take one round with the windows `rows` (b,), and write its end to the solution of the batch.

    Returns which of these windows are done (b,): settled, or at the end of the last round. Only
    those have covariances and, if they are full, a prior for the next window.

    """
    uses_shape = plan.uses_rigid_shape and turn > 0
    is_smooth = turn > 0 or plan.starts_from_fit
    constants = constants.in_round(uses_shape, is_smooth)
    ends = turn + 1 >= plan.rounds, turn > 0
    is_done = []
    at_once = max(1, POSES_AT_ONCE * num_workers() // batch.problem.length)
    for part in np.array_split(rows, ceil(len(rows) / at_once)):
        sums = observe(batch, inputs, part, constants)
        is_done.append(fit(batch, sums, inputs, constants, *ends))
    return np.concatenate(is_done)


def observe(batch: Batch, inputs: Inputs, rows: Ints, constants: Constants) -> method.Sums:
    """Return what the points show of the windows `rows` (b,) where the round begins."""
    problem, solution = batch.problem, batch.solution
    sums = method.empty_sums(rows, problem.length, batch.free.shape[1])
    record, at = constants.record(), (solution.poses, solution.shared)
    run(observe_faces, 40, len(rows), rows, problem, *at, inputs, record, sums.terms)
    if constants.uses_shape:
        thinned = problem.thinned(constants.shape_points)
        run(observe_shapes, 20, len(rows), rows, thinned, *at, record, sums.terms)
    return sums


@torch.inference_mode()
def fit(
    batch: Batch,
    sums: method.Sums,
    inputs: Inputs,
    constants: Constants,
    is_last: bool,
    may_settle: bool,
) -> NDArray[np.bool_]:
    """Search the minima of the windows of `sums`, which `observe` has made; end their round."""
    rows = np.arange(len(sums.windows))
    objective = Objective(batch, sums, inputs, constants.record(), rows)
    x = search(objective)
    is_done = end(objective, x, is_last, may_settle)
    if len(batch.solution.left.state):
        is_leaving = is_done & (batch.problem.lengths[sums.windows] == batch.problem.length)
        leaving = objective._replace(rows=rows[is_leaving])
        leaving.sum(x[None, is_leaving], method.OLDEST)
    return is_done


def search(objective: 'Objective') -> Floats:
    """Begin the round of the windows of an objective; return their minima (b, D)."""
    x = np.empty((2, len(objective.rows), objective.batch.free.shape[1]))
    start, trial = zip(torch.from_numpy(x), *objective.sum(x, method.START), strict=True)
    found = minimize(objective.at, start[0], ITERATIONS, HISTORY, TOLERANCE, start[1:], trial)
    minima: Floats = found.x.numpy()
    return minima


def end(objective: 'Objective', x: Floats, is_last: bool, may_settle: bool) -> NDArray[np.bool_]:
    """End the round of the windows of an objective at x (b, D); return which are done."""
    batch, sums, _, constants, rows = objective
    is_done = np.empty(len(rows), bool)
    run(
        method.end, 20, len(rows), x, batch, sums, constants, is_last, may_settle, is_done,
    )  # fmt: skip
    return is_done


class Objective(NamedTuple):
    """The sums of some windows of a round, `rows` (b,) of these, as `minimize` calls them."""

    batch: Batch
    sums: method.Sums
    inputs: Inputs
    constants: NDArray[np.void]
    rows: Ints

    def at(self, x: Tensor, part: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return what `sum` does, of the windows `rows[part]` at x (b, D)."""
        found = self._replace(rows=self.rows[part.numpy()]).sum(x.contiguous().numpy()[None])
        value, gradient, scaled = (of_points[0] for of_points in found)
        return value, gradient, scaled

    def sum(self, x: Floats, wanted: int = method.VALUE) -> tuple[Tensor, Tensor, Tensor]:
        """
        Return values (p, b), gradients (p, b, D), and the inverse curvature times these.

        At points x (p, b, D), see `evaluate`; what else is `wanted` is written to the batch.

        """
        value, gradient, scaled = np.empty(x.shape[:2]), np.empty(x.shape), np.empty(x.shape)
        run(
            method.evaluate, 8, len(self.rows), self.rows, wanted, self.batch, self.sums,
            self.inputs, self.constants, x, value, gradient, scaled,
        )  # fmt: skip
        return torch.from_numpy(value), torch.from_numpy(gradient), torch.from_numpy(scaled)
