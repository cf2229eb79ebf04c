"""
The solver beside a plain `torch.optim.LBFGS` fit of one window.

The reference minimises the same sum of residuals, with its gradient. It is a fair one: variables
are scaled by their expected errors, the line search is strong Wolfe, and it stops by our rule.

"""

from __future__ import annotations

from dataclasses import replace
from time import process_time

from boxreg_ros.config import Config
from boxreg_ros.core.input_model import InputModel
from boxreg_ros.core.method import round as method
from boxreg_ros.core.method.arrays import BIAS, EXTENT, Solution
from boxreg_ros.core.method.constants import CONSTANTS
from boxreg_ros.core.metrics import iou_3d
from boxreg_ros.core.problem import Problem, stack_windows
from boxreg_ros.core.refine import refine, Track
from boxreg_ros.core.solver import Batch, Objective, observe, solve, SolverPlan, start
from boxreg_ros.core.window import Window
from boxreg_ros.structures import BOX_EXTENT, Floats, POSE
from measure.speed.streams import make_windows, shortest
import numpy as np
import torch
from torch import Tensor

REFERENCE_ROUNDS = 2
"""Most renewals of correspondences and weights. Swept with 40 iterations in all, on six windows:
20, 8, 4 and 2 rounds reach 3D IoU .738, .783, .796 and .798; two are the fastest as well."""
REFERENCE_ITERATIONS = 20
"""Iterations in each round."""
REFERENCE_HISTORY = 10
"""Curvature pairs of the reference. Literature: 3 to 20 (Nocedal & Wright, section 7.2)."""


def compare(config: Config, count: int, references: int) -> dict[str, float]:
    """
    Return times per window [ms], and values and IoU of the first `references` windows.

    ``refine`` is all that `boxreg_ros.refine` does with `count` tracks of one window each, with
    the estimate of `config`: 'final' solves a window again for each of its boxes. ``refine,
    track`` solves each once, as the reference does and as is the default of `refine`. ``cold``
    and ``warm`` are the solver alone, ``reference`` is the fit of one window. A value is that of
    the terms renewed at the result. ``IoU, error`` is the standard error of the mean difference
    of ours and the reference, ``times faster`` is ``reference`` over ``refine, track``.

    """
    windows, truth = make_windows(count, config.window, 128, config)
    problem, priors = stack_windows(windows, config, CONSTANTS.prior_decay)

    def solved(problem: Problem, is_warm: bool) -> Solution:
        model = InputModel(config.faces)
        return solve(problem, config, model, model.inputs(config), is_warm)

    def cold() -> Solution:
        return solved(problem, is_warm=False)

    warm_problem = _warm(problem, cold())

    def warm() -> Solution:
        return solved(warm_problem, is_warm=True)

    tracks = [_track(window) for window in windows]
    once = replace(config, estimate='track')
    times = {
        'refine': shortest(lambda: refine(tracks, config)) / count,
        'refine, track': shortest(lambda: refine(tracks, once)) / count,
        'cold': shortest(cold) / count,
        'warm': shortest(warm) / count,
    }
    result = {name: 1e3 * seconds for name, seconds in times.items()}
    decay = CONSTANTS.prior_decay
    single = [stack_windows([window], config, decay)[0] for window in windows[:references]]
    reference_fit(single[0], config)  # imports and allocations of the first call
    begin = process_time()
    fits = [reference_fit(problem, config) for problem in single]
    result['reference'] = 1e3 * (process_time() - begin) / references
    result['times faster'] = result['reference'] / result['refine, track']
    model = InputModel(config.faces)
    ours = [solve(one, config, model, model.inputs(config), is_warm=False) for one in single]
    starts = [_Fit(one, config).batch.solution for one in single]
    iou = {}
    for name, found in (('input', starts), ('reference', fits), ('ours', ours)):
        pairs = zip(single, found, strict=True)
        values = [_Fit(one, config).value(solution) for one, solution in pairs]
        result[f'value, {name}'] = float(np.mean(values))
        rows = zip(single, found, priors.base, truth, strict=False)
        iou[name] = np.array([_iou(p, s, b, t, name == 'input') for p, s, b, t in rows])
        result[f'IoU, {name}'] = float(iou[name].mean())
    # A window has several minima; in which of them a solver ends is chance.
    result['IoU, error'] = float((iou['ours'] - iou['reference']).std() / np.sqrt(references))
    return result


class _Fit:
    """One window: the sum of its residuals, and where it starts."""

    objective: Objective
    """The sum, once it has been linearised."""

    def __init__(self, problem: Problem, config: Config) -> None:
        model = InputModel(config.faces)
        plan = SolverPlan.choose(config, False)
        constants = CONSTANTS.with_settings(config)
        self.constants = constants.in_round(uses_shape=False, is_smooth=False)
        self.inputs = model.inputs(config)
        self.batch: Batch = start(problem, config, plan, self.inputs)

    def linearise(self) -> tuple[Tensor, float]:
        """Renew the sum where the solution is; return its variables (1, D) and its value."""
        x, row = np.empty((2, *self.batch.free.shape)), np.zeros(1, np.int64)
        sums = observe(self.batch, self.inputs, row, self.constants)
        self.objective = Objective(self.batch, sums, self.inputs, self.constants.record(), row)
        value, _, _ = self.objective.sum(x, method.START)
        return torch.from_numpy(x[0]), float(value[0, 0])

    def deviations(self) -> Tensor:
        """Return the expected error of every variable, 0 for those held fixed; (1, D)."""
        problem, free = self.batch.problem, self.batch.free
        sums = self.objective.sums
        poses = np.tile(problem.of_class['pose'], problem.length)
        number = free.shape[1] - poses.shape[1]
        errors = np.concatenate([poses, sums.common['deviation'][:, :number]], axis=1)
        return torch.from_numpy(free * np.where(errors > 0, errors, 1.0))

    def value(self, solution: Solution) -> float:
        """Return the value of the sum renewed at a solution."""
        self.batch.solution.poses[:] = solution.poses
        self.batch.solution.shared[:] = solution.shared
        return self.linearise()[1]


def reference_fit(problem: Problem, config: Config) -> Solution:
    """Return the fit of one window by `torch.optim.LBFGS`."""
    fit = _Fit(problem, config)
    solution = fit.batch.solution
    for _ in range(REFERENCE_ROUNDS):
        before = solution.poses.copy()
        x = _minimum(fit)
        width = before.size
        solution.poses[:] = x[:, :width].reshape(before.shape)
        solution.shared[:] = x[:, width:]
        moved = (
            (((solution.poses - before) / problem.of_class['pose'][:, None]) ** 2).mean(2).max()
        )
        if moved <= CONSTANTS.settled_step**2:
            break
    return solution


def _minimum(fit: _Fit) -> Floats:
    """Return the minimum of the sum over start + scale * y, beginning at y = 0, (1, D)."""
    begin, _ = fit.linearise()
    scale = fit.deviations()
    row = torch.zeros(1, dtype=torch.int64)
    y = torch.zeros_like(begin, requires_grad=True)
    search = torch.optim.LBFGS(
        [y],
        max_iter=REFERENCE_ITERATIONS,
        history_size=REFERENCE_HISTORY,
        line_search_fn='strong_wolfe',
    )

    def closure() -> Tensor:
        value, gradient, _ = fit.objective.at((begin + scale * y).detach(), row)
        y.grad = scale * gradient
        return value[0]

    search.step(closure)
    found: Floats = (begin + scale * y).detach().numpy()
    return found


def _iou(
    problem: Problem, solution: Solution, base: Floats, truth: Floats, is_input: bool
) -> float:
    """Return the mean 3D IoU of a fit of one window, or of its input."""
    boxes = problem.boxes[0].copy()
    if not is_input:
        boxes[:, POSE] = solution.poses[0]
        boxes[:, BOX_EXTENT] = solution.shared[0, EXTENT:BIAS]
    boxes[:, :3] += base
    return float(iou_3d(boxes, truth).mean())


def _warm(problem: Problem, solution: Solution) -> Problem:
    """Return the problem as in a stream: all but the newest box start from a fit."""
    start_boxes = problem.boxes.copy()
    start_boxes[:, :-1, POSE] = solution.poses[:, :-1]
    start_boxes[:, :-1, BOX_EXTENT] = solution.shared[:, None, EXTENT:BIAS]
    return problem._replace(start=start_boxes)


def _track(window: Window) -> Track:
    """Return the observations of a window as the track that `refine` takes."""
    observations = window.observations
    boxes = np.array([o.box for o in observations])
    centers = boxes[:, :3]
    return Track(
        window.track_id,
        window.class_name,
        np.array([o.stamp_ns for o in observations]),
        boxes,
        [o.points + center for o, center in zip(observations, centers, strict=True)],
        np.array([o.table.origins[o.row, 0] for o in observations]) + centers,
    )
