"""The surface of one object in its box frame: cells with the moments of their points."""

from math import hypot
from typing import Any, NamedTuple

from boxreg_ros.core.method.compile import kernel, loop
from boxreg_ros.core.method.eigen import eigenvalues, eigenvector
from boxreg_ros.core.method.follow_numbers import IN_KERNELS as FOLLOW
import numpy as np

FOREIGN = -1
"""In place of the number of a cell: points beside the box that a person has drawn."""


class Surface(NamedTuple):
    """
    The map of a surface.

    Attributes
    ----------
    slots : array, shape (nx, ny, nz)
        Number of the cell at a place plus one, 0, or `FOREIGN`.
    means, normals : array, shape (S, 3)
        Of the points of each cell, and the direction of least spread around it.
    used : array, shape (1,)
        Number of cells.
    moments : array, shape (S, 11)
        Count, sums of x y z and of xx xy xz yy yz zz of the points of each cell, and the count at
        which the normal was found.

    """

    slots: Any
    means: Any
    normals: Any
    used: Any
    moments: Any


@loop
def cell_of(x, y, z, slots):
    """Return the indices of the cell at a place of the box frame; i = -1 outside of the map."""
    nx, ny, nz = slots.shape
    i = int(np.floor(x / FOLLOW.cell)) + nx // 2
    j = int(np.floor(y / FOLLOW.cell)) + ny // 2
    k = int(np.floor(z / FOLLOW.cell)) + nz // 2
    if i < 1 or j < 1 or k < 1 or i >= nx - 1 or j >= ny - 1 or k >= nz - 1:
        return -1, -1, -1
    return i, j, k


@kernel
def insert(points, half, surface):
    """Add points (n, 3) of the box frame to a map; update the normals of their cells."""
    slots, means, normals, used, moments = surface
    C = np.empty((3, 3))
    for n in range(len(points)):
        x, y, z = points[n]
        i, j, k = cell_of(x, y, z, slots)
        if i < 0:
            continue
        slot = slots[i, j, k] - 1
        if slot < 0:
            if slots[i, j, k] == FOREIGN:
                continue
            slot = used[0]
            used[0] += 1
            slots[i, j, k] = slot + 1
        of_cell = moments[slot]
        if of_cell[0] >= FOLLOW.max_cell_points:
            continue
        of_cell[0] += 1.0
        of_cell[1] += x
        of_cell[2] += y
        of_cell[3] += z
        of_cell[4] += x * x
        of_cell[5] += x * y
        of_cell[6] += x * z
        of_cell[7] += y * y
        of_cell[8] += y * z
        of_cell[9] += z * z
    for slot in range(used[0]):
        count = moments[slot, 0]
        if count > FOLLOW.normal_growth * moments[slot, 10]:
            for k in range(3):
                means[slot, k] = moments[slot, 1 + k] / count
            normal = normal_at(means[slot], half, slots, moments, C)
            for k in range(3):
                normals[slot, k] = normal[k]
            moments[slot, 10] = count


@kernel
def insert_foreign(points, half, slots):
    """Mark the places of points (n, 3) of the box frame that are beside the box."""
    for n in range(len(points)):
        x, y, z = points[n]
        if max(abs(x) - half[0], abs(y) - half[1]) > FOLLOW.tolerance:
            i, j, k = cell_of(x, y, z, slots)
            if i >= 0 and slots[i, j, k] == 0:
                slots[i, j, k] = FOREIGN


@loop
def is_foreign(x, y, z, slots):
    """Return whether a place is foreign, or beside a foreign one."""
    i, j, k = cell_of(x, y, z, slots)
    if i < 0:
        return False
    for a in range(i - 1, i + 2):
        for b in range(j - 1, j + 2):
            for c in range(k - 1, k + 2):
                if slots[a, b, c] == FOREIGN:
                    return True
    return False


@loop
def normal_at(mean, half, slots, moments, C):
    """
    Return the normal of the points in the 27 cells around a place (3,); zeros for too few.

    Where they form a line, as those of one ring, the normal is the horizontal one across it. The
    covariance `C` (3, 3) is to work in.

    """
    if half[0] - abs(mean[0]) < half[1] - abs(mean[1]):
        across = (np.sign(mean[0]), 0.0, 0.0)
    else:
        across = (0.0, np.sign(mean[1]), 0.0)
    i, j, k = cell_of(mean[0], mean[1], mean[2], slots)
    n, sx, sy, sz = 0.0, 0.0, 0.0, 0.0
    C[:] = 0.0
    for a in range(i - 1, i + 2):
        for b in range(j - 1, j + 2):
            for c in range(k - 1, k + 2):
                slot = slots[a, b, c] - 1
                if slot < 0:
                    continue
                of_cell = moments[slot]
                n += of_cell[0]
                sx += of_cell[1]
                sy += of_cell[2]
                sz += of_cell[3]
                C[0, 0] += of_cell[4]
                C[0, 1] += of_cell[5]
                C[0, 2] += of_cell[6]
                C[1, 1] += of_cell[7]
                C[1, 2] += of_cell[8]
                C[2, 2] += of_cell[9]
    if n < 4:
        return across
    m = (sx / n, sy / n, sz / n)
    for p in range(3):
        for q in range(p, 3):
            C[p, q] = C[p, q] / n - m[p] * m[q]
    values = eigenvalues(C)
    if values[1] < FOLLOW.line**2 or values[1] < 3 * values[0]:
        x, y, _ = eigenvector(C, values[2])
        length = hypot(x, y)
        return across if length < 0.5 else (-y / length, x / length, 0.0)
    return eigenvector(C, values[0])


@loop
def nearest_cell(x, y, z, surface):
    """Return the cell with the nearest mean to a place, or -1 where none is in reach."""
    slots, means = surface.slots, surface.means
    i, j, k = cell_of(x, y, z, slots)
    if i < 0:
        return -1
    best = (2 * FOLLOW.cell) ** 2
    found = -1
    for a in range(i - 1, i + 2):
        for b in range(j - 1, j + 2):
            for c in range(k - 1, k + 2):
                slot = slots[a, b, c] - 1
                if slot < 0:
                    continue
                dx = means[slot, 0] - x
                dy = means[slot, 1] - y
                dz = means[slot, 2] - z
                squared = dx * dx + dy * dy + dz * dz
                if squared < best:
                    best = squared
                    found = slot
    return found


def empty_surface(half):
    """Return a map without points for a box with `half` extents (3,)."""
    sides = (2 * np.ceil((half + FOLLOW.margin) / FOLLOW.cell) + 4).astype(np.int64)
    cells = int(sides.prod())  # their memory is taken when they get points
    return Surface(
        np.zeros(sides, np.int32),
        np.zeros((cells, 3)),
        np.zeros((cells, 3)),
        np.zeros(1, np.int64),
        np.zeros((cells, 11)),
    )
