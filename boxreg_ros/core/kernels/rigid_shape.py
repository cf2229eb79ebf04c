"""
Agreement of each observation with the rigid shape of its track, in plain loops.

The torch twin is `boxreg_ros.core.rigid_shape.agreement_torch`, which has the formulas.

"""

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


@kernel
def agreement(
    begin, end, windows, poses, extents, is_moving, roughness, cells, limits, information, wanted
):
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
    is_moving : bool
        Whether points are to be moved to the stamp of their box.
    roughness : array, shape (B,)
        How far the surface of each window's object is from rigid [m].
    cells : tuple of int
        Cells along each axis of a box.
    limits : tuple of float
        `SHAPE_MARGIN`, `MIN_FLATNESS`, `MIN_CELL_POINTS`, `EFFECTIVE_POINTS`, `STEP_RIDGE`.
    information, wanted : array, shapes (B, N, 6, 6) and (B, N, 6)
        Written.

    """
    margin, flatness, min_points, independent, ridge = limits
    N = poses.shape[1]
    M = max(1, windows.counts[begin:end].max()) if end > begin else 1
    moved = np.empty((3, M))
    velocity = np.zeros(3)
    cell_count = cells[0] * cells[1] * cells[2]
    local = np.empty((N, 3, M))
    R = np.empty((3, 3))
    half = np.empty(3)
    shift = np.empty(3)
    planes = np.empty((cell_count, 4))
    thickness = np.empty(cell_count)
    lever = np.empty(6)
    for b in range(begin, end):
        for k in range(3):
            half[k] = extents[b, k] / 2
        sums = np.zeros((cell_count, 4, 4))
        for n in range(N):
            m = windows.counts[b, n]
            fill_rotation(poses[b, n, 3], poses[b, n, 4], poses[b, n, 5], R)
            for k in range(3):
                shift[k] = poses[b, n, k] - windows.boxes[b, n, k]
            if is_moving:
                fill_velocity(poses[b], windows.times[b], n, windows.lengths[b], velocity)
            fill_moved(windows, b, n, velocity, is_moving, moved)
            to_box_axes(m, moved, shift, R, local[n])
            for i in range(m):
                x, y, z = local[n, 0, i], local[n, 1, i], local[n, 2, i]
                if not is_near(x, y, z, half, margin):
                    continue
                moment = sums[cell_of(x, y, z, half, cells)]
                p = (x, y, z, 1.0)
                for a in range(4):
                    for c in range(4):
                        moment[a, c] += p[a] * p[c]
        fill_planes(sums, roughness[b], flatness, min_points, planes, thickness)
        for n in range(N):
            m = windows.counts[b, n]
            total = information[b, n]
            total[:] = 0.0
            pull = np.zeros(6)
            used = 0
            for i in range(m):
                x, y, z = local[n, 0, i], local[n, 1, i], local[n, 2, i]
                if not is_near(x, y, z, half, margin):
                    continue
                cell = cell_of(x, y, z, half, cells)
                if thickness[cell] == 0.0:
                    continue
                used += 1
                a, c, d = planes[cell, 0], planes[cell, 1], planes[cell, 2]
                off = a * x + c * y + d * z + planes[cell, 3]
                weight = 1 / (thickness[cell] + off**2)
                lever[0], lever[1], lever[2] = a, c, d
                lever[3] = y * d - z * c
                lever[4] = z * a - x * d
                lever[5] = x * c - y * a
                for j in range(6):
                    pull[j] += weight * lever[j] * off
                    for k in range(6):
                        total[j, k] += weight * lever[j] * lever[k]
            # So many points of one observation err on their own.
            scale = independent / max(float(used), independent)
            for j in range(6):
                pull[j] *= scale
                for k in range(6):
                    total[j, k] *= scale
            step = np.linalg.solve(total + ridge * np.eye(6), pull)
            for j in range(6):
                wanted[b, n, j] = step[j]


@kernel
def is_near(x, y, z, half, margin):
    """Return whether a point is within `margin` of a box."""
    outside = max(abs(x) - half[0], abs(y) - half[1], abs(z) - half[2])
    return outside < margin
