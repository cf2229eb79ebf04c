"""
One rigid shape per track (M4): all its points in the frame of its box, as small planes.

The points of a whole track, transformed into its box, fall into cells. Each cell that holds a
piece of surface gives a plane and the thickness to which the observations smear it. Distances from
these planes are linear in a small step of the pose: their sums of squares are all that is kept, as
in point-to-plane ICP.

"""

from math import sqrt
from typing import Any, NamedTuple

from boxreg_ros.core.method.arrays import copy
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
def cell_of(x, y, z, half, cells):
    """Return the number of the cell that a point in box axes lies in."""
    cell = 0
    for k in range(3):
        value = (x, y, z)[k]
        place = int(np.floor((value / half[k] + 1) * (cells[k] / 2)))
        cell = cell * cells[k] + min(max(place, 0), cells[k] - 1)
    return cell


@kernel
def fill_planes(sums, roughness, constants, planes, thickness):
    """Fit a plane (4,) to the moments (4, 4) of each cell; thickness 0 where there is none."""
    covariance = np.empty((3, 3))
    for cell in range(len(sums)):
        thickness[cell] = 0.0
        moment = sums[cell]
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
    sums : array, shape (C, 4, 4)
        Second moments of the points in each cell.
    planes, thickness : array, shapes (C, 4) and (C,)
        See `fill_planes`.

    """

    moved: Any
    local: Any
    sums: Any
    planes: Any
    thickness: Any


@kernel
def empty_shape_work(begin, end, problem, N, cells):
    """Return arrays for the windows `begin` to `end`."""
    M = max(1, problem.counts[begin:end].max()) if end > begin else 1
    C = cells[0] * cells[1] * cells[2]
    return ShapeWork(
        np.empty((3, M)), np.empty((N, 3, M)), np.empty((C, 4, 4)), np.empty((C, 4)), np.empty(C)
    )


@kernel
def fill_sums(b, problem, poses, half, constants, work):
    """Write the points of window `b` in box axes, and the moments of each cell."""
    velocity = np.zeros(3)
    R = np.empty((3, 3))
    shift = np.empty(3)
    work.sums[:] = 0.0
    for n in range(len(poses)):
        m = problem.counts[b, n]
        local = work.local[n]
        fill_rotation(poses[n, 3], poses[n, 4], poses[n, 5], R)
        for k in range(3):
            shift[k] = poses[n, k] - problem.boxes[b, n, k]
        if problem.is_moving:
            fill_velocity(poses, problem.times[b], n, problem.lengths[b], velocity)
        fill_moved(b, n, problem, velocity, work.moved)
        to_box_axes(m, work.moved, shift, R, local)
        for i in range(m):
            x, y, z = local[0, i], local[1, i], local[2, i]
            if not is_near(x, y, z, half, SHAPE_MARGIN):
                continue
            moment = work.sums[cell_of(x, y, z, half, constants.cells)]
            p = (x, y, z, 1.0)
            for a in range(4):
                for c in range(4):
                    moment[a, c] += p[a] * p[c]


@kernel
def fill_agreement(m, local, half, constants, work, total, wanted):
    """Write information (6, 6) and wanted step (6,) of an observation of m points."""
    lever = np.empty(6)
    pull = np.zeros(6)
    total[:] = 0.0
    used = 0
    for i in range(m):
        x, y, z = local[0, i], local[1, i], local[2, i]
        if not is_near(x, y, z, half, SHAPE_MARGIN):
            continue
        cell = cell_of(x, y, z, half, constants.cells)
        if work.thickness[cell] == 0.0:
            continue
        used += 1
        a, c, d = work.planes[cell, 0], work.planes[cell, 1], work.planes[cell, 2]
        off = a * x + c * y + d * z + work.planes[cell, 3]
        weight = 1 / (work.thickness[cell] + off**2)
        lever[0], lever[1], lever[2] = a, c, d
        lever[3] = y * d - z * c
        lever[4] = z * a - x * d
        lever[5] = x * c - y * a
        for j in range(6):
            weighted = weight * lever[j]
            pull[j] += weighted * off
            for k in range(j, 6):
                total[j, k] += weighted * lever[k]
    # So many points of one observation err on their own.
    scale = constants.effective_points / max(float(used), constants.effective_points)
    for j in range(6):
        pull[j] *= scale
        for k in range(j, 6):
            total[j, k] *= scale
            total[k, j] = total[j, k]
    factor = total.copy()
    for j in range(6):
        factor[j, j] += STEP_RIDGE
    factorise_corner(factor)
    copy(pull, wanted)
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
    half = extents / 2
    information = np.empty((6, 6))
    fill_sums(b, problem, poses, half, constants, work)
    fill_planes(work.sums, problem.of_class[b].roughness, constants, work.planes, work.thickness)
    for n in range(len(poses)):
        fill_agreement(
            problem.counts[b, n], work.local[n], half, constants, work, information,
            terms[n].wanted,
        )  # fmt: skip
        fill_root(information, terms[n].root)


@loop
def is_near(x, y, z, half, margin):
    """Return whether a point is within `margin` of a box."""
    outside = max(abs(x) - half[0], abs(y) - half[1], abs(z) - half[2])
    return outside < margin
