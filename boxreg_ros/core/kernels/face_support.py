"""
The outermost points on each face of each box, as their second moments, in plain loops.

The torch twin is `boxreg_ros.core.face_support.support`.

"""

from math import ceil

from boxreg_ros.core.kernels.compile import kernel
from boxreg_ros.core.kernels.rotation import fill_rotation
import numpy as np

FACES = 5  # front, back, left, right, top: the road stands for the bottom
STRIPS = 3
SECOND_AXIS = (1, 1, 0, 0, 1)
NOWHERE = 1e9


@kernel
def add_candidate(depth, index, best_depth, best_index, count):
    """Insert a point into the `count` smallest depths, ascending; of equal ones the first stays."""
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
def fill_depths(local, half, level, limits, excess, strip, depth):
    """
    Write how far inside of the expected surface of each face each point is, (5, M) [m].

    Points that are beside a face, or too deep to be on it, are at `NOWHERE`. Writes the strips
    (2, M) too; returns how many points are in and near the box.

    """
    margin, beside, behind, deepest, fewest = limits
    M = local.shape[1]
    for k in range(3):
        for i in range(M):
            excess[k, i] = abs(local[k, i]) - half[k]
    near = 0
    for i in range(M):
        near += (excess[0, i] < margin) & (excess[1, i] < margin) & (excess[2, i] < margin)
    for k in range(2):
        scale = STRIPS / 2 / half[k]
        for i in range(M):
            place = (local[k, i] + half[k]) * scale
            strip[k, i] = (place >= 1.0) + (place >= 2.0)
    for face in range(FACES):
        axis = face // 2
        one = 1 if axis == 0 else 0
        other = 1 if axis == 2 else 2
        sign = 1.0 - 2.0 * (face % 2)
        surface = half[axis] - level[face]
        for i in range(M):
            d = max(surface - sign * local[axis, i], -1.0)
            counts = (excess[one, i] <= beside) & (excess[other, i] <= beside) & (d < deepest)
            depth[face, i] = d if counts else NOWHERE
    return near


@kernel
def support_of_box(points, depth, strip, wanted, limits, best_depth, best_index, moments, out):
    """
    Find the outermost points of the five faces of one box.

    Writes their second moments (5, 4, 4) and mean depth (5,); returns how many stand for each
    face.

    """
    margin, beside, behind, deepest, fewest = limits
    number = np.zeros(FACES, np.int64)
    best_depth[:, :wanted] = NOWHERE
    for face in range(FACES):
        own_strip = strip[SECOND_AXIS[face]]
        best_depth[:, :wanted] = NOWHERE
        for i in range(len(points)):
            d = depth[face, i]
            if d < best_depth[own_strip[i], wanted - 1]:
                add_candidate(d, i, best_depth[own_strip[i]], best_index[own_strip[i]], wanted)
        limit = deepest
        for s in range(STRIPS):
            limit = min(limit, best_depth[s, 0] + behind)
        total = 0.0
        moment = moments[face]
        for a in range(4):
            for b in range(4):
                moment[a, b] = 0.0
        for s in range(STRIPS):
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
def support(
    first, last, poses, given, extents, gaps, inset, base_weight, ground, points, counts, stride,
    share, limits, moments, distance, weight, near,
):  # fmt: skip
    """
    Write face observations of the windows `first` to `last`: see `face_support.support`.

    `moments` (B, N, 6, 4, 4), signed distance (B, N, 6), weight (B, N, 6) and number of points in
    and near the box (B, N). `counts` (B, N) of the points are real, every `stride`-th is used.

    """
    most = 1 + (points.shape[2] - 1) // stride if points.shape[2] else 0
    size = int(ceil(max(float(limits[4]), share * most))) + 1
    best_depth = np.empty((STRIPS, size))
    best_index = np.empty((STRIPS, size), np.int64)
    local = np.empty((3, most))
    excess = np.empty((3, most))
    strip = np.empty((2, most), np.int64)
    depth = np.empty((FACES, most))
    R = np.empty((3, 3))
    half = np.empty(3)
    shift = np.empty(3)
    level = np.empty(6)
    mean_depth = np.empty(FACES)
    for b in range(first, last):
        for k in range(3):
            half[k] = extents[b, k] / 2
        for n in range(poses.shape[1]):
            pose = poses[b, n]
            fill_rotation(pose[3], pose[4], pose[5], R)
            for k in range(3):
                shift[k] = pose[k] - given[b, n, k]
            for face in range(6):
                level[face] = gaps[b, face] + inset[b, n, face]
            M = (counts[b, n] + stride - 1) // stride
            p = points[b, n, : counts[b, n] : stride]
            to_box_axes(p, shift, R, local[:, :M])
            near[b, n] = fill_depths(
                local[:, :M], half, level, limits, excess[:, :M], strip[:, :M], depth[:, :M]
            )
            wanted = int(ceil(max(float(limits[4]), share * near[b, n])))
            number = support_of_box(
                p, depth, strip, wanted, limits, best_depth, best_index, moments[b, n], mean_depth
            )
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
