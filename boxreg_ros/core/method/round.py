"""
One round of many windows, in the order of the paper's figure.

    [ observe faces ] -> expect -> weigh -> linearise -> [ L-BFGS ] -> settled? -> covariances
                                                                               -> marginalise

Faces are observed by `faces`. The search is `boxreg_ros.core.lbfgs`, for all windows at once; it
calls `evaluate`. Whatever sums residuals is that one kernel: it would be compiled once more for
each other one. What it does with a window is done while the data of that are in the cache.

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
    is_wanted,
    marginalise,
    no_matrix,
    weigh,
)
from boxreg_ros.core.method.compile import kernel, loop
from boxreg_ros.core.method.covariance import empty_inverse, fill_posterior
from boxreg_ros.core.method.expectation import expect, fill_evidence
from boxreg_ros.core.method.residuals import empty_linearised, TERMS
import numpy as np
from numpy.typing import NDArray


class Sums(NamedTuple):
    """
    The sums of the residuals of the windows that pass a round together.

    Attributes
    ----------
    windows : array, shape (b,)
        Windows of the batch.
    terms, common : array of `TERMS` and `COMMON`, shapes (b, N) and (b,)
        Data and weights.
    factor : Factor
        Of the Gauss-Newton curvature at the start of the round; NaN where it is not positive
        definite.

    """

    windows: Any
    terms: Any
    common: Any
    factor: Any


def empty_sums(windows: NDArray[np.int64], N: int, D: int) -> Sums:
    """
    Return room for `windows` of N observations and D variables.

    All of it is written before it is read.

    """
    b, S = len(windows), D - POSE * N
    coupling = np.empty((b, N, POSE, padded(S + NEXT)))
    factor = Factor(np.empty((b, N, POSE, POSE)), coupling, np.empty((b, S, S)))
    return Sums(windows, np.empty((b, N), TERMS), np.empty(b, COMMON), factor)


START, VALUE, OLDEST = range(3)
"""What `evaluate` is called for: to begin a round, with its weights and the factor of its
curvature; for the sum elsewhere; for what the oldest observation leaves."""


@kernel
def evaluate(first, last, rows, wanted, batch, sums, inputs, constants, x, value, gradient,
             scaled):  # fmt: skip
    """
    Sum the residuals of the windows `sums.windows[rows[first:last]]`.

    Parameters
    ----------
    first, last : int
        First row, and the one after the last.
    rows : array, shape (b,)
        Windows of the sums that take part.
    wanted : int
        `START`: expect and weigh, with the face observations and the rigid shape; write the
        weights and the factor. `VALUE`: the sum alone. `OLDEST`: only the residuals of the oldest
        observation, which become a prior (M13).
    batch : Batch
        Of the solver.
    sums : Sums
        Of the round. Terms are those of the faces, and of the rigid shape; the rest is written at
        the `START`.
    inputs : array of `INPUTS`, shape (K,)
        Noise, margins and population of the input, by kind.
    constants : array of one record of `Constants`, shape (1,)
        Of the method, with the settings.
    x : array, shape (p, b, 6 N + S)
        Variables of the windows: one point of each. At the `START` two, which are written: the
        solution, and that less the first `scaled`, the first trial of the search.
    value, gradient, scaled : array, shapes (p, b) and twice (p, b, 6 N + S)
        Written: the sum, its gradient, and the inverse curvature times that. Those of the oldest
        observation are only to work in.

    """
    N = sums.terms.shape[1]
    none = matrix = no_matrix()
    if wanted != VALUE:  # residuals of the oldest observation depend on three poses
        matrix = empty_matrix(N if wanted == START else 3, x.shape[2] - POSE * N)
    evaluate_in_turn(
        first, last, rows, wanted, batch, sums, inputs, constants[0], x, value, gradient, scaled,
        empty_axes(N), empty_linearised(), none, matrix,
    )  # fmt: skip


@loop
def evaluate_in_turn(first, last, rows, wanted, batch, sums, inputs, constants, x, value, gradient,
                     scaled, at, out, none, matrix):  # fmt: skip
    """Do what `evaluate` does; the arrays after its own are to work in."""
    problem, free, solution = batch.problem, batch.free, batch.solution
    D, N = x.shape[2], sums.terms.shape[1]
    for row in range(first, last):
        s = rows[row]
        b, factor = sums.windows[s], factor_of_window(s, sums.factor)
        terms, common = sums.terms[s], sums.common[s]
        if wanted == START:
            poses, shared = solution.poses[b], solution.shared[b]
            for k in range(ANCHOR, len(shared)):
                shared[k] = 0.0
            for k in range(POSE * N):
                x[0, row, k] = poses[k // POSE, k % POSE]
            copy(shared, x[0, row, POSE * N :])
            expect(b, problem, inputs[problem.kind[b]], constants, batch.mean_extents[b], common)
            weigh(b, problem, poses, shared, constants, at, out, terms, common)
        observations = 1 if wanted == OLDEST else N
        for point in range(len(x)):
            at_x, pull, step = x[point, row], gradient[point, row], scaled[point, row]
            if point > 0:
                for k in range(D):
                    at_x[k] = x[0, row, k] - scaled[0, row, k]
            A = none if point > 0 else matrix
            value[point, row] = accumulate(
                at_x, observations, terms, common, problem.prior_mean[b],
                problem.prior_information[b], at, out, pull, A,
            )  # fmt: skip
            if wanted == OLDEST:
                left = solution.left
                marginalise(
                    at_x, pull, A, factor, left.state[b], left.step[b], left.information[b]
                )
                continue
            for k in range(D):
                pull[k] *= free[b, k]
            if is_wanted(A):
                factorise_free(A, free[b], factor)
            copy(pull, step)
            solve(factor, step)


@loop
def has_settled(x, start, errors, settled_step):
    """Return whether no box of a window moves by more than `settled_step` errors of its input."""
    for n in range(len(start)):
        moved = 0.0
        for k in range(POSE):
            moved += ((x[POSE * n + k] - start[n, k]) / errors[k]) ** 2 / POSE
        if not moved <= settled_step**2:
            return False
    return True


@kernel
def end(first, last, x, batch, sums, constants, is_last, may_settle, is_done):
    """
    End the round of the windows `sums.windows[first:last]`.

    Those that are done, since they are settled or the round `is_last`, have covariances.

    Parameters
    ----------
    first, last, batch, sums, constants
        As in `evaluate`; the solution of the batch is written.
    x : array, shape (b, 6 N + S)
        Minimum of each sum.
    is_last, may_settle : bool
        Whether all are done; whether those may be that hardly moved.
    is_done : array, shape (b,)
        Written.

    """
    inverse = empty_inverse(batch.solution.poses.shape[1], batch.solution.shared.shape[1])
    end_in_turn(first, last, x, batch, sums, constants[0], is_last, may_settle, is_done, inverse)


@loop
def end_in_turn(first, last, x, batch, sums, constants, is_last, may_settle, is_done, inverse):
    """Do what `end` does; `inverse` is to work in."""
    problem, free, solution = batch.problem, batch.free, batch.solution
    n = POSE * solution.poses.shape[1]
    for row in range(first, last):
        b, factor = sums.windows[row], factor_of_window(row, sums.factor)
        terms, common = sums.terms[row], sums.common[row]
        poses, errors = solution.poses[b], problem.of_class[b].pose
        is_settled = has_settled(x[row], poses, errors, constants.settled_step)
        is_done[row] = is_last or (may_settle and is_settled)
        for k in range(n):
            poses[k // POSE, k % POSE] = x[row, k]
        copy(x[row, n:], solution.shared[b])
        fill_evidence(
            common, solution.shared[b], factor.corner, constants.min_extent_gain,
            solution.evidence[b],
        )  # fmt: skip
        if not is_done[row]:
            continue
        invert_poses(factor, inverse.poses, inverse.links, inverse.response)
        fill_posterior(
            b, problem, poses, solution.shared[b], terms, common, free[b], inverse, factor.corner,
            constants, solution.posterior,
        )  # fmt: skip
