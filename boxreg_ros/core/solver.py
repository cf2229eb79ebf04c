"""
The solver of the default objective: rounds of expectation, observation, weighting and L-BFGS.

As in ICP, correspondences and weights are renewed in every round and held while the sum is
minimised. How many rounds there are, and what they use, is a `SolverPlan`, chosen once per batch.

"""

from functools import partial
from math import inf

from boxreg_ros.config import Config
from boxreg_ros.core.batch import (
    EXTENT,
    free_variables,
    MarginalPrior,
    Posterior,
    Problem,
    SHARED,
    Solution,
    State,
)
from boxreg_ros.core.expectation import InputEstimates, shared_without_population
from boxreg_ros.core.face_support import FaceOffsets
from boxreg_ros.core.input_model import InputModel
from boxreg_ros.core.input_noise import InputNoise, normalised_residuals, UNKNOWN_NOISE
from boxreg_ros.core.kernels import compiled
from boxreg_ros.core.population import UNKNOWN_POPULATION
from boxreg_ros.core.rounds import Round, run_round, SolverPlan
from boxreg_ros.core.threads import mapped, num_workers, shared_between
from boxreg_ros.structures import POSE
import torch
from torch import Tensor
from torch.nn.functional import pad

# Constants whose origin is not stated are chosen; `boxreg bench sensitivity` halves and doubles
# each of them.
NOISE_ROUNDS = 2
"""First rounds of a whole track whose residuals give the input noise. Later fits follow the
input: the noise would be estimated smaller in every round."""
OBSERVATIONS_PER_THREAD = 2500
"""Observations that a thread solves at once: more save calls, fewer save memory traffic."""


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
    plan = SolverPlan.choose(config, is_warm)
    learns_noise = config.ingredients.noise_estimation
    learns_extents = config.ingredients.population_extents
    noise = model.noise() if learns_noise and not plan.estimates_noise else UNKNOWN_NOISE
    population = model.population() if learns_extents else UNKNOWN_POPULATION
    inputs = InputEstimates(model.offsets(), noise, population, model.gap_scatter())
    free = free_variables(problem, config)
    solution = start(problem, free, inputs.offsets, plan)
    every = torch.arange(len(free), device=free.device)
    rows, turn, points = every, 0, plan.coarse_points
    with shared_between(config.solver.threads):
        while len(rows):
            batch = Round(problem.thinned(points), solution, inputs, free)
            work = partial(run_round, batch, plan, turn, config)
            is_done = mapped(work, _split(rows, problem.length))
            rows = rows[~torch.cat(is_done)]
            turn += 1
            if plan.estimates_noise and learns_noise and turn <= NOISE_ROUNDS:
                residuals = normalised_residuals(problem, solution.state)
                noise = InputNoise.estimate_by_kind(residuals, problem.kind)
                inputs = inputs._replace(noise=noise)
            if plan.estimates_noise and learns_extents:
                joined = population.joined(solution.extent_evidence, problem.kind)
                inputs = inputs._replace(population=joined)
            if not len(rows) and 2 * points <= problem.returns.width:
                rows, points = every, inf  # settled on few points: once more with all
    return solution


def start(problem: Problem, free: Tensor, offsets: FaceOffsets, plan: SolverPlan) -> Solution:
    """Return the state that the first round starts from, without covariances and prior."""
    pose = problem.start[..., POSE].contiguous()  # a copy
    shared = shared_without_population(problem, offsets)
    log_extent = shared[:, EXTENT].log()
    if plan.starts_from_fit:
        shared[:, EXTENT].lerp_(problem.start[:, 0, 3:6], free[:, -SHARED:][:, EXTENT])
    prior = extents = None
    if plan.marginalises:
        unknown = torch.full_like(problem.prior_mean, torch.nan)
        information = torch.empty_like(problem.prior_information)  # without a step, of no use
        prior = MarginalPrior(unknown, unknown.clone(), information)
        first = pad(problem.boxes[:, 0, 3:6], (0, 1), value=1.0)
        extents = problem.marginalised_extents + first
    evidence = pad(log_extent[:, None], (0, 0, 0, 2))  # (B, 3, 3)
    return Solution(State(pose, shared), Posterior.zeros(pose), prior, extents, evidence)


def _split(rows: Tensor, length: int) -> tuple[Tensor, ...]:
    """
    Return parts of `rows` for threads, windows of `length` each.

    One on a GPU, where the kernels share windows by themselves, and for few observations.

    """
    size = OBSERVATIONS_PER_THREAD / length
    if compiled(rows) is not None or not rows.is_cpu or len(rows) <= size:
        return (rows,)
    parts = num_workers() * int(1 + len(rows) / size / num_workers())
    return rows.tensor_split(min(len(rows), parts))
