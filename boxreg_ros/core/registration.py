"""Windows in, refined boxes out: the method in one readable function."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from multiprocessing import cpu_count
from typing import NamedTuple

from boxreg_ros.config import Config
from boxreg_ros.core import objective
from boxreg_ros.core.face_support import in_box_axes, Rule, Support, support
from boxreg_ros.core.geometry import FACE_AXIS, rotation_from_rpy
from boxreg_ros.core.input_model import (
    expect,
    Expected,
    extents_told,
    InputModel,
    InputNoise,
    scatter,
)
from boxreg_ros.core.lbfgs import minimize, select
from boxreg_ros.core.objective import (
    ERRORS,
    EXTENT,
    GAP,
    Problem,
    remembered,
    SHARED,
    State,
    Sum,
    Term,
)
from boxreg_ros.core.rigid_shape import agreement
from boxreg_ros.core.window import group_windows, MarginalisationPrior, stack_windows, Window
from boxreg_ros.rotations import wrap_angle
from boxreg_ros.structures import Floats, KEPT, POSE, REFINED, YAW
import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

PRIOR_OUTLIER = SWERVE = 3.0  # so many deviations off an input loses half its say, motion 3/4
GAP_OUTLIER = 2.0  # a gap this many deviations off has lost half its say
HEARD = 2  # rounds that tell the noise: fits follow it, and would make it seem ever smaller
SETTLED = 0.1  # a window whose boxes move less, in errors of the input, is done
ROUNDING = 0.3  # of the paper's norms in the first round, squared [m^2]
PART = 2500  # observations a thread works on at once: fewer cost calls, more cost memory
# Points of a box that tell where it is but for the last round, and that show its track's shape.
COARSE, SHOWN = 256, 64
MOTION = objective.acceleration, objective.slip
# What is slower [m/s], moved less [m] and turned less [errors of a heading] is parked; it rests
# where it is not faster for half a second [m/s].
PARKED = 0.3, 0.7, 3.0, 1.0


class Estimate(NamedTuple):
    """
    Boxes (N, 9) of a window with their status, reasons and covariances (N, 6, 6).

    Of a full window, what the next one is to remember of it too.

    """

    boxes: Floats
    status: tuple[str, ...]
    reasons: tuple[str, ...]
    covariances: Floats
    memory: MarginalisationPrior | None = None


class Solution(NamedTuple):
    """
    A solved batch.

    Attributes
    ----------
    state : State
        Poses, and what is shared.
    covariances : Tensor, shape (B, N, 6, 6)
        Of the poses: blocks of the inverse of the curvature.
    left : tuple of Tensor
        What full windows leave to `MarginalisationPrior`, its base excepted; NaN where they are
        not full.
    told : Tensor, shape (B, 3, 3)
        What the points tell of the extents, see `InputNoise`.

    """

    state: State
    covariances: Tensor
    left: tuple[Tensor, ...] = ()
    told: Tensor = torch.zeros(0)


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
        Learns from the fresh observations, then tells the gaps and errors to expect.

    Returns
    -------
    estimates : list of Estimate or None
        In the order of `windows`; None for those that are too short.

    """
    estimates: dict[int, Estimate] = {}
    groups = group_windows(windows, config)
    for rows in groups:
        _learn(model, [windows[i] for i in rows], config)
    for rows in groups:
        problem, base = stack_windows(part := [windows[i] for i in rows], config)
        if config.objective == 'paper':
            solved = solve_paper(problem, config)
        else:
            solved = solve(problem, config, model, part[0].is_warm)
            # The input scatters about what a window knows best, `lag` from its end.
            best = [max(0, len(window.observations) - 1 - config.lag) for window in part]
            known = scatter(problem, solved.state)[range(len(part)), best].cpu().numpy()
            model.learn_fits([w.track_id for w in part], known, solved.told.cpu().numpy())
        estimates.update(zip(rows, _judged(part, problem, base, solved, config), strict=True))
    return [estimates.get(i) for i in range(len(windows))]


@torch.inference_mode()
def _judged(
    windows: Sequence[Window], problem: Problem, base: Floats, solved: Solution, config: Config
) -> list[Estimate]:
    """
    Return what a solved batch says of each window, in the fixed frame.

    Where that does not deserve trust it is the input. Beside points anywhere in the window and
    finite numbers, a refined box must hold nearly as many of the points as the input box does: a
    test the objective does not make.

    """
    state, covariances, left, _ = solved
    given = problem.boxes[..., 3:6]
    extent = given if config.extent == 'fixed' else state.shared[:, None, EXTENT].expand_as(given)
    boxes = torch.cat([state.pose[..., :3], extent, wrap_angle(state.pose[..., 3:])], -1)
    finite = boxes.isfinite().all(-1) & (extent > 0).all(-1) & covariances.isfinite().all((2, 3))
    before, after = problem.mask.sum(-1), _held(problem, state.pose, extent)
    if (after < before / 2 - 3).any():  # only then does it matter how many the input box holds
        before = _held(problem, problem.pose, given)
    is_blind = ~problem.mask.any((1, 2))[:, None].expand_as(finite)
    failed = torch.stack([is_blind, ~finite, after < before / 2 - 3]).cpu().numpy()
    good, why = ~np.any(failed, 0), np.select(failed, ['no_points', 'not_finite', 'no_gain'], '')
    found, spread = boxes.cpu().numpy(), covariances.cpu().numpy()
    found[..., :3] += base[:, None]
    arrays, estimates = [part.cpu().numpy() for part in left], []
    lasts = (finite.all(1) & left[1].isfinite().all(1)).tolist() if left else [False] * len(found)
    for b, i in np.argwhere(problem.valid.cpu().numpy() & ~good).tolist():
        found[b, i], spread[b, i] = windows[b].observations[i].box, np.eye(6)
    status, reasons = np.where(good, REFINED, KEPT).tolist(), why.tolist()
    for b, n in enumerate(len(window.observations) for window in windows):
        memory = MarginalisationPrior(base[b], *(a[b] for a in arrays)) if lasts[b] else None
        words = tuple(status[b][:n]), tuple(reasons[b][:n])
        estimates.append(Estimate(found[b, :n], *words, spread[b, :n], memory))
    return estimates


@torch.inference_mode()
def solve(problem: Problem, config: Config, model: InputModel, is_warm: bool) -> Solution:
    """
    Minimise the robust objective: rounds of correspondence, weighting and L-BFGS, one if warm.

    The curvature is also the metric L-BFGS starts from in every round. A window whose boxes moved
    by less than `SETTLED` errors of its input takes no part in further rounds. Within a round
    windows do not depend on each other: threads share them.

    """
    length, solver, is_track = problem.boxes.shape[1], config.solver, config.estimate == 'track'
    limits = solver.iterations, solver.history, solver.tolerance
    rounds, enough = (1, torch.inf) if is_warm else (solver.rounds, COARSE)
    rule, known, turn = model.rule(), model.noise(), 0
    # Of whole tracks the model has one scatter a window, seconds apart: it tells no noise.
    noise = InputNoise(told=known.told) if is_track else known
    state = State(problem.start[..., POSE].clone(), expect(problem, rule).shared)
    told = pad(state.shared[:, None, EXTENT].log(), (0, 0, 0, 2))
    free = free_variables(problem, config)
    # A warm window judges faces by the extents found before it, if free.
    state.shared[:, EXTENT].lerp_(problem.start[:, 0, 3:6], is_warm * free[:, -SHARED:][:, EXTENT])
    covariances = state.pose.new_zeros((*state.pose.shape, 6))
    unknown = torch.full_like(problem.recalled, torch.nan)
    seen = problem.seen + pad(problem.boxes[:, 0, 3:6], (0, 1), value=1.0)
    left = unknown, unknown.clone(), problem.information.clone(), seen

    @torch.inference_mode()
    def improve(rows: Tensor) -> Tensor:
        """Take round `turn` with some windows, `enough` points; return those not done."""
        part, here, expected = select((problem.thinned(enough), state, expectation), rows)
        here.shared[:, objective.ANCHOR] = 0.0
        sights = support(part, here, config.faces.outermost, rule)
        # `any` would take three times as long; of two boxes some terms have no weights at all.
        terms = [t for t in weigh(part, here, sights, expected, config) if t.weight.norm()]
        if turn > 0 or is_warm:  # where it begins, a cold window is as noisy as its input
            terms = [yielding(t, here) if t.function in MOTION else t for t in terms]
        if turn > 0 and is_track:
            information, wanted = agreement(part.thinned(SHOWN), here)
            terms.append(Term(objective.shape, information[:, :, None], (here.pose, wanted)))
        total = Sum(terms, x := here.pack(), length, free[rows])
        best = State.unpack(minimize(total, x, *limits, total.newton).x, length)
        moved = ((best.pose - here.pose) / part.of(*ERRORS)[:, None]).square().mean(2).amax(1)
        state.pose[rows], state.shared[rows] = best  # `here` may be a view of it
        told[rows, 1:] = extents_told(told[rows, 0], expected, best, total.factor)
        is_done = (moved <= SETTLED**2) & (turn > 0) | (turn + 1 >= rounds)
        done, leaves = is_done.nonzero()[:, 0], is_done & part.valid.all(1)
        covariances[rows[done]] = select(total.factor, done).inverse_of_links(length)
        if not is_track and length == config.window:
            for whole, new in zip(left, remembered(terms, best), strict=False):
                whole[rows[leaves]] = new[leaves]
        return rows[~is_done]

    workers = solver.threads or cpu_count()
    with ThreadPoolExecutor(workers, '', torch.set_num_threads, (1,)) as pool:
        rows = every = torch.arange(len(state.pose), device=free.device)
        size = (PART if rows.is_cpu else torch.inf) / length
        while len(rows):
            expectation = expect(problem, rule, noise)
            n = min(len(rows), workers * int(1 + len(rows) / size / workers))
            ends = pool.map(improve, rows.tensor_split(n)) if len(rows) > size else [improve(rows)]
            rows, turn = torch.cat(list(ends)), turn + 1
            if is_track:
                noise = InputNoise.measure(scatter(problem, state)) if turn <= HEARD else noise
                noise = noise._replace(told=torch.cat([known.told, told.cpu()]))
            if not len(rows) and 2 * enough <= problem.points.shape[2]:
                rows, enough = every, torch.inf  # where few points lead to, all of them tell
    return Solution(state, covariances, left, told)


def solve_paper(problem: Problem, config: Config) -> Solution:
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
    expected = expect(problem, Rule(*torch.zeros(3, 6))).shared
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
            part, factors = select(problem, rows), multipliers[rows]
            loss, _ = objective.total(boxes(x, rows), part, settings, factors, rounding)
            (gradient,) = torch.autograd.grad(loss.sum(), x)
        return loss.detach(), gradient * free[rows]

    for turn in range(settings.multiplier_rounds):
        rounding = max(ROUNDING * 0.01**turn, objective.EPSILON)
        x = minimize(function, x, settings.iterations, config.solver.history, 1e-9).x
        rows = torch.arange(len(x), device=x.device)
        _, violation = objective.total(boxes(x, rows), problem, settings, multipliers, rounding)
        multipliers += violation * x.new_tensor([settings.smoothness, settings.alignment])
    spread = torch.diag_embed(problem.of(*ERRORS) ** 2)[:, None].expand(-1, length, -1, -1)
    return Solution(State(x.unflatten(1, (length, 6)), expected), spread)


def weigh(
    problem: Problem, state: State, sights: Support, expected: Expected, config: Config
) -> list[Term]:
    """
    Return the terms of one round, weighted by expected deviations and by how far off they are.

    Notes
    -----
    A face loses its say as the square of Cauchy's weight, the input as Cauchy's. A gap is unusual
    by how many deviations it is from the expected one, or the points from where they are
    expected: those of a load, or of a branch above, are not to lift the roof.

    """
    of, valid, faces, given = problem.of, problem.valid.to(state.pose), config.faces, problem.pose
    axes = rotation_from_rpy(state.pose[..., 3:])
    astray = surprise(problem, axes)

    # Closeness and enclosure: outermost points on their faces, unless metres from where a track
    # leads: those are of another object.
    errors = [faces.ends] * 2 + [faces.sides] * 2 + [faces.top, faces.bottom]
    trust = sights.trust / (1 + (sights.outwardness / faces.outlier) ** 2) ** 2
    own = valid / (1 + astray[..., :2].square().sum(2) ** 2) ** 2
    trust = trust * own[..., None] / torch.tensor(errors).to(trust) ** 2
    # The input, its bias and its extents.
    wanted, spread, error, widened = expected
    input_off = objective.prior(state, given, axes)
    off = (input_off.residual[:, :, 0].abs() + astray) / error[:, None]
    hold = valid[..., None] / widened[:, None] ** 2 / (1 + (off / PRIOR_OUTLIER) ** 2)
    # Points and the face of the input are apart by gap, bias and half the error of the extent.
    wide = faces.spread**2 + (spread[:, 3:6] ** 2 + (spread[:, EXTENT] / 2) ** 2)[:, FACE_AXIS]
    away = (sights.outwardness * trust).sum(1) / trust.sum(1).clamp(min=1e-9)
    odd = (state.shared - wanted)[:, GAP] ** 2 / faces.spread**2
    gap = spread[:, GAP] * faces.spread * (1 + odd.maximum(away**2 / wide) / GAP_OUTLIER**2).sqrt()
    shared = torch.cat([spread[:, : GAP.start], gap, spread[:, GAP.stop :]], 1) ** -2
    # Motion: smoothness, alignment, rest.
    change = of('acceleration', 'cornering', 'vertical', 'tilting', 'tilting', 'turning') ** -2
    turn = input_off.by_pose[:, :, 0].mT
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
        Term(objective.rest, diagonal(still[:, None] * _parked(problem, error[:, 5])[..., None])),
        Term(objective.shared_prior, diagonal(shared[:, None]), (wanted,)),
        Term(objective.memory, problem.information[:, None, None], (problem.recalled[:, None],)),
    ]


def yielding(term: Term, state: State) -> Term:
    """
    Return `term` of the motion with less weight where `state` is far off it [for Eq. 6 and 7].

    Else who brakes hard, swerves or drifts would be moved off the points, which then lose their
    say. The weight (B, n, 1, R, R) falls by how many deviations the residual (B, n, 1, R) is. A
    stencil yields no more than the two before it: the newest boxes are nearly as noisy as their
    input.

    """
    r = term.linearise(state).residual[:, :, 0, :, None]
    far = (r.mT @ term.weight[:, :, 0] @ r)[..., None] / SWERVE**2
    far[:, 2:] = far[:, 2:].minimum(far[:, 1:-1]).minimum(far[:, :-2])
    return term._replace(weight=term.weight / (1 + far) ** 2)


def surprise(problem: Problem, axes: Tensor) -> Tensor:
    """
    Return how far off each input pose is from what its neighbours make expect, (B, N, 6).

    The least of what two before, two after and one on each side say, along `axes`: an outlier is
    told by all of them, its neighbours by two at most. A third of it counts: noise alone makes
    so much more of it than of the noise itself.

    """
    own = torch.cat([problem.pose, problem.times.where(problem.valid, torch.nan)[..., None]], 2)
    five = pad(own.mT, (2, 2), value=torch.nan).unfold(2, 5, 1).transpose(1, 2)
    a, b, here = five[..., [0, 1, 3]], five[..., [1, 3, 4]], five[..., 2:3]
    off = here - a - (b - a) * (here - a)[..., 6:, :] / (b - a)[..., 6:, :]
    off = torch.cat([axes.mT @ off[..., :3, :], off[..., 3:6, :]], 2).abs()
    return off.nan_to_num(torch.inf).amin(3).nan_to_num(posinf=0.0) / 3


def _parked(problem: Problem, heading: Tensor) -> Tensor:
    """
    Return 1 for the steps (B, N - 1) of windows whose input hardly moves or turns, else 0.

    `heading` (B,) is how far its yaw errs as measured [rad]: noise alone is no turn. At an end of
    a long stand, a vehicle may brake or drive off: no step is at rest within four of one where the
    medians of the five boxes before and after are apart.

    """
    valid, t, xy = problem.valid.to(problem.times), problem.times, problem.boxes[..., :2]
    late = (t - (t * valid).sum(1, keepdim=True) / valid.sum(1, keepdim=True)) * valid
    rate = (late[..., None] * problem.boxes[..., [0, 1, YAW]]).sum(1) / (late * t).sum(1)[:, None]
    where = torch.where(problem.valid[..., None], torch.cat([xy, t[..., None]], 2), torch.nan)
    away = (where - where.nanmedian(1, keepdim=True).values)[..., :2].norm(dim=2)
    speed, seconds = rate[:, :2].square().sum(1).sqrt(), (t * valid).amax(1)
    moved = torch.maximum(speed * seconds, 2 * away.nanmedian(1).values)
    turned = rate[:, 2].abs() * seconds / heading.maximum(problem.of('heading')[:, 0])
    is_slow = (speed < PARKED[0]) & (moved < PARKED[1]) & (turned < PARKED[2])
    five: Tensor = pad(where.mT, (5, 5), value=torch.nan).unfold(2, 5, 1).median(3).values
    step = five[..., 6:-1] - five[..., 1:-6]  # from five to the next five
    drives = (step[:, :2].norm(dim=1) > PARKED[3] * step[:, 2]).to(t)
    return valid[:, 1:] * is_slow[:, None] * torch.max_pool1d(drives, 9, 1, 4).eq(0)


def free_variables(problem: Problem, config: Config) -> Tensor:
    """Return 1 for every variable (B, 6 N + 22) to be solved for, 0 for those that stay."""
    pose = problem.valid[..., None].to(problem.boxes).expand(-1, -1, 6).clone()
    shared = pose.new_ones((len(pose), SHARED))
    if config.mode == 'bev':
        pose[..., [2, 3, 4]], shared[:, 2] = 0.0, 0.0
    if config.extent == 'fixed':
        shared[:, :3] = 0.0
    return State(pose, shared).pack()


@torch.inference_mode()
def _learn(model: InputModel, windows: Sequence[Window], config: Config) -> None:
    """
    Show the model the fresh observations at their input boxes, live turned as they were fitted.

    The outermost points of a box given askew are its corners, which stand further out.

    """
    if fresh := [window.learning_part() for window in windows if window.num_new > 0]:
        problem, rule = stack_windows(fresh, config)[0].thinned(COARSE), model.rule()
        pose = torch.cat([problem.boxes[..., :3], problem.start[..., 6:]], -1)
        state = State(pose, expect(problem, rule).shared)
        sights = support(problem, state, config.faces.outermost, rule)
        model.learn_rule([window.track_id for window in fresh], sights, problem.valid, rule)


def _held(problem: Problem, pose: Tensor, extent: Tensor) -> Tensor:
    """Return how many points lie in boxes of `pose` (B, N, 6) and `extent` (B, N, 3), (B, N)."""
    local = in_box_axes(problem.points, problem, pose).abs_()
    return (local.sub_(extent[..., None].to(local) / 2).amax(-2) < 0.05).sum(-1)
