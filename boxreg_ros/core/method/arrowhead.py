"""
Factorisation of one arrowhead matrix: a chain of poses with a border.

A pose is coupled to the two poses after it, its `links`, and to the shared variables, the
`border`; see `Arrowhead`. Poses are eliminated one by another, each as a block: its inverse and
its regression on the variables after it are the `Factor`. Products are loops over whole vectors:
SciPy's BLAS would take 0.2 s and 10 to 15 MB to import.

"""

from math import sqrt

from boxreg_ros.core.method.arrays import (
    ANCHOR,
    BLOCK,
    copy,
    padded,
    PIVOT,
    POSE,
    SHARED,
    SPAN,
    WIDTH,
)
from boxreg_ros.core.method.compile import loop, small_array
import numpy as np

NEXT = 2 * POSE
"""Variables of the two poses after one."""
RIDGE = 1e-9
"""Added to the diagonal: an unobserved variable does not break the factorisation. Derived: the
information of a deviation of 30 km."""
NO_BLOCK = np.zeros(1, BLOCK)


@loop
def clear(A):
    """Set a matrix to zero."""
    for n in range(len(A.poses)):
        A.poses[n] = NO_BLOCK[0]
    for s in range(len(A.corner)):
        for t in range(len(A.corner)):
            A.corner[s, t] = 0.0


@loop
def fix_variables(A, free):
    """Make rows and columns of variables that are not `free` (6 N + S,) those of the identity."""
    S = len(A.corner)
    n = len(free) - S
    for i in range(n):
        pose, a = i // POSE, i % POSE
        block = A.poses[pose]
        if free[i] == 0.0:
            for before in range(max(pose - 2, 0), pose + 1):
                links = A.poses[before].links
                for b in range(POSE):
                    links[b, POSE * (pose - before) + a] = 0.0
            for c in range(SPAN):
                block.links[a, c] = 0.0
            for s in range(S):
                block.border[a, s] = 0.0
        block.links[a, a] += 1.0 - free[i] + RIDGE
    for s in range(S):
        if free[n + s] == 0.0:
            for i in range(n):
                A.poses[i // POSE].border[i % POSE, s] = 0.0
            for t in range(S):
                A.corner[s, t] = A.corner[t, s] = 0.0
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
def factorise_block(links, triangle):
    """
    Write the factor L D L' of the block of a pose, from its `links` (6, 18).

    L without its ones, and 1 / D, (6, 6). Returns False if it is not positive definite.

    """
    for a in range(POSE):
        for b in range(a + 1):
            triangle[a, b] = links[b, a]
    for k in range(POSE):
        if not triangle[k, k] > 0.0:
            return False
        triangle[k, k] = 1.0 / triangle[k, k]
        for a in range(k + 1, POSE):
            factor = triangle[a, k] * triangle[k, k]
            for b in range(k + 1, a + 1):
                triangle[a, b] -= factor * triangle[b, k]
        for a in range(k + 1, POSE):
            triangle[a, k] *= triangle[k, k]
    return True


@loop
def divide(x, triangle):
    """
    Replace right sides `x` (6, m) by the solutions of L D L' x = b, see `factorise_block`.

    Written out, since loops within that over the right sides would keep it from being compiled to
    vector instructions. A product with the inverse would have an error larger by the condition
    number of the matrix.

    """
    L10 = triangle[1, 0]
    L20, L21 = triangle[2, 0], triangle[2, 1]
    L30, L31, L32 = triangle[3, 0], triangle[3, 1], triangle[3, 2]
    L40, L41, L42, L43 = triangle[4, 0], triangle[4, 1], triangle[4, 2], triangle[4, 3]
    L50, L51, L52, L53, L54 = (
        triangle[5, 0], triangle[5, 1], triangle[5, 2], triangle[5, 3], triangle[5, 4]
    )  # fmt: skip
    d0, d1, d2 = triangle[0, 0], triangle[1, 1], triangle[2, 2]
    d3, d4, d5 = triangle[3, 3], triangle[4, 4], triangle[5, 5]
    for j in range(x.shape[1]):
        x0 = x[0, j]
        x1 = x[1, j] - L10 * x0
        x2 = x[2, j] - L20 * x0 - L21 * x1
        x3 = x[3, j] - L30 * x0 - L31 * x1 - L32 * x2
        x4 = x[4, j] - L40 * x0 - L41 * x1 - L42 * x2 - L43 * x3
        x5 = x[5, j] - L50 * x0 - L51 * x1 - L52 * x2 - L53 * x3 - L54 * x4
        x5 = d5 * x5
        x4 = d4 * x4 - L54 * x5
        x3 = d3 * x3 - L43 * x4 - L53 * x5
        x2 = d2 * x2 - L32 * x3 - L42 * x4 - L52 * x5
        x1 = d1 * x1 - L21 * x2 - L31 * x3 - L41 * x4 - L51 * x5
        x0 = d0 * x0 - L10 * x1 - L20 * x2 - L30 * x3 - L40 * x4 - L50 * x5
        x[0, j], x[1, j], x[2, j], x[3, j], x[4, j], x[5, j] = x0, x1, x2, x3, x4, x5


@loop
def fill_sides(block, S, own, coupling):
    """Write the right sides of a pose: the identity, and less what it is coupled to."""
    for a in range(POSE):
        for b in range(POSE):
            own[a, b] = 1.0 if a == b else 0.0
        for s in range(S):
            coupling[a, s] = -block.border[a, s]
        for c in range(NEXT):
            coupling[a, S + c] = -block.links[a, POSE + c]
        for r in range(S + NEXT, coupling.shape[1]):
            coupling[a, r] = 0.0


@loop
def fill_change(links, coupling, change):
    """Write the product of what the next poses are coupled to, and of their `coupling`."""
    for c in range(NEXT):
        for r in range(padded(coupling.shape[1])):
            total = 0.0
            for a in range(POSE):
                total += links[a, POSE + c] * coupling[a, r]
            change[c, r] = total


@loop
def subtract(change, S, first, second):
    """Add the `change` (12, S + 12 or more) of the two poses after one."""
    for a in range(POSE):
        for c in range(NEXT):
            first.links[a, c] += change[a, S + c]
        for c in range(POSE):
            second.links[a, c] += change[POSE + a, S + POSE + c]
        for s in range(S):
            first.border[a, s] += change[a, s]
            second.border[a, s] += change[POSE + a, s]


@loop
def add_product(border, coupling, S, found):
    """Add the product of the border of a pose, transposed, and of its `coupling` to the border."""
    for s in range(S):
        for t in range(padded(S)):
            total = found[s, t]
            for a in range(POSE):
                total += border[a, s] * coupling[a, t]
            found[s, t] = total


@loop
def eliminate_poses(A, factor):
    """
    Write the factor of each pose, and subtract its products from the variables after it.

    Returns False if a pose is not positive definite.

    """
    N, S = len(factor.own), len(A.corner)
    triangle, change, of_corner = (
        small_array(POSE, POSE), small_array(NEXT, WIDTH), small_array(SHARED, WIDTH)
    )  # fmt: skip
    for s in range(S):
        for t in range(WIDTH):
            of_corner[s, t] = 0.0
    for pose in range(N):
        block, own, coupling = A.poses[pose], factor.own[pose], factor.coupling[pose]
        if not factorise_block(block.links, triangle):
            return False
        fill_sides(block, S, own, coupling)
        divide(own, triangle)
        divide(coupling, triangle)
        fill_change(block.links, coupling, change)
        subtract(change, S, A.poses[pose + 1], A.poses[pose + 2])
        add_product(block.border, coupling, S, of_corner)
    for s in range(S):
        for t in range(s, S):
            A.corner[s, t] += of_corner[s, t]
    return True


@loop
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

    The last poses are coupled to one pose after them or none. `rest`, as long as a coupling is
    wide, is to work in: what a pose is coupled to.

    """
    S = len(factor.corner)
    end = len(x) - S
    for r in range(len(rest)):
        rest[r] = x[end + r] if r < S else 0.0
    for pose in range(len(factor.own)):
        coupling, own, after = factor.coupling[pose], x[POSE * pose :], POSE * (pose + 1)
        for c in range(NEXT):
            rest[S + c] = x[after + c] if after + c < end else 0.0
        for r in range(padded(len(rest))):
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
        for a in range(len(own)):
            total = 0.0
            for b in range(POSE):
                total += own[a, b] * right[b]
            for r in range(padded(len(rest))):
                total += coupling[a, r] * rest[r]
            found[a] = total
        for a in range(POSE):
            rest[S + POSE + a] = rest[S + a]
            rest[S + a] = right[a] = found[a]


@loop
def solve(factor, x):
    """Replace a right side `x` (6 N + S,) by the solution of A x = b."""
    rest, found = small_array(WIDTH)[: factor.coupling.shape[2]], small_array(POSE)
    first = POSE * len(factor.own)
    substitute_forward(factor, x, rest)
    for s in range(len(factor.corner)):
        rest[s] = 0.0
        for t in range(len(factor.corner)):
            rest[s] += factor.corner[s, t] * x[first + t]
    copy(rest, x[first:])
    substitute_backward(factor, x, rest, found)


@loop
def shift_known(known, own, links, response):
    """
    Move what is known of two poses (12, 12 + S or more) to the pose before.

    Their covariances, where the shared variables are held, and their `response` to these.

    """
    for a in range(len(own)):
        for c in range(POSE):
            known[POSE + a, POSE + c] = known[a, c]
            known[a, c] = own[a, c]
            known[a, POSE + c] = known[POSE + c, a] = links[a, c]
        for s in range(response.shape[1]):
            known[POSE + a, NEXT + s] = known[a, NEXT + s]
            known[a, NEXT + s] = response[a, s]


@loop
def invert_poses(factor, blocks, links, response):
    """
    Write the blocks of the poses in the inverse, where the shared variables are held.

    Their own, (N, 6, 6), and those with the two poses after, (N, 6, 12); and the `response` of
    each pose to the shared variables, (N, 6, S). With C, the covariance of these, the covariance
    of two poses is their block and T C T' of their responses T, that with the shared ones is T C.

    The blocks Z within the pattern of A follow from the last pose backward (Takahashi). With r the
    two poses after p, and its couplings W to them, B to the shared: Z_pr = W Z_rr, Z_pp is the
    inverse of its own block + Z_pr W', and T_p = B + W T_r.

    """
    S = len(factor.corner)
    known = small_array(NEXT, WIDTH)  # Z_rr, T_r
    after, product = small_array(POSE, NEXT), small_array(POSE, WIDTH)
    for c in range(NEXT):
        for r in range(WIDTH):
            known[c, r] = 0.0
    for pose in range(len(blocks) - 1, -1, -1):
        coupling, own = factor.coupling[pose], factor.own[pose]
        for a in range(POSE):
            for c in range(NEXT):
                after[a, c] = coupling[a, S + c]
        multiply(after, known, NEXT + S, product)
        for a in range(len(own)):
            for c in range(NEXT):
                links[pose, a, c] = product[a, c]
            for s in range(S):
                response[pose, a, s] = coupling[a, s] + product[a, NEXT + s]
            for b in range(a, POSE):
                total = own[a, b]
                for c in range(NEXT):
                    total += product[a, c] * after[b, c]
                blocks[pose, a, b] = blocks[pose, b, a] = total
        shift_known(known, blocks[pose], links[pose], response[pose])


@loop
def multiply(after, known, width, product):
    """Write the product of a matrix (6, 12) and the first columns of one, `width` or more."""
    for a in range(POSE):
        for r in range(padded(width)):
            total = 0.0
            for c in range(NEXT):
                total += after[a, c] * known[c, r]
            product[a, r] = total


@loop
def multiply_shared(response, shared, product):
    """Write the product of a `response` (6, S) and the first S columns of a matrix."""
    # Both forms of S have these variables; a sum of constant length takes a quarter of the time.
    for a in range(len(response)):
        for r in range(padded(response.shape[1])):
            total = 0.0
            for s in range(ANCHOR):
                total += response[a, s] * shared[s, r]
            product[a, r] = total
    if response.shape[1] > ANCHOR:
        for a in range(len(response)):
            for r in range(padded(response.shape[1])):
                total = product[a, r]
                for s in range(ANCHOR, SHARED):
                    total += response[a, s] * shared[s, r]
                product[a, r] = total


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
