"""
Factorisation of one arrowhead matrix: a banded chain of poses with a border, in plain loops.

The matrix A of n = 6 N chain variables and S border variables is kept as `band` (n, 18), where
band[i, k] = A[i, i + k], `border` (n, S) and `corner` (S, S), upper triangles. A pose is coupled
to the two after it: nothing lies beyond the band. Its Cholesky factor U, A = U' U, has the same
shape and replaces it.

"""

from math import sqrt

from boxreg_ros.core.kernels.compile import kernel
import numpy as np

POSE = 6
BAND = 3 * POSE
NEXT = 2 * POSE
"""Variables of the two poses that a pose is coupled to after it."""
RIDGE = 1e-9
"""Added to the diagonal: an unobserved variable does not break the factorisation."""


@kernel
def fix_variables(band, border, corner, free):
    """Make rows and columns of variables that are not `free` (n + S,) those of the identity."""
    n, S = border.shape
    for i in range(n):
        for k in range(min(BAND, n - i)):
            band[i, k] *= free[i] * free[i + k]
        for s in range(S):
            border[i, s] *= free[i] * free[n + s]
        band[i, 0] += 1.0 - free[i] + RIDGE
    for s in range(S):
        for t in range(s, S):
            corner[s, t] *= free[n + s] * free[n + t]
        corner[s, s] += 1.0 - free[n + s] + RIDGE


@kernel
def factorise(band, border, corner):
    """Replace a matrix by its Cholesky factor; return False where it is not positive definite."""
    n, S = border.shape
    for i in range(n):
        if not band[i, 0] > 0.0:
            return False
        root = sqrt(band[i, 0])
        last = min(BAND, n - i)
        for k in range(last):
            band[i, k] /= root
        for s in range(S):
            border[i, s] /= root
        for k in range(1, last):
            factor = band[i, k]
            if factor != 0.0:
                for j in range(last - k):
                    band[i + k, j] -= factor * band[i, k + j]
                for s in range(S):
                    border[i + k, s] -= factor * border[i, s]
        for s in range(S):
            factor = border[i, s]
            if factor != 0.0:
                for t in range(s, S):
                    corner[s, t] -= factor * border[i, t]
    for s in range(S):
        if not corner[s, s] > 0.0:
            return False
        root = sqrt(corner[s, s])
        for t in range(s, S):
            corner[s, t] /= root
        for t in range(s + 1, S):
            factor = corner[s, t]
            for u in range(t, S):
                corner[t, u] -= factor * corner[s, u]
    return True


@kernel
def solve(band, border, corner, x):
    """Replace a right side `x` (n + S,) by the solution of U' U x = b."""
    n, S = border.shape
    for i in range(n):
        x[i] /= band[i, 0]
        value = x[i]
        for k in range(1, min(BAND, n - i)):
            x[i + k] -= band[i, k] * value
        for s in range(S):
            x[n + s] -= border[i, s] * value
    for s in range(S):
        x[n + s] /= corner[s, s]
        for t in range(s + 1, S):
            x[n + t] -= corner[s, t] * x[n + s]
    for s in range(S - 1, -1, -1):
        for t in range(s + 1, S):
            x[n + s] -= corner[s, t] * x[n + t]
        x[n + s] /= corner[s, s]
    for i in range(n - 1, -1, -1):
        value = x[i]
        for k in range(1, min(BAND, n - i)):
            value -= band[i, k] * x[i + k]
        for s in range(S):
            value -= border[i, s] * x[n + s]
        x[i] = value / band[i, 0]


@kernel
def invert_corner(corner, inverse):
    """Write the inverse (S, S) of U' U of a corner's factor."""
    S = len(corner)
    for column in range(S):
        for s in range(S):
            inverse[s, column] = 0.0
        inverse[column, column] = 1.0
        for s in range(column, S):
            inverse[s, column] /= corner[s, s]
            for t in range(s + 1, S):
                inverse[t, column] -= corner[s, t] * inverse[s, column]
        for s in range(S - 1, -1, -1):
            for t in range(s + 1, S):
                inverse[s, column] -= corner[s, t] * inverse[t, column]
            inverse[s, column] /= corner[s, s]


@kernel
def fill_coupling(band, border, pose, coupling):
    """Write W = inv(U_pp) U_pr (6, 12 + S): r are the two poses after `pose`, and the border."""
    n, S = border.shape
    for a in range(POSE - 1, -1, -1):
        row = POSE * pose + a
        for c in range(NEXT):
            k = POSE + c - a
            coupling[a, c] = band[row, k] if k < min(BAND, n - row) else 0.0
        for s in range(S):
            coupling[a, NEXT + s] = border[row, s]
        for b in range(a + 1, POSE):
            factor = band[row, b - a]
            for c in range(NEXT + S):
                coupling[a, c] -= factor * coupling[b, c]
        for c in range(NEXT + S):
            coupling[a, c] /= band[row, 0]


@kernel
def fill_own_inverse(band, pose, inverse):
    """Write inv(U_pp) (6, 6) of one pose, upper triangular."""
    for column in range(POSE):
        for a in range(POSE - 1, -1, -1):
            total = 1.0 if a == column else 0.0
            for b in range(a + 1, POSE):
                total -= band[POSE * pose + a, b - a] * inverse[b, column]
            inverse[a, column] = total / band[POSE * pose + a, 0]


@kernel
def shift_known(known, own, across):
    """
    Move the known part of the inverse (12 + S, 12 + S) to the pose before.

    `own` (6, 6) is the block of this pose, `across` (6, 12 + S) the negative of those beside it.

    """
    size = len(known)
    for a in range(POSE):
        for c in range(size):
            if c < POSE:
                known[POSE + a, POSE + c] = known[a, c]
            elif c >= NEXT:
                known[POSE + a, c] = known[a, c]
                known[c, POSE + a] = known[a, c]
    for a in range(POSE):
        for c in range(size):
            if c < POSE:
                known[a, c] = own[a, c]
                known[a, POSE + c] = -across[a, c]
                known[POSE + c, a] = -across[a, c]
            elif c >= NEXT:
                known[a, c] = -across[a, c]
                known[c, a] = -across[a, c]


@kernel
def invert_poses(band, border, corner, blocks, columns, corner_inverse):
    """
    Write blocks of the inverse: those of the poses, of poses and border, and of the border.

    The diagonal blocks (N, 6, 6) of the poses, their rows in the columns of the border (N, 6, S),
    and the block of the border (S, S).

    The blocks of the inverse Z within the pattern of U follow from the last pose backward
    (Takahashi). With r the two poses after p and the border, and W = inv(U_pp) U_pr:
    Z_pr = -W Z_rr, and Z_pp = inv(U_pp) inv(U_pp)' - Z_pr W'.

    """
    n, S = border.shape
    invert_corner(corner, corner_inverse)
    size = NEXT + S
    known = np.zeros((size, size))  # Z_rr
    for s in range(S):
        for t in range(S):
            known[NEXT + s, NEXT + t] = corner_inverse[s, t]
    coupling = np.empty((POSE, size))
    across = np.empty((POSE, size))
    root = np.zeros((POSE, POSE))
    for pose in range(n // POSE - 1, -1, -1):
        own = blocks[pose]
        fill_coupling(band, border, pose, coupling)
        fill_own_inverse(band, pose, root)
        np.dot(coupling, known, across)  # -Z_pr: the largest product, by BLAS
        for a in range(POSE):
            for b in range(a, POSE):
                total = 0.0
                for c in range(b, POSE):
                    total += root[a, c] * root[b, c]
                for c in range(size):
                    total += across[a, c] * coupling[b, c]
                own[a, b] = total
                own[b, a] = total
            for s in range(S):
                columns[pose, a, s] = -across[a, NEXT + s]
        shift_known(known, own, across)


@kernel
def solve_rows(begin, end, rows, band, border, corner, b, x):
    """Write the solutions x (r, n + S) for right sides `b` of the windows `rows[begin:end]`."""
    for i in range(begin, end):
        x[i] = b[i]
        solve(band[rows[i]], border[rows[i]], corner[rows[i]], x[i])


@kernel
def invert_windows(begin, end, band, border, corner, blocks, columns, corner_inverse):
    """Write the blocks of the inverse of windows `begin` to `end`, see `invert_poses`."""
    for b in range(begin, end):
        invert_poses(band[b], border[b], corner[b], blocks[b], columns[b], corner_inverse[b])
