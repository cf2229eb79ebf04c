"""
L-BFGS for B independent problems at once, of any kind.

Every row has its own curvature history, step length, stopping test and best point, so that its
result does not depend on the other rows. See docs/decisions.md.

"""

from collections.abc import Callable
from enum import IntEnum
from typing import NamedTuple

import torch
from torch import Tensor
from torch.linalg import vector_norm

SUFFICIENT_DECREASE = 1e-4
"""Part of the predicted decrease that a step must reach: c1 of Armijo's condition. Literature:
Nocedal and Wright, Numerical Optimization, 2nd edition, section 3.1."""
MIN_CURVATURE = 1e-10
"""A pair with s'y below this part of |s||y| is left out of the history. Chosen: rounding."""
STEP_BOUNDS = (0.1, 0.5)
"""Bounds of a shortened step over the one before. Literature: Dennis and Schnabel, Numerical
Methods for Unconstrained Optimization, section 6.3.2."""
MAX_BACKTRACKS = 12
"""Most trials of one direction. Chosen: the last step is 2^-11 of the first, or shorter."""
HISTORY = 6
"""Curvature pairs that are kept. Literature: 3 to 20 (Nocedal and Wright, section 7.2)."""

Function = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
Metric = Callable[[Tensor, Tensor], Tensor]
CurvaturePair = tuple[Tensor, Tensor, Tensor]
"""A step s, the change y of the gradient over it, and 1 / s'y: (b, D), (b, D), (b, 1)."""


class Status(IntEnum):
    """How a row ended."""

    RUNNING = 0
    CONVERGED = 1
    STUCK = 2
    FAILED = 3


class Minimum(NamedTuple):
    """The best point of each row."""

    x: Tensor
    """(B, D), best point; that of the start if nothing better was found."""
    value: Tensor
    """(B,), its value."""
    status: Tensor
    """(B,), `Status`; RUNNING: the iterations ran out."""
    iterations: Tensor
    """(B,), taken."""


class _Search(NamedTuple):
    """The state of the rows (b,) that are still in the batch."""

    rows: Tensor
    x: Tensor
    value: Tensor
    gradient: Tensor
    step: Tensor  # (b, D), to try next
    slope: Tensor  # predicted change of the value over the step
    has_moved: Tensor  # whether the last trial was accepted: a new direction is needed
    backtracks: Tensor  # of the present direction
    changes: list[tuple[Tensor, Tensor]]  # of x and gradient since there were new directions
    pairs: list[CurvaturePair]


def minimize(
    function: Function,
    start: Tensor,
    iterations: int,
    history: int,
    tolerance: float,
    metric: Metric | None = None,
    first: tuple[Tensor, Tensor] | None = None,
) -> Minimum:
    """
    Minimise one function per row.

    Parameters
    ----------
    function : callable
        Maps points (b, D) and their rows (b,) to values (b,) and gradients (b, D).
    start : Tensor, shape (B, D)
        Start of each row.
    iterations, history : int
        Most iterations, and curvature pairs that are kept.
    tolerance : float
        A row has converged when the predicted decrease of its value is less, as part of
        1 + |value|.
    metric : callable, optional
        Maps vectors (b, D) and their rows to the inverse of an approximate Hessian times them.
        Without it the usual scaled identity is used.
    first : pair of Tensor, optional
        Values and gradients at the start, where they are known.

    Returns
    -------
    minimum : Minimum
        Best point, value, status and iterations per row.

    Notes
    -----
    Two-loop recursion (Nocedal and Wright, algorithm 7.4), then backtracking from a full step by
    quadratic interpolation until Armijo's condition holds. Every turn evaluates one point per row:
    a row that accepts it goes on from there while its neighbour still shortens its step. Ended
    rows leave the batch.

    """
    rows = torch.arange(len(start), device=start.device)
    value, gradient = function(start, rows) if first is None else first
    is_finite = _are_finite(value, gradient.sum(1))
    status, zeros = int(Status.FAILED) * ~is_finite, torch.zeros_like(rows)
    best = Minimum(start.clone(), value.clone(), status, zeros.clone())
    search = _Search(rows, start, value, gradient, start, value, is_finite, zeros, [], [])
    search = _select(search, is_finite.nonzero()[:, 0])
    for turn in range(iterations * MAX_BACKTRACKS):
        if turn >= iterations:
            goes_on = best.iterations[search.rows] < iterations
            search = _select(search, (goes_on | ~search.has_moved).nonzero()[:, 0])
        if search.rows.numel():
            search = _with_new_directions(search, best, metric, tolerance, history)
        if not search.rows.numel():
            break
        search = _after_trial(search, best, function)
    return best


def _with_new_directions(
    search: _Search, best: Minimum, metric: Metric | None, tolerance: float, history: int
) -> _Search:
    """
    Give a new direction to the rows that have moved, or leave those out that have converged.

    Status and iterations of `best` are updated.

    """
    moved = search.has_moved.nonzero()[:, 0]
    if not moved.numel():
        return search
    pairs = [*search.pairs, *(_pair(*change) for change in search.changes)]
    search = search._replace(changes=[], pairs=pairs[-history:])
    rows, _, value, gradient, *_, pairs = _select(search, moved)
    step = -_two_loop(gradient, pairs, rows, metric)
    slope = (gradient * step).sum(1)
    if not slope.max() < 0:  # uphill, or not a number
        is_downhill = slope < 0
        step = torch.where(is_downhill[:, None], step, -gradient)
        slope = torch.where(is_downhill, slope, -gradient.square().sum(1))
    if metric is None and not pairs:  # the scale is unknown: a step of length 1 at most
        size = gradient.abs().sum(1).clamp(min=1.0)
        step = step / size[:, None]
        slope = slope / size
    has_converged = -slope <= tolerance * (1 + value.abs())
    best.iterations.index_add_(0, rows, 1 - has_converged.to(rows.dtype))
    best.status.index_add_(0, rows, int(Status.CONVERGED) * has_converged)
    if moved.numel() < search.rows.numel():
        step = search.step.index_copy(0, moved, step)
        slope = search.slope.index_copy(0, moved, slope)
    return _running(search._replace(step=step, slope=slope), best)


def _after_trial(search: _Search, best: Minimum, function: Function) -> _Search:
    """
    Evaluate one point per row; accept it, or shorten the step.

    Point, value and status of `best` are updated.

    """
    rows, x, value, gradient, s, slope, _, backtracks, changes, _ = search
    trial, trial_gradient = function(x + s, rows)
    y = trial_gradient - gradient
    s_y = (s * y).sum(1)  # finite where the gradient is
    is_good = _are_finite(trial, s_y) & (trial <= value + SUFFICIENT_DECREASE * slope)
    all_good = bool(is_good.all())
    backtracks = ~is_good * (backtracks + 1)
    search = search._replace(has_moved=is_good, backtracks=backtracks)
    if not all_good:
        best.status.index_add_(0, rows, int(Status.STUCK) * (backtracks == MAX_BACKTRACKS))
        part = _shorter(slope, trial - value)
        search = search._replace(step=part[:, None] * s, slope=part * slope)
        trial = torch.where(is_good, trial, value)
        s, y = (torch.where(is_good[:, None], change, 0.0) for change in (s, y))
    search = search._replace(
        x=x + s, value=trial, gradient=gradient + y, changes=[*changes, (s, y)]
    )
    best.x.index_copy_(0, rows, search.x)  # by Armijo's condition never worse than before
    best.value.index_copy_(0, rows, trial)
    return search if all_good else _running(search, best)


def _pair(s: Tensor, y: Tensor) -> CurvaturePair:
    """Return the curvature pair of a change of x and gradient."""
    s_y = (s * y).sum(1)
    is_curved = s_y > MIN_CURVATURE * vector_norm(s, dim=1) * vector_norm(y, dim=1)
    return s, y, torch.where(is_curved, 1 / s_y, 0.0)[:, None]


def _are_finite(value: Tensor, total: Tensor) -> Tensor:
    """Return which values (b,) and sums (b,) are finite; a sum of finite numbers is."""
    return (value + total).isfinite()


def _shorter(slope: Tensor, rise: Tensor) -> Tensor:
    """Return parts (b,) of steps, by the parabola through the slope and the `rise` at the step."""
    parabola = -slope / (2 * (rise - slope))
    return parabola.nan_to_num(0.0, 0.0, 0.0).clamp(*STEP_BOUNDS)


def _two_loop(
    gradient: Tensor, pairs: list[CurvaturePair], rows: Tensor, metric: Metric | None
) -> Tensor:
    """Return the inverse Hessian approximated by `pairs`, times `gradient`."""
    q = gradient
    alphas = []
    for s, y, rho in reversed(pairs):
        alpha = rho * (s * q).sum(1, keepdim=True)
        q = q - alpha * y
        alphas.append(alpha)
    if metric is not None:
        q = metric(q, rows)
    elif pairs:
        _, y, rho = pairs[-1]
        scale = 1 / (rho * y.square().sum(1, keepdim=True))
        q = q * torch.where(scale.isfinite(), scale, 1.0)
    for (s, y, rho), alpha in zip(pairs, reversed(alphas), strict=True):
        q = q + s * (alpha - rho * (y * q).sum(1, keepdim=True))
    return q


def _running(search: _Search, best: Minimum) -> _Search:
    """Return the rows of a search that have not ended."""
    status = best.status.index_select(0, search.rows)
    return _select(search, (status == Status.RUNNING).nonzero()[:, 0])


def _select(search: _Search, rows: Tensor) -> _Search:
    """Return `rows`, ascending, of a search; if they are all its rows, the search itself."""
    if rows.numel() == search.rows.numel():
        return search
    *parts, changes, pairs = search
    parts = [part.index_select(0, rows) for part in parts]
    changes = [(s[rows], y[rows]) for s, y in changes]
    return _Search._make([*parts, changes, [(s[rows], y[rows], rho[rows]) for s, y, rho in pairs]])
