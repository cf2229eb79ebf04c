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
"""A step s, the change y of the gradient over it, and 1 / s'y: (b, D), (b, D), (b,)."""


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
    direction: Tensor
    slope: Tensor  # of the value along the direction
    step: Tensor  # length to try next, in multiples of the direction
    has_moved: Tensor  # whether the last trial was accepted: a new direction is needed
    tries: Tensor  # of the present direction
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
    is_finite = _are_finite(value, gradient)
    status = torch.where(is_finite, 0, int(Status.FAILED))
    best = Minimum(start.clone(), value.clone(), status, torch.zeros_like(rows))
    zeros = torch.zeros_like(rows)
    search = _Search(
        rows, start, value, gradient, start, value, value, is_finite, zeros, list[CurvaturePair]()
    )
    search = _select(search, is_finite.nonzero()[:, 0])
    for turn in range(iterations * MAX_BACKTRACKS):
        if turn >= iterations:
            goes_on = best.iterations[search.rows] < iterations
            search = _select(search, (goes_on | ~search.has_moved).nonzero()[:, 0])
        if len(search.rows):
            search = _with_new_directions(search, best, metric, tolerance)
        if not len(search.rows):
            break
        search = _after_trial(search, best, function, history)
    return best


def _with_new_directions(
    search: _Search, best: Minimum, metric: Metric | None, tolerance: float
) -> _Search:
    """
    Give a new direction to the rows that have moved, or leave those out that have converged.

    Status and iterations of `best` are updated.

    """
    moved = search.has_moved.nonzero()[:, 0]
    if not len(moved):
        return search._replace(tries=search.tries + 1)
    rows, _, value, gradient, *_, pairs = _select(search, moved)
    direction = -_two_loop(gradient, pairs, rows, metric)
    slope = (gradient * direction).sum(1)
    is_uphill = ~(slope < 0)
    if is_uphill.any():
        direction = torch.where(is_uphill[:, None], -gradient, direction)
        slope = torch.where(is_uphill, -gradient.square().sum(1), slope)
    if metric is None and not pairs:  # the scale is unknown: a step of length 1 at most
        size = gradient.abs().sum(1).clamp(min=1.0)
        direction = direction / size[:, None]
        slope = slope / size
    has_converged = -slope <= tolerance * (1 + value.abs())
    best.iterations[rows] += ~has_converged
    if len(moved) == len(search.rows):
        step, tries = torch.ones_like(slope), torch.ones_like(rows)
    else:
        direction = search.direction.index_copy(0, moved, direction)
        slope = search.slope.index_copy(0, moved, slope)
        step = torch.where(search.has_moved, 1.0, search.step)
        tries = torch.where(search.has_moved, 0, search.tries) + 1
    search = search._replace(direction=direction, slope=slope, step=step, tries=tries)
    if not has_converged.any():
        return search
    best.status[rows[has_converged]] = int(Status.CONVERGED)
    return _running(search, best)


def _after_trial(search: _Search, best: Minimum, function: Function, history: int) -> _Search:
    """
    Evaluate one point per row; accept it, or shorten the step.

    Point, value and status of `best` are updated.

    """
    rows, value, slope, step = search.rows, search.value, search.slope, search.step
    s = step[:, None] * search.direction
    trial, trial_gradient = function(search.x + s, rows)
    has_decreased = trial <= value + SUFFICIENT_DECREASE * step * slope
    is_good = _are_finite(trial, trial_gradient) & has_decreased
    y = trial_gradient - search.gradient
    all_good = bool(is_good.all())
    if not all_good:
        is_stuck = ~is_good & (search.tries == MAX_BACKTRACKS)
        best.status[rows] += int(Status.STUCK) * is_stuck
        step = _shorter(step, slope, trial - value)
        s, y = (torch.where(is_good[:, None], change, 0.0) for change in (s, y))
        trial = torch.where(is_good, trial, value)
    s_y = (s * y).sum(1)
    is_curved = s_y > MIN_CURVATURE * vector_norm(s, dim=1) * vector_norm(y, dim=1)
    pair = s, y, torch.where(is_curved, 1 / s_y, 0.0)

    search = search._replace(
        x=search.x + s,
        value=trial,
        gradient=search.gradient + y,
        step=step,
        has_moved=is_good,
        pairs=[*search.pairs, pair][-history:],
    )
    best.x[rows] = search.x  # by Armijo's condition never worse than before
    best.value[rows] = search.value
    return search if all_good else _running(search, best)


def _are_finite(value: Tensor, gradient: Tensor) -> Tensor:
    """Return which values (b,) and gradients (b, D) are finite; a sum of finite numbers is."""
    return (value + gradient.sum(1)).isfinite()


def _shorter(step: Tensor, slope: Tensor, rise: Tensor) -> Tensor:
    """Return shorter steps (b,), by the parabola through the slope and the `rise` at `step`."""
    parabola = -slope * step.square() / (2 * (rise - slope * step))
    least, most = STEP_BOUNDS
    shorter = torch.where(parabola.isfinite(), parabola, least * step)
    return shorter.clamp(least * step, most * step)


def _two_loop(
    gradient: Tensor, pairs: list[CurvaturePair], rows: Tensor, metric: Metric | None
) -> Tensor:
    """Return the inverse Hessian approximated by `pairs`, times `gradient`."""
    q = gradient
    alphas = []
    for s, y, rho in reversed(pairs):
        alpha = rho * (s * q).sum(1)
        q = q - alpha[:, None] * y
        alphas.append(alpha)
    if metric is not None:
        q = metric(q, rows)
    elif pairs:
        _, y, rho = pairs[-1]
        scale = 1 / (rho * y.square().sum(1))
        q = q * torch.where(scale.isfinite(), scale, 1.0)[:, None]
    for (s, y, rho), alpha in zip(pairs, reversed(alphas), strict=True):
        q = q + s * (alpha - rho * (y * q).sum(1))[:, None]
    return q


def _running(search: _Search, best: Minimum) -> _Search:
    """Return the rows of a search that have not ended."""
    return _select(search, (best.status[search.rows] == Status.RUNNING).nonzero()[:, 0])


def _select(search: _Search, rows: Tensor) -> _Search:
    """Return `rows`, ascending, of a search; if they are all its rows, the search itself."""
    if len(rows) == len(search.rows):
        return search
    *parts, pairs = search
    chosen = [(s[rows], y[rows], rho[rows]) for s, y, rho in pairs]
    return _Search._make([*(part[rows] for part in parts), chosen])
