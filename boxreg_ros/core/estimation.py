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
from boxreg_ros.core.problem import group_windows, Problem, stack_windows
from boxreg_ros.core.solver import solve
from boxreg_ros.core.threads import one_torch_thread, run, shared_between
from boxreg_ros.core.window import Estimate, Estimates, MarginalisationPrior, Window
from boxreg_ros.reasons import Reason
from boxreg_ros.structures import Floats, Ints, KEPT, KINEMATICS, REFINED, ROLL
import numpy as np

KEPT_REASONS = np.array(
    ['', Reason.NO_POINTS, Reason.NOT_FINITE, Reason.NO_GAIN, Reason.NOT_RIGID], np.str_
).astype(object)
"""Why a box is kept, by the results of the acceptance tests."""
STATUS = np.array([REFINED, *[KEPT] * (len(KEPT_REASONS) - 1)], object)
"""The status of a box by the same."""
MARGIN_OBSERVATIONS = 30
"""Observations of a window that give labelling margins; measured: 130 add nothing."""


@one_torch_thread()
def estimate_windows(
    windows: list[Window], config: Config, model: InputModel
) -> list[Estimate | None]:
    """
    Refine the boxes of many windows, each of its own track.

    Parameters
    ----------
    windows : list of Window
        In the fixed frame.
    config : Config
        Settings.
    model : InputModel
        Its labelling margins and its noise of the input are updated: first with the new
        observations, then with the fits.

    Returns
    -------
    estimates : list of Estimate or None
        In the order of `windows`, boxes in the fixed frame [m, rad]; None for those with fewer
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
        for rows, part, (problem, priors) in zip(groups, parts, problems, strict=True):
            if config.objective == 'paper':
                solution = solve_paper(problem, config)
            else:
                observe = partial(_update_margins, model, part, problem, config)
                solution = solve(problem, config, model, inputs, part[0].is_warm, observe)
                _update_noise(model, part, problem, solution, config)
            found = _accepted(part, problem, priors, solution, config, model.constants)
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
    first, step, counts = margin_columns(windows, problem.lengths)
    new = counts.nonzero()[0]
    if not len(new):
        return
    is_input = poses is None and config.estimate == 'track'
    if poses is not None:
        start = np.concatenate([problem.start[..., :ROLL], poses[..., 3:]], axis=-1)
        problem = problem._replace(start=start)
    problem = problem.part(new, first[new], step[new], counts[new])
    at = np.concatenate([problem.boxes[..., :3], problem.start[..., ROLL:]], axis=-1)
    track_ids = [windows[row].track_id for row in new.tolist()]
    model.observe_margins(track_ids, problem, at, config, is_input)


def margin_columns(windows: Sequence[Window], lengths: Ints) -> tuple[Ints, Ints, Ints]:
    """
    Return which observations give labelling margins; each does so in one window only.

    Of each window of `lengths` (B,) the first one, every which one, and how many, (B,) each. The
    newest is left to the next window, which has an estimate to start from. Of many, every n-th is
    taken so that about `MARGIN_OBSERVATIONS` remain.

    """
    num_new = np.array([window.num_new for window in windows])
    last = lengths - 1
    first = np.maximum(0, last - num_new)
    step = 1 + num_new // MARGIN_OBSERVATIONS
    return first, step, -((first - last) // step)


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
    row, last = np.arange(len(best))[:, None], np.maximum(best, 0)[:, None]
    column = np.concatenate([last - 1, last], axis=1)
    pair = problem._replace(boxes=problem.boxes[row, column], counts=problem.counts[row, column])
    extents = solution.shared[:, EXTENT:BIAS]
    residuals = normalised_residuals(pair, solution.poses[row, column], extents)[:, 1]
    # Each box counts once. The first one stays the best of its window as long as this grows.
    residuals[best < 0] = np.nan
    track_ids = [window.track_id for window in windows]
    model.add_fits(track_ids, problem.kind, residuals, solution.evidence)


def _accepted(
    windows: Sequence[Window],
    problem: Problem,
    priors: MarginalisationPrior,
    solution: Solution,
    config: Config,
    constants: Constants,
) -> list[Estimate]:
    """
    Return the estimate of each window in the fixed frame, after the acceptance tests (M27).

    The base of its `priors` (B, 3) is the origin of the centres of `problem` [m].

    """
    poses, valid = solution.poses, problem.valid
    covariances, extent_covariances, distances, kinematics = solution.posterior
    extent = problem.boxes[..., 3:6]
    if config.extent == 'track':
        extent = np.repeat(solution.shared[:, None, EXTENT:BIAS], problem.length, axis=1)
    tested = Tested(
        np.empty(valid.shape, np.int8), np.empty((*valid.shape, 9)),
        np.empty((*valid.shape, 2), np.int64),
        priors.extent_range,
        np.empty(len(valid), bool),
    )  # fmt: skip
    run(
        accept, 5, len(valid), problem, priors.base, np.ascontiguousarray(poses),
        np.ascontiguousarray(extent), covariances, SIDE_NOISE, config.window, constants.record(),
        tested,
    )  # fmt: skip
    is_kept = tested.results != ACCEPTED
    reasons, status = KEPT_REASONS[tested.results], STATUS[tested.results]
    found, near_points = tested.boxes, tested.near_points
    extent_covariances = np.repeat(extent_covariances[:, None], problem.length, axis=1)
    for b, i in np.transpose(is_kept.nonzero()).tolist():
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
    left = _priors_left(priors.base, problem, solution, tested)
    return list(map(Estimate, repeat(table), [0, *ends], ends, left))


def _priors_left(
    base: Floats, problem: Problem, solution: Solution, tested: Tested
) -> list[tuple[MarginalisationPrior, int] | None]:
    """Return the marginalisation prior that each window leaves, if it leaves one."""
    if not len(solution.left.state):
        return [None] * len(base)
    extents = problem.marginalised_extents.copy()
    extents[:, :3] += problem.boxes[:, 0, 3:6]
    extents[:, 3] += 1
    table = MarginalisationPrior(base, *solution.left, extents, tested.ranges)
    is_left = tested.is_finite & np.isfinite(solution.left.step).all(1)
    return [(table, row) if left else None for row, left in enumerate(is_left.tolist())]
