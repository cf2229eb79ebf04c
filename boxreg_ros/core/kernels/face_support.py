"""
The outermost points on each face of each box, as their second moments, in plain loops.

The torch twin is `boxreg_ros.core.face_support.outermost_points`.

"""

from math import ceil

from boxreg_ros.core.kernels.compile import kernel
from boxreg_ros.core.kernels.rotation import fill_rotation
import numpy as np

FACES = 5
"""Front, back, left, right, top: the bottom is observed by the road."""
NOWHERE = 1e9
"""Depth of points that are not on a face [m]."""


@kernel
def add_candidate(depth, index, best_depth, best_index, count):
    """Insert a point into the `count` smallest depths, ascending; equal ones keep their order."""
    place = count - 1
    while place > 0 and depth < best_depth[place - 1]:
        best_depth[place] = best_depth[place - 1]
        best_index[place] = best_index[place - 1]
        place -= 1
    best_depth[place] = depth
    best_index[place] = index


@kernel
def to_box_axes(points, shift, R, local):
    """Write points (M, 3) in box axes (3, M); the box is `shift` (3,) from their origin [m]."""
    for i in range(len(points)):
        x = points[i, 0] - shift[0]
        y = points[i, 1] - shift[1]
        z = points[i, 2] - shift[2]
        local[0, i] = R[0, 0] * x + R[1, 0] * y + R[2, 0] * z
        local[1, i] = R[0, 1] * x + R[1, 1] * y + R[2, 1] * z
        local[2, i] = R[0, 2] * x + R[1, 2] * y + R[2, 2] * z


@kernel
def fill_depths(local, half, level, limits, strips, excess, strip, depth):
    """
    Write how far inside of the expected surface of each face each point is, (5, M) [m].

    Points that are beside a face, or too deep to be on it, are at `NOWHERE`. Writes the strips
    (2, M) too; returns how many points are in and near the box.

    """
    outside_margin, edge_margin, _, deepest, _ = limits
    M = local.shape[1]
    for k in range(3):
        for i in range(M):
            excess[k, i] = abs(local[k, i]) - half[k]
    near = 0
    for i in range(M):
        near += (
            (excess[0, i] < outside_margin)
            & (excess[1, i] < outside_margin)
            & (excess[2, i] < outside_margin)
        )
    for k in range(2):
        scale = strips / 2 / half[k]
        for i in range(M):
            place = min(max((local[k, i] + half[k]) * scale, 0.0), strips - 1.0)
            strip[k, i] = int(place)
    for face in range(FACES):
        axis = face // 2
        one = 1 if axis == 0 else 0
        other = 1 if axis == 2 else 2
        sign = 1.0 - 2.0 * (face % 2)
        surface = half[axis] - level[face]
        for i in range(M):
            d = surface - sign * local[axis, i]
            counts = (excess[one, i] <= edge_margin) & (excess[other, i] <= edge_margin)
            counts &= (d >= -outside_margin) & (d < deepest)
            depth[face, i] = d if counts else NOWHERE
    return near


@kernel
def outermost_points(
    points, depth, strip, strip_axis, wanted, limits, best_depth, best_index, moments, out
):
    """
    Find the outermost points of the five faces of one box.

    Writes their second moments (5, 4, 4) and mean depth (5,); returns how many stand for each
    face.

    """
    _, _, max_depth, deepest, _ = limits
    number = np.zeros(FACES, np.int64)
    for face in range(FACES):
        own_strip = strip[strip_axis[face]]
        best_depth[:, :wanted] = NOWHERE
        for i in range(len(points)):
            d = depth[face, i]
            if d < best_depth[own_strip[i], wanted - 1]:
                add_candidate(d, i, best_depth[own_strip[i]], best_index[own_strip[i]], wanted)
        limit = deepest
        for s in range(len(best_depth)):
            limit = min(limit, best_depth[s, 0] + max_depth)
        total = 0.0
        moment = moments[face]
        for a in range(4):
            for b in range(4):
                moment[a, b] = 0.0
        for s in range(len(best_depth)):
            for rank in range(wanted):
                if not best_depth[s, rank] <= limit:
                    break
                number[face] += 1
                total += best_depth[s, rank]
                p = points[best_index[s, rank]]
                for a in range(3):
                    for b in range(a, 3):
                        moment[a, b] += np.float64(p[a]) * p[b]
                    moment[a, 3] += p[a]
        if number[face]:
            for a in range(3):
                for b in range(a, 4):
                    moment[a, b] /= number[face]
                    moment[b, a] = moment[a, b]
            moment[3, 3] = 1.0
        out[face] = total / max(number[face], 1)
    return number


@kernel
def observe_faces(
    poses, given, extents, gaps, inset, base_weight, ground, points, counts, share, strip_axis,
    strips, limits, moments, distance, weight, near,
):  # fmt: skip
    """
    Write the face observations of all windows.

    Parameters
    ----------
    poses, given : array, shape (B, N, 6)
        Poses of this round and of the input.
    extents, gaps : array, shapes (B, 3) and (B, 6)
        Extents and labelling margins [m].
    inset, base_weight : array, shape (B, N, 6)
        How much further inside points are expected [m], and the weight of a face with points.
    ground : array, shape (B, N)
        Height of the road minus that of the input centre [m]; NaN if unknown.
    points, counts : array, shapes (B, N, M, 3) and (B, N)
        Points minus the input centre [m]; the first `counts` are not padding.
    share : float
        Part of the points of a box that is taken from each strip of a face.
    strip_axis, strips : tuple of int and int
        Axis along which the strips of each face lie, and their number.
    limits : tuple of float
        `OUTSIDE_MARGIN`, `EDGE_MARGIN`, `MAX_DEPTH`, largest depth, `MIN_POINTS`.
    moments, distance, weight, near : array
        Written: (B, N, 6, 4, 4), (B, N, 6) [m], (B, N, 6), and the points in and near each box
        (B, N).

    """
    B, N, M = points.shape[:3]
    size = ceil(max(limits[4], share * M)) + 1
    best_depth = np.empty((strips, size))
    best_index = np.empty((strips, size), np.int64)
    local = np.empty((3, M))
    excess = np.empty((3, M))
    strip = np.empty((2, M), np.int64)
    depth = np.empty((FACES, M))
    R = np.empty((3, 3))
    half = np.empty(3)
    shift = np.empty(3)
    level = np.empty(6)
    mean_depth = np.empty(FACES)
    for b in range(B):
        for k in range(3):
            half[k] = extents[b, k] / 2
        for n in range(N):
            pose = poses[b, n]
            fill_rotation(pose[3], pose[4], pose[5], R)
            for k in range(3):
                shift[k] = pose[k] - given[b, n, k]
            for face in range(6):
                level[face] = gaps[b, face] + inset[b, n, face]
            m = counts[b, n]
            to_box_axes(points[b, n, :m], shift, R, local[:, :m])
            near[b, n] = fill_depths(
                local[:, :m], half, level, limits, strips, excess[:, :m], strip[:, :m],
                depth[:, :m],
            )  # fmt: skip
            wanted = ceil(max(limits[4], share * near[b, n]))
            number = outermost_points(
                points[b, n, :m], depth, strip, strip_axis, wanted, limits, best_depth,
                best_index, moments[b, n], mean_depth,
            )  # fmt: skip
            for face in range(FACES):
                is_seen = number[face] >= limits[4]
                distance[b, n, face] = -mean_depth[face]
                weight[b, n, face] = base_weight[b, n, face] if is_seen else 0.0
            add_road(shift, ground[b, n], half[2], gaps[b, 5], moments[b, n, 5], distance[b, n])
            weight[b, n, 5] = base_weight[b, n, 5]


@kernel
def add_road(shift, ground, half_height, gap, moment, distance):
    """Write the observation of the bottom: a point of the road under the centre of the box."""
    road = ground if np.isfinite(ground) else 0.0
    point = (shift[0], shift[1], road, 1.0)
    for a in range(4):
        for b in range(4):
            moment[a, b] = point[a] * point[b]
    distance[5] = shift[2] - road - half_height + gap
