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
from boxreg_ros.core.input_model import InputModel
from boxreg_ros.core.input_noise import normalised_residuals
from boxreg_ros.core.method.acceptance import accept, ACCEPTED, Tested
from boxreg_ros.core.method.arrays import BIAS, EXTENT, Solution
from boxreg_ros.core.method.constants import Constants
from boxreg_ros.core.observation import SIDE_NOISE
from boxreg_ros.core.paper import solve_paper
from boxreg_ros.core.problem import group_windows, NO_RANGE, Problem, stack_windows
from boxreg_ros.core.solver import solve
from boxreg_ros.core.tables import stacked
from boxreg_ros.core.threads import one_torch_thread, run, shared_between
from boxreg_ros.core.window import Estimate, Estimates, MarginalisationPrior, Window
from boxreg_ros.reasons import Reason
from boxreg_ros.rotations import wrap_angle
from boxreg_ros.structures import BOX_EXTENT, Floats, KEPT, KINEMATICS, REFINED, ROLL
import numpy as np
from numpy.typing import NDArray

KEPT_REASONS = np.array(
    ['', Reason.NO_POINTS, Reason.NOT_FINITE, Reason.NO_GAIN, Reason.NOT_RIGID], np.str_
)
"""Why a box is kept, by the results of the acceptance tests."""
STATUS = np.array([REFINED, *[KEPT] * (len(KEPT_REASONS) - 1)], np.str_)
"""The status of a box by the same."""


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
    problems = [stack_windows(part, config, decay) for part in parts]
    with shared_between(config.solver.threads):
        for part, (problem, _) in zip(parts, problems, strict=True):
            _update_margins(model, part, problem, config)
        # Whole tracks show their own noise.
        inputs = model.inputs(config, with_noise=config.estimate != 'track')
        for rows, part, (problem, base) in zip(groups, parts, problems, strict=True):
            if config.objective == 'paper':
                solution = solve_paper(problem, config)
            else:
                observe = partial(_update_margins, model, part, problem, config)
                solution = solve(problem, config, model, inputs, part[0].is_warm, observe)
                _update_noise(model, part, problem, solution, config)
            found = _accepted(part, problem, base, solution, config, model.constants)
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
    constants: Constants,
) -> list[Estimate]:
    """
    Return the estimate of each window in the fixed frame, after the acceptance tests (M27).

    `base` (B, 3) is the origin of the centres of `problem` [m].

    """
    poses, valid = solution.poses, problem.valid
    covariances, extent_covariances, distances, kinematics = solution.posterior
    extent = problem.boxes[..., 3:6]
    if config.extent == 'track':
        extent = np.repeat(solution.shared[:, None, EXTENT:BIAS], problem.length, axis=1)
    tested = Tested(
        np.empty(valid.shape, np.int8), np.empty(valid.shape, np.int64),
        stacked([w.prior.extent_range if w.prior else NO_RANGE for w in windows]),
        np.empty(len(valid), bool),
    )  # fmt: skip
    run(
        accept, 5, len(valid), problem, np.ascontiguousarray(poses), np.ascontiguousarray(extent),
        covariances, SIDE_NOISE, config.window, constants.record(), tested,
    )  # fmt: skip
    priors = _priors(base, problem, solution, tested.is_finite, tested.ranges)
    is_kept = tested.results != ACCEPTED
    reasons, status = KEPT_REASONS[tested.results], STATUS[tested.results]
    found = np.empty((*valid.shape, 9))
    found[..., :3] = poses[..., :3] + base[:, None]
    found[..., BOX_EXTENT] = extent
    found[..., ROLL:] = wrap_angle(poses[..., 3:])
    near_points = np.empty((*valid.shape, 2), np.int64)
    near_points[..., 0] = tested.held
    near_points[..., 1] = problem.counts - tested.held
    extent_covariances = np.repeat(extent_covariances[:, None], problem.length, axis=1)
    for b, i in np.argwhere(is_kept).tolist():
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
    columns = zip(base, state, step, information, extents, ranges, strict=True)
    return [
        MarginalisationPrior(*column) if is_left else None
        for column, is_left in zip(columns, has_prior.tolist(), strict=True)
    ]
