"""
Value, gradient and Gauss-Newton matrix of the objective of one window, in plain loops.

Every term adds r' W r / 2 to the value, J' W r to the gradient and J' W J to the matrix `A`, which
has the layout of `arrowhead`; a matrix without rows is not wanted. The torch twins of these
functions are those of `terms`.

"""

from typing import Any, NamedTuple

from boxreg_ros.core.kernels.arrays import ArrowheadArrays, TermArrays
from boxreg_ros.core.kernels.arrowhead import (
    BORDER,
    clear,
    eliminate_pose,
    factorise,
    NEXT,
    POSE,
    RIDGE,
    solve,
    SPAN,
    substitute_forward,
)
from boxreg_ros.core.kernels.compile import kernel
from boxreg_ros.core.kernels.rotation import fill_rotation, fill_rotation_derivatives
import numpy as np

EXTENT, BIAS, GAP, PIVOT, ANCHOR, SIDESLIP, SHARED = 0, 3, 9, 15, 16, 22, 23
"""First of the shared variables of each kind, and their number."""
UNKNOWN_RIDGE = 1e-6
"""Information that is assumed in directions which no residual constrains."""


@kernel
def no_matrix():
    """Return the matrix of an evaluation without curvature."""
    return ArrowheadArrays(
        np.empty((0, POSE, SPAN)), np.empty((0, POSE, BORDER)), np.empty((0, 0))
    )


@kernel
def is_wanted(A: Any) -> bool:
    """Return whether the curvature is wanted."""
    return len(A.links) > 0


@kernel
def unweighted_terms(N, shapes, prior, b):
    """Return room for the terms of window `b`: only its prior has weights; `shapes` are 0 or N."""
    return TermArrays(
        np.empty((N, 6)), np.empty((N, 6)), np.zeros((N, 6, 4, 4)),
        np.empty((N, 3, 3)), np.zeros((N, 6)),
        np.empty((N, 6)), np.empty((N, 6)), np.empty((shapes, 6, 6)),
        np.empty(N), np.zeros((N, 3, 3)), np.zeros((N, 3)), np.zeros((N, 2)), np.zeros((N, 6)),
        prior.mean[b], prior.W[b], np.empty(SHARED), np.zeros(SHARED),
    )  # fmt: skip


@kernel
def add_faces(n, pose, shared, terms, scratch, gradient, A):
    """
    Add the six face residuals of one observation (M2).

    The plane of a face is v = (normal, level). Its normal turns with the angles of the pose; its
    level changes with the position, too, by the negative of the normal.

    """
    R, dR = scratch.R[n], scratch.dR[n]
    v, pull, by_angles, weighted = scratch.plane, scratch.pull, scratch.by_angles, scratch.weighted
    given, inset, W = terms.given[n], terms.inset[n], terms.W_faces[n]
    row = 6 * n
    first = len(gradient) - SHARED
    value = 0.0
    for face in range(6):
        w = W[face]
        if w[3, 3] == 0.0:
            continue
        axis = face // 2
        sign = 1.0 - 2.0 * (face % 2)
        v[3] = inset[face] + shared[GAP + face] - shared[EXTENT + axis] / 2
        for j in range(3):
            v[j] = sign * R[j, axis]
            v[3] -= v[j] * (pose[j] - given[j])
        for k in range(3):
            by_angles[3, k] = 0.0
            for j in range(3):
                by_angles[j, k] = sign * dR[k, j, axis]
                by_angles[3, k] -= (pose[j] - given[j]) * by_angles[j, k]
        for a in range(4):
            pull[a] = w[a, 0] * v[0] + w[a, 1] * v[1] + w[a, 2] * v[2] + w[a, 3] * v[3]
            value += 0.5 * v[a] * pull[a]
        for k in range(3):
            gradient[row + k] -= v[k] * pull[3]
            for a in range(4):
                gradient[row + 3 + k] += by_angles[a, k] * pull[a]
        gradient[first + GAP + face] += pull[3]
        gradient[first + EXTENT + axis] -= 0.5 * pull[3]
        if is_wanted(A):
            for a in range(4):
                for k in range(3):
                    weighted[a, k] = (
                        w[a, 0] * by_angles[0, k] + w[a, 1] * by_angles[1, k]
                        + w[a, 2] * by_angles[2, k] + w[a, 3] * by_angles[3, k]
                    )  # fmt: skip
            add_face_curvature(n, face, v, w[3, 3], by_angles, weighted, A)
    return value


@kernel
def add_face_curvature(n, face, v, w, by_angles, weighted, A):
    """Add J' W J of one face: w is the weight of its level, `weighted` (4, 3) is W `by_angles`."""
    axis = face // 2
    links, border = A.links[n], A.border[n]
    for k in range(3):
        for m in range(k, 3):
            links[k, m] += w * v[k] * v[m]
            total = 0.0
            for a in range(4):
                total += by_angles[a, k] * weighted[a, m]
            links[3 + k, 3 + m] += total
        for m in range(3):
            links[k, 3 + m] -= v[k] * weighted[3, m]
        border[k, GAP + face] -= w * v[k]
        border[k, EXTENT + axis] += 0.5 * w * v[k]
        border[3 + k, GAP + face] += weighted[3, k]
        border[3 + k, EXTENT + axis] -= 0.5 * weighted[3, k]
    A.corner[GAP + face, GAP + face] += w
    A.corner[EXTENT + axis, GAP + face] -= 0.5 * w
    A.corner[EXTENT + axis, EXTENT + axis] += 0.25 * w


@kernel
def fill_step(pose, start, axes, r):
    """Write the step (6,) of a pose from `start`: position along axes, angles as they are."""
    for k in range(3):
        r[k] = 0.0
        for j in range(3):
            r[k] += axes[j, k] * (pose[j] - start[j])
        r[3 + k] = pose[3 + k] - start[3 + k]


@kernel
def add_input(n, pose, shared, terms, r, gradient, A):
    """Add the step of one pose from its input less the bias (M3), with diagonal weights."""
    axes, w = terms.axes[n], terms.W_input[n]
    row = 6 * n
    first = len(gradient) - SHARED
    fill_step(pose, terms.given[n], axes, r)
    value = 0.0
    for k in range(6):
        r[k] -= shared[BIAS + k]
        value += 0.5 * w[k] * r[k] ** 2
        gradient[first + BIAS + k] -= w[k] * r[k]
    for k in range(3):
        for j in range(3):
            gradient[row + j] += axes[j, k] * w[k] * r[k]
        gradient[row + 3 + k] += w[3 + k] * r[3 + k]
    if is_wanted(A):
        for k in range(3):
            for j in range(3):
                for m in range(j, 3):
                    A.links[n, j, m] += axes[j, k] * w[k] * axes[m, k]
                A.border[n, j, BIAS + k] -= axes[j, k] * w[k]
            A.links[n, 3 + k, 3 + k] += w[3 + k]
            A.border[n, 3 + k, BIAS + 3 + k] -= w[3 + k]
        for k in range(6):
            A.corner[BIAS + k, BIAS + k] += w[k]
    return value


@kernel
def add_rigid_shape(n, pose, shared, terms, r, gradient, A):
    """
    Add the step of one pose from the start of the round less anchor and wanted step (M4).

    The Jacobian by the pose is D = diag(axes', I), that by the anchor -I.

    """
    axes, W = terms.axes[n], terms.W_shape[n]
    row = 6 * n
    first = len(gradient) - SHARED
    fill_step(pose, terms.start[n], axes, r)
    for k in range(6):
        r[k] -= shared[ANCHOR + k] + terms.wanted[n, k]
    DW = np.empty((6, 6))  # D' W
    for k in range(6):
        for j in range(3):
            DW[j, k] = axes[j, 0] * W[0, k] + axes[j, 1] * W[1, k] + axes[j, 2] * W[2, k]
            DW[3 + j, k] = W[3 + j, k]
    value = 0.0
    for k in range(6):
        pull = 0.0
        for m in range(6):
            pull += W[k, m] * r[m]
            gradient[row + k] += DW[k, m] * r[m]
        value += 0.5 * r[k] * pull
        gradient[first + ANCHOR + k] -= pull
    if is_wanted(A):
        for k in range(6):
            for m in range(k, 6):
                total = DW[k, m]
                if m < 3:
                    total = DW[k, 0] * axes[m, 0] + DW[k, 1] * axes[m, 1] + DW[k, 2] * axes[m, 2]
                A.links[n, k, m] += total
                A.corner[ANCHOR + k, ANCHOR + m] += W[k, m]
            for m in range(6):
                A.border[n, k, ANCHOR + m] -= DW[k, m]
    return value


@kernel
def fill_acceleration(n, poses, times, r):
    """Write the second difference of poses n, n + 1 and n + 2 over time, (6,)."""
    first = times[n + 1] - times[n]
    second = times[n + 2] - times[n + 1]
    mean = (first + second) / 2
    for k in range(6):
        forward = (poses[n + 2, k] - poses[n + 1, k]) / second
        r[k] = (forward - (poses[n + 1, k] - poses[n, k]) / first) / mean
    return 1 / first / mean, (-1 / first - 1 / second) / mean, 1 / second / mean


@kernel
def add_acceleration(n, poses, terms, r, gradient, A):
    """Add the second difference of poses n, n + 1 and n + 2 (M5)."""
    W, w = terms.W_acceleration[n], terms.W_turning[n]
    c = fill_acceleration(n, poses, terms.times, r)  # derivatives by the three poses
    value = 0.0
    for k in range(3):
        pull = W[k, 0] * r[0] + W[k, 1] * r[1] + W[k, 2] * r[2]
        turn = w[k] * r[3 + k]
        value += 0.5 * (r[k] * pull + r[3 + k] * turn)
        for i in range(3):
            gradient[6 * (n + i) + k] += c[i] * pull
            gradient[6 * (n + i) + 3 + k] += c[i] * turn
    if is_wanted(A):
        for i in range(3):
            for j in range(i, 3):
                share = c[i] * c[j]
                block = A.links[n + i, :, 6 * (j - i) : 6 * (j - i + 1)]
                for k in range(3):
                    for m in range(k if i == j else 0, 3):
                        block[k, m] += share * W[k, m]
                    block[3 + k, 3 + k] += share * w[k]
    return value


@kernel
def slip_of(n, poses, R, dt, shared, Rm, r):
    """
    Write the velocity of the pivot across the path from pose n to n + 1, (2,) [m/s].

    To the left of the path and upward. `R` (N, 3, 3) are the axes of the poses; those between the
    two poses are written to `Rm`.

    """
    pivot, sideslip = shared[PIVOT], shared[SIDESLIP]
    before, after = poses[n], poses[n + 1]
    fill_rotation(
        (before[3] + after[3]) / 2, (before[4] + after[4]) / 2, (before[5] + after[5]) / 2, Rm
    )
    r[0] = 0.0
    r[1] = 0.0
    for j in range(3):
        step = after[j] - before[j] - pivot * (R[n + 1, j, 0] - R[n, j, 0])
        r[0] += (Rm[j, 1] - sideslip * Rm[j, 0]) * step / dt
        r[1] += Rm[j, 2] * step / dt


@kernel
def add_slip(n, poses, shared, terms, scratch, gradient, A):
    """Add the velocity of the pivot across the path and upward from pose n to n + 1 (M7)."""
    pivot = shared[PIVOT]
    R0, dR0, R1, dR1 = scratch.R[n], scratch.dR[n], scratch.R[n + 1], scratch.dR[n + 1]
    Rm, dRm, J = scratch.mean_R, scratch.mean_dR, scratch.J
    before, after = poses[n], poses[n + 1]
    fill_rotation_derivatives(
        (before[3] + after[3]) / 2, (before[4] + after[4]) / 2, (before[5] + after[5]) / 2, Rm, dRm
    )
    rate = 1 / (terms.times[n + 1] - terms.times[n])
    row = 6 * n
    first = len(gradient) - SHARED
    value = 0.0
    for side in range(2):
        axis = 1 + side
        sideslip = shared[SIDESLIP] if side == 0 else 0.0
        w = terms.W_slip[n, side]
        r = 0.0
        by_pivot = 0.0
        by_sideslip = 0.0
        for j in range(3):
            across = (Rm[j, axis] - sideslip * Rm[j, 0]) * rate
            turned = R1[j, 0] - R0[j, 0]
            step = after[j] - before[j] - pivot * turned
            r += across * step
            by_pivot -= across * turned
            if side == 0:
                by_sideslip -= Rm[j, 0] * rate * step
            J[j] = -across
            J[6 + j] = across
        for k in range(3):
            tilt = 0.0
            swing0 = 0.0
            swing1 = 0.0
            for j in range(3):
                step = after[j] - before[j] - pivot * (R1[j, 0] - R0[j, 0])
                tilt += step * (dRm[k, j, axis] - sideslip * dRm[k, j, 0]) * rate / 2
                swing0 += J[6 + j] * dR0[k, j, 0]
                swing1 += J[6 + j] * dR1[k, j, 0]
            J[3 + k] = tilt + pivot * swing0
            J[9 + k] = tilt - pivot * swing1
        value += 0.5 * w * r**2
        for k in range(12):
            gradient[row + k] += J[k] * w * r
        gradient[first + PIVOT] += by_pivot * w * r
        gradient[first + SIDESLIP] += by_sideslip * w * r
        if is_wanted(A):
            for k in range(12):
                links, border = A.links[n + k // 6, k % 6], A.border[n + k // 6, k % 6]
                for m in range(k, 12):
                    links[m - 6 * (k // 6)] += w * J[k] * J[m]
                border[PIVOT] += w * J[k] * by_pivot
                border[SIDESLIP] += w * J[k] * by_sideslip
            A.corner[PIVOT, PIVOT] += w * by_pivot**2
            A.corner[PIVOT, SIDESLIP] += w * by_pivot * by_sideslip
            A.corner[SIDESLIP, SIDESLIP] += w * by_sideslip**2
    return value


@kernel
def add_zero_motion(n, poses, terms, gradient, A):
    """Add the step from pose n to n + 1 (M6)."""
    w = terms.W_zero_motion[n]
    value = 0.0
    row = 6 * n
    for k in range(6):
        step = poses[n + 1, k] - poses[n, k]
        value += 0.5 * w[k] * step**2
        gradient[row + k] -= w[k] * step
        gradient[row + 6 + k] += w[k] * step
        if is_wanted(A):
            A.links[n, k, k] += w[k]
            A.links[n + 1, k, k] += w[k]
            A.links[n, k, 6 + k] -= w[k]
    return value


@kernel
def add_shared_prior(shared, terms, gradient, A):
    """Add the deviation of the shared variables from those expected (M8)."""
    first = len(gradient) - SHARED
    value = 0.0
    for s in range(SHARED):
        off = shared[s] - terms.expected[s]
        value += 0.5 * terms.W_shared[s] * off**2
        gradient[first + s] += terms.W_shared[s] * off
        if is_wanted(A):
            A.corner[s, s] += terms.W_shared[s]
    return value


@kernel
def add_marginal_prior(poses, shared, terms, gradient, A):
    """Add the quadratic form in the two oldest poses and the shared variables (M9)."""
    W = terms.W_prior
    first = len(gradient) - SHARED
    size = 12 + SHARED
    r = np.empty(size)
    for k in range(12):
        r[k] = poses[k // 6, k % 6] - terms.prior_mean[k]
    for s in range(SHARED):
        r[12 + s] = shared[s] - terms.prior_mean[12 + s]
    value = 0.0
    for k in range(size):
        pull = 0.0
        for m in range(size):
            pull += W[k, m] * r[m]
        value += 0.5 * r[k] * pull
        gradient[k if k < 12 else first + k - 12] += pull
    if is_wanted(A):
        for k in range(12):
            links, border = A.links[k // 6, k % 6], A.border[k // 6, k % 6]
            for m in range(k, 12):
                links[m - 6 * (k // 6)] += W[k, m]
            for s in range(SHARED):
                border[s] += W[k, 12 + s]
        for s in range(SHARED):
            for t in range(s, SHARED):
                A.corner[s, t] += W[12 + s, 12 + t]
    return value


class Scratch(NamedTuple):
    """
    Arrays that the residuals of one window work in.

    Attributes
    ----------
    R, dR : array, shapes (N, 3, 3) and (N, 3, 3, 3)
        Axes of the poses and their derivatives.
    plane, pull, by_angles, weighted : array, shapes (4,), (4,), (4, 3) and (4, 3)
        Of `add_faces`.
    mean_R, mean_dR, J : array, shapes (3, 3), (3, 3, 3) and (12,)
        Of `add_slip`.
    r : array, shape (6,)
        A residual.

    """

    R: Any
    dR: Any
    plane: Any
    pull: Any
    by_angles: Any
    weighted: Any
    mean_R: Any
    mean_dR: Any
    J: Any
    r: Any


@kernel
def empty_scratch(N):
    """Return the arrays for a window of N observations."""
    return Scratch(
        np.empty((N, 3, 3)), np.empty((N, 3, 3, 3)), np.empty(4), np.empty(4), np.empty((4, 3)),
        np.empty((4, 3)), np.empty((3, 3)), np.empty((3, 3, 3)), np.empty(12), np.empty(6),
    )  # fmt: skip


@kernel
def accumulate(x, last, terms, scratch, gradient, A):
    """
    Return the sum of the residuals of one window (M1); write its gradient and matrix.

    Parameters
    ----------
    x : array, shape (6 N + 23,)
        Poses and shared variables.
    last : int
        Only residuals that begin at the first `last` observations; less than N leaves out the
        prior on the shared variables too, which belongs to no observation.
    terms : TermArrays
        Data and weights.
    scratch : Scratch
        Arrays to work in.
    gradient : array, shape (6 N + 23,)
        Written.
    A : ArrowheadArrays
        Gauss-Newton matrix, written; of `no_matrix` where it is not wanted.

    """
    N = (len(x) - SHARED) // 6
    poses = x[: 6 * N].reshape(N, 6)
    shared = x[6 * N :]
    gradient[:] = 0.0
    clear(A)
    value = 0.0
    for n in range(min(last + 1, N)):
        fill_rotation_derivatives(
            poses[n, 3], poses[n, 4], poses[n, 5], scratch.R[n], scratch.dR[n]
        )
    for n in range(min(last, N)):
        value += add_faces(n, poses[n], shared, terms, scratch, gradient, A)
        if terms.W_input[n, 0] != 0.0:
            value += add_input(n, poses[n], shared, terms, scratch.r, gradient, A)
        if n < len(terms.W_shape):
            value += add_rigid_shape(n, poses[n], shared, terms, scratch.r, gradient, A)
        if terms.W_acceleration[n, 0, 0] != 0.0:
            value += add_acceleration(n, poses, terms, scratch.r, gradient, A)
        if terms.W_slip[n, 0] != 0.0:
            value += add_slip(n, poses, shared, terms, scratch, gradient, A)
        if terms.W_zero_motion[n, 0] != 0.0:
            value += add_zero_motion(n, poses, terms, gradient, A)
    if terms.W_prior[0, 0] != 0.0:
        value += add_marginal_prior(poses, shared, terms, gradient, A)
    if last >= N:
        value += add_shared_prior(shared, terms, gradient, A)
    return value


@kernel
def fill_dense(A, dense):
    """Write a matrix with a chain of two poses as a dense one, (35, 35)."""
    for pose in range(2):
        for a in range(POSE):
            i = POSE * pose + a
            for c in range(a, NEXT - POSE * pose):
                dense[i, POSE * pose + c] = A.links[pose, a, c]
            for s in range(BORDER):
                dense[i, NEXT + s] = A.border[pose, a, s]
    for s in range(BORDER):
        for t in range(s, BORDER):
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
    is_definite = eliminate_pose(A, 0)
    A.corner[:] -= np.dot(A.border[0].T, A.border[0])
    rest = ArrowheadArrays(A.links[1:5], A.border[1:5], A.corner)
    fill_dense(rest, information)
    # The ridge is for directions that nothing is known about.
    for pose in range(2):
        for a in range(POSE):
            rest.links[pose, a, a] += UNKNOWN_RIDGE
    for s in range(SHARED):
        rest.corner[s, s] += UNKNOWN_RIDGE
    if not (is_definite and factorise(rest)):
        step[:] = np.nan
        information[:] = np.nan
        return
    substitute_forward(A, gradient, POSE)
    step[:NEXT] = -gradient[POSE : POSE + NEXT]
    step[NEXT:] = -gradient[n:]
    solve(rest, step)
