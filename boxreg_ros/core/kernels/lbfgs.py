"""
L-BFGS of one window, in plain loops.

The torch twin, for many problems of any kind at once, is `boxreg_ros.core.lbfgs.minimize`.

"""

from math import isfinite, sqrt
from typing import Any, NamedTuple

from boxreg_ros.core.kernels.arrowhead import solve
from boxreg_ros.core.kernels.compile import kernel
from boxreg_ros.core.kernels.normal_equations import accumulate, no_matrix, SHARED
import numpy as np


class Search(NamedTuple):
    """
    Arrays that the search of one window works in, D variables and a history of H pairs.

    Attributes
    ----------
    gradient, direction, trial, trial_gradient : array, shape (D,)
        At the present point, and at the point that is tried.
    steps, changes : array, shape (H, D)
        Steps s and changes y of the gradient over them, a ring.
    scales : array, shape (H,)
        1 / s'y; 0 for pairs that are not used.
    shares : array, shape (H,)
        Of the pairs, in the two-loop recursion.

    """

    gradient: Any
    direction: Any
    trial: Any
    trial_gradient: Any
    steps: Any
    changes: Any
    scales: Any
    shares: Any


@kernel
def empty_search(D, history):
    """Return arrays for D variables."""
    return Search(
        np.empty(D), np.empty(D), np.empty(D), np.empty(D), np.empty((history, D)),
        np.empty((history, D)), np.empty(history), np.empty(history),
    )  # fmt: skip


@kernel
def dot(a, b):
    """Return a'b."""
    total = 0.0
    for i in range(len(a)):
        total += a[i] * b[i]
    return total


@kernel
def are_finite(values):
    """Return whether all values (n,) are finite."""
    total = 0.0
    for value in values:
        total += 0.0 * value  # NaN for infinity and NaN
    return total == 0.0


@kernel
def fill_direction(search, count, U):
    """
    Write the direction: minus the inverse Hessian times the gradient, by the last pairs.

    Two-loop recursion about the inverse of the matrix with the factor `U`; `count` pairs were
    made.

    """
    q = search.direction
    q[:] = search.gradient
    H = len(search.scales)
    first = max(0, count - H)
    for pair in range(count - 1, first - 1, -1):
        i = pair % H
        search.shares[i] = search.scales[i] * dot(search.steps[i], q)
        for k in range(len(q)):
            q[k] -= search.shares[i] * search.changes[i, k]
    solve(U, q)
    for pair in range(first, count):
        i = pair % H
        share = search.shares[i] - search.scales[i] * dot(search.changes[i], q)
        for k in range(len(q)):
            q[k] += share * search.steps[i, k]
    for k in range(len(q)):
        q[k] = -q[k]


@kernel
def keep_pair(search, count, step, is_good, min_curvature):
    """Write the pair of the trial with a step length; one that was rejected is not used."""
    i = count % len(search.scales)
    s, y = search.steps[i], search.changes[i]
    for k in range(len(s)):
        s[k] = step * search.direction[k] if is_good else 0.0
        y[k] = search.trial_gradient[k] - search.gradient[k] if is_good else 0.0
    s_y = dot(s, y)
    is_curved = s_y > min_curvature * sqrt(dot(s, s)) * sqrt(dot(y, y))
    search.scales[i] = 1 / s_y if is_curved else 0.0


@kernel
def minimise(x, value, terms, free, U, search, scratch, numbers):
    """
    Minimise the sum of the terms of one window over its variables `x`, in place.

    Parameters
    ----------
    x : array, shape (6 N + 23,)
        Start, then the best point.
    value : float
        Value at the start; `search.gradient` is the gradient there.
    terms : TermArrays
        Data and weights.
    free : array, shape (6 N + 23,)
        1 for variables that are estimated, 0 for those held fixed.
    U : ArrowheadArrays
        Factor of the curvature at the start.
    search, scratch : Search, tuple
        Arrays to work in.
    numbers : SearchNumbers
        Constants and settings.

    """
    D = len(x)
    N = (D - SHARED) // 6
    gradient, direction = search.gradient, search.direction
    if not (isfinite(value) and are_finite(gradient)):
        return
    trial, trial_gradient = search.trial, search.trial_gradient
    shortest, longest = numbers.step_bounds
    count = 0
    for _ in range(numbers.iterations):
        fill_direction(search, count, U)
        slope = dot(gradient, direction)
        if not slope < 0.0:
            for k in range(D):
                direction[k] = -gradient[k]
            slope = -dot(gradient, gradient)
        if -slope <= numbers.tolerance * (1 + abs(value)):
            return
        step = 1.0
        is_good = False
        for _ in range(numbers.max_backtracks):
            for k in range(D):
                trial[k] = x[k] + step * direction[k]
            trial_value = accumulate(trial, N, terms, scratch, trial_gradient, no_matrix())
            for k in range(D):
                trial_gradient[k] *= free[k]
            most = value + numbers.sufficient_decrease * step * slope
            is_good = trial_value <= most and are_finite(trial_gradient)
            if numbers.history > 0:
                keep_pair(search, count, step, is_good, numbers.min_curvature)
                count += 1
            if is_good:
                break
            # The minimum of the parabola through value, slope and trial.
            parabola = -slope * step**2 / (2 * (trial_value - value - slope * step))
            shorter = parabola if isfinite(parabola) else shortest * step
            step = min(max(shorter, shortest * step), longest * step)
        if not is_good:
            return
        x[:] = trial
        gradient[:] = trial_gradient
        value = trial_value
