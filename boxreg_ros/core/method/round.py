"""
One round of many windows, in the order of the paper's figure.

    [ observe faces ] -> expect -> weigh -> linearise -> [ L-BFGS ] -> settled? -> covariances
                                                                               -> marginalise

Faces are observed by `faces`. The search is `boxreg_ros.core.lbfgs`, for all windows at once; it
calls `evaluate` and `precondition`. Whatever sums residuals is one kernel, `evaluate`: it would be
compiled once more for each other one.

"""

from typing import Any, NamedTuple

from boxreg_ros.core.method.arrays import (
    ANCHOR,
    COMMON,
    copy,
    Factor,
    factor_of_window,
    padded,
    POSE,
)
from boxreg_ros.core.method.arrowhead import invert_poses, NEXT, solve
from boxreg_ros.core.method.assemble import (
    accumulate,
    empty_axes,
    empty_matrix,
    factorise_free,
    marginalise,
    no_matrix,
    weigh,
)
from boxreg_ros.core.method.compile import kernel
from boxreg_ros.core.method.covariance import empty_inverse, fill_posterior
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
    coupling = np.empty((B, N, POSE, padded(S + NEXT)))
    factor = Factor(np.empty((B, N, POSE, POSE)), coupling, np.empty((B, S, S)))
    return Sums(np.empty((B, N), TERMS), common, factor)


@kernel
def begin(first, last, rows, problem, inputs, constants, poses, shared, sums, x):
    """
    Begin a round of the windows `rows[first:last]`: expect and weigh.

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
    constants : array of one record of `Constants`, shape (1,)
        Of the method, with the settings.
    poses, shared : array, shapes (B, N, 6) and (B, S)
        Start of the round.
    sums : Sums
        Of the batch, with the face observations and the rigid shape: data and weights are written.
    x : array, shape (b, 6 N + S)
        Written: variables of the windows.

    """
    constants = constants[0]
    N = poses.shape[1]
    n = POSE * N
    at, out, mean_extents = empty_axes(N), empty_linearised(), np.empty(SIZE)
    for row in range(first, last):
        b = rows[row]
        shared[b, ANCHOR:] = 0.0
        terms, common = sums.terms[b], sums.common[b]
        expect(b, problem, inputs[problem.kind[b]], constants, mean_extents, common)
        weigh(b, problem, poses[b], shared[b], constants, at, out, terms, common)
        copy(poses[b].ravel(), x[row, :n])
        copy(shared[b], x[row, n:])


VALUE, CURVATURE, OLDEST = range(3)
"""What `evaluate` writes beside value and gradient: nothing; the factor of the curvature; what the
oldest observation leaves."""


@kernel
def evaluate(first, last, rows, x, free, sums, wanted, value, gradient, left):
    """
    Sum the residuals of the windows `rows[first:last]`.

    Parameters
    ----------
    first, last, rows, sums
        As in `begin`; the factor is written if the `CURVATURE` is wanted.
    x : array, shape (b, 6 N + S)
        Variables of the windows.
    free : array, shape (B, 6 N + S)
        1 for variables that are estimated, 0 for those held fixed.
    wanted : int
        `VALUE`, `CURVATURE`; or `OLDEST`: only the residuals of the oldest observation, which
        become a prior (M13).
    value, gradient : array, shapes (b,) and (b, 6 N + S)
        Written; those of the oldest observation are only to work in.
    left : Quadratic
        Of the batch: written by the oldest observations.

    """
    D, N = x.shape[1], sums.terms.shape[1]
    at, out, A = empty_axes(N), empty_linearised(), no_matrix()
    if wanted != VALUE:  # residuals of the oldest observation depend on three poses
        A = empty_matrix(N if wanted == CURVATURE else 3, D - POSE * N)
    for row in range(first, last):
        b = rows[row]
        terms, common = sums.terms[b], sums.common[b]
        observations = 1 if wanted == OLDEST else N
        value[row] = accumulate(x[row], observations, terms, common, at, out, gradient[row], A)
        if wanted == OLDEST:
            marginalise(x[row], gradient[row], A, left.state[b], left.step[b], left.information[b])
            continue
        for k in range(D):
            gradient[row, k] *= free[b, k]
        if wanted == CURVATURE:
            factorise_free(A, free[b], factor_of_window(b, sums.factor))


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

    Those that are done, since they are settled or the round `is_last`, have covariances.

    Parameters
    ----------
    first, last, rows, problem, free, constants, sums
        As in `begin` and `evaluate`.
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
    inverse = empty_inverse(N, S)
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
        invert_poses(factor, inverse.poses, inverse.links, inverse.response)
        fill_posterior(
            b, problem, found, solution.shared[b], terms, common, free[b], inverse, factor.corner,
            constants, solution.posterior,
        )  # fmt: skip
