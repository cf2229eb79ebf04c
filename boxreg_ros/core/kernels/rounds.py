"""
One round of windows, in plain loops: observe, weigh, sum up, factorise, minimise.

The torch twin is `boxreg_ros.core.rounds.run_round_torch`. What a window works with stays in the
processor's cache from one step to the next.

"""

from boxreg_ros.core.kernels.arrowhead import (
    empty_arrowhead,
    factorise,
    fix_variables,
    invert_corner,
    invert_poses,
)
from boxreg_ros.core.kernels.compile import kernel
from boxreg_ros.core.kernels.face_support import empty_face_work, observe_window
from boxreg_ros.core.kernels.lbfgs import empty_search, minimise
from boxreg_ros.core.kernels.normal_equations import (
    accumulate,
    empty_scratch,
    marginalise,
    SHARED,
    unweighted_terms,
)
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


@kernel
def run_windows(
    begin, end, windows, start, insets, expected, of_class, shape, numbers, faces, results
):
    """
    Take one round with the windows `begin` to `end`.

    Parameters
    ----------
    begin, end : int
        First window, and the one after the last.
    windows : WindowArrays
        Input of the windows.
    start : StartArrays
        Start of the round.
    insets : tuple of two arrays, shape (B, 6)
        `occlusion_inset` and `range_inset` of `boxreg_ros.core.face_support.FaceOffsets` [m].
    expected : ExpectedArrays
        Means and deviations of input and shared variables.
    of_class : ClassDeviations
        Of the class of each window.
    shape : ShapeArrays
        Rigid shape.
    numbers : RoundNumbers
        Constants and settings.
    faces : FaceArrays
        Face observations, written.
    results : RoundResults
        Written.

    """
    N = start.poses.shape[1]
    n = 6 * N
    search_numbers = numbers.search
    work = empty_face_work(begin, end, windows, numbers.faces)
    scratch = empty_scratch(N)
    search = empty_search(n + SHARED, search_numbers.history)
    A = empty_arrowhead(N)
    for b in range(begin, end):
        free, x = start.free[b], results.x[b]
        observe_window(
            b, windows, start.poses[b], start.shared[b], insets[0][b], insets[1][b],
            numbers.faces, work, faces,
        )  # fmt: skip
        terms = unweighted_terms(N, start, shape, b)
        weigh(b, windows, start, faces, expected, of_class, numbers.weights, terms)
        x[:n] = start.poses[b].ravel()
        x[n:] = start.shared[b]
        value = linearise(x, terms, free, scratch, search.gradient, A)
        minimise(x, value, terms, free, A, search, scratch, search_numbers)
        invert_corner(A.corner, results.corner[b])
        poses = x[:n].reshape(N, 6)
        is_done = search_numbers.is_last or (
            search_numbers.may_settle
            and has_settled(poses, start.poses[b], of_class.pose[b], search_numbers.settled_step)
        )
        results.is_done[b] = is_done
        if not is_done:
            continue
        invert_poses(A, results.corner[b], results.pose_blocks[b], results.border_blocks[b])
        if len(results.prior_mean) and windows.lengths[b] == N:
            accumulate(x, 1, terms, scratch, search.gradient, A)
            marginalise(
                x, search.gradient, A, results.prior_mean[b], results.prior_step[b],
                results.prior_information[b],
            )  # fmt: skip
