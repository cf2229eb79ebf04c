"""
Agreement of each observation with the rigid shape of its track, in plain loops.

The torch twin is `boxreg_ros.core.rigid_shape.agreement_torch`, which has the formulas.

"""

from typing import Any, NamedTuple

from boxreg_ros.core.kernels.compile import kernel
from boxreg_ros.core.kernels.face_support import fill_moved, fill_velocity, to_box_axes
from boxreg_ros.core.kernels.rotation import fill_rotation
import numpy as np


@kernel
def cell_of(x, y, z, half, cells):
    """Return the number of the cell that a point in box axes lies in."""
    cell = 0
    for k in range(3):
        value = (x, y, z)[k]
        place = int(np.floor((value / half[k] + 1) * (cells[k] / 2)))
        cell = cell * cells[k] + min(max(place, 0), cells[k] - 1)
    return cell


@kernel
def fill_planes(sums, roughness, flatness, min_points, planes, thickness):
    """Fit a plane (4,) to the moments (4, 4) of each cell; thickness 0 where there is none."""
    for cell in range(len(sums)):
        thickness[cell] = 0.0
        number = sums[cell, 3, 3]
        if number < min_points:
            continue
        mean = sums[cell, :3, 3] / number
        covariance = sums[cell, :3, :3] / number - np.outer(mean, mean)
        power, axes = np.linalg.eigh(covariance)
        thick = max(power[0], 0.0) + roughness**2
        if power[1] > flatness * thick:
            thickness[cell] = thick
            planes[cell, 3] = 0.0
            for k in range(3):
                planes[cell, k] = axes[k, 0]
                planes[cell, 3] -= axes[k, 0] * mean[k]


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
def empty_shape_work(begin, end, windows, N, cells):
    """Return arrays for the windows `begin` to `end`."""
    M = max(1, windows.counts[begin:end].max()) if end > begin else 1
    C = cells[0] * cells[1] * cells[2]
    return ShapeWork(
        np.empty((3, M)), np.empty((N, 3, M)), np.empty((C, 4, 4)), np.empty((C, 4)), np.empty(C)
    )


@kernel
def fill_sums(b, windows, poses, half, numbers, work):
    """Write the points of window `b` in box axes, and the moments of each cell."""
    velocity = np.zeros(3)
    R = np.empty((3, 3))
    shift = np.empty(3)
    work.sums[:] = 0.0
    for n in range(len(poses)):
        m = windows.counts[b, n]
        local = work.local[n]
        fill_rotation(poses[n, 3], poses[n, 4], poses[n, 5], R)
        for k in range(3):
            shift[k] = poses[n, k] - windows.boxes[b, n, k]
        if numbers.is_moving:
            fill_velocity(poses, windows.times[b], n, windows.lengths[b], velocity)
        fill_moved(windows, b, n, velocity, numbers.is_moving, work.moved)
        to_box_axes(m, work.moved, shift, R, local)
        for i in range(m):
            x, y, z = local[0, i], local[1, i], local[2, i]
            if not is_near(x, y, z, half, numbers.margin):
                continue
            moment = work.sums[cell_of(x, y, z, half, numbers.cells)]
            p = (x, y, z, 1.0)
            for a in range(4):
                for c in range(4):
                    moment[a, c] += p[a] * p[c]


@kernel
def fill_agreement(m, local, half, numbers, work, total, wanted):
    """Write information (6, 6) and wanted step (6,) of an observation of m points."""
    lever = np.empty(6)
    pull = np.zeros(6)
    total[:] = 0.0
    used = 0
    for i in range(m):
        x, y, z = local[0, i], local[1, i], local[2, i]
        if not is_near(x, y, z, half, numbers.margin):
            continue
        cell = cell_of(x, y, z, half, numbers.cells)
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
            pull[j] += weight * lever[j] * off
            for k in range(6):
                total[j, k] += weight * lever[j] * lever[k]
    # So many points of one observation err on their own.
    scale = numbers.effective_points / max(float(used), numbers.effective_points)
    for j in range(6):
        pull[j] *= scale
        for k in range(6):
            total[j, k] *= scale
    wanted[:] = np.linalg.solve(total + numbers.ridge * np.eye(6), pull)


@kernel
def agree(b, windows, poses, extents, roughness, numbers, work, information, wanted):
    """Write information (N, 6, 6) and wanted steps (N, 6) of window `b`, see `agreement`."""
    half = extents / 2
    fill_sums(b, windows, poses, half, numbers, work)
    fill_planes(
        work.sums, roughness, numbers.flatness, numbers.min_cell_points, work.planes,
        work.thickness,
    )  # fmt: skip
    for n in range(len(poses)):
        fill_agreement(
            windows.counts[b, n], work.local[n], half, numbers, work, information[n], wanted[n]
        )


@kernel
def agreement(begin, end, windows, poses, extents, roughness, numbers, information, wanted):
    """
    Write information (B, N, 6, 6) and wanted steps (B, N, 6) of windows `begin` to `end`.

    Parameters
    ----------
    begin, end : int
        First window, and the one after the last.
    windows : WindowArrays
        Input of the windows.
    poses : array, shape (B, N, 6)
        Poses of this round.
    extents : array, shape (B, 3)
        Extents [m].
    roughness : array, shape (B,)
        How far the surface of each window's object is from rigid [m].
    numbers : ShapeNumbers
        Constants.
    information, wanted : array, shapes (B, N, 6, 6) and (B, N, 6)
        Written.

    """
    work = empty_shape_work(begin, end, windows, poses.shape[1], numbers.cells)
    for b in range(begin, end):
        agree(
            b, windows, poses[b], extents[b], roughness[b], numbers, work, information[b],
            wanted[b],
        )  # fmt: skip


@kernel
def is_near(x, y, z, half, margin):
    """Return whether a point is within `margin` of a box."""
    outside = max(abs(x) - half[0], abs(y) - half[1], abs(z) - half[2])
    return outside < margin
