"""
The sum of all residuals of one window (M1): value, gradient and Gauss-Newton curvature.

Every residual adds r' W r / 2 to the value, J' W r to the gradient and J' W J to the matrix A.

"""

from boxreg_ros.core.method.arrays import (
    Arrowhead,
    BLOCK,
    copy,
    EXTENT,
    Factor,
    GAP,
    POSE,
    PRIOR,
    SPAN,
    WIDTH,
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
from boxreg_ros.core.method.compile import kernel, loop, small_array
from boxreg_ros.core.method.residuals import (
    AXES,
    fill_axes,
    fill_plane,
    fill_residual,
    fill_weight,
    IS_COMBINATION,
    IS_ROBUST,
    level_of,
    POSES_OF,
)
from boxreg_ros.core.method.weights import (
    fill_parked,
    fill_pin_factor,
    robustify,
    weigh_faces,
    weigh_shared,
    Weighing,
)
import numpy as np

UNKNOWN_RIDGE = 1e-6
"""Information of the marginalisation prior in directions that no residual constrains. Derived:
that of a deviation of 1000 m."""


@kernel
def empty_matrix(N, S):
    """Return room for the matrix of a window of N observations."""
    return Arrowhead(np.empty(N + 2, BLOCK), np.empty((S, S)))


@kernel
def no_matrix():
    """Return the matrix of an evaluation without curvature."""
    return Arrowhead(np.empty(0, BLOCK), np.empty((0, 0)))


@loop
def is_wanted(A):
    """Return whether the curvature is wanted."""
    return len(A.poses) > 0


@loop
def add(n, poses, rows, columns, W, out, first, gradient, A):
    """
    Add one residual `out` of some poses from n on, with diagonal weights W (6,).

    The gradient by the shared variables begins at `first`.

    """
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
        for i in range(poses):
            links, border, before = A.poses[n + i].links, A.poses[n + i].border, POSE * i
            for c in range(before, width):
                weighted = W[row] * J[c]
                for a in range(POSE):
                    links[a, c - before] += J[before + a] * weighted
            for s in range(columns):
                weighted = W[row] * S[s]
                for a in range(POSE):
                    border[a, out.columns[s]] += J[before + a] * weighted
        for s in range(columns):
            weighted = W[row] * S[s]
            for t in range(s, columns):
                A.corner[out.columns[s], out.columns[t]] += weighted * S[t]
    return value


@loop
def add_combination(n, poses, rows, columns, W, out, first, gradient, A):
    """
    Add one residual `out` of a combination of some poses from n on, as `add` does.

    With J the derivatives by the combination, J' W J is computed once for all of the poses. Its
    rows are six: few residuals have shared variables, whose loop is not written out.

    """
    J, share, pull, curvature = out.J, out.share, out.pull, out.curvature
    value = 0.0
    for row in range(POSE):
        value += 0.5 * W[row] * out.r[row] ** 2
    for a in range(POSE):
        total = 0.0
        for row in range(POSE):
            total += J[row, a] * W[row] * out.r[row]
        pull[a] = total
    for i in range(poses):
        for a in range(POSE):
            gradient[POSE * (n + i) + a] += share[i] * pull[a]
    for s in range(columns):
        for row in range(POSE):
            gradient[first + out.columns[s]] += out.S[row, s] * W[row] * out.r[row]
    if not is_wanted(A):
        return value
    for a in range(POSE):
        for b in range(a, POSE):
            total = 0.0
            for row in range(POSE):
                total += J[row, a] * W[row] * J[row, b]
            curvature[a, b] = curvature[b, a] = total
    for i in range(poses):
        for k in range(i, poses):
            links, after = A.poses[n + i].links, POSE * (k - i)
            for a in range(POSE):
                for b in range(POSE):
                    links[a, after + b] += share[i] * share[k] * curvature[a, b]
    for s in range(columns):
        for row in range(rows):
            weighted = W[row] * out.S[row, s]
            if weighted == 0.0:
                continue
            for i in range(poses):
                border = A.poses[n + i].border
                for a in range(POSE):
                    border[a, out.columns[s]] += share[i] * weighted * J[row, a]
            for t in range(s, columns):
                A.corner[out.columns[s], out.columns[t]] += weighted * out.S[row, t]
    return value


@loop
def add_faces(n, axis, shared, terms, room, first, gradient, A):
    """
    Add the two faces (M2) along an axis of a box: sums over their outermost points.

    The generic `add` for the derivatives of `fill_plane`, written out. What both faces have in
    common is computed once, of the sum of their weights (4, 4).

    """
    u, by_angles, pull, weighted = room.plane, room.by_angles, room.pull, room.weighted
    front, back = terms[n].W_faces[2 * axis], terms[n].W_faces[2 * axis + 1]
    value = 0.0
    for side in range(2):
        face = 2 * axis + side
        sign = 1.0 - 2.0 * side
        w, level = terms[n].W_faces[face], level_of(n, face, shared, terms)
        for a in range(4):
            pull[a] = w[a, 3] * level
            for b in range(4):
                pull[a] += sign * w[a, b] * u[b]
            value += 0.5 * sign * u[a] * pull[a]
        value += 0.5 * level * pull[3]
        for k in range(3):
            gradient[POSE * n + k] -= sign * u[k] * pull[3]
            for a in range(4):
                gradient[POSE * n + 3 + k] += sign * by_angles[a, k] * pull[a]
        gradient[first + GAP + face] += pull[3]
        gradient[first + EXTENT + axis] -= 0.5 * pull[3]
        if is_wanted(A):
            border, own = A.poses[n].border, w[3, 3]
            for k in range(3):
                turn = 0.0
                for a in range(4):
                    turn += sign * w[3, a] * by_angles[a, k]
                border[k, GAP + face] -= sign * own * u[k]
                border[k, EXTENT + axis] += 0.5 * sign * own * u[k]
                border[3 + k, GAP + face] += turn
                border[3 + k, EXTENT + axis] -= 0.5 * turn
            A.corner[GAP + face, GAP + face] += own
            A.corner[EXTENT + axis, GAP + face] -= 0.5 * own
            A.corner[EXTENT + axis, EXTENT + axis] += 0.25 * own
    if not is_wanted(A):
        return value
    for a in range(4):
        for k in range(3):
            weighted[a, k] = 0.0
            for b in range(4):
                weighted[a, k] += (front[a, b] + back[a, b]) * by_angles[b, k]
    links, both = A.poses[n].links, front[3, 3] + back[3, 3]
    for k in range(3):
        for m in range(k, 3):
            links[k, m] += both * u[k] * u[m]
            total = 0.0
            for a in range(4):
                total += by_angles[a, k] * weighted[a, m]
            links[3 + k, 3 + m] += total
        for m in range(3):
            links[k, 3 + m] -= u[k] * weighted[3, m]
    return value


@loop
def add_shared_prior(shared, common, first, gradient, A):
    """Add the deviation of the shared variables from those expected (M8)."""
    value = 0.0
    for s in range(len(shared)):
        off = shared[s] - common.shared[s]
        value += 0.5 * common.W_shared[s] * off**2
        gradient[first + s] += common.W_shared[s] * off
        if is_wanted(A):
            A.corner[s, s] += common.W_shared[s]
    return value


@loop
def add_marginal_prior(x, mean, W, r, first, gradient, A):
    """
    Add the quadratic form in the two oldest poses and the shared variables (M9).

    Its minimum is `mean` (29,), its information `W` (29, 29); `r` (29,) is to work in.

    """
    S = len(W) - NEXT
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
            own = A.poses[pose]
            links, border = own.links[k - POSE * pose], own.border[k - POSE * pose]
            for m in range(k, NEXT):
                links[m - POSE * pose] += W[k, m]
            for s in range(S):
                border[s] += W[k, NEXT + s]
        for s in range(S):
            for t in range(s, S):
                A.corner[s, t] += W[NEXT + s, NEXT + t]
    return value


@kernel
def empty_axes(N):
    """Return room for the axes of N poses."""
    return np.empty(N, AXES)


@loop
def has_weight(W):
    """Return whether any row of a residual has a weight, W (6,)."""
    total = 0.0
    for k in range(POSE):
        total += abs(W[k])
    return total != 0.0


@loop
def clear_derivatives(out):
    """Set the derivatives of a residual to zero."""
    for a in range(POSE):
        for c in range(SPAN):
            out.J[a, c] = 0.0
        for s in range(POSE):
            out.S[a, s] = 0.0


@loop
def add_all(poses, shared, last, terms, at, room, first, gradient, A):
    """Add all `RESIDUALS` that begin at the first `last` observations."""
    value = 0.0
    out = room[0]
    for i in range(len(POSES_OF)):
        for n in range(min(last, number_of(len(poses), POSES_OF[i], True))):
            W = terms[n].W[i]
            if has_weight(W):
                clear_derivatives(out)
                rows, columns = fill_residual(i, n, poses, shared, terms, at, out)
                if IS_COMBINATION[i]:
                    value += add_combination(
                        n, POSES_OF[i], rows, columns, W, out, first, gradient, A
                    )
                else:
                    value += add(n, POSES_OF[i], rows, columns, W, out, first, gradient, A)
    return value


@loop
def accumulate(x, last, terms, common, prior_mean, W_prior, at, out, gradient, A):
    """
    Return the sum of the residuals of one window (M1); write its gradient and curvature.

    Parameters
    ----------
    x : array, shape (6 N + S,)
        Poses and shared variables.
    last : int
        Only residuals that begin at the first `last` observations; less than N leaves out the
        prior on the shared variables too, which belongs to no observation.
    terms, common : array of `TERMS`, shape (N,), and record `COMMON`
        Data and weights of the window.
    prior_mean, W_prior : array, shapes (29,) and (29, 29)
        Marginalisation prior (M9): minimum and information.
    at, out : array of `AXES`, shape (N,), and of `LINEARISED`, shape (1,)
        To work in.
    gradient : array, shape (6 N + S,)
        Written.
    A : Arrowhead
        Gauss-Newton matrix, written; of `no_matrix` where it is not wanted.

    """
    N = len(terms)
    first = POSE * N
    poses, shared = x[:first].reshape(N, POSE), x[first:]
    room = out[0]
    for k in range(len(x)):
        gradient[k] = 0.0
    clear(A)
    fill_axes(poses, 0, min(last + 1, N), at)
    value = 0.0
    for n in range(min(last, N)):
        for axis in range(3):
            if terms[n].W_faces[2 * axis, 3, 3] + terms[n].W_faces[2 * axis + 1, 3, 3] != 0.0:
                fill_plane(n, axis, poses, terms, at, room.plane, room.by_angles)
                value += add_faces(n, axis, shared, terms, room, first, gradient, A)
    value += add_all(poses, shared, last, terms, at, out, first, gradient, A)
    if W_prior[0, 0] != 0.0:
        value += add_marginal_prior(x, prior_mean, W_prior, room.off, first, gradient, A)
    if last >= N:
        value += add_shared_prior(shared, common, first, gradient, A)
    return value


@loop
def weigh(b, problem, poses, shared, constants, at, out, terms, common):
    """
    Write data and weights of the terms of window `b` at the start of a round.

    Parameters
    ----------
    b : int
        The window.
    problem : Problem
        Input of the batch.
    poses, shared : array, shapes (N, 6) and (S,)
        Boxes and shared variables of the window.
    constants : record of `Constants`
        Of the method, with the settings.
    at, out : array of `AXES`, shape (N,), and of `LINEARISED`, shape (1,)
        To work in.
    terms, common : array of `TERMS`, shape (N,), and record `COMMON`
        Of the window, with its face observations, rigid shape and expectation: the rest is
        written.

    """
    N, length = len(poses), problem.lengths[b]
    boxes, times, of_class = problem.boxes[b], problem.times[b], problem.of_class[b]
    parked, pin_factor, face_weight = at['parked'], out[0].pin_factor, at['face_weight']
    yaw_deviation = max(common.pose_deviation[5], of_class.pose[5])
    fill_parked(boxes, times, length, yaw_deviation, constants, parked)
    fill_pin_factor(length, common, pin_factor)
    fill_axes(poses, 0, N, at)
    for n in range(N):
        terms[n].time = times[n]
        for i in range(3):
            for j in range(3):
                terms[n].axes[i, j] = at[n].R[i, j]
        for k in range(POSE):
            terms[n].start[k] = poses[n, k]
            terms[n].given[k] = boxes[n, k if k < 3 else k + 3]
            for i in range(len(POSES_OF)):
                terms[n].W[i, k] = 0.0
    weigh_faces(length, of_class.roughness, constants, terms, face_weight)
    weigh_shared(length, shared, terms, common, face_weight, constants)
    window = Weighing(
        length, common.pose_deviation, common.widened_deviation, problem.pinned[b], pin_factor,
        parked, of_class,
    )  # fmt: skip
    weigh_each(poses, shared, terms, window, constants, at, out)


@loop
def weigh_each(poses, shared, terms, window, constants, at, room):
    """Write the weights of each of `RESIDUALS` where they are not zero."""
    out, squared = room[0], at['squared']
    for i in range(len(POSES_OF)):
        count = number_of(window.length, POSES_OF[i], constants.residuals[i])
        for n in range(count):
            W = terms[n].W[i]
            rows, _ = fill_residual(i, n, poses, shared, terms, at, out)
            fill_weight(i, n, out.r, window, constants, W)
            squared[n] = squared_norm(rows, W, out.r)
        if IS_ROBUST[i] and constants.is_robust:
            robustify(i, count, squared, constants.outlier, terms)


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


@loop
def factorise_free(A, free, factor):
    """
    Write the factor of a matrix in the `free` variables (6 N + S,).

    The corner of one that is not positive definite is NaN, and with it all that follows.

    """
    fix_variables(A, free)
    if not factorise(A, factor):
        S = len(factor.corner)
        for s in range(S):
            for t in range(S):
                factor.corner[s, t] = np.nan


@loop
def fill_dense(A, dense):
    """Write the block of the second pose, the third and the shared variables, (29, 29)."""
    S = len(A.corner)
    for i in range(len(dense) - S):
        pose, a = i // POSE, i % POSE
        links, border = A.poses[1 + pose].links[a], A.poses[1 + pose].border[a]
        for c in range(i, NEXT):
            dense[i, c] = links[c - POSE * pose]
        for s in range(S):
            dense[i, NEXT + s] = border[s]
    for s in range(S):
        for t in range(s, S):
            dense[NEXT + s, NEXT + t] = A.corner[s, t]
    for i in range(len(dense)):
        for j in range(i):
            dense[i, j] = dense[j, i]


@loop
def marginalise(x, gradient, A, factor, mean, step, information):
    """
    Write the quadratic form that replaces the oldest observation of one window (M13).

    In the next two poses and the shared variables: where they are (29,), the step from there to
    the minimum (29,), and the curvature (29, 29). The sums of the residuals of the oldest
    observation, from `accumulate`, are the input; they are changed, as is the `factor` of the
    window.

    """
    n = len(x) - len(A.corner)
    copy(x[POSE:], mean[:NEXT])
    copy(x[n:], mean[NEXT:])
    for a in range(POSE):
        A.poses[0].links[a, a] += RIDGE
    oldest = Factor(factor.own[:1], factor.coupling[:1], factor.corner)
    is_definite = eliminate_poses(A, oldest)
    fill_dense(A, information)
    substitute_forward(oldest, gradient, small_array(WIDTH)[: factor.coupling.shape[2]])
    triangle = small_array(PRIOR, PRIOR)
    for k in range(PRIOR):
        step[k] = -gradient[POSE + k if k < NEXT else n + k - NEXT]
        copy(information[k], triangle[k])
        triangle[k, k] += UNKNOWN_RIDGE
    if not (is_definite and factorise_corner(triangle)):
        for k in range(PRIOR):
            step[k] = np.nan
        return
    solve_corner(triangle, step)  # an inverse would lose directions of almost no information
