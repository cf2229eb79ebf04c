"""Registration of the points of one sweep to the surface of one object."""

from math import hypot
from typing import Any, NamedTuple

from boxreg_ros.core.method.arrays import copy
from boxreg_ros.core.method.arrowhead import factorise_corner, invert, solve_corner
from boxreg_ros.core.method.compile import kernel, loop
from boxreg_ros.core.method.crop import flat_height
from boxreg_ros.core.method.follow_numbers import IN_KERNELS as FOLLOW
from boxreg_ros.core.method.surface import insert, insert_foreign, is_foreign, nearest_cell
from boxreg_ros.core.method.turn_rate import pose_information
import numpy as np

REASONS = ('', 'few_points', 'no_fit', 'uncertain', 'jump')
"""Why a pose is not accepted."""
ACCEPTED, FEW_POINTS, NO_FIT, UNCERTAIN, JUMP = range(len(REASONS))


class Target(NamedTuple):
    """An object that is followed."""

    half: Any
    """Half its extents (3,) [m]."""
    tilt: Any
    """Rotation by roll and pitch (3, 3)."""
    road: Any
    """How the road is found, and how high above it points are of the object: `CropNumbers`."""
    surface: Any
    """What has been seen of it."""
    is_rigid: bool
    """Whether it fits its surface at any time: limbs move."""


class Expected(NamedTuple):
    """Where an object is expected."""

    state: Any
    """By its motion."""
    reach: float
    """How far along the heading it is searched after a loss [m]; 0 while it is seen."""
    usual: float
    """Running mean of the score."""
    road: float
    """Height of the road above the bottom of the box [m]; NaN if unknown."""


class Fit(NamedTuple):
    """
    How the points of a sweep fit a pose.

    Points in the box, those that fit, those near the surface, and a score: the harmonic mean of
    the part of the points, with those beside the box, that fit, and of the part of the surface
    that they hit; 0 for fewer than three points.

    """

    inside: float
    fitting: float
    matched: float
    score: float

    @property
    def part(self) -> float:
        """Part of the points near the surface that fit it."""
        return self.fitting / max(self.matched, 1.0)


class Registered(NamedTuple):
    """A pose (4,), its covariance (4, 4), fit, rank, and reason of `REASONS`."""

    pose: Any
    covariance: Any
    fit: Any
    rank: float
    """Score of the fit, less what the distance from the prediction costs."""
    reason: int


@kernel
def find(points, expected, target):
    """
    Return the pose of an object by the points (n, 3) around its prediction, as `registered`.

    After a loss, and where it fits worse than usual, it is searched along the heading: in steps of
    a cell while it is seen, since points further from the surface have hardly any weight, and with
    the deviations of the prediction of a rigid one widened by as much as it fits worse.

    """
    prior, information = expected.state.values[:4].copy(), pose_information(expected.state)
    own = around(points, prior, target.half, FOLLOW.around)
    height = road_below(own, prior, target) - expected.road
    if np.isfinite(height):
        weight = 1 / FOLLOW.road_deviation**2
        prior[2] += height * weight / (information[2, 2] + weight)
        information[2, 2] += weight
    best = registered(own, prior, prior, information, target, FOLLOW.max_steps)
    is_lost = expected.reach > 0
    slips = best.fit.inside > FOLLOW.effective_points
    slips = slips and best.fit.score < FOLLOW.search_below * expected.usual
    if is_lost or slips:
        step, count = FOLLOW.cell, 2
        if is_lost:
            step = 2 * FOLLOW.cell
            count = int(expected.reach / step)
        elif target.is_rigid:
            scale(information, (best.fit.score / expected.usual) ** 2)
        for n in range(-count, count + 1):
            start = prior.copy()
            start[0] += n * step * np.cos(prior[3])
            start[1] += n * step * np.sin(prior[3])
            own = around(points, start, target.half, FOLLOW.around)
            if (n == 0 and is_lost) or len(own) < FOLLOW.min_points:
                continue
            other = registered(own, start, prior, information, target, FOLLOW.max_steps)
            if other.rank > best.rank + FOLLOW.jump_cost:
                best = other
    if is_lost and best.reason == ACCEPTED:
        fits = best.fit.fitting >= FOLLOW.min_sure_fit * max(best.fit.matched, 1.0)
        if not fits or best.fit.score < FOLLOW.min_score_again * expected.usual:
            return Registered(best.pose, best.covariance, best.fit, best.rank, NO_FIT)
    return best


@kernel
def fitted(points, state, target, iterations):
    """Return the pose of an object by points (n, 3) near it, from its prediction alone."""
    pose = state.values[:4]
    return registered(points, pose, pose, pose_information(state), target, iterations)


@kernel
def registered(points, start, prior, information, target, iterations):
    """
    Return the pose of a box x y z yaw that puts points (n, 3) on its surface, and its tests.

    From a `start` (4,), with the `information` (4, 4) of the pose `prior` (4,).

    """
    points = np.ascontiguousarray(points[:: 1 + len(points) // FOLLOW.max_sweep_points])
    pose = start.copy()
    total, factor = information.copy(), information.copy()
    for _ in range(iterations):
        H, step, count = _system(points, pose, target)
        if count < FOLLOW.min_points:
            break
        for a in range(4):
            for b in range(4):
                total[a, b] = factor[a, b] = H[a, b] + information[a, b]
                step[a] += information[a, b] * (pose[b] - prior[b])
        factorise_corner(factor)
        solve_corner(factor, step)
        size = np.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
        part = min(1.0, 2 * FOLLOW.cell / max(size, 1e-9))
        for a in range(4):
            step[a] *= part
            pose[a] -= step[a]
        if size < FOLLOW.settled and abs(step[3]) < FOLLOW.settled_yaw:
            break
    found = fit(points, pose, target)
    invert(total)
    jump = 0.0
    for a in range(4):
        for b in range(4):
            jump += (pose[a] - prior[a]) * information[a, b] * (pose[b] - prior[b])
    rank = found.score - FOLLOW.jump_cost * min(jump, FOLLOW.max_jump)
    return Registered(pose, total, found, rank, _reason(pose, total, found, jump))


@kernel
def _reason(pose, covariance, found, jump):
    """Return why a pose is not accepted, an index of `REASONS`."""
    if found.fitting < FOLLOW.min_points:
        return FEW_POINTS
    fits = found.fitting >= FOLLOW.min_fit * found.matched
    if not fits or found.matched < FOLLOW.min_seen * found.inside:
        return NO_FIT
    c, s = np.cos(pose[3]), np.sin(pose[3])
    along = c * c * covariance[0, 0] + s * s * covariance[1, 1] + 2 * c * s * covariance[0, 1]
    if along > FOLLOW.max_deviation**2 or covariance[3, 3] > FOLLOW.max_yaw_deviation**2:
        return UNCERTAIN
    return JUMP if jump > FOLLOW.max_jump else ACCEPTED


@kernel
def _system(points, pose, target):
    """Return the normal equations (4, 4) and (4,) of the points at a pose, and their number."""
    half, surface, slots = target.half, target.surface, target.surface.slots
    H = np.zeros((4, 4))
    g = np.zeros(4)
    R = axes(pose, target.tilt)
    J = np.empty(4)
    weights = 0.0
    count = 0
    for n in range(len(points)):
        dx, dy, x, y, z = offset_in_box(points, n, pose, R)
        out_x, out_y = abs(x) - half[0], abs(y) - half[1]
        if max(out_x, out_y, z - half[2]) > FOLLOW.margin or z < target.road.clearance - half[2]:
            continue
        count += 1
        nx, ny, nz = 0.0, 0.0, 0.0
        slot = nearest_cell(x, y, z, surface)
        if slot >= 0:
            nx, ny, nz = surface.normals[slot]
            if nx == 0 and ny == 0 and nz == 0:
                continue
            r = from_surface(x, y, z, slot, surface)
            robust = 1 / (1 + (r / FOLLOW.outlier) ** 2) ** 2
            w = robust / FOLLOW.deviation**2
            weights += robust
        else:
            r = max(out_x, out_y) - FOLLOW.tolerance
            if r <= 0 or z > half[2] or is_foreign(x, y, z, slots):
                continue
            if out_x > out_y:
                nx = np.sign(x)
            else:
                ny = np.sign(y)
            w = (1 - min(1.0, r / (FOLLOW.margin - FOLLOW.tolerance)) ** 2) ** 2
            w /= (3 * FOLLOW.deviation) ** 2
            weights += 1.0
        wx = R[0, 0] * nx + R[0, 1] * ny + R[0, 2] * nz
        wy = R[1, 0] * nx + R[1, 1] * ny + R[1, 2] * nz
        J[0], J[1] = -wx, -wy
        J[2] = -(R[2, 0] * nx + R[2, 1] * ny + R[2, 2] * nz)
        J[3] = wx * dy - wy * dx
        for a in range(4):
            g[a] += w * J[a] * r
            for b in range(4):
                H[a, b] += w * J[a] * J[b]
    part = FOLLOW.effective_points / max(weights, FOLLOW.effective_points)
    scale(H, part)
    for a in range(4):
        g[a] *= part
    return H, g, count


@loop
def scale(matrix, factor):
    """Multiply a matrix (4, 4) by a number, in place."""
    for a in range(4):
        for b in range(4):
            matrix[a, b] *= factor


@loop
def from_surface(x, y, z, slot, surface):
    """Return the signed distance of a place of the box frame from a piece of the surface [m]."""
    nx, ny, nz = surface.normals[slot]
    mx, my, mz = surface.means[slot]
    return nx * (x - mx) + ny * (y - my) + nz * (z - mz)


@kernel
def fit(points, pose, target):
    """Return how points (n, 3) fit a pose, `Fit`."""
    half, surface, slots = target.half, target.surface, target.surface.slots
    R = axes(pose, target.tilt)
    is_hit = np.zeros(surface.used[0], np.bool_)
    inside, fitting, beside, matched, hit = 0.0, 0.0, 0.0, 0.0, 0.0
    for n in range(len(points)):
        _, _, x, y, z = offset_in_box(points, n, pose, R)
        if z < target.road.clearance - half[2] or z > half[2] + FOLLOW.tolerance:
            continue
        out = max(abs(x) - half[0], abs(y) - half[1])
        if out > FOLLOW.tolerance:
            if out < FOLLOW.margin and not is_foreign(x, y, z, slots):
                beside += 1
            continue
        inside += 1
        slot = nearest_cell(x, y, z, surface)
        if slot >= 0:
            hit += not is_hit[slot]
            is_hit[slot] = True
            matched += 1
            fitting += abs(from_surface(x, y, z, slot, surface)) < FOLLOW.outlier
    score = 0.0
    if inside >= 3:
        part = fitting / (inside + beside)
        seen = hit / max(1.0, surface.used[0])
        score = 2 * part * seen / max(part + seen, 1e-9)
    return Fit(inside, fitting, matched, score)


@kernel
def score(points, pose, target):
    """Return how well points (n, 3) fit a pose, see `Fit`."""
    return fit(points, pose, target).score


@kernel
def around(points, pose, half, margin):
    """Return the points (n, 3), which ascend by x, around a pose."""
    reach = hypot(half[0], half[1]) + FOLLOW.crop + margin
    return within(points, pose, reach, half[2] + FOLLOW.crop)


@kernel
def within(points, center, reach, height):
    """Return the points (n, 3), which ascend by x, within `reach` in x and y, `height` in z."""
    first = first_from(center[0] - reach, points)
    last = first_from(center[0] + reach, points)
    found = np.empty((last - first, 3))
    count = 0
    for n in range(first, last):
        if abs(points[n, 1] - center[1]) >= reach:
            continue
        if abs(points[n, 2] - center[2]) < height:
            found[count, 0] = points[n, 0]
            found[count, 1] = points[n, 1]
            found[count, 2] = points[n, 2]
            count += 1
    return found[:count]


@loop
def first_from(x, points):
    """Return the first of points (n, 3), which ascend by x, that is not below x."""
    first, last = 0, len(points)
    while first < last:
        middle = (first + last) // 2
        if points[middle, 0] < x:
            first = middle + 1
        else:
            last = middle
    return first


@kernel
def near(points, pose, half, margin, boxes, same):
    """
    Return the points (n, 3) around a pose, without those of other objects.

    `boxes` (m, 16) have centre, half extents, axes and number of each of these. Not left out are
    the points of one whose centre is in the box (it is the object itself), or with a number in
    `same`.

    """
    found = around(points, pose, half, margin)
    reach = hypot(half[0], half[1]) + FOLLOW.crop + margin
    for k in range(len(boxes)):
        other = boxes[k]
        away = hypot(other[0] - pose[0], other[1] - pose[1])
        is_near = half[1] < away < reach + hypot(other[3], other[4])
        for number in same:
            is_near &= number != other[15]
        if is_near:
            found = _outside(found, other[:3], other[3:6], other[6:15].reshape(3, 3))
    return found


@kernel
def _outside(points, center, half, R):
    """Return the points (n, 3) that are not in a box, in place."""
    count = 0
    for n in range(len(points)):
        _, _, x, y, z = offset_in_box(points, n, center, R)
        if abs(x) > half[0] or abs(y) > half[1] or abs(z) > half[2]:
            copy(points[n], points[count])
            count += 1
    return points[:count]


@kernel
def axes(pose, tilt):
    """Return the axes of a box as columns (3, 3)."""
    c, s = np.cos(pose[3]), np.sin(pose[3])
    R = np.empty((3, 3))
    for k in range(3):
        R[0, k] = c * tilt[0, k] - s * tilt[1, k]
        R[1, k] = s * tilt[0, k] + c * tilt[1, k]
        R[2, k] = tilt[2, k]
    return R


@loop
def offset_in_box(points, n, center, R):
    """Return dx, dy of a point from the centre of a box, and x, y, z along the columns of R."""
    dx = points[n, 0] - center[0]
    dy = points[n, 1] - center[1]
    dz = points[n, 2] - center[2]
    x = R[0, 0] * dx + R[1, 0] * dy + R[2, 0] * dz
    y = R[0, 1] * dx + R[1, 1] * dy + R[2, 1] * dz
    z = R[0, 2] * dx + R[1, 2] * dy + R[2, 2] * dz
    return dx, dy, x, y, z


@kernel
def in_box(points, pose, target, margin):
    """Return points (n, 3) within `margin` of a box and above the road, in the box frame."""
    half = target.half
    R = axes(pose, target.tilt)
    found = np.empty((len(points), 3))
    count = 0
    for n in range(len(points)):
        _, _, x, y, z = offset_in_box(points, n, pose, R)
        is_inside = max(abs(x) - half[0], abs(y) - half[1], z - half[2]) < margin
        if is_inside and z > target.road.clearance - half[2]:
            found[count, 0], found[count, 1], found[count, 2] = x, y, z
            count += 1
    return found[:count]


@kernel
def learn(points, pose, target, is_seed, road):
    """
    Add the points (n, 3) in a box to the map of its surface; return their number and the road.

    Those beside the box of a seed are foreign. The road is its height above the bottom of the box
    [m], which is found by these points where it is NaN.

    """
    if is_seed:
        beside = in_box(points, pose, target, FOLLOW.margin)
        insert_foreign(beside, target.half, target.surface.slots)
    inside = in_box(points, pose, target, FOLLOW.tolerance)
    insert(inside, target.half, target.surface)
    return len(inside), road_below(points, pose, target) if np.isnan(road) else road


@kernel
def road_below(points, pose, target):
    """Return the height of the road above the bottom of a box; NaN without points of it [m]."""
    half, road = target.half, target.road
    R = axes(pose, target.tilt)
    heights = np.empty(len(points))
    count = 0
    for n in range(len(points)):
        _, _, x, y, z = offset_in_box(points, n, pose, R)
        out = max(abs(x) - half[0], abs(y) - half[1])
        if road.road_gap < out < road.road_width and abs(z + half[2]) < road.road_range:
            heights[count] = z + half[2]
            count += 1
    return flat_height(
        heights[:count], road.road_quantiles, road.road_flatness, road.min_road_points
    )
