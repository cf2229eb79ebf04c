"""
One rigid shape per track (M4): all its points in the frame of its box, as small planes.

The points of a whole track, transformed into its box, fall into cells. Each cell that holds a
piece of surface gives a plane and the thickness to which the observations smear it. Distances from
these planes are linear in a small step of the pose: their sums of squares are all that is kept, as
in point-to-plane ICP.

"""

from math import inf, sqrt
from typing import Any, NamedTuple

from boxreg_ros.core.method.arrays import most_points
from boxreg_ros.core.method.arrowhead import factorise_corner, solve_corner
from boxreg_ros.core.method.compile import kernel, loop
from boxreg_ros.core.method.eigen import eigenvalues, eigenvector
from boxreg_ros.core.method.faces import fill_moved, fill_velocity, to_box_axes
from boxreg_ros.core.method.rotation import fill_rotation
import numpy as np

SHAPE_MARGIN = 0.3
"""Points up to this far outside of a box are part of the shape [m]. Chosen."""
STEP_RIDGE = 1e-3
"""Information added to that of a step: without points none is wanted. Derived: that of a deviation
of 30 m."""
ROOT_TOLERANCE = 1e-14
"""Least pivot of a root, over the largest one. Derived: rounding."""


@loop
def fill_cells(m, local, half, cells, cell):
    """Write the cell that each of m points in box axes (3, M) lies in; the last one if outside."""
    last = cells[0] * cells[1] * cells[2]
    scale = (cells[0] / 2 / half[0], cells[1] / 2 / half[1], cells[2] / 2 / half[2])
    for i in range(m):
        number, is_near = 0.0, True
        for k in range(3):
            is_near &= abs(local[k, i]) - half[k] < SHAPE_MARGIN
            place = min(max(local[k, i] * scale[k] + cells[k] / 2, 0.0), cells[k] - 1.0)
            number = number * cells[k] + np.floor(place)
        is_near &= number < last  # NaN, of a box without a size, is not
        cell[i] = np.int32(number if is_near else last)


@loop
def fill_planes(roughness, constants, work):
    """Fit a plane to the moments of each cell but the last; thickness inf where there is none."""
    planes, thickness, covariance = work.planes, work.thickness, work.covariance
    for cell in range(len(thickness)):
        thickness[cell] = inf
        planes[cell] = 0.0
        if cell == len(thickness) - 1:
            break
        moment = work.sums[cell]
        number = moment[3, 3]
        if number < constants.min_cell_points:
            continue
        for j in range(3):
            for k in range(j, 3):
                product = moment[j, 3] * moment[k, 3] / number
                covariance[j, k] = (moment[j, k] - product) / number
        power = eigenvalues(covariance)
        thick = max(power[0], 0.0) + roughness**2
        if power[1] > constants.min_flatness * thick:
            thickness[cell] = thick
            normal = eigenvector(covariance, power[0])
            planes[cell, 3] = 0.0
            for k in range(3):
                planes[cell, k] = normal[k]
                planes[cell, 3] -= normal[k] * moment[k, 3] / number


class ShapeWork(NamedTuple):
    """
    Arrays to work in, for N observations of at most M points and C cells.

    Attributes
    ----------
    moved, local : array, shapes (3, M) and (N, 3, M)
        Points at the stamp of their box, and in box axes [m].
    cell : array, shape (N, M)
        The cell of each; C for points outside of the box.
    sums : array, shape (C + 1, 4, 4)
        Second moments of the points in each cell, the upper triangle.
    planes, thickness : array, shapes (C + 1, 4) and (C + 1,)
        See `fill_planes`.
    lever, weighted : array, shapes (7, M) and (M,)
        See `fill_agreement`.
    covariance, factor : array, shapes (3, 3) and (6, 6)
        Of a cell, and of the step of an observation.

    """

    moved: Any
    local: Any
    cell: Any
    sums: Any
    planes: Any
    thickness: Any
    lever: Any
    weighted: Any
    covariance: Any
    factor: Any


@kernel
def empty_shape_work(problem, N, cells):
    """Return arrays for the observations of a batch."""
    M = most_points(problem.counts)
    C = cells[0] * cells[1] * cells[2] + 1
    return ShapeWork(
        np.empty((3, M)), np.empty((N, 3, M)), np.empty((N, M), np.int32), np.empty((C, 4, 4)),
        np.empty((C, 4)), np.empty(C), np.empty((7, M)), np.empty(M), np.empty((3, 3)),
        np.empty((6, 6)),
    )  # fmt: skip


@kernel
def fill_sums(b, problem, poses, half, constants, work):
    """Write the points of window `b` in box axes, and the moments of each cell."""
    velocity = np.zeros(3)
    R = np.empty((3, 3))
    shift = np.empty(3)
    work.sums[:] = 0.0
    for n in range(len(poses)):
        local = work.local[n]
        fill_rotation(poses[n, 3], poses[n, 4], poses[n, 5], R)
        for k in range(3):
            shift[k] = poses[n, k] - problem.boxes[b, n, k]
        if problem.is_moving:
            fill_velocity(poses, problem.times[b], n, problem.lengths[b], velocity)
        m = fill_moved(b, n, problem, velocity, work.moved)
        to_box_axes(m, work.moved, shift, R, local)
        fill_cells(m, local, half, constants.cells, work.cell[n])
        for i in range(problem.counts[b, n]):
            moment = work.sums[work.cell[n, i]]
            p = (local[0, i], local[1, i], local[2, i], 1.0)
            for a in range(4):
                for c in range(a, 4):
                    moment[a, c] += p[a] * p[c]


@loop
def fill_agreement(m, n, constants, work, total, wanted):
    """
    Write information (6, 6) and wanted step (6,) of observation n, of m points.

    The rows of `lever` are the derivatives of the distances of points from their planes, and the
    distances; `weighted` are their weights.

    """
    local, cell, lever, weighted, factor = (
        work.local[n], work.cell[n], work.lever, work.weighted, work.factor
    )  # fmt: skip
    used = 0
    for i in range(m):  # without a branch: the next one replaces one too far
        x, y, z = local[0, i], local[1, i], local[2, i]
        a, c, d, level = work.planes[cell[i]]
        lever[0, used], lever[1, used], lever[2, used] = a, c, d
        lever[3, used] = y * d - z * c
        lever[4, used] = z * a - x * d
        lever[5, used] = x * c - y * a
        off = a * x + c * y + d * z + level
        lever[6, used] = off
        weighted[used] = 1 / (work.thickness[cell[i]] + off**2)
        used += work.thickness[cell[i]] < inf
    for j in range(6):
        for k in range(j, 7):
            product = 0.0
            for i in range(used):
                product += weighted[i] * lever[j, i] * lever[k, i]
            if k < 6:
                total[j, k] = product
            else:
                wanted[j] = product
    # So many points of one observation err on their own.
    scale = constants.effective_points / max(float(used), constants.effective_points)
    for j in range(6):
        wanted[j] *= scale
        for k in range(j, 6):
            total[j, k] *= scale
            factor[j, k] = total[k, j] = total[j, k]
        factor[j, j] += STEP_RIDGE
    factorise_corner(factor)
    solve_corner(factor, wanted)


@loop
def fill_root(information, root):
    """Write the lower Cholesky root (6, 6) of a matrix, 0 in directions without information."""
    least = 0.0
    for k in range(6):
        least = max(least, ROOT_TOLERANCE * information[k, k])
    for k in range(6):
        for j in range(6):
            root[k, j] = 0.0
    for k in range(6):
        pivot = information[k, k]
        for m in range(k):
            pivot -= root[k, m] ** 2
        if not pivot > least:
            continue
        root[k, k] = sqrt(pivot)
        for j in range(k + 1, 6):
            total = information[j, k]
            for m in range(k):
                total -= root[j, m] * root[k, m]
            root[j, k] = total / root[k, k]


@kernel
def agree(b, problem, poses, extents, constants, work, terms):
    """
    Compare each observation of window `b` with the common shape of its track.

    Parameters
    ----------
    b : int
        The window.
    problem : Problem
        Input of the batch, of `constants.shape_points` points a box.
    poses, extents : array, shapes (N, 6) and (3,)
        Boxes of the window in this round [m, rad].
    constants : record of `Constants`
        Of the method, with the settings.
    work : ShapeWork
        Arrays to work in.
    terms : array of `TERMS`, shape (N,)
        Of the window. Written: the step of each pose after which it agrees best with the shape,
        and the root L of the information L L' about it, in box axes [m, rad].

    """
    half = extents[0] / 2, extents[1] / 2, extents[2] / 2
    information = np.empty((6, 6))
    fill_sums(b, problem, poses, half, constants, work)
    fill_planes(problem.of_class[b].roughness, constants, work)
    for n in range(len(poses)):
        fill_agreement(problem.counts[b, n], n, constants, work, information, terms[n].wanted)
        fill_root(information, terms[n].root)


@kernel
def observe_shapes(first, last, rows, problem, poses, shared, constants, terms):
    """
    Compare the windows `rows[first:last]` with the shapes of their tracks, see `agree`.

    What it shows of the window `rows[i]` is in `terms[i]`, of shape (b, N).

    """
    constants = constants[0]
    work = empty_shape_work(problem, poses.shape[1], constants.cells)
    for row in range(first, last):
        b = rows[row]
        agree(b, problem, poses[b], shared[b, :3], constants, work, terms[row])
