"""
Factorisation of one arrowhead matrix: a chain of poses with a border.

A pose is coupled to the two poses after it, its `links`, and to the shared variables, the
`border`; see `Arrowhead`. Poses are eliminated one by another, each as a block: its inverse and
its regression on the variables after it are the `Factor`. Large products are those of BLAS, since
numba unrolls short loops into scalars.

"""

from math import sqrt

from boxreg_ros.core.method.arrays import PIVOT, POSE, REST, SHARED
from boxreg_ros.core.method.compile import kernel, loop
import numpy as np

NEXT = 2 * POSE
"""Variables of the two poses after one."""
RIDGE = 1e-9
"""Added to the diagonal: an unobserved variable does not break the factorisation. Derived: the
information of a deviation of 30 km."""


@loop
def clear(A):
    """Set a matrix to zero."""
    A.links[:] = 0.0
    A.border[:] = 0.0
    A.corner[:] = 0.0


@loop
def fix_variables(A, free):
    """Make rows and columns of variables that are not `free` (6 N + 23,) those of the identity."""
    n = len(free) - SHARED
    for i in range(n):
        pose, a = i // POSE, i % POSE
        if free[i] == 0.0:
            for before in range(max(pose - 2, 0), pose + 1):
                for b in range(POSE):
                    A.links[before, b, POSE * (pose - before) + a] = 0.0
            A.links[pose, a] = 0.0
            A.border[pose, a] = 0.0
        A.links[pose, a, a] += 1.0 - free[i] + RIDGE
    for s in range(SHARED):
        if free[n + s] == 0.0:
            A.border[:, :, s] = 0.0
            A.corner[s] = 0.0
            A.corner[:, s] = 0.0
        A.corner[s, s] += 1.0 - free[n + s] + RIDGE


@loop
def factorise_corner(corner):
    """Replace the corner by its factor; return False where it is not positive definite."""
    size = len(corner)
    for s in range(size):
        if not corner[s, s] > 0.0:
            return False
        scale = 1.0 / sqrt(corner[s, s])
        for t in range(s, size):
            corner[s, t] *= scale
        for t in range(s + 1, size):
            factor = corner[s, t]
            for u in range(t, size):
                corner[t, u] -= factor * corner[s, u]
    return True


@loop
def solve_corner(U, x):
    """Replace a right side `x` (m,) by the solution of U' U x = b, for an upper triangle U."""
    size = len(x)
    for s in range(size):
        x[s] /= U[s, s]
        for t in range(s + 1, size):
            x[t] -= U[s, t] * x[s]
    for s in range(size - 1, -1, -1):
        for t in range(s + 1, size):
            x[s] -= U[s, t] * x[t]
        x[s] /= U[s, s]


@loop
def invert(S):
    """
    Replace a matrix (m, m) by its inverse; return False if it is not positive definite.

    Columns beside it, S (m, m + k), are replaced by the inverse times them. Their product with the
    inverse would have an error larger by the condition number of the matrix.

    """
    size, width = S.shape
    for k in range(size):  # Gauss and Jordan
        if not S[k, k] > 0.0:
            return False
        scale = 1.0 / S[k, k]
        S[k, k] = 1.0
        for j in range(width):
            S[k, j] *= scale
        for i in range(size):
            if i != k:
                factor = S[i, k]
                S[i, k] = 0.0
                for j in range(width):
                    S[i, j] -= factor * S[k, j]
    return True


@kernel
def eliminate_pose(A, pose, factor, room):
    """
    Write the factor of one pose, and subtract its products from the poses after it.

    The corner is left to the caller, and `room` is to work in. Returns False if the pose is not
    positive definite.

    """
    links, border, _ = A
    own, coupling = factor.own[pose], factor.coupling[pose]
    rows, after, change = room
    for a in range(POSE):
        for c in range(a, POSE):
            rows[a, c] = rows[c, a] = links[pose, a, c]
        for s in range(SHARED):
            rows[a, POSE + s] = -border[pose, a, s]
        for c in range(NEXT):
            after[a, c] = links[pose, a, POSE + c]
            rows[a, POSE + SHARED + c] = -after[a, c]
    if not invert(rows):
        return False
    own[:] = rows[:, :POSE]
    coupling[:] = rows[:, POSE:]
    np.dot(after.T, coupling, change)
    for a in range(POSE):
        for c in range(NEXT):
            links[pose + 1, a, c] += change[a, SHARED + c]
        for c in range(POSE):
            links[pose + 2, a, c] += change[POSE + a, SHARED + POSE + c]
        for s in range(SHARED):
            border[pose + 1, a, s] += change[a, s]
            border[pose + 2, a, s] += change[POSE + a, s]
    return True


@kernel
def eliminate_poses(A, factor):
    """Eliminate the poses of a factor one by another; return False if one is not definite."""
    N = len(factor.own)
    room = np.empty((POSE, POSE + REST)), np.empty((POSE, NEXT)), np.empty((NEXT, REST))
    for pose in range(N):
        if not eliminate_pose(A, pose, factor, room):
            return False
    border = A.border[:N].reshape(POSE * N, SHARED)
    change = np.dot(border.T, factor.coupling.reshape(POSE * N, REST))
    for s in range(SHARED):
        for t in range(s, SHARED):
            A.corner[s, t] += change[s, t]
    return True


@kernel
def factorise(A, factor):
    """Write the factor of a matrix, which is changed; return False if it is not definite."""
    if not eliminate_poses(A, factor):
        return False
    for s in range(SHARED):
        for t in range(s, SHARED):
            factor.corner[s, t] = factor.corner[t, s] = A.corner[s, t]
    return invert(factor.corner)


@loop
def substitute_forward(factor, x):
    """
    Eliminate the poses of a factor from a right side (6 N + 23,).

    The last poses are coupled to one pose after them or none. What is added beyond the chain is
    zero.

    """
    shared = x[len(x) - SHARED :]
    for pose in range(len(factor.own)):
        coupling = factor.coupling[pose]
        own, after = x[POSE * pose :], x[POSE * (pose + 1) : POSE * (pose + 3)]
        for s in range(len(shared)):  # loops of unknown length are not unrolled into scalars
            total = 0.0
            for a in range(POSE):
                total += coupling[a, s] * own[a]
            shared[s] += total
        for c in range(len(after)):
            total = 0.0
            for a in range(POSE):
                total += coupling[a, SHARED + c] * own[a]
            after[c] += total


@kernel
def solve(factor, x):
    """Replace a right side `x` (6 N + 23,) by the solution of A x = b."""
    own, coupling, corner = factor
    substitute_forward(factor, x)
    first = len(x) - SHARED
    shared = np.dot(corner, x[first:])
    x[first:] = shared
    found = np.empty(POSE)
    for pose in range(len(own) - 1, -1, -1):
        right, after = x[POSE * pose :], x[POSE * (pose + 1) : POSE * (pose + 3)]
        for a in range(POSE):
            total = 0.0
            for b in range(POSE):
                total += own[pose, a, b] * right[b]
            for s in range(len(shared)):
                total += coupling[pose, a, s] * shared[s]
            for c in range(len(after)):
                total += coupling[pose, a, SHARED + c] * after[c]
            found[a] = total
        for a in range(POSE):
            right[a] = found[a]


@loop
def shift_known(known, own, beside):
    """Move the known part of the inverse (35, 35) to the pose before, (6, 6) and (6, 35)."""
    second = SHARED + POSE
    for a in range(POSE):
        for c in range(POSE):
            known[second + a, second + c] = known[SHARED + a, SHARED + c]
            known[SHARED + a, SHARED + c] = own[a, c]
            known[SHARED + a, second + c] = beside[a, SHARED + c]
            known[second + c, SHARED + a] = beside[a, SHARED + c]
        for s in range(SHARED):
            known[second + a, s] = known[SHARED + a, s]
            known[s, second + a] = known[SHARED + a, s]
            known[SHARED + a, s] = beside[a, s]
            known[s, SHARED + a] = beside[a, s]


@kernel
def invert_poses(factor, blocks, beside):
    """
    Write the blocks of the poses in the inverse.

    Their own, (N, 6, 6), and those with the shared variables and the two poses after, (N, 6, 35).

    The blocks of the inverse Z within the pattern of A follow from the last pose backward
    (Takahashi), beginning with that of the shared variables. With r those and the two poses after
    p, and the coupling W: Z_pr = W Z_rr, and Z_pp is the inverse of its own block + Z_pr W'.

    """
    known = np.zeros((REST, REST))  # Z_rr
    known[:SHARED, :SHARED] = factor.corner
    own = np.empty((POSE, POSE))
    for pose in range(len(blocks) - 1, -1, -1):
        coupling = factor.coupling[pose]
        np.dot(coupling, known, beside[pose])
        np.dot(beside[pose], coupling.T, own)
        for a in range(POSE):
            for b in range(POSE):
                blocks[pose, a, b] = factor.own[pose, a, b] + (own[a, b] + own[b, a]) / 2
        shift_known(known, blocks[pose], beside[pose])


@loop
def add_sandwich(columns, G, through, found):
    """
    Add the variance of the gradient, seen through rows (n, 15) of the inverse curvature.

    Of `G` (15, 15), symmetric, the diagonal and the places beside it are read: the others are
    zero. `through` (15,) is to work in.

    """
    for i in range(len(columns)):
        for k in range(PIVOT):
            through[k] = columns[i, k] * G[k, k]
        for k in range(PIVOT - 1):
            through[k] += columns[i, k + 1] * G[k + 1, k]
            through[k + 1] += columns[i, k] * G[k, k + 1]
        for j in range(i, len(columns)):
            total = 0.0
            for k in range(PIVOT):
                total += through[k] * columns[j, k]
            found[i, j] += total
            if j > i:
                found[j, i] += total
