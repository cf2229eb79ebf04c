"""
One round of many windows, in the order of the paper's figure.

    [ observe faces ] -> expect -> weigh -> linearise -> [ L-BFGS ] -> settled? -> covariances

Faces are observed by `faces`. The search is `boxreg_ros.core.lbfgs`, for all windows at once; it
calls `evaluate` and `precondition`.

"""

from typing import Any, NamedTuple

from boxreg_ros.core.method.arrays import (
    ANCHOR,
    COMMON,
    copy,
    Factor,
    factor_of_window,
    POSE,
)
from boxreg_ros.core.method.arrowhead import invert_poses, NEXT, solve
from boxreg_ros.core.method.assemble import (
    accumulate,
    empty_axes,
    empty_matrix,
    linearise,
    marginalise,
    no_matrix,
    weigh,
)
from boxreg_ros.core.method.compile import kernel
from boxreg_ros.core.method.covariance import fill_posterior, Inverse
from boxreg_ros.core.method.expectation import expect, fill_evidence, SIZE
from boxreg_ros.core.method.residuals import empty_linearised, TERMS
import numpy as np


class Sums(NamedTuple):
    """
    The sums of the residuals of B windows in one round.

    Attributes
    ----------
    terms, common : array of `TERMS` and `COMMON`, shapes (B, N) and (B,)
        Data and weights.
    factor : Factor
        Of the Gauss-Newton curvature at the start of the round; NaN where it is not positive
        definite.

    """

    terms: Any
    common: Any
    factor: Any


def empty_sums(B: int, N: int, S: int, prior_mean: Any, prior_information: Any) -> Sums:
    """Return room for B windows of N observations with a prior (B, 29) and (B, 29, 29)."""
    # All of it is written before it is read.
    common = np.empty(B, COMMON)
    common['prior_mean'] = prior_mean
    common['W_prior'] = prior_information
    factor = Factor(
        np.empty((B, N, POSE, POSE)), np.empty((B, N, POSE, S + NEXT)), np.empty((B, S, S))
    )
    return Sums(np.empty((B, N), TERMS), common, factor)


@kernel
def begin(first, last, rows, problem, inputs, free, constants, poses, shared, sums,
          x, value, gradient):  # fmt: skip
    """
    Begin a round of the windows `rows[first:last]`.

    Parameters
    ----------
    first, last : int
        First row, and the one after the last.
    rows : array, shape (b,)
        Windows of the batch that take part.
    problem : Problem
        Input of the batch.
    inputs : array of `INPUTS`, shape (K,)
        Noise, margins and population of the input, by kind.
    free : array, shape (B, 6 N + S)
        1 for variables that are estimated, 0 for those held fixed.
    constants : array of one record of `Constants`, shape (1,)
        Of the method, with the settings.
    poses, shared : array, shapes (B, N, 6) and (B, S)
        Start of the round.
    sums : Sums
        Of the batch, with the face observations and the rigid shape: the rest is written.
    x, value, gradient : array, shapes (b, 6 N + S), (b,) and (b, 6 N + S)
        Written: variables of the windows, and the sum of the residuals there.

    """
    constants = constants[0]
    N = poses.shape[1]
    n = POSE * N
    at, out, A = empty_axes(N), empty_linearised(), empty_matrix(N, shared.shape[1])
    mean_extents = np.empty(SIZE)
    for row in range(first, last):
        b = rows[row]
        shared[b, ANCHOR:] = 0.0
        terms, common = sums.terms[b], sums.common[b]
        expect(b, problem, inputs[problem.kind[b]], constants, mean_extents, common)
        weigh(b, problem, poses[b], shared[b], constants, at, out, terms, common)
        copy(poses[b].ravel(), x[row, :n])
        copy(shared[b], x[row, n:])
        value[row] = linearise(
            x[row], terms, common, free[b], at, out, gradient[row], A,
            factor_of_window(b, sums.factor),
        )  # fmt: skip


@kernel
def evaluate(first, last, rows, x, free, sums, value, gradient):
    """
    Write value (b,) and gradient (b, 6 N + S) of the windows `rows[first:last]` at `x`.

    `free` and `sums` are as in `begin`.

    """
    D, N = x.shape[1], sums.terms.shape[1]
    at, out, matrix = empty_axes(N), empty_linearised(), no_matrix()
    for row in range(first, last):
        terms, common = sums.terms[rows[row]], sums.common[rows[row]]
        value[row] = accumulate(x[row], N, terms, common, at, out, gradient[row], matrix)
        for k in range(D):
            gradient[row, k] *= free[rows[row], k]


@kernel
def precondition(first, last, rows, factor, vectors):
    """Replace the `vectors` (b, 6 N + S) of windows by the inverse curvature times them."""
    for row in range(first, last):
        solve(factor_of_window(rows[row], factor), vectors[row])


@kernel
def has_settled(poses, start, errors, settled_step):
    """Return whether no box of a window moves by more than `settled_step` errors of its input."""
    for n in range(len(poses)):
        moved = 0.0
        for k in range(POSE):
            moved += ((poses[n, k] - start[n, k]) / errors[k]) ** 2 / POSE
        if not moved <= settled_step**2:
            return False
    return True


@kernel
def end(first, last, rows, x, problem, free, constants, sums, solution, is_last, may_settle,
        is_done):  # fmt: skip
    """
    End the round of the windows `rows[first:last]`.

    Those that are done, since they are settled or the round `is_last`, have covariances and, if
    they are full, leave a prior to the next window.

    Parameters
    ----------
    first, last, rows, problem, free, constants, sums
        As in `begin`.
    x : array, shape (b, 6 N + S)
        Minimum of each sum.
    solution : Solution
        Of the batch: written.
    is_last, may_settle : bool
        Whether all are done; whether those may be that hardly moved.
    is_done : array, shape (b,)
        Written.

    """
    constants = constants[0]
    N, S = solution.poses.shape[1], solution.shared.shape[1]
    n = POSE * N
    oldest = np.int64(1)  # for a literal 1 all that sums residuals would be compiled once more
    at, out, gradient = empty_axes(N), empty_linearised(), np.empty(n + S)
    first_three = empty_matrix(3, S)  # poses that residuals of the oldest observation depend on
    inverse = Inverse(np.empty((N, POSE, POSE)), np.empty((N, POSE, S + NEXT)))
    for row in range(first, last):
        b = rows[row]
        terms, common, factor = sums.terms[b], sums.common[b], factor_of_window(b, sums.factor)
        found = x[row, :n].copy().reshape(N, POSE)
        errors = problem.of_class[b].pose
        is_settled = has_settled(found, solution.poses[b], errors, constants.settled_step)
        is_done[row] = is_last or (may_settle and is_settled)
        copy(x[row], solution.poses[b].ravel())
        copy(x[row, n:], solution.shared[b])
        fill_evidence(
            common, solution.shared[b], factor.corner, constants.min_extent_gain,
            solution.evidence[b],
        )  # fmt: skip
        if not is_done[row]:
            continue
        invert_poses(factor, inverse.poses, inverse.beside)
        fill_posterior(
            b, problem, found, solution.shared[b], terms, common, free[b], inverse, factor.corner,
            constants, solution.posterior,
        )  # fmt: skip
        if len(solution.prior_state) and problem.lengths[b] == N:
            accumulate(x[row], oldest, terms, common, at, out, gradient, first_three)
            marginalise(
                x[row], gradient, first_three, solution.prior_state[b], solution.prior_step[b],
                solution.prior_information[b],
            )  # fmt: skip
