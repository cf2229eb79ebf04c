"""
Windows in, refined boxes out: the method in one readable function.

    input boxes, points --> expectation --> face observations --> weights --> one minimisation
                                 ^                                                  |
                                 +------------------- not settled ------------------+
                                                                                    v
                                   input box kept <-- acceptance tests <-- refined boxes

The rounds are in `solver`, their parts in `method`, the search for the minimum in `lbfgs`. `paper`
has the published objective to the letter. docs/method.md has the formulas.

"""

from collections.abc import Sequence
from functools import partial
from itertools import repeat

from boxreg_ros.config import Config
from boxreg_ros.core.articulation import changes_shape, extent_ranges
from boxreg_ros.core.input_model import InputModel
from boxreg_ros.core.input_noise import normalised_residuals
from boxreg_ros.core.method.arrays import BIAS, EXTENT, Solution
from boxreg_ros.core.method.constants import CONSTANTS
from boxreg_ros.core.method.faces import count_held
from boxreg_ros.core.observation import SIDE_NOISE
from boxreg_ros.core.paper import solve_paper
from boxreg_ros.core.problem import group_windows, NO_RANGE, Problem, stack_windows
from boxreg_ros.core.solver import solve
from boxreg_ros.core.threads import one_torch_thread, run, shared_between
from boxreg_ros.core.window import Estimate, Estimates, MarginalisationPrior, Window
from boxreg_ros.reasons import Reason
from boxreg_ros.rotations import wrap_angle
from boxreg_ros.structures import Floats, Ints, KEPT, KINEMATICS, POSE, REFINED, ROLL
import numpy as np
from numpy.typing import NDArray

KEPT_REASONS = (Reason.NO_POINTS, Reason.NOT_FINITE, Reason.NO_GAIN, Reason.NOT_RIGID)
"""Why a box is kept, in the order of `_failed_tests`."""


@one_torch_thread()
def estimate_windows(
    windows: list[Window], config: Config, model: InputModel
) -> list[Estimate | None]:
    """
    Refine the boxes of many windows, each of its own track.

    The labelling margins and the noise of the input in `model` are updated: first with the new
    observations, then with the fits. Returned in the order of `windows`; None for those with fewer
    than `min_observations`.

    """
    estimates: dict[int, Estimate] = {}
    groups = group_windows(windows, config)
    if not groups:
        return [None] * len(windows)
    parts = [[windows[i] for i in rows] for rows in groups]
    decay = model.constants.prior_decay
    stacked = [stack_windows(part, config, decay) for part in parts]
    with shared_between(config.solver.threads):
        for part, (problem, _) in zip(parts, stacked, strict=True):
            _update_margins(model, part, problem, config)
        # Whole tracks show their own noise.
        inputs = model.inputs(config, with_noise=config.estimate != 'track')
        for rows, part, (problem, base) in zip(groups, parts, stacked, strict=True):
            if config.objective == 'paper':
                solution = solve_paper(problem, config)
            else:
                observe = partial(_update_margins, model, part, problem, config)
                solution = solve(problem, config, model, inputs, part[0].is_warm, observe)
                _update_noise(model, part, problem, solution, config)
            found = _accepted(part, problem, base, solution, config, model.constants.max_lost_part)
            estimates.update(zip(rows, found, strict=True))
    return [estimates.get(i) for i in range(len(windows))]


def _update_margins(
    model: InputModel,
    windows: Sequence[Window],
    problem: Problem,
    config: Config,
    poses: Floats | None = None,
) -> None:
    """
    Update the labelling margins with the faces of new observations at their input boxes.

    `problem` has the `windows`. The angles are those of `poses` (B, N, 6), or of the start, as far
    as there is an earlier estimate: the outermost points of a box with a wrong yaw are its
    corners, further outside. Whole tracks have none: those of the input are replaced later.

    """
    columns = [window.margin_columns() for window in windows]
    new = [row for row, part in enumerate(columns) if part]
    if not new:
        return
    is_input = poses is None and config.estimate == 'track'
    if poses is not None:
        start = np.concatenate([problem.start[..., :ROLL], poses[..., 3:]], axis=-1)
        problem = problem._replace(start=start)
    problem = problem.part(new, [columns[row] for row in new])
    at = np.concatenate([problem.boxes[..., :3], problem.start[..., ROLL:]], axis=-1)
    track_ids = [windows[row].track_id for row in new]
    model.observe_margins(track_ids, problem, at, config, is_input)


def _update_noise(
    model: InputModel,
    windows: Sequence[Window],
    problem: Problem,
    solution: Solution,
    config: Config,
) -> None:
    """Update the noise with the best fit of each window, `lag` from its end, and its extents."""
    lag = min(config.lag, config.window - 1)
    best = problem.lengths - 1 - lag
    extents = solution.shared[:, EXTENT:BIAS]
    every = normalised_residuals(problem, solution.poses, extents)
    residuals = every[np.arange(len(best)), best.clip(0)]
    # Each box counts once. The first one stays the best of its window as long as this grows.
    residuals[best < 0] = np.nan
    track_ids = [window.track_id for window in windows]
    model.add_fits(track_ids, problem.kind, residuals, solution.evidence)


def _accepted(
    windows: Sequence[Window],
    problem: Problem,
    base: Floats,
    solution: Solution,
    config: Config,
    max_lost_part: float,
) -> list[Estimate]:
    """
    Return the estimate of each window in the fixed frame, after the acceptance tests.

    `base` (B, 3) is the origin of the centres of `problem` [m].

    """
    poses, valid = solution.poses, problem.valid
    covariances, extent_covariances, distances, kinematics = solution.posterior
    extent = problem.boxes[..., 3:6]
    if config.extent == 'track':
        extent = np.repeat(solution.shared[:, None, EXTENT:BIAS], problem.length, axis=1)
    held = _held(problem, poses, extent)
    found = np.concatenate([poses[..., :3], extent, wrap_angle(poses[..., 3:])], -1)
    is_finite = np.isfinite(found).all(-1) & (extent > 0).all(-1)
    is_finite &= np.isfinite(covariances).all((2, 3))
    past = [window.prior.extent_range if window.prior else NO_RANGE for window in windows]
    ranges = extent_ranges(problem, np.array(past), config.window)
    is_bent = changes_shape(ranges, problem.of_class['extent'])
    priors = _priors(base, problem, solution, is_finite.all(1), ranges)
    failed = _failed_tests(problem, is_finite, held, is_bent, max_lost_part)
    is_kept = failed.any(0)
    reasons = np.select(failed, KEPT_REASONS, '')
    status = np.where(is_kept, KEPT, REFINED)
    found[..., :3] += base[:, None]
    near_points = np.stack([held, problem.counts - held], -1)
    extent_covariances = np.repeat(extent_covariances[:, None], problem.length, axis=1)
    for b, i in np.argwhere(valid & is_kept).tolist():
        found[b, i] = windows[b].observations[i].box
        covariances[b, i] = np.eye(6)
        extent_covariances[b, i] = np.eye(3)
        distances[b, i] = 0.0
        near_points[b, i] = 0
        kinematics[b, i] = np.zeros((), KINEMATICS)
    columns = (
        found, status, reasons, covariances, extent_covariances, distances, near_points,
        kinematics,
    )  # fmt: skip
    flat = (part.reshape(-1, *part.shape[2:]) for part in columns)
    table = Estimates(*(flat if valid.all() else (part[valid.ravel()] for part in flat)))
    ends = np.cumsum(problem.lengths).tolist()
    return list(map(Estimate, repeat(table), [0, *ends], ends, priors))


def _failed_tests(
    problem: Problem,
    is_finite: NDArray[np.bool_],
    held: Ints,
    is_bent: NDArray[np.bool_],
    max_lost_part: float,
) -> NDArray[np.bool_]:
    """
    Return the acceptance tests that each refined box fails (M27), shape (4, B, N).

    The tests, in the order of `KEPT_REASONS`: the window has points; box and covariance are finite
    and the extent is positive; the refined box holds nearly as many points, `held` (B, N), as the
    input box, which the objective does not require; the body keeps its shape, as the objective
    assumes, and is not `is_bent` (B,).

    """
    before = problem.counts  # at most: counting those of the input boxes takes time
    least = (1 - max_lost_part) * before - CONSTANTS.min_face_points
    if (held < least).any():
        extent = np.ascontiguousarray(problem.boxes[..., 3:6])
        before = _held(problem, problem.boxes[..., POSE], extent)
        least = (1 - max_lost_part) * before - CONSTANTS.min_face_points
    failed = np.empty((len(KEPT_REASONS), *held.shape), bool)
    failed[0] = problem.counts.sum(1, keepdims=True) == 0
    failed[1] = ~is_finite
    failed[2] = held < least
    failed[3] = is_bent[:, None]
    return failed


def _held(problem: Problem, poses: Floats, extent: Floats) -> Ints:
    """Return how many points are in boxes at `poses` (B, N, 6) of `extent` (B, N, 3), (B, N)."""
    held = np.zeros(problem.counts.shape, np.int64)
    contiguous = np.ascontiguousarray(poses), np.ascontiguousarray(extent)
    run(count_held, len(held), problem, *contiguous, SIDE_NOISE, held)
    return held


def _priors(
    base: Floats,
    problem: Problem,
    solution: Solution,
    is_solved: NDArray[np.bool_],
    ranges: Floats,
) -> list[MarginalisationPrior | None]:
    """Return the marginalisation prior that each window leaves, if it leaves one."""
    state, step, information = solution[-3:]
    if not len(state):
        return [None] * len(base)
    first = np.concatenate([problem.boxes[:, 0, 3:6], np.ones((len(base), 1))], axis=1)
    extents = problem.marginalised_extents + first
    has_prior = is_solved & np.isfinite(step).all(1)
    return [
        MarginalisationPrior(base[b], state[b], step[b], information[b], extents[b], ranges[b])
        if has_prior[b]
        else None
        for b in range(len(base))
    ]
