"""
L-BFGS for B independent problems at once; knows no boxes.

Every row has its own curvature history, step length, stopping test and best point, so that a row
behaves as if it were alone: a hard or broken one neither slows nor spoils its neighbours.

"""

from collections.abc import Callable
from enum import IntEnum
from typing import NamedTuple

import torch
from torch import Tensor

SUFFICIENT = 1e-4  # part of the promised decrease that a step must bring (Armijo)
CURVATURE = 1e-10  # a pair with s.y below this part of |s||y| is not remembered
BACKTRACKS = 12

Function = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
Metric = Callable[[Tensor, Tensor], Tensor]


class Status(IntEnum):
    """How a row ended."""

    RUNNING = 0
    CONVERGED = 1
    STUCK = 2
    FAILED = 3


class Minimum(NamedTuple):
    """
    The best point of each row.

    Attributes
    ----------
    x, value : Tensor, shapes (B, D) and (B,)
        Best point met and its value; that of the start if nothing better was found.
    status, iterations : Tensor, shape (B,)
        `Status` (RUNNING: the iterations ran out), and iterations taken.

    """

    x: Tensor
    value: Tensor
    status: Tensor
    iterations: Tensor


def minimize(
    function: Function,
    start: Tensor,
    iterations: int,
    history: int,
    tolerance: float,
    metric: Metric | None = None,
) -> Minimum:
    """
    Minimise one function per row.

    Parameters
    ----------
    function : callable
        Maps points (b, D) and their rows (b,) to values (b,) and gradients (b, D).
    start : Tensor, shape (B, D)
        Where each row starts.
    iterations, history : int
        Most iterations, and curvature pairs remembered.
    tolerance : float
        A row ends when its step promises to lower the value by less, as part of 1 + |value|.
    metric : callable, optional
        Maps vectors (b, D) and their rows to the inverse of an approximate Hessian times them.
        Without it the usual scaled identity is used.

    Returns
    -------
    minimum : Minimum
        Best point, value, status and iterations per row.

    Notes
    -----
    Two-loop recursion, then backtracking from a full step by quadratic interpolation until the
    Armijo condition holds. Ended rows leave the batch as soon as they are half of it.

    """
    rows = torch.arange(len(start), device=start.device)
    value, gradient = function(start, rows)
    finite = value.isfinite() & gradient.isfinite().all(1)
    best = Minimum(
        start.clone(), value.clone(), torch.where(finite, 0, Status.FAILED), torch.zeros_like(rows)
    )
    x, gradient = start.clone(), torch.where(finite[:, None], gradient, 0.0)
    pairs: list[tuple[Tensor, Tensor, Tensor]] = []
    for iteration in range(iterations):
        running = best.status[rows] == Status.RUNNING
        count = int(running.sum())
        if count == 0:
            break
        if count <= len(rows) // 2:
            rows, x, value, gradient = (t[running] for t in (rows, x, value, gradient))
            pairs = [(s[running], y[running], r[running]) for s, y, r in pairs]
            running = running[running]
        direction = -_two_loop(gradient, pairs, rows, metric)
        slope = (gradient * direction).sum(1)
        uphill = ~(slope < 0)
        direction = torch.where(uphill[:, None], -gradient, direction)
        slope = torch.where(uphill, -gradient.square().sum(1), slope)
        if metric is None and not pairs:  # nothing known of the scale yet
            size = gradient.abs().sum(1).clamp(min=1.0)
            direction, slope = direction / size[:, None], slope / size
        converged = running & (-slope <= tolerance * (1 + value.abs()))
        best.status[rows[converged]] = int(Status.CONVERGED)
        running &= ~converged
        step, fresh_value, fresh_gradient = _search(
            function, x, value, direction, slope, gradient, rows, running
        )
        moved = running & (step > 0)
        best.status[rows[running & ~moved]] = int(Status.STUCK)
        best.iterations[rows[running]] = iteration + 1
        change = torch.where(moved, step, 0.0)[:, None] * direction
        x = x + change
        bend = torch.where(moved[:, None], fresh_gradient - gradient, 0.0)
        product = (change * bend).sum(1)
        useful = product > CURVATURE * change.norm(dim=1) * bend.norm(dim=1)
        pairs.append((change, bend, torch.where(useful, 1 / product, 0.0)))
        pairs = pairs[-history:]
        value = torch.where(moved, fresh_value, value)
        gradient = torch.where(moved[:, None], fresh_gradient, gradient)
        best.x[rows], best.value[rows] = x, value  # Armijo: never above the one before
    return best


def _two_loop(
    gradient: Tensor,
    pairs: list[tuple[Tensor, Tensor, Tensor]],
    rows: Tensor,
    metric: Metric | None,
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


def _search(
    function: Function,
    x: Tensor,
    value: Tensor,
    direction: Tensor,
    slope: Tensor,
    gradient: Tensor,
    rows: Tensor,
    running: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the step accepted by each row (0: none), and value and gradient there."""
    step = torch.ones_like(value)
    accepted = ~running
    taken, new_value, new_gradient = torch.zeros_like(value), value, gradient
    for _ in range(BACKTRACKS):
        trial, trial_gradient = function(x + step[:, None] * direction, rows)
        good = (
            ~accepted
            & (trial <= value + SUFFICIENT * step * slope)
            & trial_gradient.isfinite().all(1)
        )
        taken = torch.where(good, step, taken)
        new_value = torch.where(good, trial, new_value)
        new_gradient = torch.where(good[:, None], trial_gradient, new_gradient)
        accepted = accepted | good
        if bool(accepted.all()):
            break
        parabola = -slope * step.square() / (2 * (trial - value - slope * step))
        shorter = torch.where(parabola.isfinite(), parabola, 0.1 * step)
        step = torch.where(accepted, step, shorter.clamp(0.1 * step, 0.5 * step))
    return taken, new_value, new_gradient
