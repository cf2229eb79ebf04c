"""
The outermost points on each face of each box, as their second moments, in plain loops.

The torch twin is `boxreg_ros.core.face_support.observe_faces_torch`; the formulas are (M10) to
(M12).

"""

from math import ceil, inf, isfinite, isnan, sqrt

from boxreg_ros.core.kernels.compile import kernel
from boxreg_ros.core.kernels.rotation import fill_rotation
import numpy as np

EXTENT, GAP = 0, 9
"""First of the shared variables of each kind."""
FACES = 5
"""Front, back, left, right, top: the bottom is observed by the road."""
BOTTOM = 5
NOWHERE = 1e9
"""Depth of points that are not on a face [m]."""
ALWAYS_VISIBLE = 9.0
"""Tangent of the roof; that of the bottom is its negative."""
FAR_SENSOR = 1e6
"""Distance of an unknown sensor, over that of the centre of the points."""


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
def fill_depths(local, half, level, numbers, excess, strip, depth):
    """
    Write how far inside of the expected surface of each face each point is, (5, M) [m].

    Points that are beside a face, or too deep to be on it, are at `NOWHERE`. Writes the strips
    (2, M) too; returns how many points are in and near the box.

    """
    outside_margin, edge_margin, deepest = (
        numbers.outside_margin, numbers.edge_margin, numbers.deepest
    )  # fmt: skip
    strips = numbers.strips
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
def outermost_points(points, depth, strip, wanted, numbers, best_depth, best_index, moments, out):
    """
    Find the outermost points of the five faces of one box.

    Writes their second moments (5, 4, 4) and mean depth (5,); returns how many stand for each
    face.

    """
    number = np.zeros(FACES, np.int64)
    for face in range(FACES):
        own_strip = strip[numbers.strip_axis[face]]
        best_depth[:, :wanted] = NOWHERE
        for i in range(len(points)):
            d = depth[face, i]
            if d < best_depth[own_strip[i], wanted - 1]:
                add_candidate(d, i, best_depth[own_strip[i]], best_index[own_strip[i]], wanted)
        limit = numbers.deepest
        for s in range(len(best_depth)):
            limit = min(limit, best_depth[s, 0] + numbers.max_depth)
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
def returns_of(windows, values, b, n):
    """Return the values of the points of one observation."""
    first = windows.first[b, n]
    return values[first : first + windows.counts[b, n] * windows.stride : windows.stride]


@kernel
def centre_of(points, centre):
    """Write the mean of points (M, 3); zero without points."""
    centre[:] = 0.0
    for i in range(len(points)):
        for k in range(3):
            centre[k] += points[i, k]
    for k in range(3):
        centre[k] /= max(len(points), 1)


@kernel
def fill_visibility(box, origins, points, numbers, R, toward, tangent):
    """Write the visibility of each face of one input box from its best sensor, (6,)."""
    fill_rotation(box[6], box[7], box[8], R)
    tangent[:4] = -inf
    for sensor in range(len(origins)):
        raise_visibility(box, origins[sensor], points, numbers, R, toward, tangent)
    tangent[4] = ALWAYS_VISIBLE
    tangent[5] = -ALWAYS_VISIBLE


@kernel
def raise_visibility(box, origin, points, numbers, R, toward, tangent):
    """Raise the visibility of the upright faces to that from one sensor."""
    if isfinite(origin[0]) and isfinite(origin[1]) and isfinite(origin[2]):
        for k in range(3):
            toward[k] = origin[k]
    else:
        centre_of(points, toward)
        for k in range(3):
            toward[k] *= FAR_SENSOR
    for face in range(4):
        axis = face // 2
        sign = 1.0 - 2.0 * (face % 2)
        outward = -box[3 + axis] / 2
        along = 0.0
        for k in range(3):
            outward += sign * toward[k] * R[k, axis]
            along += toward[k] * R[k, 1 - axis]
        along = abs(along) - box[4 - axis] / 2
        tangent[face] = max(tangent[face], outward / max(along, numbers.min_along))


@kernel
def fill_insets(origins, tangent, occlusion_inset, range_inset, numbers, shares, inset, weight):
    """Write the shares (2, 6) of the two insets, their sum (6,), and the weights of faces (6,)."""
    reach = sqrt(origins[0, 0] ** 2 + origins[0, 1] ** 2)
    for sensor in range(1, len(origins)):
        reach = min(reach, sqrt(origins[sensor, 0] ** 2 + origins[sensor, 1] ** 2))
    beyond = 0.0 if isnan(reach) else (reach - numbers.near_range) / numbers.range_span
    beyond = min(max(beyond, 0.0), numbers.max_range_share)
    for face in range(6):
        u = tangent[face] + numbers.edge_lead[face]
        occluded = 0.5 - 0.5 * u / sqrt(u**2 + numbers.softness)
        shares[0, face] = occluded
        shares[1, face] = (1.0 - occluded) * beyond
        by_range = shares[1, face] * range_inset[face]
        inset[face] = occluded * occlusion_inset[face] + by_range
        seen = 1.0 if tangent[face] > 0.0 else numbers.occluded_weight
        weight[face] = seen / (1.0 + (by_range / numbers.range_half_weight) ** 2)


@kernel
def fill_velocity(poses, times, n, length, velocity):
    """Write the velocity (3,) of pose n: the mean over the steps before and after it."""
    before = max(n - 1, 0)
    after = min(n + 1, length - 1)
    duration = max(times[after] - times[before], 1e-9)
    for k in range(3):
        velocity[k] = (poses[after, k] - poses[before, k]) / duration


@kernel
def to_box_axes(points, delays, velocity, shift, R, moved, local):
    """
    Write points at the stamp of their box (M12), (M, 3), and in its axes, (3, M) [m].

    The box is `shift` (3,) from the origin of the points.

    """
    for i in range(len(points)):
        for k in range(3):
            moved[i, k] = points[i, k] - velocity[k] * delays[i]
        x = moved[i, 0] - shift[0]
        y = moved[i, 1] - shift[1]
        z = moved[i, 2] - shift[2]
        local[0, i] = R[0, 0] * x + R[1, 0] * y + R[2, 0] * z
        local[1, i] = R[0, 1] * x + R[1, 1] * y + R[2, 1] * z
        local[2, i] = R[0, 2] * x + R[1, 2] * y + R[2, 2] * z


@kernel
def add_road(shift, ground, half_height, gap, moment, distance):
    """Write the observation of the bottom: a point of the road under the centre of the box."""
    road = ground if isfinite(ground) else 0.0
    point = (shift[0], shift[1], road, 1.0)
    for a in range(4):
        for b in range(4):
            moment[a, b] = point[a] * point[b]
    distance[BOTTOM] = shift[2] - road - half_height + gap


@kernel
def observe_faces(
    begin, end, windows, poses, shared, occlusion_inset, range_inset, numbers, faces
):
    """
    Write the face observations of the windows `begin` to `end`.

    Parameters
    ----------
    begin, end : int
        First window, and the one after the last.
    windows : WindowArrays
        Input of the windows.
    poses, shared : array, shapes (B, N, 6) and (B, 22)
        Boxes of this round.
    occlusion_inset, range_inset : array, shape (B, 6)
        As in `boxreg_ros.core.face_support.FaceOffsets` [m].
    numbers : FaceNumbers
        Constants and settings.
    faces : FaceArrays
        Written; zero for padding.

    """
    M = max(1, windows.counts[begin:end].max()) if end > begin else 1
    size = ceil(max(numbers.min_points, numbers.share * M)) + 1
    best_depth = np.empty((numbers.strips, size))
    best_index = np.empty((numbers.strips, size), np.int64)
    moved = np.empty((M, 3))
    local = np.empty((3, M))
    excess = np.empty((3, M))
    strip = np.empty((2, M), np.int64)
    depth = np.empty((FACES, M))
    R = np.empty((3, 3))
    half = np.empty(3)
    shift = np.empty(3)
    level = np.empty(6)
    toward = np.empty(3)
    tangent = np.empty(6)
    velocity = np.zeros(3)
    mean_depth = np.empty(FACES)
    for b in range(begin, end):
        length = windows.lengths[b]
        for k in range(3):
            half[k] = shared[b, EXTENT + k] / 2
        for n in range(poses.shape[1]):
            moments, distance, weight = (
                faces.moments[b, n],
                faces.distance[b, n],
                faces.weight[b, n],
            )
            inset, shares = faces.inset[b, n], faces.inset_shares[:, b, n]
            if n >= length:
                moments[:] = 0.0
                distance[:] = 0.0
                weight[:] = 0.0
                inset[:] = 0.0
                shares[:] = 0.0
                faces.num_points[b, n] = 0.0
                continue
            m = windows.counts[b, n]
            points = returns_of(windows, windows.points, b, n)
            box, pose, origins = windows.boxes[b, n], poses[b, n], windows.origins[b, n]
            fill_visibility(box, origins, points, numbers, R, toward, tangent)
            fill_insets(
                origins, tangent, occlusion_inset[b], range_inset[b], numbers, shares, inset,
                weight,
            )  # fmt: skip
            for k in range(3):
                shift[k] = pose[k] - box[k]
            for face in range(6):
                level[face] = shared[b, GAP + face] + inset[face]
            if numbers.is_moving:
                fill_velocity(poses[b], windows.times[b], n, length, velocity)
            fill_rotation(pose[3], pose[4], pose[5], R)
            to_box_axes(
                points, returns_of(windows, windows.delays, b, n), velocity, shift, R, moved[:m],
                local[:, :m],
            )  # fmt: skip
            near = fill_depths(
                local[:, :m], half, level, numbers, excess[:, :m], strip[:, :m], depth[:, :m]
            )
            wanted = ceil(max(numbers.min_points, numbers.share * near))
            number = outermost_points(
                moved[:m], depth, strip, wanted, numbers, best_depth, best_index, moments,
                mean_depth,
            )  # fmt: skip
            for face in range(FACES):
                distance[face] = -mean_depth[face]
                if number[face] < numbers.min_points:
                    weight[face] = 0.0
            add_road(
                shift,
                windows.ground[b, n],
                half[2],
                shared[b, GAP + BOTTOM],
                moments[BOTTOM],
                distance,
            )
            weight[BOTTOM] = 1.0 if isfinite(windows.ground[b, n]) else 0.0
            faces.num_points[b, n] = near


@kernel
def count_held(begin, end, windows, poses, extents, margin, is_moving, held):
    """
    Write how many points are in each box, or less than `margin` outside of it, (B, N).

    Boxes at `poses` (B, N, 6) of `extents` (B, N, 3); windows `begin` to `end`. With `is_moving`
    points are at the stamp of their box (M12).

    """
    R = np.empty((3, 3))
    velocity = np.zeros(3)
    shift = np.empty(3)
    for b in range(begin, end):
        for n in range(windows.lengths[b]):
            pose, extent, box = poses[b, n], extents[b, n], windows.boxes[b, n]
            fill_rotation(pose[3], pose[4], pose[5], R)
            if is_moving:
                fill_velocity(poses[b], windows.times[b], n, windows.lengths[b], velocity)
            for k in range(3):
                shift[k] = pose[k] - box[k]
            points = returns_of(windows, windows.points, b, n)
            delays = returns_of(windows, windows.delays, b, n)
            count = 0
            for i in range(len(points)):
                x = points[i, 0] - velocity[0] * delays[i] - shift[0]
                y = points[i, 1] - velocity[1] * delays[i] - shift[1]
                z = points[i, 2] - velocity[2] * delays[i] - shift[2]
                outside = -margin
                for k in range(3):
                    along = R[0, k] * x + R[1, k] * y + R[2, k] * z
                    outside = max(outside, abs(along) - extent[k] / 2)
                count += outside < margin
            held[b, n] = count
