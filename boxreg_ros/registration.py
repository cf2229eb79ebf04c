"""Windows in, refined boxes out: the method in one readable function."""

from collections.abc import Sequence
from typing import NamedTuple

from boxreg_ros import objective
from boxreg_ros.calibration import InputModel, InputNoise, Rule, scatter
from boxreg_ros.config import Config
from boxreg_ros.correspondence import in_box_axes, Support, support
from boxreg_ros.geometry import rotation_from_rpy, wrap_angle
from boxreg_ros.lbfgs import minimize, select
from boxreg_ros.objective import ANCHOR, EXTENT, Problem, SHARED, State, Sum, Term
from boxreg_ros.shape import agreement
from boxreg_ros.structures import Floats, KEPT, POSE, REFINED
from boxreg_ros.window import batches, stack, Window
import numpy as np
import torch
from torch import Tensor

# Around the box, where a face's points are looked for: first round, later [m].
MARGINS = 0.4, 0.3
RETREAT_SPREAD = 0.4  # of a retreat, between objects
PRIOR_OUTLIER = 3.0  # an input this many deviations off has lost half its say
INFLATION = 1.5  # of the deviation of an input whose error is correlated over time

GAP_OUTLIER = 2.0  # a gap this many deviations off has lost half its say
SETTLED = 0.1  # a window whose boxes move less, in errors of the input, is done
ROUNDING = 0.3  # of the paper's norms in the first round, squared [m^2]
PARKED = 0.3, 0.7  # what is slower [m/s] and moved less [m] is parked


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
    threads = torch.get_num_threads()
    torch.set_num_threads(config.solver.threads)  # tensors are small: threads wait, not work
    try:
        return _register(windows, config, model)
    finally:
        torch.set_num_threads(threads)


def _register(windows: Sequence[Window], config: Config, model: InputModel) -> list[Estimate]:
    """Do what `register` says."""
    estimates = [_kept(window, 'short_track') for window in windows]
    groups = batches(windows, config)
    for rows in groups:
        _learn(model, [windows[i] for i in rows], config)
    for rows in groups:
        part = [windows[i] for i in rows]
        problem, base = stack(part, config)
        if config.objective == 'paper':
            state, covariances = solve_paper(problem, config)
        else:
            rounds = 1 if part[0].is_warm else config.solver.rounds
            state, covariances = solve(problem, config, model, rounds)
        if config.estimate != 'track':
            _learn_noise(model, part, problem, state, config.lag)
        kept = [estimates[i] for i in rows]
        found = _judged(kept, problem, base, state, covariances, config)
        for i, estimate in zip(rows, found, strict=True):
            estimates[i] = estimate
    return estimates


def _judged(
    kept: Sequence[Estimate],
    problem: Problem,
    base: Floats,
    state: State,
    covariances: Tensor,
    config: Config,
) -> list[Estimate]:
    """
    Return what a solved batch says of each window, in the fixed frame.

    Where that does not deserve trust it is the input, `kept`. Beside points at all and finite
    numbers, a refined box must hold nearly as many of the points as the input box does: a test
    the objective does not make.

    """
    given = problem.boxes[..., 3:6]
    extent = given if config.extent == 'fixed' else state.shared[:, None, EXTENT].expand_as(given)
    boxes = torch.cat([state.pose[..., :3], extent, wrap_angle(state.pose[..., 3:])], -1)
    finite = boxes.isfinite().all(-1) & (extent > 0).all(-1) & covariances.isfinite().all((2, 3))
    before, after = _held(problem, problem.pose, given), _held(problem, state.pose, extent)
    failed = torch.stack([~problem.mask.any(-1), ~finite, after < before / 2 - 3])
    good = (~failed.any(0)).cpu().numpy()
    status = np.where(good, REFINED, KEPT)
    reasons = np.select(list(failed.cpu().numpy()), ['no_points', 'not_finite', 'no_gain'], '')
    found, spread = boxes.cpu().numpy(), covariances.cpu().numpy()
    found[..., :3] += base[:, None]
    estimates = []
    for b, known in enumerate(kept):
        n = len(known.boxes)
        is_own = good[b, :n, None]
        own = np.where(is_own, found[b, :n], known.boxes)
        error = np.where(is_own[..., None], spread[b, :n], known.covariances)
        words = tuple(status[b, :n].tolist()), tuple(reasons[b, :n].tolist())
        estimates.append(Estimate(own, *words, error))
    return estimates


def _learn_noise(
    model: InputModel, windows: Sequence[Window], problem: Problem, state: State, lag: int
) -> None:
    """Show the model how the input scatters where a window knows it best, `lag` from its end."""
    best = torch.tensor([max(0, len(w.observations) - 1 - lag) for w in windows])
    rows = scatter(problem, state)[torch.arange(len(windows)), best]
    model.learn_noise([w.track_id for w in windows], rows.cpu().numpy())


def solve(
    problem: Problem, config: Config, model: InputModel, rounds: int
) -> tuple[State, Tensor]:
    """
    Minimise the robust objective: rounds of correspondence, weighting and L-BFGS.

    Returns the state and the covariances of the poses, (B, N, 6, 6): blocks of the inverse of
    the curvature, which is also the metric L-BFGS starts from in every round. A window whose
    boxes moved by less than `SETTLED` errors of its input takes no part in further rounds.

    """
    length, solver = problem.boxes.shape[1], config.solver
    limits = solver.iterations, solver.history, solver.tolerance
    rule, noise = model.rule(), model.noise()
    expected = expected_shared(problem, rule)
    state = State(problem.start[..., POSE].clone(), expected.clone())
    covariances = state.pose.new_zeros((*state.pose.shape, 6))
    free = free_variables(problem, config)
    rows = torch.arange(len(expected), device=expected.device)
    everything = problem
    for turn in range(rounds):
        margin = MARGINS[0] if turn == 0 and rounds > 1 else MARGINS[1]
        part = State(state.pose[rows], state.shared[rows])
        part.shared[:, ANCHOR] = 0.0
        sights = support(problem, part, margin, config.faces.outermost, rule.depths)
        terms = weigh(problem, part, sights, expected[rows], noise, config, is_first=turn == 0)
        if turn > 0 and config.estimate == 'track':
            information, wanted = agreement(problem, part)
            terms.append(Term(objective.shape, information[:, :, None], (part.pose, wanted)))
        x = part.pack()
        total = Sum(terms, x, length, free[rows])
        found = State.unpack(minimize(total, x, *limits, total.newton).x, length)
        state.pose[rows], state.shared[rows] = found
        if config.estimate == 'track':
            noise = InputNoise.measure(scatter(everything, state), everything.valid)
        step = ((found.pose - part.pose) / problem.errors[:, None]).square().mean(2).amax(1).sqrt()
        is_done = (step <= SETTLED) & (turn > 1) | (turn + 1 == rounds)
        done, rest = is_done.nonzero()[:, 0], (~is_done).nonzero()[:, 0]
        covariances[rows[done]] = select(total.factor, done).inverse_of_links(length)
        rows, problem = rows[rest], problem.select(rest)
        if not len(rows):
            break
    return state, covariances


def solve_paper(problem: Problem, config: Config) -> tuple[State, Tensor]:
    """
    Minimise the paper's objective (Eq. 8) by L-BFGS, multipliers updated in between.

    Returns the state, extents as the windows' input means them, and the squared errors of the
    input as covariances: the paper's terms have no scale to derive any from.

    Notes
    -----
    A zigzag satisfies Eq. 6, and norms that are not squared hold a search at their kinks. So the
    norms of Eq. 6 and 7 are rounded off, less in every round: the last one is to the letter.

    """
    length, settings = problem.boxes.shape[1], config.paper
    expected = expected_shared(problem, Rule(torch.zeros(6), torch.zeros(6)))
    extent = expected[:, None, EXTENT].expand(-1, length, -1)
    free = free_variables(problem, config)[:, : 6 * length]
    x = problem.pose.flatten(1)
    multipliers = x.new_tensor([settings.smoothness, settings.alignment]).repeat(len(x), 1)

    def boxes(x: Tensor, rows: Tensor) -> Tensor:
        pose = x.unflatten(1, (length, 6))
        return torch.cat([pose[..., :3], extent[rows], pose[..., 3:]], -1)

    def function(x: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
        with torch.enable_grad():
            x = x.detach().requires_grad_()
            part, factors = problem.select(rows), multipliers[rows]
            loss, _ = objective.total(boxes(x, rows), part, settings, factors, rounding)
            (gradient,) = torch.autograd.grad(loss.sum(), x)
        return loss.detach(), gradient * free[rows]

    for turn in range(settings.multiplier_rounds):
        rounding = max(ROUNDING * 0.01**turn, objective.EPSILON)
        x = minimize(function, x, settings.iterations, config.solver.history, 1e-9).x
        rows = torch.arange(len(x), device=x.device)
        _, violation = objective.total(boxes(x, rows), problem, settings, multipliers, rounding)
        multipliers += violation * x.new_tensor([settings.smoothness, settings.alignment])
    spread = torch.diag_embed(problem.errors**2)[:, None].expand(-1, length, -1, -1)
    return State(x.unflatten(1, (length, 6)), expected), spread


def weigh(
    problem: Problem,
    state: State,
    sights: Support,
    expected: Tensor,
    noise: InputNoise | None,
    config: Config,
    is_first: bool = False,
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
    given = problem.pose

    def of(*names: str) -> Tensor:
        return torch.stack([kind[name] for name in names], -1)

    # Closeness and enclosure: outermost points on their faces.
    errors = [faces.ends] * 2 + [faces.sides] * 2 + [faces.top, faces.bottom]
    trust = sights.trust * (sights.points / (sights.points + 5.0))[..., None]
    trust = trust / (1 + (sights.outwardness / faces.outlier) ** 2) ** 2
    trust = trust * valid[..., None] / torch.tensor(errors).to(trust) ** 2
    # The input, its bias and its extents.
    error = problem.errors
    inflation = torch.tensor(INFLATION).to(error)
    bias, extent = error * error.new_tensor([1, 1, 1, 1, 1, 0.5]), kind['extent'][:, None]
    if noise is not None:
        deviation, correlation = noise.deviation.to(error), noise.correlation.to(error)
        ratio = (deviation[:6] / error).clamp(0.05, 4.0)
        slow = ((correlation - 0.15) / 0.3).clamp(0.1, 1.0)
        error = error * ratio
        inflation = ((1 + correlation[:6]) / (1 - correlation[:6])).sqrt()
        bias = bias * slow[:6] * ratio.clamp(0.1, 2.0)
        extent = extent * slow[6:]
    axes = rotation_from_rpy(state.pose[..., 3:])
    off = objective.prior(state, given, axes).residual[:, :, 0]
    off = (off.abs() + surprise(problem) * is_first) / error[:, None]
    hold = valid[..., None] / (error * inflation)[:, None] ** 2 / (1 + (off / PRIOR_OUTLIER) ** 2)
    hidden = (sights.retreat * valid[..., None]).sum(1) / valid.sum(1, keepdim=True)
    gap = (faces.spread**2 + (RETREAT_SPREAD * hidden) ** 2).sqrt()
    unusual = (state.shared[:, objective.GAP] - expected[:, objective.GAP]) / gap
    gap = gap * (1 + (unusual / GAP_OUTLIER) ** 2).sqrt()
    pivot, anchor = torch.full_like(gap[:, :1], 0.25), torch.ones_like(gap)
    shared = torch.cat([expected[:, :3] * extent, bias, gap, pivot, anchor], 1) ** -2
    # Motion: smoothness, alignment, rest.
    change = of('acceleration', 'cornering', 'vertical', 'tilting', 'tilting', 'turning') ** -2
    turn = torch.eye(6).to(state.pose).expand(*state.pose.shape[:2], 6, 6).clone()
    turn[..., :3, :3] = axes
    change = ((turn * change[:, None, None]) @ turn.mT)[:, 1:-1] * valid[:, 2:, None, None]
    slip = of('slip', 'climb') ** -2
    still = (of('drift') * error.new_tensor([1, 1, 0.5, 0.15, 0.15, 0.15])) ** -2

    def diagonal(weight: Tensor) -> Tensor:
        return torch.diag_embed(weight)[:, :, None]

    return [
        Term(objective.faces, sights.moments * trust[..., None, None], (given, sights.retreat)),
        Term(objective.prior, diagonal(hold), (given, axes)),
        Term(objective.acceleration, change[:, :, None], (problem.times,)),
        Term(objective.slip, diagonal(slip[:, None] * valid[:, 1:, None]), (problem.times,)),
        Term(objective.rest, diagonal(still[:, None] * _parked(problem)[..., None])),
        Term(objective.shared_prior, diagonal(shared[:, None]), (expected,)),
    ]


def surprise(problem: Problem) -> Tensor:
    """
    Return how far each input pose is off what its neighbours make expect, shape (B, N, 6).

    The least of what two before, two after and one on each side say, along the axes of the box:
    before anything is solved, an outlier is told by all of them, its neighbours by two at most.
    A third of it counts: noise alone makes so much more of it than of the noise itself.

    """
    pose, t = problem.pose, problem.times[..., None]
    axes = rotation_from_rpy(pose[..., 3:])
    least = torch.full_like(pose, torch.inf)
    for first, second in ((-2, -1), (-1, 1), (1, 2)):
        low, high = max(0, -first), max(0, -first, pose.shape[1] - max(0, second))
        a, b, here = (slice(low + k, high + k) for k in (first, second, 0))
        share = (t[:, here] - t[:, a]) / (t[:, b] - t[:, a])
        off = pose[:, here] - pose[:, a] - share * (pose[:, b] - pose[:, a])
        off = torch.cat([(axes[:, here].mT @ off[..., :3, None])[..., 0], off[..., 3:]], -1).abs()
        real = (problem.valid[:, a] & problem.valid[:, b])[..., None]
        least[:, here] = least[:, here].minimum(torch.where(real, off, torch.inf))
    return torch.where(least.isfinite(), least, 0.0) / 3


def _parked(problem: Problem) -> Tensor:
    """Return 1 for the steps (B, N - 1) of windows whose input hardly moves, else 0."""
    count = problem.valid.sum(1, keepdim=True)
    index = torch.arange(problem.valid.shape[1], device=count.device)
    third = (count + 2) // 3
    where = torch.cat([problem.boxes[..., :2], problem.times[..., None]], -1)

    def middle(part: Tensor) -> Tensor:
        return torch.where(part[..., None], where, torch.nan).nanmedian(1).values

    change = middle((index >= count - third) & problem.valid) - middle(index < third)
    moved: Tensor = change[:, :2].norm(dim=1)
    is_parked = (moved < PARKED[0] * change[:, 2]) & (moved < PARKED[1])
    return (is_parked[:, None] & problem.valid[:, 1:]).to(where)


def expected_shared(problem: Problem, rule: Rule) -> Tensor:
    """Return the expectation of what is shared (B, 22): mean extent, no bias, rule, pivot."""
    extents = problem.boxes[..., 3:6]
    count = problem.valid.sum(1)
    ranked = torch.where(problem.valid[..., None], extents, torch.inf).sort(1).values
    cut = (0.15 * count).long()[:, None]
    index = torch.arange(extents.shape[1], device=count.device)
    kept = ((index >= cut) & (index < count[:, None] - cut))[..., None]
    mean = torch.where(kept, ranked, 0.0).sum(1) / kept.sum(1)
    gaps = rule.gaps.to(mean).expand(len(mean), 6)
    none = torch.zeros_like(gaps)
    return torch.cat([mean, none, gaps, problem.deviations['pivot'][:, None], none], 1)


def free_variables(problem: Problem, config: Config) -> Tensor:
    """Return 1 for every variable (B, 6 N + 22) to be solved for, 0 for those that stay."""
    pose = problem.valid[..., None].to(problem.boxes).expand(-1, -1, 6).clone()
    shared = pose.new_ones((len(pose), SHARED))
    if config.mode == 'bev':
        pose[..., [2, 3, 4]] = 0.0
    if config.extent == 'fixed':
        shared[:, :3] = 0.0
    return State(pose, shared).pack()


def _learn(model: InputModel, windows: Sequence[Window], config: Config) -> None:
    """Show the model the fresh observations at their input boxes."""
    windows = [window for window in windows if window.fresh > 0]
    if not windows:
        return
    problem, _ = stack([window.fresh_part() for window in windows], config)
    rule = model.rule()
    state = State(problem.pose, expected_shared(problem, rule))
    sights = support(problem, state, MARGINS[0], config.faces.outermost, rule.depths)
    model.learn_rule([w.track_id for w in windows], sights, problem.valid, rule)


def _held(problem: Problem, pose: Tensor, extent: Tensor) -> Tensor:
    """Return how many points lie in boxes of `pose` (B, N, 6) and `extent` (B, N, 3), (B, N)."""
    local = in_box_axes(problem.points, problem, pose).abs_()
    x, y, z = local.sub_(extent[..., None].to(local) / 2).unbind(-2)
    return ((x.maximum(y).maximum(z) < 0.05) & problem.mask).sum(-1)


def _kept(window: Window, reason: str) -> Estimate:
    """Return the input boxes of a window."""
    n = len(window.observations)
    boxes = np.array([o.box for o in window.observations]).reshape(n, 9)
    unknown = np.broadcast_to(np.eye(6), (n, 6, 6))
    return Estimate(boxes, (KEPT,) * n, (reason,) * n, unknown)
