"""
The solver beside a plain `torch.optim.LBFGS` fit of one window.

The reference minimises the same terms by automatic differentiation. It is a fair one: variables
are scaled by their expected errors, the line search is strong Wolfe, and it stops by our rule.

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from time import perf_counter

from boxreg_ros.bench.speed.streams import make_windows, shortest
from boxreg_ros.config import Config
from boxreg_ros.core.batch import EXTENT, free_variables, POSE_ERRORS, Problem, Solution, State
from boxreg_ros.core.expectation import expect, InputEstimates
from boxreg_ros.core.face_support import observe_faces
from boxreg_ros.core.input_model import InputModel
from boxreg_ros.core.metrics import iou_3d
from boxreg_ros.core.refine import refine, Track
from boxreg_ros.core.rounds import SETTLED_STEP
from boxreg_ros.core.solver import solve
from boxreg_ros.core.terms import Term
from boxreg_ros.core.track_window import Window
from boxreg_ros.core.weights import weigh
from boxreg_ros.core.window import stack_windows
from boxreg_ros.structures import BOX_EXTENT, Floats, POSE
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
    of ours and the reference.

    """
    windows, truth = make_windows(count, config.window, 128, config)
    problem, base = stack_windows(windows, config)

    def cold() -> Solution:
        return solve(problem, config, InputModel(config.faces), is_warm=False)

    warm_problem = _warm(problem, cold().state, config)

    def warm() -> Solution:
        return solve(warm_problem, config, InputModel(config.faces), is_warm=True)

    tracks = [_track(window) for window in windows]
    once = replace(config, estimate='track')
    times = {
        'refine': shortest(lambda: refine(tracks, config), config) / count,
        'refine, track': shortest(lambda: refine(tracks, once), config) / count,
        'cold': shortest(cold, config) / count,
        'warm': shortest(warm, config) / count,
    }
    result = {name: 1e3 * seconds for name, seconds in times.items()}
    single = [stack_windows([window], config)[0] for window in windows[:references]]
    reference_fit(single[0], config)  # imports and allocations of the first call
    begin = perf_counter()
    fits = [reference_fit(problem, config) for problem in single]
    result['reference'] = 1e3 * (perf_counter() - begin) / references
    ours = [solve(one, config, InputModel(config.faces), is_warm=False).state for one in single]
    iou = {}
    for name, states in (('input', None), ('reference', fits), ('ours', ours)):
        states = states or [_start(one, config) for one in single]
        pairs = zip(single, states, strict=True)
        result[f'value, {name}'] = float(np.mean([_value(p, s, config) for p, s in pairs]))
        rows = zip(single, states, base, truth, strict=False)
        iou[name] = np.array(
            [_iou(p, None if name == 'input' else s, b, t) for p, s, b, t in rows]
        )
        result[f'IoU, {name}'] = float(iou[name].mean())
    # A window has several minima; in which of them a solver ends is chance.
    result['IoU, error'] = float((iou['ours'] - iou['reference']).std() / np.sqrt(references))
    return result


def reference_fit(problem: Problem, config: Config) -> State:
    """Return the fit of one window by `torch.optim.LBFGS`."""
    state = _start(problem, config)
    free = free_variables(problem, config)
    scale = free * _deviations(problem, config)
    errors = problem.of_class(*POSE_ERRORS)[:, None]
    for _ in range(REFERENCE_ROUNDS):
        terms = _terms(problem, state, config)
        found = State.unpack(_minimum(terms, state.pack(), scale, problem.length), problem.length)
        moved = ((found.pose - state.pose) / errors).square().mean(2).amax()
        state = found
        if moved <= SETTLED_STEP**2:
            break
    return state


def _minimum(terms: Sequence[Term], start: Tensor, scale: Tensor, length: int) -> Tensor:
    """Return the minimum of the sum of `terms` over start + scale * y, beginning at y = 0."""
    y = torch.zeros_like(start, requires_grad=True)
    search = torch.optim.LBFGS(
        [y],
        max_iter=REFERENCE_ITERATIONS,
        history_size=REFERENCE_HISTORY,
        line_search_fn='strong_wolfe',
    )

    def closure() -> Tensor:
        search.zero_grad()
        value = _total(terms, State.unpack(start + scale * y, length))
        value.backward()
        return value

    search.step(closure)
    return (start + scale * y).detach()


def _deviations(problem: Problem, config: Config) -> Tensor:
    """Return the expected error of every variable, 1 where none is known; (1, 6 N + 23)."""
    expected = expect(problem, InputEstimates(InputModel(config.faces).offsets()))
    pose = problem.of_class(*POSE_ERRORS).repeat(1, problem.length)
    deviations = torch.cat([pose, expected.deviation], 1)
    return torch.where(deviations > 0, deviations, 1.0)


def _start(problem: Problem, config: Config) -> State:
    """Return the input boxes with the expected shared variables."""
    offsets = InputModel(config.faces).offsets()
    return State(problem.pose.clone(), expect(problem, InputEstimates(offsets)).shared)


def _terms(problem: Problem, state: State, config: Config) -> list[Term]:
    """Return the weighted terms with correspondences at `state`."""
    offsets = InputModel(config.faces).offsets()
    observations = observe_faces(problem, state, offsets, config)
    return weigh(problem, state, observations, expect(problem, InputEstimates(offsets)), config)


def _value(problem: Problem, state: State, config: Config) -> float:
    """Return the value of the terms renewed at `state`."""
    return float(_total(_terms(problem, state, config), state))


def _total(terms: Sequence[Term], state: State) -> Tensor:
    residuals = [(term.linearise(state).residual, term.weight) for term in terms]
    parts = [(r * (W @ r[..., None])[..., 0]).sum() / 2 for r, W in residuals]
    return torch.stack(parts).sum()


def _iou(problem: Problem, state: State | None, base: Floats, truth: Floats) -> float:
    """Return the mean 3D IoU of a fit of one window, or of its input for None."""
    boxes = problem.boxes[0].cpu().numpy().copy()
    if state is not None:
        boxes[:, POSE] = state.pose[0].cpu().numpy()
        boxes[:, BOX_EXTENT] = state.shared[0, EXTENT].cpu().numpy()
    boxes[:, :3] += base
    return float(iou_3d(boxes, truth).mean())


def _warm(problem: Problem, state: State, config: Config) -> Problem:
    """Return the problem as in a stream: all but the newest box start from a fit."""
    extent = state.shared[:, None, EXTENT].expand(-1, config.window, -1)
    solved = torch.cat([state.pose[..., :3], extent, state.pose[..., 3:]], -1)
    start = torch.cat([solved[:, :-1], problem.boxes[:, -1:]], 1)
    return problem._replace(start=start)


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
        np.array([o.origins[0] for o in observations]) + centers,
    )
