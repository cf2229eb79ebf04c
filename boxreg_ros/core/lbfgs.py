"""
L-BFGS for B independent problems at once; knows no boxes.

Every row has its own curvature history, step length, stopping test and best point, so that a row
behaves as if it were alone: a hard or broken one neither slows nor spoils its neighbours.

"""

from collections.abc import Callable
from enum import IntEnum
from typing import Any, NamedTuple

import torch
from torch import Tensor

SUFFICIENT = 1e-4  # part of the promised decrease that a step must bring (Armijo)
CURVATURE = 1e-10  # a pair with s.y below this part of |s||y| is not remembered
BACKTRACKS = 12
PATIENCE = 4  # turns between questions to a device that must be waited for

Metric = Callable[[Tensor, Tensor], Tensor]
Pair = tuple[Tensor, Tensor, Tensor]  # step, change of the gradient, 1 / their product


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
    function: Callable[[Tensor, Tensor], tuple[Tensor, Tensor]],
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
    Armijo condition holds. Every turn asks for one point per row: a row that accepts it goes on
    from there while its neighbour still shortens its step. Ended rows leave the batch as soon as
    they are half of it. A device that must be waited for is asked only every few turns.

    """
    rows = torch.arange(len(start), device=start.device)
    value, gradient = function(start, rows)
    finite = value.isfinite() & gradient.isfinite().all(1)
    status = torch.where(finite, 0, int(Status.FAILED))
    best = Minimum(start.clone(), value.clone(), status, torch.zeros_like(rows))
    moved, tries, step, slope = finite, torch.zeros_like(rows), value, value
    x, direction, gradient = start, start, torch.where(finite[:, None], gradient, 0.0)
    pairs: list[Pair] = []
    for turn in range(iterations * BACKTRACKS):
        taken = best.iterations[rows]
        running = (best.status[rows] == Status.RUNNING) & ((taken < iterations) | ~moved)
        if turn % (1 if rows.is_cpu else PATIENCE) == 0:
            if not (count := int(running.sum())):
                break
            if count <= len(rows) // 2:
                state = (rows, x, value, gradient, direction, slope, step, moved, tries, pairs)
                state = select(state, running.nonzero()[:, 0])
                rows, x, value, gradient, direction, slope, step, moved, tries, pairs = state
                running = running[running]
        # Rows that have moved need a new direction.
        fresh, along = running & moved, -_two_loop(gradient, pairs, rows, metric)
        promise = (gradient * along).sum(1)
        uphill = ~(promise < 0)
        along = torch.where(uphill[:, None], -gradient, along)
        promise = torch.where(uphill, -gradient.square().sum(1), promise)
        if metric is None and not pairs:  # nothing known of the scale yet
            size = gradient.abs().sum(1).clamp(min=1.0)
            along, promise = along / size[:, None], promise / size
        converged = fresh & (-promise <= tolerance * (1 + value.abs()))
        best.status[rows] += int(Status.CONVERGED) * converged
        running, fresh = running & ~converged, fresh & ~converged
        best.iterations[rows] += fresh
        direction = torch.where(fresh[:, None], along, direction)
        slope, step = torch.where(fresh, promise, slope), torch.where(fresh, 1.0, step)
        tries = torch.where(fresh, 0, tries) + 1
        # One trial.
        trial, bent = function(x + step[:, None] * direction, rows)
        good = running & bent.isfinite().all(1) & (trial <= value + SUFFICIENT * step * slope)
        best.status[rows] += int(Status.STUCK) * (running & ~good & (tries == BACKTRACKS))
        change = torch.where(good, step, 0.0)[:, None] * direction
        bend = torch.where(good[:, None], bent - gradient, 0.0)
        product = (change * bend).sum(1)
        useful = product > CURVATURE * change.norm(dim=1) * bend.norm(dim=1)
        pairs = [*pairs, (change, bend, torch.where(useful, 1 / product, 0.0))][-history:]
        parabola = -slope * step.square() / (2 * (trial - value - slope * step))
        step = torch.where(parabola.isfinite(), parabola, 0.1 * step).clamp(0.1 * step, 0.5 * step)
        x, gradient, value = x + change, gradient + bend, torch.where(good, trial, value)
        moved = good | (moved & ~running)
        best.x[rows], best.value[rows] = x, value  # Armijo: never above the one before
    return best


def _two_loop(gradient: Tensor, pairs: list[Pair], rows: Tensor, metric: Metric | None) -> Tensor:
    """Return the inverse Hessian approximated by `pairs`, times `gradient`."""
    q, alphas = gradient, []
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


def select(part: Any, rows: Tensor) -> Any:
    """Return `rows`, ascending, of tensors (B, ...) in tuples and lists; all: no copy."""
    if isinstance(part, Tensor):
        return part[rows] if len(rows) < len(part) else part
    if isinstance(part, tuple | list):
        parts = [select(inner, rows) for inner in part]
        return type(part)(*parts) if hasattr(part, '_fields') else type(part)(parts)
    return part
