"""Registration of the points of one sweep to the surface of one object."""

from boxreg_ros.core.following.kernels.surface import is_foreign, nearest
from boxreg_ros.core.method.compile import kernel
import numpy as np

REACH = 0.3
"""Largest distance of a point to its part of the surface [m]."""
DEVIATION = 0.05
"""Of a point from the surface [m]."""
OUTLIER = 0.12
"""Distance at which the weight of a point is 1/4 [m]."""
FIT = 0.12
"""Points nearer to the surface than this fit it [m]."""
MARGIN = 0.4
"""Points up to this far outside of the box are used [m]."""
OUTSIDE_DEVIATION = 0.15
"""Of points outside of the box [m]."""
OUTSIDE_TOLERANCE = 0.1
"""Points less far outside are not [m]."""
MOST = 30.0
"""Evidence of one sweep, in points: more points of one surface are not independent."""


@kernel
def register(points, start, prior, information, tilt, half, clearance, surface, iterations):
    """
    Return the pose of a box (4,) x y z yaw that puts points on its surface, and statistics.

    Parameters: `points` (n, 3) of the sweep, `start` and `prior` (4,) with the `information`
    (4, 4) of the prior, `tilt` (3, 3) the rotation by roll and pitch, `half` extents (3,), the
    height `clearance` above the bottom under which points are of the road, and the map `surface`.

    Returned: pose (4,), information (4, 4) of the points alone, and: points in the box, those
    that fit the surface, root mean square of their distance, parts of the surface that they hit.

    """
    slots, moments, normals, _ = surface
    pose = start.copy()
    H = np.zeros((4, 4))
    for _ in range(iterations):
        H, g = _system(points, pose, tilt, half, clearance, slots, moments, normals)
        total = H + information
        gradient = g + information @ (pose - prior)
        step = np.linalg.solve(total, gradient)
        size = np.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
        if size > 0.3:
            step *= 0.3 / size
        pose = pose - step
        if size < 1e-3 and abs(step[3]) < 5e-4:
            break
    stats = fit(points, pose, tilt, half, clearance, surface)
    return pose, H, stats


@kernel
def _system(points, pose, tilt, half, clearance, slots, moments, normals):
    """Return the normal equations (4, 4) and (4,) of the points at a pose."""
    H = np.zeros((4, 4))
    g = np.zeros(4)
    c, s = np.cos(pose[3]), np.sin(pose[3])
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ tilt
    J = np.empty(4)
    weights = 0.0
    n_outside = 0.0
    for n in range(len(points)):
        dx = points[n, 0] - pose[0]
        dy = points[n, 1] - pose[1]
        dz = points[n, 2] - pose[2]
        x = R[0, 0] * dx + R[1, 0] * dy + R[2, 0] * dz
        y = R[0, 1] * dx + R[1, 1] * dy + R[2, 1] * dz
        z = R[0, 2] * dx + R[1, 2] * dy + R[2, 2] * dz
        if abs(x) > half[0] + MARGIN or abs(y) > half[1] + MARGIN or z > half[2] + MARGIN:
            continue
        if z < clearance - half[2]:
            continue
        slot = nearest(x, y, z, slots, moments, REACH)
        if slot >= 0:
            nx, ny, nz = normals[slot]
            if nx == 0 and ny == 0 and nz == 0:
                continue
            count = moments[slot, 0]
            r = (
                nx * (x - moments[slot, 1] / count)
                + ny * (y - moments[slot, 2] / count)
                + nz * (z - moments[slot, 3] / count)
            )
            robust = 1 / (1 + (r / OUTLIER) ** 2) ** 2
            w = robust / DEVIATION**2
            weights += robust
        else:
            out_x = abs(x) - half[0]
            out_y = abs(y) - half[1]
            r = max(out_x, out_y) - OUTSIDE_TOLERANCE
            if r <= 0 or z > half[2] or is_foreign(x, y, z, slots):
                continue
            nx, ny, nz = 0.0, 0.0, 0.0
            if out_x > out_y:
                nx = np.sign(x)
            else:
                ny = np.sign(y)
            w = (1 - min(1.0, r / (MARGIN - OUTSIDE_TOLERANCE)) ** 2) ** 2 / OUTSIDE_DEVIATION**2
            n_outside += 1
        wx = R[0, 0] * nx + R[0, 1] * ny + R[0, 2] * nz
        wy = R[1, 0] * nx + R[1, 1] * ny + R[1, 2] * nz
        wz = R[2, 0] * nx + R[2, 1] * ny + R[2, 2] * nz
        J[0], J[1], J[2] = -wx, -wy, -wz
        J[3] = wx * dy - wy * dx
        for a in range(4):
            g[a] += w * J[a] * r
            for b in range(4):
                H[a, b] += w * J[a] * J[b]
    total = weights + n_outside
    if total > MOST:
        H *= MOST / total
        g *= MOST / total
    return H, g


@kernel
def fit(points, pose, tilt, half, clearance, surface):
    """Return points in the box, those that fit, their distance (RMS), and the cells they hit."""
    slots, moments, normals, used = surface
    c, s = np.cos(pose[3]), np.sin(pose[3])
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ tilt
    hit = np.zeros(used[0], np.bool_)
    inside, fitting, squares, beside, matched = 0.0, 0.0, 0.0, 0.0, 0.0
    for n in range(len(points)):
        dx = points[n, 0] - pose[0]
        dy = points[n, 1] - pose[1]
        dz = points[n, 2] - pose[2]
        x = R[0, 0] * dx + R[1, 0] * dy + R[2, 0] * dz
        y = R[0, 1] * dx + R[1, 1] * dy + R[2, 1] * dz
        z = R[0, 2] * dx + R[1, 2] * dy + R[2, 2] * dz
        if z < clearance - half[2] or z > half[2] + OUTSIDE_TOLERANCE:
            continue
        out = max(abs(x) - half[0], abs(y) - half[1])
        if out > OUTSIDE_TOLERANCE:
            if out < MARGIN and not is_foreign(x, y, z, slots):
                beside += 1
            continue
        inside += 1
        slot = nearest(x, y, z, slots, moments, REACH)
        if slot < 0:
            continue
        hit[slot] = True
        matched += 1
        count = moments[slot, 0]
        nx, ny, nz = normals[slot]
        r = (
            nx * (x - moments[slot, 1] / count)
            + ny * (y - moments[slot, 2] / count)
            + nz * (z - moments[slot, 3] / count)
        )
        if abs(r) < FIT:
            fitting += 1
            squares += r * r
    rms = np.sqrt(squares / max(fitting, 1.0))
    return np.array([inside, fitting, rms, hit.sum() / max(1.0, used[0]), beside, matched])


@kernel
def near(points, center, reach):
    """Return the points (n, 3), which ascend by x, within `reach` (3,) of a centre (3,)."""
    first = np.searchsorted(points[:, 0], center[0] - reach[0])
    last = np.searchsorted(points[:, 0], center[0] + reach[0])
    found = np.empty((last - first, 3))
    count = 0
    for n in range(first, last):
        if abs(points[n, 1] - center[1]) < reach[1] and abs(points[n, 2] - center[2]) < reach[2]:
            found[count, 0] = points[n, 0]
            found[count, 1] = points[n, 1]
            found[count, 2] = points[n, 2]
            count += 1
    return found[:count]


@kernel
def in_box(points, pose, tilt, half, clearance, margin):
    """Return points (n, 3) within `margin` of a box and above the road, in the box frame."""
    c, s = np.cos(pose[3]), np.sin(pose[3])
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ tilt
    found = np.empty((len(points), 3))
    count = 0
    for n in range(len(points)):
        q = R.T @ (points[n] - pose[:3])
        if (np.abs(q) < half + margin).all() and q[2] > clearance - half[2]:
            found[count] = q
            count += 1
    return found[:count]


@kernel
def road_below(points, pose, tilt, half):
    """Return the height of the road above the bottom of a box; NaN without points of it [m]."""
    c, s = np.cos(pose[3]), np.sin(pose[3])
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ tilt
    heights = np.empty(len(points))
    count = 0
    for n in range(len(points)):
        q = R.T @ (points[n] - pose[:3])
        out = max(abs(q[0]) - half[0], abs(q[1]) - half[1])
        height = q[2] + half[2]
        if 0.05 < out < 1.0 and abs(height) < 0.6:
            heights[count] = height
            count += 1
    if count < 5:
        return np.nan
    ordered = np.sort(heights[:count])
    low = ordered[int(0.1 * count)]
    middle = ordered[int(0.3 * count)]
    if ordered[int(0.6 * count)] - low > 0.15:
        return np.nan
    return middle


@kernel
def outside(points, pose, tilt, half):
    """Return the points (n, 3) that are not in a box."""
    c, s = np.cos(pose[3]), np.sin(pose[3])
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ tilt
    found = np.empty((len(points), 3))
    count = 0
    for n in range(len(points)):
        q = R.T @ (points[n] - pose[:3])
        if (np.abs(q) > half).any():
            found[count] = points[n]
            count += 1
    return found[:count]
