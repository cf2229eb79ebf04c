"""
Value, gradient and Gauss-Newton matrix of the objective of one window, in plain loops.

Every term adds r' W r / 2 to the value, J' W r to the gradient and J' W J to the matrix, which
has the layout of `arrowhead`. The torch twins of these functions are those of `terms`.

"""

from math import sqrt

from boxreg_ros.core.kernels.arrowhead import BAND, factorise, fix_variables, RIDGE
from boxreg_ros.core.kernels.compile import kernel
from boxreg_ros.core.kernels.rotation import fill_rotation, fill_rotation_derivatives
import numpy as np

EXTENT, BIAS, GAP, PIVOT, ANCHOR, SHARED = 0, 3, 9, 15, 16, 22
"""First of the shared variables of each kind, and their number."""
UNKNOWN_RIDGE = 1e-6
"""Information that is assumed in directions which no residual constrains."""


@kernel
def add_block(band, row, column, i, j, value):
    """Add to A[row + i, column + j] if that is in the upper triangle."""
    if column + j >= row + i:
        band[row + i, column + j - row - i] += value


@kernel
def add_faces(n, pose, shared, given, inset, W, scratch, gradient, band, border, corner, curved):
    """Add the six face residuals of one observation; W (6, 4, 4) are weighted point moments."""
    R, dR, J, WJ = scratch
    fill_rotation_derivatives(pose[3], pose[4], pose[5], R, dR)
    row = 6 * n
    first = len(border)
    value = 0.0
    v = np.empty(4)
    pull = np.empty(4)
    for face in range(6):
        w = W[face]
        if w[3, 3] == 0.0:
            continue
        axis = face // 2
        sign = 1.0 - 2.0 * (face % 2)
        level = 0.0
        for j in range(3):
            v[j] = sign * R[j, axis]
            level -= v[j] * (pose[j] - given[j])
            J[3, j] = -v[j]
        v[3] = level + inset[face] + shared[GAP + face] - shared[EXTENT + axis] / 2
        for k in range(3):
            tilt = 0.0
            for j in range(3):
                J[j, k] = 0.0
                J[j, 3 + k] = sign * dR[k, j, axis]
                tilt -= (pose[j] - given[j]) * J[j, 3 + k]
            J[3, 3 + k] = tilt
        for a in range(4):
            total = 0.0
            for b in range(4):
                total += w[a, b] * v[b]
            pull[a] = total
            value += 0.5 * v[a] * total
        for k in range(6):
            total = 0.0
            for a in range(4):
                total += J[a, k] * pull[a]
            gradient[row + k] += total
        gradient[first + GAP + face] += pull[3]
        gradient[first + EXTENT + axis] -= 0.5 * pull[3]
        if not curved:
            continue
        for a in range(4):
            for k in range(6):
                total = 0.0
                for b in range(4):
                    total += w[a, b] * J[b, k]
                WJ[a, k] = total
        for k in range(6):
            for m in range(k, 6):
                total = 0.0
                for a in range(4):
                    total += J[a, k] * WJ[a, m]
                band[row + k, m - k] += total
            border[row + k, GAP + face] += WJ[3, k]
            border[row + k, EXTENT + axis] -= 0.5 * WJ[3, k]
        corner[GAP + face, GAP + face] += w[3, 3]
        corner[EXTENT + axis, GAP + face] -= 0.5 * w[3, 3]
        corner[EXTENT + axis, EXTENT + axis] += 0.25 * w[3, 3]
    return value


@kernel
def add_step(
    n, pose, shared, start, axes, wanted, W, part, gradient, band, border, corner, curved
):
    """
    Add the step of one pose from `start` along `axes` less six shared variables from `part` on.

    W (6, 6) is its weight. The Jacobian by the pose is A = diag(axes', I), that by the shared
    variables -I.

    """
    row = 6 * n
    first = len(border)
    r = np.empty(6)
    AW = np.empty((6, 6))
    for k in range(3):
        total = 0.0
        for j in range(3):
            total += axes[j, k] * (pose[j] - start[j])
        r[k] = total - shared[part + k] - wanted[k]
        r[3 + k] = pose[3 + k] - start[3 + k] - shared[part + 3 + k] - wanted[3 + k]
    value = 0.0
    for k in range(6):
        for j in range(3):
            total = 0.0
            for m in range(3):
                total += axes[j, m] * W[m, k]
            AW[j, k] = total
            AW[3 + j, k] = W[3 + j, k]
    for k in range(6):
        pull = 0.0
        for m in range(6):
            pull += W[k, m] * r[m]
        value += 0.5 * r[k] * pull
        gradient[first + part + k] -= pull
        total = 0.0
        for m in range(6):
            total += AW[k, m] * r[m]
        gradient[row + k] += total
    if not curved:
        return value
    for k in range(6):
        for m in range(k, 6):
            if m < 3:
                total = 0.0
                for j in range(3):
                    total += AW[k, j] * axes[m, j]
            else:
                total = AW[k, m]
            band[row + k, m - k] += total
        for m in range(6):
            border[row + k, part + m] -= AW[k, m]
        for m in range(k, 6):
            corner[part + k, part + m] += W[k, m]
    return value


@kernel
def add_acceleration(n, poses, times, W, gradient, band, curved):
    """Add the second difference of poses n, n + 1 and n + 2; W (6, 6) is its weight."""
    first = times[n + 1] - times[n]
    second = times[n + 2] - times[n + 1]
    mean = (first + second) / 2
    c = (1 / first / mean, (-1 / first - 1 / second) / mean, 1 / second / mean)
    value = 0.0
    r = np.empty(6)
    for k in range(6):
        forward = (poses[n + 2, k] - poses[n + 1, k]) / second
        r[k] = (forward - (poses[n + 1, k] - poses[n, k]) / first) / mean
    for k in range(6):
        pull = 0.0
        for m in range(6):
            pull += W[k, m] * r[m]
        value += 0.5 * r[k] * pull
        for i in range(3):
            gradient[6 * (n + i) + k] += c[i] * pull
    if curved:
        for i in range(3):
            for j in range(i, 3):
                for k in range(6):
                    for m in range(6):
                        add_block(band, 6 * (n + i), 6 * (n + j), k, m, c[i] * c[j] * W[k, m])
    return value


@kernel
def slip_of(before, after, dt, pivot, r):
    """Write the velocity of the pivot to the left and upward between two poses, (2,) [m/s]."""
    R0, R1, Rm = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    fill_rotation(before[3], before[4], before[5], R0)
    fill_rotation(after[3], after[4], after[5], R1)
    fill_rotation(
        (before[3] + after[3]) / 2, (before[4] + after[4]) / 2, (before[5] + after[5]) / 2, Rm
    )
    for side in range(2):
        r[side] = 0.0
        for j in range(3):
            step = after[j] - before[j] - pivot * (R1[j, 0] - R0[j, 0])
            r[side] += Rm[j, 1 + side] / dt * step


@kernel
def add_slip(n, poses, times, pivot, W, scratch, gradient, band, border, corner, curved):
    """Add the velocity of the pivot to the left and upward from pose n to n + 1; W (2, 2)."""
    R0, dR0, R1, dR1, Rm, dRm, J = scratch
    before = poses[n]
    after = poses[n + 1]
    fill_rotation_derivatives(before[3], before[4], before[5], R0, dR0)
    fill_rotation_derivatives(after[3], after[4], after[5], R1, dR1)
    fill_rotation_derivatives(
        (before[3] + after[3]) / 2, (before[4] + after[4]) / 2, (before[5] + after[5]) / 2, Rm, dRm
    )
    dt = times[n + 1] - times[n]
    row = 6 * n
    first = len(border)
    r = np.zeros(2)
    by_pivot = np.zeros(2)
    for side in range(2):
        axis = 1 + side
        for j in range(3):
            across = Rm[j, axis] / dt
            turned = R1[j, 0] - R0[j, 0]
            step = after[j] - before[j] - pivot * turned
            r[side] += across * step
            by_pivot[side] -= across * turned
            J[side, j] = -across
            J[side, 6 + j] = across
        for k in range(3):
            tilt = 0.0
            swing0 = 0.0
            swing1 = 0.0
            for j in range(3):
                turned = R1[j, 0] - R0[j, 0]
                step = after[j] - before[j] - pivot * turned
                tilt += step * dRm[k, j, axis] / dt / 2
                swing0 += Rm[j, axis] / dt * dR0[k, j, 0]
                swing1 += Rm[j, axis] / dt * dR1[k, j, 0]
            J[side, 3 + k] = tilt + pivot * swing0
            J[side, 9 + k] = tilt - pivot * swing1
    value = 0.0
    for side in range(2):
        pull = W[side, 0] * r[0] + W[side, 1] * r[1]
        value += 0.5 * r[side] * pull
        for k in range(12):
            gradient[row + k] += J[side, k] * pull
        gradient[first + PIVOT] += by_pivot[side] * pull
    if not curved:
        return value
    for side in range(2):
        for other in range(2):
            weight = W[side, other]
            for k in range(12):
                for m in range(k, 12):
                    band[row + k, m - k] += weight * J[side, k] * J[other, m]
                border[row + k, PIVOT] += weight * J[side, k] * by_pivot[other]
            corner[PIVOT, PIVOT] += weight * by_pivot[side] * by_pivot[other]
    return value


@kernel
def add_zero_motion(n, poses, W, gradient, band, curved):
    """Add the step from pose n to n + 1; W (6, 6) is its weight."""
    value = 0.0
    row = 6 * n
    for k in range(6):
        pull = 0.0
        for m in range(6):
            pull += W[k, m] * (poses[n + 1, m] - poses[n, m])
        value += 0.5 * (poses[n + 1, k] - poses[n, k]) * pull
        gradient[row + k] -= pull
        gradient[row + 6 + k] += pull
    if curved:
        for k in range(6):
            for m in range(6):
                add_block(band, row, row, k, m, W[k, m])
                add_block(band, row + 6, row + 6, k, m, W[k, m])
                add_block(band, row, row + 6, k, m, -W[k, m])
    return value


@kernel
def add_shared_prior(shared, expected, W, gradient, first, corner, curved):
    """Add the deviation of the shared variables from those expected; W (22, 22)."""
    value = 0.0
    for s in range(SHARED):
        pull = 0.0
        for t in range(SHARED):
            pull += W[s, t] * (shared[t] - expected[t])
        value += 0.5 * (shared[s] - expected[s]) * pull
        gradient[first + s] += pull
        if curved:
            for t in range(s, SHARED):
                corner[s, t] += W[s, t]
    return value


@kernel
def add_marginal_prior(poses, shared, mean, information, gradient, band, border, corner, curved):
    """Add the quadratic form in the two oldest poses and the shared variables, (34,)."""
    first = len(border)
    size = 12 + SHARED
    r = np.empty(size)
    for k in range(12):
        r[k] = poses[k // 6, k % 6] - mean[k]
    for s in range(SHARED):
        r[12 + s] = shared[s] - mean[12 + s]
    value = 0.0
    for k in range(size):
        pull = 0.0
        for m in range(size):
            pull += information[k, m] * r[m]
        value += 0.5 * r[k] * pull
        gradient[k if k < 12 else first + k - 12] += pull
    if curved:
        for k in range(12):
            for m in range(k, 12):
                band[k, m - k] += information[k, m]
            for s in range(SHARED):
                border[k, s] += information[k, 12 + s]
        for s in range(SHARED):
            for t in range(s, SHARED):
                corner[s, t] += information[12 + s, 12 + t]
    return value


@kernel
def rotation_scratch():
    """Return arrays that the residuals of one window work in."""
    faces = np.empty((3, 3)), np.empty((3, 3, 3)), np.empty((4, 6)), np.empty((4, 6))
    slip = (
        np.empty((3, 3)), np.empty((3, 3, 3)), np.empty((3, 3)), np.empty((3, 3, 3)),
        np.empty((3, 3)), np.empty((3, 3, 3)), np.empty((2, 12)),
    )  # fmt: skip
    return faces, slip


@kernel
def add_window(b, poses, shared, last, terms, gradient, band, border, corner, curved):
    """
    Add all residuals of window `b` that begin at its first `last` observations.

    `terms` are the `TermArrays` of the batch. The prior on the shared variables is not among
    them: it belongs to no observation.

    """
    times, given, inset = terms.times[b], terms.given[b], terms.inset[b]
    W_faces, W_input, W_shape = terms.W_faces[b], terms.W_input[b], terms.W_shape[b]
    W_acceleration, W_slip, W_still = (
        terms.W_acceleration[b], terms.W_slip[b], terms.W_zero_motion[b]
    )  # fmt: skip
    faces_scratch, slip_scratch = rotation_scratch()
    nothing = np.zeros(6)
    value = 0.0
    for n in range(min(last, len(W_faces))):
        value += add_faces(
            n, poses[n], shared, given[n], inset[n], W_faces[n], faces_scratch, gradient, band,
            border, corner, curved,
        )  # fmt: skip
    for n in range(min(last, len(W_input))):
        if W_input[n, 0, 0] != 0.0:
            value += add_step(
                n, poses[n], shared, terms.input_pose[b, n], terms.axes[b, n], nothing,
                W_input[n], BIAS, gradient, band, border, corner, curved,
            )  # fmt: skip
    for n in range(min(last, len(W_shape))):
        value += add_step(
            n, poses[n], shared, terms.shape_start[b, n], terms.shape_axes[b, n],
            terms.wanted[b, n], W_shape[n], ANCHOR, gradient, band, border, corner, curved,
        )  # fmt: skip
    for n in range(min(last, len(W_acceleration))):
        if W_acceleration[n, 0, 0] != 0.0:
            value += add_acceleration(n, poses, times, W_acceleration[n], gradient, band, curved)
    for n in range(min(last, len(W_slip))):
        if W_slip[n, 0, 0] != 0.0:
            value += add_slip(
                n, poses, times, shared[PIVOT], W_slip[n], slip_scratch, gradient, band, border,
                corner, curved,
            )  # fmt: skip
    for n in range(min(last, len(W_still))):
        if W_still[n, 0, 0] != 0.0:
            value += add_zero_motion(n, poses, W_still[n], gradient, band, curved)
    W_prior = terms.W_prior[b]
    if W_prior[0, 0] != 0.0:
        value += add_marginal_prior(
            poses, shared, terms.prior_mean[b], W_prior, gradient, band, border, corner, curved
        )
    return value


@kernel
def accumulate(begin, end, x, rows, last, terms, value, gradient, band, border, corner):
    """
    Write the sums of the residuals of the windows `rows[begin:end]`.

    Parameters
    ----------
    begin, end : int
        First window, and the one after the last.
    x, rows : array, shapes (b, D) and (b,)
        Variables, and which windows of `terms` they are of.
    last : int
        Only residuals that begin at the first `last` observations; less than N leaves out the
        prior on the shared variables too, which belongs to no observation.
    terms : TermArrays
        Data and weights.
    value, gradient : array, shapes (b,) and (b, D)
        Written.
    band, border, corner : array, shapes (b, 6 N, 18), (b, 6 N, S) and (b, S, S)
        Gauss-Newton matrices, written; of length b = 0 where they are not wanted.

    """
    curved = len(band) > 0
    N = (x.shape[1] - SHARED) // 6
    no_band = np.empty((0, BAND))
    no_border = np.empty((6 * N, 0))
    no_corner = np.empty((0, 0))
    for i in range(begin, end):
        b = rows[i]
        poses = x[i, : 6 * N].reshape(N, 6)
        shared = x[i, 6 * N :]
        gradient[i] = 0.0
        own_band, own_border, own_corner = no_band, no_border, no_corner
        if curved:
            band[i] = 0.0
            border[i] = 0.0
            corner[i] = 0.0
            own_band, own_border, own_corner = band[i], border[i], corner[i]
        value[i] = add_window(
            b, poses, shared, last, terms, gradient[i], own_band, own_border, own_corner, curved
        )
        if last >= N:
            value[i] += add_shared_prior(
                shared, terms.expected[b], terms.W_shared[b], gradient[i], 6 * N, own_corner,
                curved,
            )  # fmt: skip


@kernel
def factorise_windows(begin, end, free, band, border, corner):
    """
    Replace Gauss-Newton matrices by their Cholesky factors in the `free` variables (B, D).

    Those of the windows `begin` to `end`.
    Factors of a matrix that is not positive definite are NaN.

    """
    for b in range(begin, end):
        fix_variables(band[b], border[b], corner[b], free[b])
        if not factorise(band[b], border[b], corner[b]):
            band[b] = np.nan
            border[b] = np.nan
            corner[b] = np.nan


@kernel
def marginalise(begin, end, x, gradient, band, border, corner, mean, step, information):
    """
    Write the quadratic form that stands for the oldest observation of the windows.

    In the next two poses and the shared variables: where they are (B, 34), the step from there to
    the minimum (B, 34), and the curvature (B, 34, 34). The sums of the residuals of the oldest
    observation, from `accumulate`, are the input.

    """
    N = (x.shape[1] - SHARED) // 6
    head = min(3, N)
    size = 12 + SHARED
    for b in range(begin, end):
        poses = x[b, : 6 * N].reshape(N, 6)
        shared = x[b, 6 * N :]
        # Dense, in the order: oldest pose, two next poses, shared variables.
        form = np.zeros((18 + SHARED, 18 + SHARED))
        pull = np.zeros(18 + SHARED)
        for i in range(6 * head):
            pull[i] = gradient[b, i]
            for k in range(min(BAND, 6 * head - i)):
                form[i, i + k] = band[b, i, k]
            for s in range(SHARED):
                form[i, 18 + s] = border[b, i, s]
        for s in range(SHARED):
            pull[18 + s] = gradient[b, 6 * N + s]
            for t in range(s, SHARED):
                form[18 + s, 18 + t] = corner[b, s, t]
        for i in range(6):
            form[i, i] += RIDGE
        is_definite = eliminate(form, pull, 6)
        for i in range(size):
            mean[b, i] = poses[1 + i // 6, i % 6] if i < 12 else shared[i - 12]
            for j in range(size):
                low, high = min(i, j), max(i, j)
                information[b, i, j] = form[6 + low, 6 + high] if is_definite else np.nan
        # The ridge is for directions that nothing is known about.
        for i in range(6, 18 + SHARED):
            form[i, i] += UNKNOWN_RIDGE
        rest = form[6:, 6:].copy()
        x_rest = -pull[6:]
        is_definite = is_definite and eliminate(rest, x_rest, size)
        back_substitute(rest, x_rest)
        for i in range(size):
            step[b, i] = x_rest[i] if is_definite else np.nan


@kernel
def eliminate(form, pull, count):
    """Eliminate the first `count` variables of an upper triangle and its right side (in place)."""
    size = len(form)
    for i in range(count):
        if not form[i, i] > 0.0:
            return False
        root = sqrt(form[i, i])
        for j in range(i, size):
            form[i, j] /= root
        pull[i] /= root
        for j in range(i + 1, size):
            factor = form[i, j]
            if factor != 0.0:
                for k in range(j, size):
                    form[j, k] -= factor * form[i, k]
                pull[j] -= factor * pull[i]
    return True


@kernel
def back_substitute(upper, x):
    """Replace x by the solution of U x = x for an upper triangle U."""
    for i in range(len(x) - 1, -1, -1):
        for j in range(i + 1, len(x)):
            x[i] -= upper[i, j] * x[j]
        x[i] /= upper[i, i]
