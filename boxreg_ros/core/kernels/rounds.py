"""
One round of windows, in plain loops: observe, weigh, sum up, factorise, minimise.

The torch twin is `boxreg_ros.core.rounds.run_round_torch`. What a window works with stays in the
processor's cache from one step to the next.

"""

from typing import Any, NamedTuple

from boxreg_ros.core.kernels.arrowhead import (
    empty_arrowhead,
    factorise,
    fix_variables,
    invert_corner,
    invert_poses,
    POSE,
)
from boxreg_ros.core.kernels.compile import kernel
from boxreg_ros.core.kernels.expectation import fill_evidence
from boxreg_ros.core.kernels.face_support import empty_face_work, observe_window
from boxreg_ros.core.kernels.lbfgs import empty_search, minimise
from boxreg_ros.core.kernels.normal_equations import (
    accumulate,
    ANCHOR,
    empty_scratch,
    marginalise,
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
    points, shape, scratch, search : FaceWork, ShapeWork, Scratch, Search
        Of the parts of the round.
    x : array, shape (6 N + 23,)
        Variables of the window.
    A : ArrowheadArrays
        Curvature, then its factor.

    """

    points: Any
    shape: Any
    scratch: Any
    search: Any
    x: Any
    A: Any


@kernel
def empty_round_work(begin, end, windows, N, numbers):
    """Return arrays for the windows `begin` to `end`."""
    D = POSE * N + SHARED
    return RoundWork(
        empty_face_work(begin, end, windows, numbers.faces),
        empty_shape_work(begin, end, windows, N, numbers.shape.cells),
        empty_scratch(N), empty_search(D, numbers.search.history), np.empty(D), empty_arrowhead(N),
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
def run_window(
    b, row, windows, thinned, known, prior, every_free, expected, of_class, numbers, work, faces,
    solution, ends,
):  # fmt: skip
    """Take one round with window `b`, at `row` of `faces` and `ends`; see `run_windows`."""
    poses, shared, free = solution.poses[b], solution.shared[b], every_free[b]
    search, x, A, kind = numbers.search, work.x, work.A, windows.kind[b]
    N = len(poses)
    n = POSE * N
    shared[ANCHOR:SIDESLIP] = 0.0
    observe_window(
        b, windows, poses, shared, known.occlusion_inset[kind], known.range_inset[kind],
        numbers.faces, work.points, row, faces,
    )  # fmt: skip
    terms = unweighted_terms(N, N if search.uses_shape else 0, prior, b)
    weigh(b, windows, poses, shared, row, faces, expected, of_class, numbers.weights, terms)
    if search.uses_shape:
        terms.start[:] = poses
        agree(
            b, thinned, poses, shared[:3], of_class.shape[b], numbers.shape, work.shape,
            terms.W_shape, terms.wanted,
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
    invert_corner(A.corner, ends.corner[row])
    fill_evidence(
        solution.evidence[b, 0], expected.shared[b], expected.deviation[b], shared,
        ends.corner[row], numbers.min_extent_gain, solution.evidence[b, 1:],
    )  # fmt: skip
    ends.is_done[row] = is_done
    if is_done:
        invert_poses(A, ends.corner[row], ends.pose_blocks[row], ends.border_blocks[row])
        if len(solution.prior_state) and windows.lengths[b] == N:
            leave_prior(b, terms, work, solution)


@kernel
def run_windows(
    begin, end, rows, windows, thinned, known, prior, free, expected, of_class, numbers, faces,
    solution, ends,
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
        Insets of the points, by kind.
    prior : PriorArrays
        Marginalisation prior.
    free : array, shape (B, 6 N + 23)
        1 for variables that are estimated, 0 for those held fixed.
    expected : ExpectedArrays
        Means and deviations of input and shared variables.
    of_class : ClassArrays
        Settings of the class of each window.
    numbers : RoundNumbers
        Constants and settings.
    faces : FaceArrays
        Face observations of these windows, written.
    solution : SolutionArrays
        Start of the round; its end is written.
    ends : EndArrays
        Written.

    """
    work = empty_round_work(0, len(windows.counts), windows, solution.poses.shape[1], numbers)
    for row in range(begin, end):
        run_window(
            rows[row], row, windows, thinned, known, prior, free, expected, of_class, numbers,
            work, faces, solution, ends,
        )  # fmt: skip
