"""
L-BFGS for B independent problems at once, of any kind.

Every row has its own curvature history, step length, stopping test and best point, so that its
result does not depend on the other rows. See docs/decisions.md.

"""

from collections.abc import Callable
from enum import IntEnum
from typing import Any, NamedTuple

from boxreg_ros.structures import Floats, Ints
import numpy as np
from numpy.typing import NDArray
import torch
from torch import Tensor

SUFFICIENT_DECREASE = 1e-4
"""Part of the predicted decrease that a step must reach: c1 of Armijo's condition. Literature:
Nocedal and Wright, Numerical Optimization, 2nd edition, section 3.1."""
MIN_CURVATURE = 1e-10
"""A pair with s'y below this part of the predicted decrease is left out of the history. Chosen:
rounding."""
STEP_BOUNDS = (0.1, 0.5)
"""Bounds of a shortened step over the one before. Literature: Dennis and Schnabel, Numerical
Methods for Unconstrained Optimization, section 6.3.2."""
MAX_BACKTRACKS = 12
"""Most trials of one direction. Chosen: the last step is 2^-11 of the first, or shorter."""
HISTORY = 6
"""Curvature pairs that are kept. Literature: 3 to 20 (Nocedal and Wright, section 7.2)."""

Function = Callable[[Tensor, Tensor], tuple[Tensor, ...]]
CurvaturePair = tuple[Tensor, Tensor, Tensor, Tensor]
"""A step s, the change y of the gradient over it, that of the scaled gradient, (B, D) each; and
1 / s'y, (B, 1)."""


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
    status: Ints
    """(B,), `Status`; RUNNING: the iterations ran out."""
    iterations: Ints
    """(B,), taken."""


class _Points(NamedTuple):
    """A point of each of b rows, its value, gradient and scaled gradient, (b, D) but the value."""

    x: Tensor
    value: Tensor
    gradient: Tensor
    scaled: Tensor

    @classmethod
    def of(cls, x: Tensor, value: Tensor, gradient: Tensor, *scaled: Tensor) -> '_Points':
        """Return points with what the function gives: without a scaled gradient, the gradient."""
        return cls(x, value, gradient, *(scaled or (gradient,)))

    def copy(self) -> '_Points':
        """Return copies."""
        return _Points(*(part.clone() for part in self))

    def part(self, rows: Tensor) -> '_Points':
        """Return those of some rows."""
        return _Points(*(part.index_select(0, rows) for part in self))

    def set_rows(self, rows: Ints, others: '_Points', chosen: Ints) -> None:
        """Replace those of `rows` by those of `others` that are `chosen`."""
        for part, other in zip(self, others, strict=True):
            part.numpy()[rows] = other.numpy()[chosen]


@np.errstate(all='ignore')  # numbers that are not finite have a status, or a shorter step
def minimize(
    function: Function,
    start: Tensor,
    iterations: int,
    history: int,
    tolerance: float,
    first: tuple[Tensor, ...] | None = None,
    trial: tuple[Tensor, ...] | None = None,
) -> Minimum:
    """
    Minimise one function per row.

    Parameters
    ----------
    function : callable
        Maps points (b, D) and their rows (b,) to values (b,) and gradients (b, D); and, if it is
        known, to an approximate inverse Hessian of each row, which is the same at all points,
        times its gradient (b, D). Without that the usual scaled identity is used.
    start : Tensor, shape (B, D)
        Start of each row.
    iterations, history : int
        Most iterations, and curvature pairs that are kept.
    tolerance : float
        A row has converged when the predicted decrease of its value is less, as part of
        1 + |value|.
    first : tuple of Tensor, optional
        What the function gives at the start, where it is known.
    trial : tuple of Tensor, optional
        The start less that times the gradient, and what the function gives there, if known.

    Returns
    -------
    minimum : Minimum
        Best point, value, status and iterations per row.

    Notes
    -----
    Two-loop recursion (Nocedal and Wright, algorithm 7.4), then backtracking from a full step by
    quadratic interpolation until Armijo's condition holds: no row gets worse. Ended rows are not
    evaluated.

    """
    at = _Points.of(start, *(first or function(start, torch.arange(len(start)))))
    known = _Points(*trial) if trial else None
    has_metric = at.scaled is not at.gradient
    is_running = np.ones(len(start), bool)
    status = np.full(len(start), int(Status.RUNNING))
    taken = np.zeros(len(start), int)
    pairs: list[CurvaturePair] = []
    for iteration in range(iterations):
        step = _two_loop(at, pairs, has_metric)
        step, slope = _downhill(step, at.gradient, is_scaled=bool(pairs) or has_metric)
        value = at.value.numpy()
        goes_on = slope > tolerance * (1 + np.abs(value))  # neither is NaN
        ended = (is_running & ~goes_on).nonzero()[0]
        if len(ended):
            is_finite = np.isfinite(slope[ended] + value[ended])
            status[ended] = np.where(is_finite, int(Status.CONVERGED), int(Status.FAILED))
            is_running[ended] = False
        rows = is_running.nonzero()[0]
        if not len(rows):
            break
        taken += is_running
        before = at
        if step is not at.scaled:
            known = None
        at, stuck = _line_search(function, before, rows, step, slope, known)
        status[stuck] = int(Status.STUCK)
        is_running[stuck] = False
        if iteration + 1 < iterations:
            pairs = [*pairs, _pair(before, at, slope)][-history:]
    return Minimum(at.x, at.value, status, taken)


def _downhill(step: Tensor, gradient: Tensor, is_scaled: bool) -> tuple[Tensor, Floats]:
    """
    Return steps (B, D) that are to be subtracted, and the predicted decreases of the values (B,).

    A step uphill is replaced by that along the gradient. Where the scale is unknown, a step has a
    length of 1 at most.

    """
    slope = _product(gradient, step)
    is_downhill = slope > 0
    if not is_downhill.all():  # uphill, or not a number
        step = torch.where(_column(is_downhill), step, gradient)
        slope = np.where(is_downhill, slope, _product(gradient, gradient))
    if not is_scaled:
        size = gradient.abs().sum(1).clamp(min=1.0)
        step = step / size[:, None]
        slope = slope / size.numpy()
    return step, slope


def _line_search(
    function: Function,
    before: _Points,
    rows: Ints,
    step: Tensor,
    slope: Floats,
    known: _Points | None,
) -> tuple[_Points, Ints]:
    """
    Return the points where a step of each of `rows` ends, and the rows that found no better one.

    The steps (B, D) and `slope` (B,), as those `before`, are of all rows; the others stay. The
    first points, those at the full step, may be `known`.

    """
    found, x, value = before, before.x, before.value.numpy()
    remaining = rows
    for _ in range(MAX_BACKTRACKS):
        if len(remaining) < len(x):
            index = torch.from_numpy(remaining)
            x, step = x.index_select(0, index), step.index_select(0, index)
            value, slope = value[remaining], slope[remaining]
            known = known and known.part(index)
        reached = x - step
        trial = known or _Points.of(reached, *function(reached, torch.from_numpy(rows)))
        known = None
        is_good = trial.value.numpy() <= value - SUFFICIENT_DECREASE * slope
        good = is_good.nonzero()[0]
        if len(good) == len(before.x):
            return trial, rows[:0]
        if found is before:
            found = before.copy()
        found.set_rows(rows[good], trial, good)
        if len(good) == len(rows):
            return found, rows[:0]
        remaining = (~is_good).nonzero()[0]
        rows = rows[remaining]
        part = _shorter(slope, trial.value.numpy() - value)
        step, slope = _column(part) * step, part * slope
    return found, rows


def _pair(before: _Points, after: _Points, slope: Floats) -> CurvaturePair:
    """Return the curvature pair of a step; of a row that did not move, one without effect."""
    s, y = after.x - before.x, after.gradient - before.gradient
    s_y = _product(s, y)
    is_curved = s_y > MIN_CURVATURE * slope
    rho = _column(np.divide(1, s_y, out=np.zeros(len(s_y)), where=is_curved))
    return s, y, after.scaled - before.scaled, rho


def _product(a: Tensor, b: Tensor) -> Floats:
    """Return the inner products (B,) of vectors (B, D)."""
    product: Floats = (a * b).sum(1).numpy()
    return product


def _column(numbers: NDArray[Any]) -> Tensor:
    """Return a number of each row as a column (B, 1)."""
    return torch.from_numpy(numbers[:, None])


def _shorter(slope: Floats, rise: Floats) -> Floats:
    """Return parts (b,) of steps, by the parabola through the slope and the `rise` at the step."""
    parabola = slope / (2 * (rise + slope))
    shortest, longest = STEP_BOUNDS
    part: Floats = np.fmin(np.fmax(parabola, shortest), longest)  # the shortest of NaN
    return part


def _two_loop(at: _Points, pairs: list[CurvaturePair], has_metric: bool) -> Tensor:
    """Return the inverse Hessian approximated by `pairs`, times the gradient."""
    q, step = at.gradient, at.scaled  # which is linear in q
    alphas = []
    for s, y, scaled_y, rho in reversed(pairs):
        alpha = rho * (s * q).sum(1, keepdim=True)
        q = q.addcmul(alpha, y, value=-1)
        step = step.addcmul(alpha, scaled_y, value=-1)
        alphas.append(alpha)
    if pairs and not has_metric:
        _, y, _, rho = pairs[-1]
        scale = 1 / (rho * y.square().sum(1, keepdim=True))
        step = step * torch.where(scale.isfinite(), scale, 1.0)
    for (s, y, _, rho), alpha in zip(pairs, reversed(alphas), strict=True):
        step = step.addcmul(s, alpha - rho * (y * step).sum(1, keepdim=True))
    return step
