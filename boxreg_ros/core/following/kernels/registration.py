"""Registration of the points of one sweep to the surface of one object."""

from boxreg_ros.core.following.kernels.surface import insert, is_foreign, nearest
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

CROP, CROP_ABOVE = 0.7, 0.6
"""Points so far around a box belong to its sweep, sideways and in height [m]."""
BESIDE = 0.3
"""And so much further away are the boxes of others whose points are left out [m]."""

# A pose is accepted if all of these hold.
REASONS = ('', 'few_points', 'no_fit', 'uncertain', 'jump')
"""Why a pose is not accepted."""
ACCEPTED, FEW_POINTS, NO_FIT, UNCERTAIN, JUMP = range(len(REASONS))
MIN_POINTS = 5
"""Points that fit the surface."""
MIN_FIT = 0.5
"""Part of the points near the surface that fit it."""
MIN_SEEN = 0.3
"""Part of the points in the box that are near the surface."""
MAX_DEVIATION = 0.35
"""Deviation along the heading [m]."""
MAX_YAW_DEVIATION = 0.12
"""[rad]."""
MAX_JUMP = 16.0
"""Squared Mahalanobis distance from the prediction."""

MAX_SWEEP_POINTS = 400
"""A sweep with more points around a box is thinned; swept: the poses are as good."""
AROUND = 0.5
"""Points so far around a start are registered from it [m]."""
ROAD_DEVIATION = 0.07
"""Of the height of the road beside a box [m]; swept: 0.05 and 0.1 are as good, 0.2 drifts."""
JUMP_COST = 0.02
"""Of a unit of squared Mahalanobis distance, in score, up to `MOST_JUMP` of these; chosen: a pose
at the limit of a jump has to fit a fifth better than one at the prediction."""
MOST_JUMP = 10.0
SEARCH_BELOW = 0.85
"""An object with a smaller part of its usual score is searched along the heading; chosen."""
MIN_POINTS_TO_SEARCH = 30
"""But not by fewer points, whose score is noise; chosen: as `MOST`."""
MIN_FIT_AGAIN = 0.6
"""Part of the points that fit, to find an object again after a loss."""
MIN_SCORE_AGAIN = 0.5
"""And of their score before the loss, as a running mean."""


@kernel
def find(
    points, prior, information, step, count, is_lost, usual, road, tilt, half, clearance, slots,
    means, normals, used,
):  # fmt: skip
    """
    Return the pose of an object in a sweep, and its tests, as `registered`.

    By the `points` (n, 3) around its prediction `prior` (4,). After a loss, and where it fits
    worse than usual, by 2 `count` further starts, each `step` [m] along the heading; `usual` is
    the running mean of its score, `road` the height of the road above its bottom.

    """
    prior, information = prior.copy(), information.copy()
    own = _around(points, prior, half)
    height = road_below(own, prior, tilt, half) - road
    if np.isfinite(height):
        weight = ROAD_DEVIATION**-2
        prior[2] += height * weight / (information[2, 2] + weight)
        information[2, 2] += weight
    best = registered(
        own, prior, prior, information, tilt, half, clearance, slots, means, normals, used, 12
    )
    slips = best[2][0] > MIN_POINTS_TO_SEARCH and best[2][3] < SEARCH_BELOW * usual
    if is_lost or slips:
        for n in range(-count, count + 1):
            start = prior.copy()
            start[0] += n * step * np.cos(prior[3])
            start[1] += n * step * np.sin(prior[3])
            own = _around(points, start, half)
            if n == 0 or len(own) < MIN_POINTS:
                continue
            other = registered(
                own, start, prior, information, tilt, half, clearance, slots, means, normals, used,
                12,
            )  # fmt: skip
            if rank(other[2][3], other[3]) > rank(best[2][3], best[3]) + JUMP_COST:
                best = other
    pose, covariance, stats, jump, reason = best
    fits_badly = stats[1] < MIN_FIT_AGAIN * max(stats[2], 1.0)
    if is_lost and reason == ACCEPTED and (fits_badly or stats[3] < MIN_SCORE_AGAIN * usual):
        reason = NO_FIT
    return pose, covariance, stats, jump, reason


@kernel
def rank(score, jump):
    """Return a score, less what the distance from the prediction costs."""
    return score - JUMP_COST * min(jump, MOST_JUMP)


@kernel
def _around(points, pose, half):
    """Return the points (n, 3) `AROUND` a pose."""
    reach = np.hypot(half[0], half[1]) + CROP + AROUND
    found = np.empty_like(points)
    count = 0
    for n in range(len(points)):
        if abs(points[n, 0] - pose[0]) >= reach or abs(points[n, 1] - pose[1]) >= reach:
            continue
        if abs(points[n, 2] - pose[2]) < half[2] + CROP_ABOVE:
            found[count] = points[n]
            count += 1
    return found[:count]


@kernel
def registered(
    points, start, prior, information, tilt, half, clearance, slots, means, normals, used,
    iterations,
):  # fmt: skip
    """
    Return the pose of a box (4,) x y z yaw that puts points on its surface, and its tests.

    Parameters: `points` (n, 3) of the sweep, `start` and `prior` (4,) with the `information`
    (4, 4) of the prior, `tilt` (3, 3) the rotation by roll and pitch, `half` extents (3,), the
    height `clearance` above the bottom under which points are of the road, and the map of the
    surface.

    Returned: pose (4,), covariance (4, 4), statistics as of `fit`, the squared Mahalanobis
    distance from the prior, and the index of the reason in `REASONS`.

    """
    points = np.ascontiguousarray(points[:: 1 + len(points) // MAX_SWEEP_POINTS])
    pose = start.copy()
    total = information.copy()
    for _ in range(iterations):
        H, g, count = _system(points, pose, tilt, half, clearance, slots, means, normals)
        if count < MIN_POINTS:
            break
        total = H + information
        gradient = g + information @ (pose - prior)
        step = np.linalg.solve(total, gradient)
        size = np.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
        if size > 0.3:
            step *= 0.3 / size
        pose = pose - step
        if size < 1e-3 and abs(step[3]) < 5e-4:
            break
    stats = fit(points, pose, tilt, half, clearance, slots, means, normals, used)
    covariance = np.linalg.inv(total)
    off = pose - prior
    jump = off @ information @ off
    return pose, covariance, stats, jump, _reason(pose, covariance, stats, jump)


@kernel
def _reason(pose, covariance, stats, jump):
    """Return why a pose is not accepted, an index of `REASONS`."""
    inside, fitting, matched = stats[0], stats[1], stats[2]
    if fitting < MIN_POINTS:
        return FEW_POINTS
    if fitting < MIN_FIT * matched or matched < MIN_SEEN * inside:
        return NO_FIT
    c, s = np.cos(pose[3]), np.sin(pose[3])
    along = c * c * covariance[0, 0] + s * s * covariance[1, 1] + 2 * c * s * covariance[0, 1]
    if along > MAX_DEVIATION**2 or covariance[3, 3] > MAX_YAW_DEVIATION**2:
        return UNCERTAIN
    return JUMP if jump > MAX_JUMP else ACCEPTED


@kernel
def _system(points, pose, tilt, half, clearance, slots, means, normals):
    """Return the normal equations (4, 4) and (4,) of the points at a pose, and their number."""
    H = np.zeros((4, 4))
    g = np.zeros(4)
    R = axes(pose, tilt)
    J = np.empty(4)
    weights = 0.0
    n_outside = 0.0
    count = 0
    for n in range(len(points)):
        dx = points[n, 0] - pose[0]
        dy = points[n, 1] - pose[1]
        dz = points[n, 2] - pose[2]
        x, y, z = in_frame(dx, dy, dz, R)
        if abs(x) > half[0] + MARGIN or abs(y) > half[1] + MARGIN or z > half[2] + MARGIN:
            continue
        if z < clearance - half[2]:
            continue
        count += 1
        slot = nearest(x, y, z, slots, means, REACH)
        if slot >= 0:
            nx, ny, nz = normals[slot]
            if nx == 0 and ny == 0 and nz == 0:
                continue
            mx, my, mz = means[slot]
            r = nx * (x - mx) + ny * (y - my) + nz * (z - mz)
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
    return H, g, count


@kernel
def fit(points, pose, tilt, half, clearance, slots, means, normals, used):
    """
    Return points in the box, those that fit, those near the surface, and a score.

    The score is the harmonic mean of the part of the points, with those beside the box, that fit,
    and of the part of the surface that they hit; 0 for fewer than three points.

    """
    R = axes(pose, tilt)
    hit = np.zeros(used[0], np.bool_)
    inside, fitting, beside, matched = 0.0, 0.0, 0.0, 0.0
    for n in range(len(points)):
        dx = points[n, 0] - pose[0]
        dy = points[n, 1] - pose[1]
        dz = points[n, 2] - pose[2]
        x, y, z = in_frame(dx, dy, dz, R)
        if z < clearance - half[2] or z > half[2] + OUTSIDE_TOLERANCE:
            continue
        out = max(abs(x) - half[0], abs(y) - half[1])
        if out > OUTSIDE_TOLERANCE:
            if out < MARGIN and not is_foreign(x, y, z, slots):
                beside += 1
            continue
        inside += 1
        slot = nearest(x, y, z, slots, means, REACH)
        if slot < 0:
            continue
        hit[slot] = True
        matched += 1
        nx, ny, nz = normals[slot]
        mx, my, mz = means[slot]
        r = nx * (x - mx) + ny * (y - my) + nz * (z - mz)
        if abs(r) < FIT:
            fitting += 1
    score = 0.0
    if inside >= 3:
        part = fitting / (inside + beside)
        seen = hit.sum() / max(1.0, used[0])
        score = 2 * part * seen / max(part + seen, 1e-9)
    return np.array([inside, fitting, matched, score])


@kernel
def near(points, pose, half, margin, boxes, same):
    """
    Return the points (n, 3), which ascend by x, around a pose, without those of other objects.

    `boxes` (m, 16) have centre, half extents, axes and number of each of these. Not left out are
    the points of one whose centre is in the box (it is the object itself), or with a number in
    `same`.

    """
    reach = np.hypot(half[0], half[1]) + CROP + margin
    first = np.searchsorted(points[:, 0], pose[0] - reach)
    last = np.searchsorted(points[:, 0], pose[0] + reach)
    found = np.empty((last - first, 3))
    count = 0
    for n in range(first, last):
        if abs(points[n, 1] - pose[1]) >= reach:
            continue
        if abs(points[n, 2] - pose[2]) < half[2] + CROP_ABOVE:
            found[count, 0] = points[n, 0]
            found[count, 1] = points[n, 1]
            found[count, 2] = points[n, 2]
            count += 1
    found = found[:count]
    reach += BESIDE
    for k in range(len(boxes)):
        other = boxes[k]
        away = np.hypot(other[0] - pose[0], other[1] - pose[1])
        is_near = half[1] < away < reach + np.hypot(other[3], other[4])
        if is_near and not (same == other[15]).any():
            found = _outside(found, other[:3], other[3:6], other[6:15].reshape(3, 3))
    return found


@kernel
def in_frame(x, y, z, R):
    """Return a vector in the axes of a box, the columns of R (3, 3)."""
    return (
        R[0, 0] * x + R[1, 0] * y + R[2, 0] * z,
        R[0, 1] * x + R[1, 1] * y + R[2, 1] * z,
        R[0, 2] * x + R[1, 2] * y + R[2, 2] * z,
    )


@kernel
def axes(pose, tilt):
    """Return the axes of a box as columns (3, 3)."""
    c, s = np.cos(pose[3]), np.sin(pose[3])
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ tilt


@kernel
def in_box(points, pose, tilt, half, clearance, margin):
    """Return points (n, 3) within `margin` of a box and above the road, in the box frame."""
    R = axes(pose, tilt)
    found = np.empty((len(points), 3))
    count = 0
    for n in range(len(points)):
        x, y, z = in_frame(
            points[n, 0] - pose[0], points[n, 1] - pose[1], points[n, 2] - pose[2], R
        )
        if abs(x) >= half[0] + margin or abs(y) >= half[1] + margin:
            continue
        if clearance - half[2] < z < half[2] + margin:
            found[count, 0], found[count, 1], found[count, 2] = x, y, z
            count += 1
    return found[:count]


@kernel
def learn(points, pose, tilt, half, clearance, margin, slots, means, normals, used, moments):
    """Add the points (n, 3) in a box to the map of its surface; return their number."""
    inside = in_box(points, pose, tilt, half, clearance, margin)
    insert(inside, half, slots, means, normals, used, moments)
    return len(inside)


@kernel
def road_below(points, pose, tilt, half):
    """Return the height of the road above the bottom of a box; NaN without points of it [m]."""
    R = axes(pose, tilt)
    heights = np.empty(len(points))
    count = 0
    for n in range(len(points)):
        x, y, z = in_frame(
            points[n, 0] - pose[0], points[n, 1] - pose[1], points[n, 2] - pose[2], R
        )
        out = max(abs(x) - half[0], abs(y) - half[1])
        height = z + half[2]
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
def _outside(points, center, half, R):
    """Return the points (n, 3) that are not in a box, in place."""
    count = 0
    for n in range(len(points)):
        x, y, z = in_frame(
            points[n, 0] - center[0], points[n, 1] - center[1], points[n, 2] - center[2], R
        )
        if abs(x) > half[0] or abs(y) > half[1] or abs(z) > half[2]:
            points[count] = points[n]
            count += 1
    return points[:count]
