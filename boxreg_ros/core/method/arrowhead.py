"""
Factorisation of one arrowhead matrix: a chain of poses with a border.

A pose is coupled to the two poses after it, its `links`, and to the shared variables, the
`border`; see `Arrowhead`. Poses are eliminated one by another, each as a block: its inverse and
its regression on the variables after it are the `Factor`. Large products are those of BLAS, since
numba unrolls short loops into scalars.

"""

from math import sqrt

from boxreg_ros.core.method.arrays import copy, PIVOT, POSE, SPAN
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
    for n in range(len(A.poses)):
        A.poses[n].links[:] = 0.0
        A.poses[n].border[:] = 0.0
    A.corner[:] = 0.0


@loop
def fix_variables(A, free):
    """Make rows and columns of variables that are not `free` (6 N + S,) those of the identity."""
    S = len(A.corner)
    n = len(free) - S
    for i in range(n):
        pose, a = i // POSE, i % POSE
        if free[i] == 0.0:
            for before in range(max(pose - 2, 0), pose + 1):
                for b in range(POSE):
                    A.poses[before].links[b, POSE * (pose - before) + a] = 0.0
            A.poses[pose].links[a] = 0.0
            A.poses[pose].border[a] = 0.0
        A.poses[pose].links[a, a] += 1.0 - free[i] + RIDGE
    for s in range(S):
        if free[n + s] == 0.0:
            for pose in range(len(A.poses)):
                A.poses[pose].border[:, s] = 0.0
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
def invert(rows):
    """
    Replace the matrix at the left of rows (m, m + k) by its inverse, by Gauss and Jordan in place.

    What stands beside it is replaced by the inverse times that: a product with the inverse would
    have an error larger by the condition number of the matrix. Returns False if it is not
    positive definite.

    """
    size, width = rows.shape
    for k in range(size):
        if not rows[k, k] > 0.0:
            return False
        scale = 1.0 / rows[k, k]
        rows[k, k] = 1.0
        for j in range(width):
            rows[k, j] *= scale
        for i in range(size):
            if i != k:
                factor = rows[i, k]
                rows[i, k] = 0.0
                for j in range(width):
                    rows[i, j] -= factor * rows[k, j]
    return True


@loop
def fill_rows(block, S, rows):
    """Write the block of a pose, and less what it is coupled to, (6, S + 18)."""
    links, border = block.links, block.border
    for a in range(POSE):
        for c in range(POSE):
            rows[a, c] = links[min(a, c), max(a, c)]
        for s in range(S):
            rows[a, POSE + s] = -border[a, s]
        for c in range(NEXT):
            rows[a, POSE + S + c] = -links[a, POSE + c]


@loop
def keep(rows, block, own, coupling, after, border):
    """Write the factor of a pose from its `rows`, and what it is coupled to, from its block."""
    rest = coupling.shape[1]
    for a in range(POSE):
        for c in range(POSE):
            own[a, c] = rows[a, c]
        for r in range(rest):
            coupling[a, r] = rows[a, POSE + r]
        for c in range(NEXT):
            after[a, c] = block.links[a, POSE + c]
        for s in range(rest - NEXT):
            border[a, s] = block.border[a, s]


@loop
def subtract(change, S, first, second):
    """Add the `change` (12, S + 12) of the two poses after one."""
    for a in range(POSE):
        for c in range(NEXT):
            first.links[a, c] += change[a, S + c]
        for c in range(POSE):
            second.links[a, c] += change[POSE + a, S + POSE + c]
        for s in range(S):
            first.border[a, s] += change[a, s]
            second.border[a, s] += change[POSE + a, s]


@kernel
def eliminate_poses(A, factor):
    """
    Write the factor of each pose, and subtract its products from the variables after it.

    Returns False if a pose is not positive definite.

    """
    N, S = len(factor.own), len(A.corner)
    rows, after = np.empty((POSE, SPAN + S)), np.empty((POSE, NEXT))
    change, border = np.empty((NEXT, S + NEXT)), np.empty((N, POSE, S))
    for pose in range(N):
        block, own, coupling = A.poses[pose], factor.own[pose], factor.coupling[pose]
        fill_rows(block, S, rows)
        if not invert(rows):
            return False
        keep(rows, block, own, coupling, after, border[pose])
        np.dot(after.T, coupling, change)
        subtract(change, S, A.poses[pose + 1], A.poses[pose + 2])
    columns = factor.coupling.reshape(POSE * N, S + NEXT)
    change = np.empty((S, S + NEXT))
    np.dot(border.reshape(POSE * N, S).T, columns, change)
    for s in range(S):
        for t in range(s, S):
            A.corner[s, t] += change[s, t]
    return True


@kernel
def factorise(A, factor):
    """Write the factor of a matrix, which is changed; return False if it is not definite."""
    if not eliminate_poses(A, factor):
        return False
    S = len(A.corner)
    for s in range(S):
        for t in range(s, S):
            factor.corner[s, t] = factor.corner[t, s] = A.corner[s, t]
    return invert(factor.corner)


@loop
def substitute_forward(factor, x, rest):
    """
    Eliminate the poses of a factor from a right side (6 N + S,).

    The last poses are coupled to one pose after them or none. `rest` (S + 12,) is to work in: what
    a pose is coupled to.

    """
    S = len(factor.corner)
    end = len(x) - S
    for s in range(S):
        rest[s] = x[end + s]
    for pose in range(len(factor.own)):
        coupling, own, after = factor.coupling[pose], x[POSE * pose :], POSE * (pose + 1)
        for c in range(NEXT):
            rest[S + c] = x[after + c] if after + c < end else 0.0
        for r in range(len(rest)):  # loops of unknown length are not unrolled into scalars
            total = 0.0
            for a in range(POSE):
                total += coupling[a, r] * own[a]
            rest[r] += total
        for c in range(min(NEXT, end - after)):
            x[after + c] = rest[S + c]
    for s in range(S):
        x[end + s] = rest[s]


@loop
def substitute_backward(factor, x, rest, found):
    """Replace what `substitute_forward` leaves by the solution; `found` (6,) is to work in."""
    S = len(factor.corner)
    end = len(x) - S
    for s in range(S):
        rest[s] = x[end + s]
    for c in range(NEXT):
        rest[S + c] = 0.0
    for pose in range(len(factor.own) - 1, -1, -1):
        own, coupling, right = factor.own[pose], factor.coupling[pose], x[POSE * pose :]
        for a in range(POSE):
            total = 0.0
            for b in range(POSE):
                total += own[a, b] * right[b]
            for r in range(len(rest)):
                total += coupling[a, r] * rest[r]
            found[a] = total
        for a in range(POSE):
            rest[S + POSE + a] = rest[S + a]
            rest[S + a] = right[a] = found[a]


@kernel
def solve(factor, x):
    """Replace a right side `x` (6 N + S,) by the solution of A x = b."""
    rest, found = np.empty(factor.coupling.shape[2]), np.empty(POSE)
    first = POSE * len(factor.own)
    substitute_forward(factor, x, rest)
    shared = rest[: len(factor.corner)]
    np.dot(factor.corner, x[first:], shared)
    copy(shared, x[first:])
    substitute_backward(factor, x, rest, found)


@loop
def shift_known(known, own, beside):
    """
    Move the known part of the inverse (S + 12, S + 12) to the pose before.

    Its own block is (6, 6), that with the variables after it (6, S + 12).

    """
    S = len(known) - NEXT
    second = S + POSE
    for a in range(POSE):
        for c in range(POSE):
            known[second + a, second + c] = known[S + a, S + c]
            known[S + a, S + c] = own[a, c]
            known[S + a, second + c] = beside[a, S + c]
            known[second + c, S + a] = beside[a, S + c]
        for s in range(S):
            known[second + a, s] = known[S + a, s]
            known[s, second + a] = known[S + a, s]
            known[S + a, s] = beside[a, s]
            known[s, S + a] = beside[a, s]


@kernel
def invert_poses(factor, blocks, beside):
    """
    Write the blocks of the poses in the inverse.

    Their own, (N, 6, 6), and those with the shared variables and the two poses after,
    (N, 6, S + 12).

    The blocks of the inverse Z within the pattern of A follow from the last pose backward
    (Takahashi), beginning with that of the shared variables. With r those and the two poses after
    p, and the coupling W: Z_pr = W Z_rr, and Z_pp is the inverse of its own block + Z_pr W'.

    """
    S = len(factor.corner)
    known = np.zeros((S + NEXT, S + NEXT))  # Z_rr
    for s in range(S):
        for t in range(S):
            known[s, t] = factor.corner[s, t]
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
