"""
One round of windows, in plain loops: expect, observe, weigh, sum up, factorise, minimise.

The torch twin is `boxreg_ros.core.rounds.run_round_torch`. The arrays of a window stay in the
processor's cache from one step to the next.

"""

from typing import Any, NamedTuple

from boxreg_ros.core.kernels.arrays import ExpectedArrays, FaceArrays, InverseArrays
from boxreg_ros.core.kernels.arrowhead import (
    empty_arrowhead,
    factorise,
    fix_variables,
    invert_corner,
    invert_poses,
    POSE,
)
from boxreg_ros.core.kernels.compile import kernel
from boxreg_ros.core.kernels.covariance import empty_covariance_work, fill_posterior
from boxreg_ros.core.kernels.expectation import (
    empty_expectation_work,
    expect,
    fill_evidence,
)
from boxreg_ros.core.kernels.face_support import empty_face_work, observe_window
from boxreg_ros.core.kernels.lbfgs import empty_search, minimise
from boxreg_ros.core.kernels.normal_equations import (
    accumulate,
    ANCHOR,
    empty_scratch,
    marginalise,
    PIVOT,
    SHARED,
    SIDESLIP,
    unweighted_terms,
)
from boxreg_ros.core.kernels.rigid_shape import agree, empty_shape_work
from boxreg_ros.core.kernels.weights import weigh
import numpy as np


@kernel
def linearise(x, terms, free, scratch, gradient, A):
    """
    Return the value of the terms of one window; write gradient and factor of the curvature.

    In the `free` variables. The factor of a matrix that is not positive definite is NaN.

    """
    n = len(x) - SHARED
    value = accumulate(x, n // 6, terms, scratch, gradient, A)
    for k in range(len(x)):
        gradient[k] *= free[k]
    fix_variables(A, free)
    if not factorise(A):
        A.links[: n // 6] = np.nan
        A.border[: n // 6] = np.nan
        A.corner[:] = np.nan
    return value


@kernel
def has_settled(poses, start, errors, settled_step):
    """Return whether no box of a window moves by more than `settled_step` errors of its input."""
    for n in range(len(poses)):
        moved = 0.0
        for k in range(6):
            moved += ((poses[n, k] - start[n, k]) / errors[k]) ** 2 / 6
        if not moved <= settled_step**2:
            return False
    return True


class RoundWork(NamedTuple):
    """
    Arrays that the round of one window works in.

    Attributes
    ----------
    expectation, points, shape, scratch, search, covariance : tuple
        Of the parts of the round: `ExpectationWork`, `FaceWork`, `ShapeWork`, `Scratch`, `Search`
        and `CovarianceWork`.
    expected : ExpectedArrays
        Means and deviations of input and shared variables.
    faces : FaceArrays
        Face observations of the window, its only one.
    inverse : InverseArrays
        Blocks of the inverse curvature.
    x : array, shape (6 N + 23,)
        Variables of the window.
    A : ArrowheadArrays
        Curvature, then its factor.

    """

    expectation: Any
    points: Any
    shape: Any
    scratch: Any
    search: Any
    covariance: Any
    expected: Any
    faces: Any
    inverse: Any
    x: Any
    A: Any


@kernel
def empty_round_work(begin, end, windows, N, numbers):
    """Return arrays for the windows `begin` to `end`."""
    D = POSE * N + SHARED
    return RoundWork(
        empty_expectation_work(), empty_face_work(begin, end, windows, numbers.faces),
        empty_shape_work(begin, end, windows, N, numbers.shape.cells),
        empty_scratch(N), empty_search(D, numbers.search.history), empty_covariance_work(N),
        ExpectedArrays(
            np.empty(SHARED), np.empty(SHARED), np.empty(POSE), np.empty(POSE), np.empty(POSE),
            np.empty(PIVOT),
        ),
        FaceArrays(
            np.empty((1, N, 6, 4, 4)), np.empty((1, N, 6)), np.empty((1, N, 6)),
            np.empty((1, N, 6)), np.empty((1, N, 2, 6)), np.empty((1, N)),
        ),
        InverseArrays(
            np.empty((N, POSE, POSE)), np.empty((N, POSE, SHARED)), np.empty((SHARED, SHARED))
        ),
        np.empty(D), empty_arrowhead(N),
    )  # fmt: skip


@kernel
def leave_prior(b, terms, work, solution):
    """Write the prior of the window after window `b`: its oldest observation is eliminated."""
    accumulate(work.x, 1, terms, work.scratch, work.search.gradient, work.A)
    marginalise(
        work.x, work.search.gradient, work.A, solution.prior_state[b], solution.prior_step[b],
        solution.prior_information[b],
    )  # fmt: skip


@kernel
def run_window(b, windows, thinned, known, prior, every_free, of_class, numbers, work, solution):
    """Take one round with window `b`, see `run_windows`; return whether it is done."""
    poses, shared, free = solution.poses[b], solution.shared[b], every_free[b]
    search, x, A, kind = numbers.search, work.x, work.A, windows.kind[b]
    expected, faces, inverse = work.expected, work.faces, work.inverse
    shape = of_class.shape[b]
    N = len(poses)
    n = POSE * N
    shared[ANCHOR:SIDESLIP] = 0.0
    expect(b, windows, of_class, known, numbers.expectation, work.expectation, expected)
    observe_window(
        b, windows, poses, shared, known.occlusion_inset[kind], known.range_inset[kind],
        numbers.faces, work.points, 0, faces,
    )  # fmt: skip
    terms = unweighted_terms(N, N if search.uses_shape else 0, prior, b)
    weigh(b, windows, poses, shared, 0, faces, expected, of_class, numbers.weights, terms)
    if search.uses_shape:
        terms.start[:] = poses
        agree(
            b, thinned, poses, shared[:3], shape, numbers.shape, work.shape, terms.W_shape,
            terms.wanted,
        )  # fmt: skip
    x[:n] = poses.ravel()
    x[n:] = shared
    value = linearise(x, terms, free, work.scratch, work.search.gradient, A)
    minimise(x, value, terms, free, A, work.search, work.scratch, search)
    found = x[:n].reshape(N, POSE)
    is_done = search.is_last or (
        search.may_settle and has_settled(found, poses, of_class.pose[b], search.settled_step)
    )
    poses[:] = found
    shared[:] = x[n:]
    invert_corner(A.corner, inverse.corner)
    fill_evidence(
        solution.evidence[b, 0], expected.shared, expected.deviation, shared,
        inverse.corner, numbers.min_extent_gain, solution.evidence[b, 1:],
    )  # fmt: skip
    if is_done:
        invert_poses(A, inverse.corner, inverse.poses, inverse.border)
        fill_posterior(
            b, windows, poses, shared, 0, faces, expected, shape, free, terms.W_shared, inverse,
            numbers.weights, numbers.covariance, work.covariance, solution.posterior,
        )  # fmt: skip
        if len(solution.prior_state) and windows.lengths[b] == N:
            leave_prior(b, terms, work, solution)
    return is_done


@kernel
def run_windows(
    begin, end, rows, windows, thinned, known, prior, free, of_class, numbers, solution, is_done
):  # fmt: skip
    """
    Take one round with the windows `rows[begin:end]`.

    Parameters
    ----------
    begin, end : int
        First row, and the one after the last.
    rows : array, shape (b,)
        Windows of the batch that take part.
    windows, thinned : WindowArrays
        Input of the windows, and the same with the points of the rigid shape.
    known : InputArrays
        Noise, margins and population of the input, by kind.
    prior : PriorArrays
        Marginalisation prior.
    free : array, shape (B, 6 N + 23)
        1 for variables that are estimated, 0 for those held fixed.
    of_class : ClassArrays
        Settings of the class of each window.
    numbers : RoundNumbers
        Constants and settings.
    solution : SolutionArrays
        Start of the round; its end is written.
    is_done : array, shape (b,)
        Written: whether a window is settled, or this was the last round.

    """
    work = empty_round_work(0, len(windows.counts), windows, solution.poses.shape[1], numbers)
    for row in range(begin, end):
        is_done[row] = run_window(
            rows[row], windows, thinned, known, prior, free, of_class, numbers, work, solution,
        )  # fmt: skip
