"""
Factorisation of one arrowhead matrix: a chain of poses with a border, in plain loops.

A pose is coupled to the two poses after it, its `links`, and to the shared variables, the
`border`; see `Arrowhead`. The Cholesky factor U, A = U' U, has the same shape and replaces
the matrix A. Large products are those of BLAS, since numba unrolls short loops into scalars.

"""

from math import sqrt

from boxreg_ros.core.method.arrays import PIVOT, POSE, SHARED, SPAN
from boxreg_ros.core.method.compile import kernel, loop
import numpy as np

NEXT = 2 * POSE
"""Variables of the two poses after one."""
REST = NEXT + SHARED
"""Variables that a pose is coupled to."""
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
        links, border = A.links[pose, a], A.border[pose, a]
        for c in range(min(SPAN, n - POSE * pose)):
            links[c] *= free[i] * free[POSE * pose + c]
        for s in range(SHARED):
            border[s] *= free[i] * free[n + s]
        links[a] += 1.0 - free[i] + RIDGE
    for s in range(SHARED):
        for t in range(s, SHARED):
            A.corner[s, t] *= free[n + s] * free[n + t]
        A.corner[s, s] += 1.0 - free[n + s] + RIDGE


@loop
def factorise_rows(links, border):
    """Replace the rows of one pose by those of U; return False if it is not positive definite."""
    for a in range(POSE):
        if not links[a, a] > 0.0:
            return False
        scale = 1.0 / sqrt(links[a, a])
        for c in range(a, len(links[a])):
            links[a, c] *= scale
        for s in range(len(border[a])):
            border[a, s] *= scale
        for b in range(a + 1, POSE):
            factor = links[a, b]
            for c in range(b, len(links[b])):
                links[b, c] -= factor * links[a, c]
            for s in range(len(border[b])):
                border[b, s] -= factor * border[a, s]
    return True


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


@kernel
def eliminate_pose(A, pose):
    """
    Factorise the rows of one pose and subtract their products from the poses after it.

    The corner is left to the caller. Returns False if the pose is not positive definite.

    """
    links, border, _ = A
    if not factorise_rows(links[pose], border[pose]):
        return False
    across = links[pose, :, POSE:].copy()
    by_links = np.dot(across.T, across)
    by_border = np.dot(across.T, border[pose])
    for a in range(POSE):
        for c in range(NEXT):
            links[pose + 1, a, c] -= by_links[a, c]
        for c in range(POSE):
            links[pose + 2, a, c] -= by_links[POSE + a, POSE + c]
        for s in range(SHARED):
            border[pose + 1, a, s] -= by_border[a, s]
            border[pose + 2, a, s] -= by_border[POSE + a, s]
    return True


@kernel
def factorise(A):
    """Replace a matrix by its Cholesky factor; return False where it is not positive definite."""
    N = len(A.links) - 2
    for pose in range(N):
        if not eliminate_pose(A, pose):
            return False
    border = A.border[:N].reshape(POSE * N, SHARED)
    A.corner[:] -= np.dot(border.T, border)
    return factorise_corner(A.corner)


@loop
def substitute_forward(U, x, count):
    """Eliminate the first `count` variables of the chain from a right side (6 N + 23,)."""
    n = len(x) - SHARED
    for i in range(count):
        pose, a = i // POSE, i % POSE
        first = POSE * pose
        x[i] /= U.links[pose, a, a]
        for c in range(a + 1, min(SPAN, n - first)):
            x[first + c] -= U.links[pose, a, c] * x[i]
        for s in range(SHARED):
            x[n + s] -= U.border[pose, a, s] * x[i]


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
def solve(U, x):
    """Replace a right side `x` (6 N + 23,) by the solution of U' U x = b."""
    links, border, corner = U
    n = len(x) - SHARED
    substitute_forward(U, x, n)
    solve_corner(corner, x[n:])
    for i in range(n - 1, -1, -1):
        pose, a = i // POSE, i % POSE
        first = POSE * pose
        value = x[i]
        for c in range(a + 1, min(SPAN, n - first)):
            value -= links[pose, a, c] * x[first + c]
        for s in range(SHARED):
            value -= border[pose, a, s] * x[n + s]
        x[i] = value / links[pose, a, a]


@loop
def fill_inverse_root(U, inverse):
    """Write the inverse (m, m) of an upper triangle U (m, m)."""
    size = len(inverse)
    for a in range(size - 1, -1, -1):
        for c in range(size):
            inverse[a, c] = 0.0
        inverse[a, a] = 1.0
        for b in range(a + 1, size):
            factor = U[a, b]
            for c in range(b, size):
                inverse[a, c] -= factor * inverse[b, c]
        for c in range(a, size):
            inverse[a, c] /= U[a, a]


@kernel
def invert_corner(corner, inverse):
    """Write the inverse (23, 23) of U' U of a corner's factor."""
    root = np.empty((SHARED, SHARED))
    fill_inverse_root(corner, root)
    np.dot(root, root.T, inverse)


@loop
def shift_known(known, own, across):
    """
    Move the known part of the inverse (35, 35) to the pose before.

    `own` (6, 6) is the block of this pose, `across` (6, 35) the negative of those beside it.

    """
    for a in range(POSE):
        for c in range(POSE):
            known[POSE + a, POSE + c] = known[a, c]
        for c in range(NEXT, REST):
            known[POSE + a, c] = known[a, c]
            known[c, POSE + a] = known[a, c]
    for a in range(POSE):
        for c in range(POSE):
            known[a, c] = own[a, c]
            known[a, POSE + c] = -across[a, c]
            known[POSE + c, a] = -across[a, c]
        for c in range(NEXT, REST):
            known[a, c] = -across[a, c]
            known[c, a] = -across[a, c]


@kernel
def invert_poses(U, corner_inverse, blocks, link_blocks, border_blocks):
    """
    Write the blocks of the poses in the inverse.

    Their own, (N, 6, 6), those with the two poses after, (N, 6, 12), and with the border,
    (N, 6, 23).

    The blocks of the inverse Z within the pattern of U follow from the last pose backward
    (Takahashi), beginning with that of the border, `corner_inverse` (23, 23). With r the two poses
    after p and the border, and W = inv(U_pp) U_pr: Z_pr = -W Z_rr, and
    Z_pp = inv(U_pp) inv(U_pp)' - Z_pr W'.

    """
    known = np.zeros((REST, REST))  # Z_rr
    known[NEXT:, NEXT:] = corner_inverse
    rest = np.empty((POSE, REST))  # U_pr
    coupling = np.empty((POSE, REST))  # W
    across = np.empty((POSE, REST))  # -Z_pr
    root = np.empty((POSE, POSE))
    for pose in range(len(blocks) - 1, -1, -1):
        rest[:, :NEXT] = U.links[pose, :, POSE:]
        rest[:, NEXT:] = U.border[pose]
        fill_inverse_root(U.links[pose], root)
        np.dot(root, rest, coupling)
        np.dot(coupling, known, across)
        own = np.dot(root, root.T) + np.dot(across, coupling.T)
        for a in range(POSE):
            for b in range(POSE):
                blocks[pose, a, b] = (own[a, b] + own[b, a]) / 2
            for c in range(NEXT):
                link_blocks[pose, a, c] = -across[a, c]
            for s in range(SHARED):
                border_blocks[pose, a, s] = -across[a, NEXT + s]
        shift_known(known, blocks[pose], across)


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
