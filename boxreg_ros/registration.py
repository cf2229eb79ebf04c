"""Windows in, refined boxes out: the method in one readable function."""

from collections.abc import Sequence
from dataclasses import fields
from typing import NamedTuple

from boxreg_ros import objective
from boxreg_ros.calibration import InputModel, InputNoise, Rule, scatter
from boxreg_ros.config import ClassConfig, Config
from boxreg_ros.geometry import rotation_from_rpy, to_box_frame
from boxreg_ros.lbfgs import minimize
from boxreg_ros.objective import Problem, SHARED, State, Support, Term
from boxreg_ros.sampling import Observation
from boxreg_ros.structures import Floats, HEIGHT, KEPT, LENGTH, POSE, REFINED, YAW
import numpy as np
import torch
from torch import Tensor

MARGINS = (
    0.4,
    0.3,
)  # around the box, where a face's points are looked for: first round, later [m]
RETREAT_SPREAD = 0.4  # of a retreat, between objects
PRIOR_OUTLIER = 3.0  # an input this many deviations off has lost half its say
INFLATION = 1.5  # of the deviation of an input whose error is correlated over time
PARKED = 0.3, 0.7  # what is slower [m/s] and moved less [m] is parked
BATCH_VALUES = 3e7  # most point coordinates, or entries of the curvature, solved at once


class Window(NamedTuple):
    """
    Observations of one track, in order.

    Attributes
    ----------
    track_id, class_name : str
        Identity and category.
    observations : sequence of N Observation
        In the order of their stamps.
    fresh : int
        How many of them, the last ones, no window has had before.

    """

    track_id: str
    class_name: str
    observations: Sequence[Observation]
    fresh: int


class Estimate(NamedTuple):
    """Boxes (N, 9) of a window with their status, reasons and covariances (N, 6, 6)."""

    boxes: Floats
    status: tuple[str, ...]
    reasons: tuple[str, ...]
    covariances: Floats


def register(windows: Sequence[Window], config: Config, model: InputModel) -> list[Estimate]:
    """
    Refine the boxes of many windows.

    Parameters
    ----------
    windows : sequence of Window
        Each of its own track.
    config : Config
        Settings.
    model : InputModel
        Learns from the fresh observations, then tells the gaps and errors to expect.

    Returns
    -------
    estimates : list of Estimate
        In the order of `windows`.

    """
    estimates = [_kept(window, 'short_track') for window in windows]
    batches = [
        (rows, stack([windows[i] for i in rows], config)) for rows in _batches(windows, config)
    ]
    for rows, (problem, _) in batches:
        _learn(model, problem, [windows[i] for i in rows])
    for rows, (problem, origins) in batches:
        if config.objective == 'paper':
            state, covariances = solve_paper(problem, config)
        else:
            state, covariances = solve(problem, config, model)
        boxes = _boxes(problem, state, origins, config)
        if config.estimate != 'track':
            settled = torch.tensor(
                [max(0, len(windows[i].observations) - 1 - config.lag) for i in rows]
            )
            deviation = scatter(problem, state)[torch.arange(len(rows)), settled].cpu().numpy()
            model.learn_noise([windows[i].track_id for i in rows], deviation)
        for row, index in enumerate(rows):
            estimates[index] = _judge(windows[index], boxes[row], covariances[row])
    return estimates


def solve(problem: Problem, config: Config, model: InputModel) -> tuple[State, Tensor]:
    """
    Minimise the robust objective: rounds of correspondence, weighting and L-BFGS.

    Returns the state and the covariances of the poses, (B, N, 6, 6): blocks of the inverse of
    the curvature, which is also the metric L-BFGS starts from in every round.

    """
    length = problem.boxes.shape[1]
    rule = model.rule()
    expected = _expected(problem, rule)
    state = State(problem.pose.clone(), expected.clone())
    free = _free(problem, config)
    noise = model.noise()
    for turn in range(config.solver.rounds):
        support = objective.support(
            problem, state, MARGINS[min(turn, 1)], config.faces.outermost, rule.depths
        )
        terms = weigh(problem, state, support, expected, noise, config)
        x = state.pack()
        H = objective.curvature(terms, x, length) * free[:, :, None] * free[:, None, :]
        L = torch.linalg.cholesky(H + torch.diag_embed(1.0 - free + 1e-9))

        def function(x: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
            part = terms if len(rows) == len(L) else [term.select(rows) for term in terms]
            value, gradient = objective.value_and_gradient(part, x, length)
            return value, gradient * free[rows]

        def metric(vector: Tensor, rows: Tensor) -> Tensor:
            return torch.cholesky_solve(vector[..., None], L[rows])[..., 0]

        settings = config.solver
        found = minimize(
            function, x, settings.iterations, settings.history, settings.tolerance, metric
        )
        state = State.unpack(found.x, length)
        if config.estimate == 'track':
            noise = InputNoise.measure(scatter(problem, state), problem.valid)
    blocks = torch.cholesky_inverse(L)[:, : 6 * length, : 6 * length]
    blocks = blocks.unflatten(1, (length, 6)).unflatten(3, (length, 6))
    return state, blocks.diagonal(dim1=1, dim2=3).permute(0, 3, 1, 2)


def solve_paper(problem: Problem, config: Config) -> tuple[State, Tensor]:
    """
    Minimise the paper's objective (Eq. 8) by L-BFGS, multipliers updated in between.

    Returns the state, extents as the windows' input means them, and the squared errors of the
    input as covariances: the paper's terms have no scale to derive any from.

    """
    length, settings = problem.boxes.shape[1], config.paper
    expected = _expected(problem, Rule(torch.zeros(6), torch.zeros(6)))
    extent = expected[:, None, objective.EXTENT].expand(-1, length, -1)
    free = _free(problem, config)[:, : 6 * length]
    x = problem.pose.flatten(1)
    multipliers = x.new_tensor([settings.smoothness, settings.alignment]).repeat(len(x), 1)

    def boxes(x: Tensor, rows: Tensor) -> Tensor:
        pose = x.unflatten(1, (length, 6))
        return torch.cat([pose[..., :3], extent[rows], pose[..., 3:]], -1)

    def function(x: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
        part = problem if len(rows) == len(extent) else problem.select(rows)
        with torch.enable_grad():
            x = x.detach().requires_grad_()
            loss, _ = objective.total(boxes(x, rows), part, settings, multipliers[rows])
            (gradient,) = torch.autograd.grad(loss.sum(), x)
        return loss.detach(), gradient * free[rows]

    for _ in range(settings.multiplier_rounds):
        x = minimize(function, x, settings.iterations, config.solver.history, 1e-9).x
        everything = torch.arange(len(x), device=x.device)
        _, violation = objective.total(boxes(x, everything), problem, settings, multipliers)
        multipliers += violation * x.new_tensor([settings.smoothness, settings.alignment])
    kind = problem.deviations
    names = ('position', 'lateral', 'height', 'tilt', 'tilt', 'heading')
    spread = torch.stack([kind[name] for name in names], -1) ** 2
    return State(x.unflatten(1, (length, 6)), expected), torch.diag_embed(spread)[:, None].expand(
        -1, length, -1, -1
    )


def weigh(
    problem: Problem,
    state: State,
    support: Support,
    expected: Tensor,
    noise: InputNoise | None,
    config: Config,
) -> list[Term]:
    """
    Return the terms of one round, weighted by expected deviations and by how far off they are.

    Notes
    -----
    A face loses its say as the square of Cauchy's weight, the input as Cauchy's. The error of an
    input is a part that is constant over its track, the bias, and one that changes slowly: the
    correlation measured widens its deviation, and without correlation there is no bias either.

    """
    kind, valid, faces = problem.deviations, problem.valid.to(state.pose), config.faces

    def of(*names: str) -> Tensor:
        return torch.stack([kind[name] for name in names], -1)

    # Closeness and enclosure: outermost points on their faces.
    errors = [faces.ends] * 2 + [faces.sides] * 2 + [faces.top, faces.bottom]
    trust = support.seen * (support.count / (support.count + 5.0))[..., None]
    trust = trust / (1 + (support.outwardness / faces.outlier) ** 2) ** 2
    trust = trust * valid[..., None] / torch.tensor(errors).to(trust) ** 2
    # The input, its bias and its extents.
    error = of('position', 'lateral', 'height', 'tilt', 'tilt', 'heading')
    inflation = torch.tensor(INFLATION).to(error)
    bias, extent = error * error.new_tensor([1, 1, 1, 1, 1, 0.5]), kind['extent'][:, None]
    if noise is not None:
        ratio = (noise.deviation[:6] / error).clamp(0.05, 4.0)
        slow = (noise.correlation / 0.4).clamp(0.1, 1.0)
        error = error * ratio
        inflation = ((1 + noise.correlation[:6]) / (1 - noise.correlation[:6])).sqrt()
        bias = bias * slow[:6] * ratio.clamp(0.1, 2.0)
        extent = extent * slow[6:]
    off = objective.prior(problem, state).residual[:, :, 0] / error[:, None]
    hold = valid[..., None] / (error * inflation)[:, None] ** 2 / (1 + (off / PRIOR_OUTLIER) ** 2)
    hidden = (support.retreat * valid[..., None]).sum(1) / valid.sum(1, keepdim=True)
    gap = (faces.spread**2 + (RETREAT_SPREAD * hidden) ** 2).sqrt()
    shared = (
        torch.cat([expected[:, :3] * extent, bias, gap, torch.full_like(gap[:, :1], 0.25)], 1)
        ** -2
    )
    # Motion: smoothness, alignment, rest.
    change = of('acceleration', 'cornering', 'vertical', 'tilting', 'tilting', 'turning') ** -2
    turn = torch.eye(6).to(state.pose).expand(*state.pose.shape[:2], 6, 6).clone()
    turn[..., :3, :3] = rotation_from_rpy(state.pose[..., 3:])
    change = (turn * change[:, None, None]) @ turn.mT
    slip = of('slip', 'climb') ** -2
    still = (of('drift') * error.new_tensor([1, 1, 0.5, 0.15, 0.15, 0.15])) ** -2

    def diagonal(weight: Tensor) -> Tensor:
        return torch.diag_embed(weight)[:, :, None]

    return [
        Term(objective.faces, problem, support.moments * trust[..., None, None], support.retreat),
        Term(objective.prior, problem, diagonal(hold)),
        Term(
            objective.acceleration,
            problem,
            (change[:, 1:-1] * valid[:, 2:, None, None])[:, :, None],
        ),
        Term(objective.slip, problem, diagonal(slip[:, None] * valid[:, 1:, None])),
        Term(objective.rest, problem, diagonal(still[:, None] * _parked(problem)[..., None])),
        Term(objective.shared_prior, problem, diagonal(shared[:, None]), expected),
    ]


def _parked(problem: Problem) -> Tensor:
    """Return 1 for the steps (B, N - 1) of windows whose input hardly moves, else 0."""
    count = problem.valid.sum(1, keepdim=True)
    index = torch.arange(problem.valid.shape[1], device=count.device)
    third = (count + 2) // 3
    where = torch.cat([problem.boxes[..., :2], problem.times[..., None]], -1)

    def mean(part: Tensor) -> Tensor:
        return (where * part[..., None]).sum(1) / part.sum(1, keepdim=True)

    change = mean((index >= count - third) & problem.valid) - mean(index < third)
    moved = change[:, :2].norm(dim=1)
    is_parked = (moved < PARKED[0] * change[:, 2]) & (moved < PARKED[1])
    return (is_parked[:, None] & problem.valid[:, 1:]).to(where)


def _expected(problem: Problem, rule: Rule) -> Tensor:
    """Return the expectation of what is shared (B, 16): mean input extent, no bias, the rule, the axle."""
    extents = problem.boxes[..., 3:6]
    count = problem.valid.sum(1)
    ranked = torch.where(problem.valid[..., None], extents, torch.inf).sort(1).values
    cut = (0.15 * count).long()[:, None]
    index = torch.arange(extents.shape[1], device=count.device)
    kept = ((index >= cut) & (index < count[:, None] - cut))[..., None]
    mean = torch.where(kept, ranked, 0.0).sum(1) / kept.sum(1)
    gaps = rule.gaps.to(mean).expand(len(mean), 6)
    return torch.cat([mean, torch.zeros_like(gaps), gaps, problem.deviations['pivot'][:, None]], 1)


def _free(problem: Problem, config: Config) -> Tensor:
    """Return 1 for every variable (B, 6 N + 16) to be solved for, 0 for those that stay."""
    pose = problem.valid[..., None].to(problem.boxes).expand(-1, -1, 6).clone()
    shared = pose.new_ones((len(pose), SHARED))
    if config.mode == 'bev':
        pose[..., [2, 3, 4]] = 0.0
    if config.extent == 'fixed':
        shared[:, :3] = 0.0
    return State(pose, shared).pack()


def _learn(model: InputModel, problem: Problem, windows: list[Window]) -> None:
    """Show the rule the fresh observations at their input boxes."""
    rule = model.rule()
    expected = _expected(problem, rule)
    support = objective.support(
        problem, State(problem.pose, expected), MARGINS[0], 0.05, rule.depths
    )
    first = torch.tensor([len(w.observations) - w.fresh for w in windows])
    fresh = torch.arange(problem.valid.shape[1]) >= first[:, None]
    model.learn_rule([w.track_id for w in windows], support, fresh & problem.valid, rule)


def _batches(windows: Sequence[Window], config: Config) -> list[list[int]]:
    """Return groups of windows of similar length and bounded size; short ones are left out."""
    lengths = [len(window.observations) for window in windows]
    rows = [i for i, n in enumerate(lengths) if n >= config.min_observations]
    batches: list[list[int]] = []
    for i in sorted(rows, key=lambda i: (lengths[i], i)):
        size = max((6 * lengths[i] + SHARED) ** 2, lengths[i] * config.sampling.points * 18)
        if not batches or (len(batches[-1]) + 1) * size > BATCH_VALUES:
            batches.append([])
        batches[-1].append(i)
    return batches


def stack(windows: Sequence[Window], config: Config) -> tuple[Problem, Floats]:
    """Return padded tensors of `windows` and the point (B, 3) their centres are relative to."""
    B, N = len(windows), max(len(w.observations) for w in windows)
    M = max(1, *(len(o.points) for w in windows for o in w.observations))
    boxes, times, valid = np.zeros((B, N, 9)), np.zeros((B, N)), np.zeros((B, N), dtype=bool)
    points, mask = np.zeros((B, N, M, 3)), np.zeros((B, N, M), dtype=bool)
    origins, ground = np.full((B, N, 3), np.nan), np.full((B, N), np.nan)
    for b, window in enumerate(windows):
        n = len(window.observations)
        given = np.array([o.box for o in window.observations])
        given[:, YAW] = one_heading(given[:, YAW])
        boxes[b, :n], boxes[b, n:], valid[b, :n] = given, given[-1], True
        for i, o in enumerate(window.observations):
            points[b, i, : len(o.points)], mask[b, i, : len(o.points)] = o.points, True
            times[b, i] = (o.stamp_ns - window.observations[0].stamp_ns) * 1e-9
            origins[b, i], ground[b, i] = o.origin, o.ground
        times[b, n:] = times[b, n - 1] + 0.1 * np.arange(1, N - n + 1)
    start = boxes[:, 0, :3].copy()
    boxes[:, :, :3] -= start[:, None]
    kinds = [config.class_config(window.class_name) for window in windows]
    deviations = {
        f.name: torch.tensor([getattr(kind, f.name) for kind in kinds], dtype=torch.float64)
        for f in fields(ClassConfig)
        if f.name != 'names'
    }
    arrays = (boxes, valid, times, points, mask, origins, ground)
    tensors = (torch.from_numpy(array).to(config.device) for array in arrays)
    return Problem(*tensors, {k: v.to(config.device) for k, v in deviations.items()}), start


def one_heading(yaw: Floats) -> Floats:
    """Return `yaw` (N,) unwrapped [rad], with the half turns undone that are in the minority."""
    chain = np.unwrap(yaw, period=np.pi)
    turned = np.cos(yaw - chain) < 0
    return chain + np.pi if turned.mean() > 0.5 else chain


def _boxes(problem: Problem, state: State, origins: Floats, config: Config) -> Floats:
    """Return the boxes (B, N, 9) of a state, in the fixed frame."""
    boxes = problem.boxes.cpu().numpy().copy()
    boxes[..., POSE] = state.pose.cpu().numpy()
    boxes[..., :3] += origins[:, None]
    if config.extent == 'track':
        boxes[..., LENGTH : HEIGHT + 1] = state.shared[:, None, objective.EXTENT].cpu().numpy()
    boxes[..., 6:9] = np.arctan2(np.sin(boxes[..., 6:9]), np.cos(boxes[..., 6:9]))
    return boxes


def _judge(window: Window, boxes: Floats, covariances: Tensor) -> Estimate:
    """
    Return the refined boxes, or the input where they do not deserve trust.

    Beside points at all and finite numbers, a refined box must hold nearly as many of the points
    as the input box does: a test the objective does not make.

    """
    kept = _kept(window, '')
    result, status, reasons = kept.boxes.copy(), list(kept.status), list(kept.reasons)
    spread = kept.covariances.copy()
    for i, observation in enumerate(window.observations):
        points = torch.from_numpy(observation.points).double()
        pair = torch.from_numpy(np.stack([observation.box, boxes[i]]))
        local = to_box_frame(points + pair[0, :3], pair).abs()
        held = (local < pair[:, None, 3:6] / 2 + 0.05).all(-1).sum(-1)
        if len(points) == 0:
            reasons[i] = 'no_points'
        elif not np.isfinite(boxes[i]).all() or (boxes[i, 3:6] <= 0).any():
            reasons[i] = 'not_finite'
        elif held[1] < 0.5 * held[0] - 3:
            reasons[i] = 'no_gain'
        else:
            result[i], status[i], spread[i] = boxes[i], REFINED, covariances[i].cpu().numpy()
    return Estimate(result, tuple(status), tuple(reasons), spread)


def _kept(window: Window, reason: str) -> Estimate:
    """Return the input boxes of a window."""
    n = len(window.observations)
    boxes = np.array([o.box for o in window.observations]).reshape(n, 9)
    unknown = np.broadcast_to(np.eye(6), (n, 6, 6))
    return Estimate(boxes, (KEPT,) * n, (reason,) * n, unknown)
