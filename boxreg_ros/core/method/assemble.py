"""
The sum of all residuals of one window (M1): value, gradient and Gauss-Newton curvature.

Every residual adds r' W r / 2 to the value, J' W r to the gradient and J' W J to the matrix A.

"""

from boxreg_ros.core.method.arrays import (
    Arrowhead,
    BOX_POSE,
    EXTENT,
    Factor,
    GAP,
    POSE,
    PRIOR,
    REST,
    SHARED,
    SPAN,
)
from boxreg_ros.core.method.arrowhead import (
    clear,
    eliminate_poses,
    factorise,
    factorise_corner,
    fix_variables,
    NEXT,
    RIDGE,
    solve_corner,
    substitute_forward,
)
from boxreg_ros.core.method.compile import kernel, loop
from boxreg_ros.core.method.residuals import (
    Axes,
    fill_axes,
    fill_plane,
    RESIDUALS,
)
from boxreg_ros.core.method.weights import (
    fill_parked,
    fill_pin_factor,
    robustify,
    weigh_faces,
    weigh_shared,
    Weighing,
)
from numba import literal_unroll
import numpy as np

UNKNOWN_RIDGE = 1e-6
"""Information of the marginalisation prior in directions that no residual constrains. Derived:
that of a deviation of 1000 m."""


@kernel
def empty_matrix(N):
    """Return room for the matrix of a window of N observations."""
    return Arrowhead(
        np.empty((N + 2, POSE, SPAN)), np.empty((N + 2, POSE, SHARED)), np.empty((SHARED, SHARED))
    )


@kernel
def no_matrix():
    """Return the matrix of an evaluation without curvature."""
    return Arrowhead(np.empty((0, POSE, SPAN)), np.empty((0, POSE, SHARED)), np.empty((0, 0)))


@loop
def is_wanted(A):
    """Return whether the curvature is wanted."""
    return len(A.links) > 0


@loop
def add(n, poses, rows, columns, W, out, gradient, A):
    """Add one residual `out` of some poses from n on, with diagonal weights W (6,)."""
    first = len(gradient) - SHARED
    width = POSE * poses
    value = 0.0
    for row in range(rows):
        J, S, pull = out.J[row], out.S[row], W[row] * out.r[row]
        value += 0.5 * pull * out.r[row]
        for a in range(width):
            gradient[POSE * n + a] += J[a] * pull
        for s in range(columns):
            gradient[first + out.columns[s]] += S[s] * pull
        if not is_wanted(A):
            continue
        for a in range(width):
            weighted = W[row] * J[a]
            if weighted == 0.0:
                continue
            pose = a // POSE
            links, border = A.links[n + pose, a - POSE * pose], A.border[n + pose, a - POSE * pose]
            for b in range(a, width):
                links[b - POSE * pose] += weighted * J[b]
            for s in range(columns):
                border[out.columns[s]] += weighted * S[s]
        for s in range(columns):
            weighted = W[row] * S[s]
            if weighted == 0.0:
                continue
            for t in range(s, columns):
                A.corner[out.columns[s], out.columns[t]] += weighted * S[t]
    return value


@loop
def add_plane(n, face, w, v, by_angles, pull, weighted, gradient, A):
    """
    Add the plane v (4,) of a face with the weight w (4, 4): the sum over its outermost points.

    The generic `add` for the derivatives of `fill_plane`, written out: this is half of a round.
    `pull` (4,) and `weighted` (4, 3) are to work in.

    """
    axis = face // 2
    first = len(gradient) - SHARED
    value = 0.0
    for a in range(4):
        pull[a] = w[a, 0] * v[0] + w[a, 1] * v[1] + w[a, 2] * v[2] + w[a, 3] * v[3]
        value += 0.5 * v[a] * pull[a]
    for k in range(3):
        gradient[POSE * n + k] -= v[k] * pull[3]
        for a in range(4):
            gradient[POSE * n + 3 + k] += by_angles[a, k] * pull[a]
    gradient[first + GAP + face] += pull[3]
    gradient[first + EXTENT + axis] -= 0.5 * pull[3]
    if not is_wanted(A):
        return value
    for a in range(4):
        for k in range(3):
            weighted[a, k] = (
                w[a, 0] * by_angles[0, k] + w[a, 1] * by_angles[1, k]
                + w[a, 2] * by_angles[2, k] + w[a, 3] * by_angles[3, k]
            )  # fmt: skip
    links, border, level = A.links[n], A.border[n], w[3, 3]
    for k in range(3):
        for m in range(k, 3):
            links[k, m] += level * v[k] * v[m]
            total = 0.0
            for a in range(4):
                total += by_angles[a, k] * weighted[a, m]
            links[3 + k, 3 + m] += total
        for m in range(3):
            links[k, 3 + m] -= v[k] * weighted[3, m]
        border[k, GAP + face] -= level * v[k]
        border[k, EXTENT + axis] += 0.5 * level * v[k]
        border[3 + k, GAP + face] += weighted[3, k]
        border[3 + k, EXTENT + axis] -= 0.5 * weighted[3, k]
    A.corner[GAP + face, GAP + face] += level
    A.corner[EXTENT + axis, GAP + face] -= 0.5 * level
    A.corner[EXTENT + axis, EXTENT + axis] += 0.25 * level
    return value


@loop
def add_shared_prior(shared, common, gradient, A):
    """Add the deviation of the shared variables from those expected (M8)."""
    first = len(gradient) - SHARED
    value = 0.0
    for s in range(SHARED):
        off = shared[s] - common.shared[s]
        value += 0.5 * common.W_shared[s] * off**2
        gradient[first + s] += common.W_shared[s] * off
        if is_wanted(A):
            A.corner[s, s] += common.W_shared[s]
    return value


@kernel
def add_marginal_prior(x, common, gradient, A):
    """Add the quadratic form in the two oldest poses and the shared variables (M9)."""
    W, mean = common.W_prior, common.prior_mean
    first = len(gradient) - SHARED
    r = np.empty(PRIOR)
    for k in range(PRIOR):
        r[k] = x[k if k < NEXT else first + k - NEXT] - mean[k]
    value = 0.0
    for k in range(PRIOR):
        pull = 0.0
        for m in range(PRIOR):
            pull += W[k, m] * r[m]
        value += 0.5 * r[k] * pull
        gradient[k if k < NEXT else first + k - NEXT] += pull
    if is_wanted(A):
        for k in range(NEXT):
            pose = k // POSE
            links, border = A.links[pose, k - POSE * pose], A.border[pose, k - POSE * pose]
            for m in range(k, NEXT):
                links[m - POSE * pose] += W[k, m]
            for s in range(SHARED):
                border[s] += W[k, NEXT + s]
        for s in range(SHARED):
            for t in range(s, SHARED):
                A.corner[s, t] += W[NEXT + s, NEXT + t]
    return value


@kernel
def empty_axes(N):
    """Return room for the axes of N poses."""
    return Axes(np.empty((N, 3, 3)), np.empty((N, 3, 3, 3)))


@loop
def has_weight(W):
    """Return whether any row of a residual has a weight, W (6,)."""
    total = 0.0
    for k in range(POSE):
        total += abs(W[k])
    return total != 0.0


@kernel
def add_all(poses, shared, last, terms, at, out, gradient, A):
    """Add all `RESIDUALS` that begin at the first `last` observations."""
    value = 0.0
    i = 0
    for row in literal_unroll(RESIDUALS):
        for n in range(min(last, number_of(len(poses), row.poses, True))):
            W = terms[n].W[i]
            if has_weight(W):
                out.J[:] = 0.0
                out.S[:] = 0.0
                rows, columns = row.function(n, poses, shared, terms, at, out)
                value += add(n, row.poses, rows, columns, W, out, gradient, A)
        i += 1
    return value


@kernel
def accumulate(x, last, terms, common, at, out, gradient, A):
    """
    Return the sum of the residuals of one window (M1); write its gradient and curvature.

    Parameters
    ----------
    x : array, shape (6 N + 23,)
        Poses and shared variables.
    last : int
        Only residuals that begin at the first `last` observations; less than N leaves out the
        prior on the shared variables too, which belongs to no observation.
    terms, common : array of `TERMS`, shape (N,), and record `COMMON`
        Data and weights of the window.
    at, out : Axes, Linearised
        To work in.
    gradient : array, shape (6 N + 23,)
        Written.
    A : Arrowhead
        Gauss-Newton matrix, written; of `no_matrix` where it is not wanted.

    """
    n_shared = len(x) - SHARED
    N = n_shared // POSE
    poses, shared = x[:n_shared].reshape(N, POSE), x[n_shared:]
    v, by_angles, pull, weighted = np.empty(4), np.empty((4, 3)), np.empty(4), np.empty((4, 3))
    gradient[:] = 0.0
    clear(A)
    fill_axes(poses, 0, min(last + 1, N), at)
    value = 0.0
    for n in range(min(last, N)):
        for face in range(6):
            w = terms[n].W_faces[face]
            if w[3, 3] != 0.0:
                fill_plane(n, face, poses, shared, terms, at, v, by_angles)
                value += add_plane(n, face, w, v, by_angles, pull, weighted, gradient, A)
    value += add_all(poses, shared, last, terms, at, out, gradient, A)
    if common.W_prior[0, 0] != 0.0:
        value += add_marginal_prior(x, common, gradient, A)
    if last >= N:
        value += add_shared_prior(shared, common, gradient, A)
    return value


@kernel
def weigh(b, problem, poses, shared, constants, at, out, terms, common):
    """
    Write data and weights of the terms of window `b` at the start of a round.

    Parameters
    ----------
    b : int
        The window.
    problem : Problem
        Input of the batch.
    poses, shared : array, shapes (N, 6) and (23,)
        Boxes and shared variables of the window.
    constants : record of `Constants`
        Of the method, with the settings.
    at, out : Axes, Linearised
        To work in.
    terms, common : array of `TERMS`, shape (N,), and record `COMMON`
        Of the window, with its face observations, rigid shape and expectation: the rest is
        written.

    """
    N, length = len(poses), problem.lengths[b]
    boxes, times, of_class = problem.boxes[b], problem.times[b], problem.of_class[b]
    parked, pin_factor, face_weight = np.empty(N, np.bool_), np.empty(POSE), np.empty((N, 6))
    yaw_deviation = max(common.pose_deviation[5], of_class.pose[5])
    fill_parked(boxes, times, length, yaw_deviation, constants, parked)
    fill_pin_factor(length, common, pin_factor)
    fill_axes(poses, 0, N, at)
    for n in range(N):
        terms[n].time = times[n]
        terms[n].axes[:] = at.R[n]
        terms[n].start[:] = poses[n]
        for k in range(POSE):
            terms[n].given[k] = boxes[n, BOX_POSE[k]]
        terms[n].W[:] = 0.0
    weigh_faces(length, of_class.roughness, constants, terms, face_weight)
    weigh_shared(length, shared, terms, common, face_weight, constants)
    window = Weighing(
        length, common.pose_deviation, common.widened_deviation, problem.pinned[b], pin_factor,
        parked, of_class,
    )  # fmt: skip
    weigh_each(poses, shared, terms, window, constants, at, out)


@kernel
def weigh_each(poses, shared, terms, window, constants, at, out):
    """Write the weights of each of `RESIDUALS` where they are not zero."""
    squared = np.zeros(len(poses))
    i = 0
    for row in literal_unroll(RESIDUALS):
        count = number_of(window.length, row.poses, constants.residuals[i])
        for n in range(count):
            W = terms[n].W[i]
            rows, _ = row.function(n, poses, shared, terms, at, out)
            row.weight(n, out.r, window, constants, W)
            squared[n] = squared_norm(rows, W, out.r)
        if row.is_robust and constants.is_robust:
            robustify(i, count, squared, constants.outlier, terms)
        i += 1


@loop
def number_of(length, poses, is_used):
    """Return how many residuals of some `poses` each there are."""
    return max(length + 1 - poses, 0) if is_used else 0


@loop
def squared_norm(rows, W, r):
    """Return r' W r with diagonal weights."""
    total = 0.0
    for k in range(rows):
        total += W[k] * r[k] ** 2
    return total


@kernel
def linearise(x, terms, common, free, at, out, gradient, A, factor):
    """
    Return the value of the terms of one window; write gradient and factor of the curvature.

    In the `free` variables. The factor of a matrix that is not positive definite is NaN.

    """
    value = accumulate(x, len(terms), terms, common, at, out, gradient, A)
    for k in range(len(x)):
        gradient[k] *= free[k]
    fix_variables(A, free)
    if not factorise(A, factor):
        factor.own[:] = np.nan
        factor.coupling[:] = np.nan
        factor.corner[:] = np.nan
    return value


@loop
def fill_dense(A, dense):
    """Write the block of the second pose, the third and the shared variables, (35, 35)."""
    for pose in range(2):
        for a in range(POSE):
            i = POSE * pose + a
            for c in range(a, NEXT - POSE * pose):
                dense[i, POSE * pose + c] = A.links[1 + pose, a, c]
            for s in range(SHARED):
                dense[i, NEXT + s] = A.border[1 + pose, a, s]
    for s in range(SHARED):
        for t in range(s, SHARED):
            dense[NEXT + s, NEXT + t] = A.corner[s, t]
    for i in range(len(dense)):
        for j in range(i):
            dense[i, j] = dense[j, i]


@kernel
def marginalise(x, gradient, A, mean, step, information):
    """
    Write the quadratic form that replaces the oldest observation of one window (M13).

    In the next two poses and the shared variables: where they are (35,), the step from there to
    the minimum (35,), and the curvature (35, 35). The sums of the residuals of the oldest
    observation, from `accumulate`, are the input; they are changed.

    """
    n = len(x) - SHARED
    mean[:NEXT] = x[POSE : POSE + NEXT]
    mean[NEXT:] = x[n:]
    for a in range(POSE):
        A.links[0, a, a] += RIDGE
    oldest = Factor(
        np.empty((1, POSE, POSE)), np.empty((1, POSE, REST)), np.empty((SHARED, SHARED))
    )
    is_definite = eliminate_poses(A, oldest)
    fill_dense(A, information)
    substitute_forward(oldest, gradient)
    step[:NEXT] = -gradient[POSE : POSE + NEXT]
    step[NEXT:] = -gradient[n:]
    triangle = information.copy()
    for k in range(PRIOR):
        triangle[k, k] += UNKNOWN_RIDGE
    if not (is_definite and factorise_corner(triangle)):
        step[:] = np.nan
        information[:] = np.nan
        return
    solve_corner(triangle, step)  # an inverse would lose directions of almost no information
