"""
Windows in, refined boxes out: the method in one readable function.

    input boxes, points --> expectation --> face observations --> weights --> one minimisation
                                 ^                                                  |
                                 +------------------- not settled ------------------+
                                                                                    v
                                   input box kept <-- acceptance tests <-- refined boxes

The rounds are in `solver`, their parts in `expectation`, `face_support` (face
observations), `weights`, and `lbfgs` with `terms` (minimisation). `paper` has the published
objective to the letter. docs/method.md has the formulas.

"""

from collections.abc import Sequence
from itertools import repeat

from boxreg_ros.config import Config
from boxreg_ros.core.batch import EXTENT, Problem, Solution, State
from boxreg_ros.core.expectation import shared_without_population
from boxreg_ros.core.face_support import motion_compensated, observe_faces, to_box_frame
from boxreg_ros.core.input_model import InputModel
from boxreg_ros.core.input_noise import residuals_at
from boxreg_ros.core.kernels import compiled, contiguous
from boxreg_ros.core.paper import solve_paper
from boxreg_ros.core.rounds import COARSE_POINTS
from boxreg_ros.core.smoothing import smoothed_angles
from boxreg_ros.core.solver import solve
from boxreg_ros.core.threads import one_torch_thread, run, shared_between
from boxreg_ros.core.track_window import Estimate, Estimates, MarginalisationPrior, Window
from boxreg_ros.core.window import group_windows, stack_windows
from boxreg_ros.reasons import Reason
from boxreg_ros.rotations import wrap_angle
from boxreg_ros.structures import Floats, Ints, KEPT, REFINED
import numpy as np
from numpy.typing import NDArray
import torch
from torch import Tensor

# A refined box may hold fewer points than its input box, but at least this part of them, less a
# few. Chosen; see `boxreg bench sensitivity`.
MIN_HELD_PART = 0.5
MAX_LOST_POINTS = 3
HELD_MARGIN = 0.05
"""Points up to this far outside a box count as held by it [m]. Chosen."""
KEPT_REASONS = (Reason.NO_POINTS, Reason.NOT_FINITE, Reason.NO_GAIN)
"""Why a box is kept, in the order of `_failed_tests`."""


@one_torch_thread()
def register(windows: list[Window], config: Config, model: InputModel) -> list[Estimate | None]:
    """
    Refine the boxes of many windows.

    Parameters
    ----------
    windows : list of Window
        Each of its own track.
    config : Config
        Settings.
    model : InputModel
        Labelling margins and noise of the input. It is updated: first with the new observations,
        then with the fits.

    Returns
    -------
    estimates : list of Estimate or None
        In the order of `windows`; None for those with fewer than `min_observations`.

    """
    estimates: dict[int, Estimate] = {}
    groups = group_windows(windows, config)
    parts = [[windows[i] for i in rows] for rows in groups]
    stacked = [stack_windows(part, config) for part in parts]
    with shared_between(config.solver.threads):
        for part, (problem, _) in zip(parts, stacked, strict=True):
            _update_offsets(model, part, problem, config)
        for rows, part, (problem, base) in zip(groups, parts, stacked, strict=True):
            if config.objective == 'paper':
                solution = solve_paper(problem, config)
            else:
                solution = solve(problem, config, model, part[0].is_warm)
                _update_noise(model, part, problem, solution, config)
            found = _accepted(part, problem, base, solution, config)
            estimates.update(zip(rows, found, strict=True))
    return [estimates.get(i) for i in range(len(windows))]


@torch.inference_mode()
def _update_offsets(
    model: InputModel, windows: Sequence[Window], problem: Problem, config: Config
) -> None:
    """
    Update the labelling margins with the faces of new observations at their input boxes.

    The angles of the boxes are smoothed, see `smoothed_angles`. `problem` has the `windows`.

    """
    columns = [window.margin_columns() for window in windows]
    new = [row for row, part in enumerate(columns) if part]
    if not new:
        return
    problem = problem.part(new, [columns[row] for row in new]).thinned(COARSE_POINTS)
    offsets = model.offsets()
    pose = torch.cat([problem.boxes[..., :3], smoothed_angles(problem)], -1)
    state = State(pose, shared_without_population(problem, offsets))
    observations = observe_faces(problem, state, offsets, config)
    track_ids = [windows[row].track_id for row in new]
    model.add_face_observations(track_ids, problem.kind, observations, problem.valid, offsets)


@torch.inference_mode()
def _update_noise(
    model: InputModel,
    windows: Sequence[Window],
    problem: Problem,
    solution: Solution,
    config: Config,
) -> None:
    """Update the noise with the best fit of each window, `lag` from its end, and its extents."""
    lag = min(config.lag, config.window - 1)
    best = np.array([len(window.observations) - 1 - lag for window in windows])
    residuals = residuals_at(problem, solution.state, best.clip(0))
    # Each box counts once. The first one stays the best of its window as long as this grows.
    residuals[best < 0] = np.nan
    track_ids = [window.track_id for window in windows]
    evidence = solution.extent_evidence.cpu().numpy()
    model.add_fits(track_ids, problem.kind, residuals, evidence)


@torch.inference_mode()
def _accepted(
    windows: Sequence[Window], problem: Problem, base: Floats, solution: Solution, config: Config
) -> list[Estimate]:
    """
    Return the estimate of each window in the fixed frame, after the acceptance tests.

    `base` (B, 3) is the origin of the centres of `problem` [m].

    """
    extents_of_boxes = _extents(problem, solution.state, config)
    held = _held(problem, solution.state.pose, extents_of_boxes).cpu().numpy()
    pose, extent = solution.state.pose.cpu().numpy(), extents_of_boxes.cpu().numpy()
    covariances, extents, distances = (part.cpu().numpy() for part in solution.posterior)
    found = np.concatenate([pose[..., :3], extent, wrap_angle(pose[..., 3:])], -1)
    is_finite = np.isfinite(found).all(-1) & (extent > 0).all(-1)
    is_finite &= np.isfinite(covariances).all((2, 3))
    priors = _priors(base, solution, is_finite.all(1))
    failed = _failed_tests(problem, is_finite, held)
    is_kept = failed.any(0)
    reasons = np.select(failed, KEPT_REASONS, '')
    status = np.where(is_kept, KEPT, REFINED)
    found[..., :3] += base[:, None]
    near_points = np.stack([held, problem.counts.cpu().numpy() - held], -1)
    extent_covariances = np.repeat(extents[:, None], found.shape[1], axis=1)
    valid = problem.valid.cpu().numpy()
    for b, i in np.argwhere(valid & is_kept).tolist():
        found[b, i] = windows[b].observations[i].box
        covariances[b, i] = np.eye(6)
        extent_covariances[b, i] = np.eye(3)
        distances[b, i] = 0.0
        near_points[b, i] = 0
    columns = found, status, reasons, covariances, extent_covariances, distances, near_points
    table = Estimates(*(part[valid] for part in columns))
    ends = np.cumsum(valid.sum(1)).tolist()
    return list(map(Estimate, repeat(table), [0, *ends], ends, priors))


def _failed_tests(problem: Problem, is_finite: NDArray[np.bool_], held: Ints) -> NDArray[np.bool_]:
    """
    Return the acceptance tests that each refined box fails (M27), shape (3, B, N).

    The tests, in the order of `KEPT_REASONS`: the window has points; box and covariance are finite
    and the extent is positive; the refined box holds nearly as many points, `held` (B, N), as the
    input box, which the objective does not require.

    """
    before = problem.counts.cpu().numpy()  # at most: counting those of the input boxes takes time
    is_blind = np.broadcast_to(before.sum(1, keepdims=True) == 0, before.shape)
    if (held < MIN_HELD_PART * before - MAX_LOST_POINTS).any():
        before = _held(problem, problem.pose, problem.boxes[..., 3:6]).cpu().numpy()
    has_lost = held < MIN_HELD_PART * before - MAX_LOST_POINTS
    return np.stack([is_blind, ~is_finite, has_lost])


def _extents(problem: Problem, state: State, config: Config) -> Tensor:
    """Return the extents of the refined boxes, shape (B, N, 3) [m]."""
    given = problem.boxes[..., 3:6]
    if config.extent == 'fixed':
        return given
    return state.shared[:, None, EXTENT].expand_as(given)


def _held(problem: Problem, pose: Tensor, extent: Tensor) -> Tensor:
    """Return how many points are in boxes at `pose` (B, N, 6) of `extent` (B, N, 3), (B, N)."""
    kernels = compiled(pose)
    if kernels is not None:
        held = np.zeros(problem.counts.shape, np.int64)
        run(
            kernels.face_support.count_held, len(held), problem.arrays(), contiguous(pose),
            contiguous(extent), HELD_MARGIN, problem.returns.is_moving, held,
        )  # fmt: skip
        return torch.from_numpy(held)
    return _held_torch(problem, pose, extent)


def _held_torch(problem: Problem, pose: Tensor, extent: Tensor) -> Tensor:
    """Return the same as `_held`, by torch."""
    points = motion_compensated(problem, State(pose, problem.prior_mean))
    local = to_box_frame(points, problem, pose).abs_()
    outside = local.sub_(extent[..., None].to(local) / 2).amax(-2)
    return (outside < HELD_MARGIN).sum(-1)


def _priors(
    base: Floats, solution: Solution, is_solved: NDArray[np.bool_]
) -> list[MarginalisationPrior | None]:
    """Return the marginalisation prior that each window leaves, if it leaves one."""
    if solution.prior is None or solution.marginalised_extents is None:
        return [None] * len(base)
    parts = (*solution.prior, solution.marginalised_extents)
    arrays = [part.cpu().numpy() for part in parts]
    has_prior = (is_solved & np.isfinite(arrays[1]).all(1)).tolist()
    return [
        MarginalisationPrior(base[b], *(array[b] for array in arrays)) if has_prior[b] else None
        for b in range(len(base))
    ]
