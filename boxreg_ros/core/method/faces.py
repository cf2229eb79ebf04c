"""
The outermost points on each face of each box, as their second moments, (M10) to (M12).

This is the correspondence search of every round.

"""

from math import ceil, inf, isfinite, isnan, sqrt
from typing import Any, NamedTuple

from boxreg_ros.core.method.arrays import BOTTOM, EXTENT, GAP, most_points, padded, TOP
from boxreg_ros.core.method.compile import kernel, loop, small_array
from boxreg_ros.core.method.residuals import TERMS
from boxreg_ros.core.method.rotation import fill_rotation
import numpy as np

FACES = 5
"""Front, back, left, right, top: the bottom is observed by the road."""
STRIP_AXIS = (1, 1, 0, 0, 1)
"""Box axis along which the strips of each of these lie side by side."""
INDICES = 2**17
"""Indices of points, below the units of a depth. Derived: `sampling.points` is less."""
DEPTH_UNITS = 2.0**35
"""Units of a depth per metre. Derived: with the index in 53 bits, those of a float, within 1 m."""
ALWAYS_VISIBLE = 9.0
"""Tangent of the roof; that of the bottom is its negative."""
FAR = 1e6
"""Coordinates of padding [m]. Derived: near no box."""
FAR_SENSOR = 1e6
"""Distance of an unknown sensor, over that of the centre of the points."""
MIN_ALONG = 0.5
"""Least distance along a face in the tangent of its visibility [m]. Chosen."""
NO_TERMS = np.zeros(1, TERMS)


@loop
def fill_candidates(depth, m, constants, candidates):
    """
    Write the depths of those of m points that may be outermost on a face; return how many.

    They are m with the padding, a multiple of `LANES`; its depth is infinite. Those further behind
    the outermost one than `max_depth` are on another surface.

    """
    behind = packed(constants.max_depth)
    a = b = c = d = packed(constants.deepest) - behind
    for i in range(0, m, 4):  # one minimum would wait for the one before
        a, b = min(a, depth[i]), min(b, depth[i + 1])
        c, d = min(c, depth[i + 2]), min(d, depth[i + 3])
    limit = min(min(a, b), min(c, d)) + behind
    count = 0
    for i in range(m):
        candidates[count] = depth[i]
        count += depth[i] <= limit
    return count


@loop
def packed(depth):
    """Return a depth [m] as a whole number, to which the index of a point is added."""
    return np.floor(depth * DEPTH_UNITS) * INDICES


@loop
def fill_depths(m, half, level, constants, work):
    """
    Write how far inside of the expected surface of each face each of m points is, (5, M).

    `packed` with their indices: points are ordered by depth. Points that are beside a face, or too
    deep to be on it, are at infinity. Writes the strips (2, M) too; returns how many points are in
    and near the box.

    """
    local, excess, strip, depth = work.local, work.excess, work.strip, work.depth
    outside_margin, edge_margin, deepest = (
        constants.outside_margin, constants.edge_margin, constants.deepest
    )  # fmt: skip
    strips = constants.strips
    for k in range(len(excess)):
        for i in range(m):
            excess[k, i] = abs(local[k, i]) - half[k]
    near = 0
    for i in range(m):
        near += (
            (excess[0, i] < outside_margin)
            & (excess[1, i] < outside_margin)
            & (excess[2, i] < outside_margin)
        )
    for k in range(len(strip)):
        scale = strips / 2 / half[k]
        for i in range(m):
            place = (local[k, i] + half[k]) * scale
            strip[k, i] = np.int32(min(max(0.0, place), strips - 1.0))  # 0 for NaN
    for face in range(len(depth)):
        axis = face // 2
        one = 1 if axis == 0 else 0
        other = 1 if axis == 2 else 2
        sign = 1.0 - 2.0 * (face % 2)
        surface = half[axis] - level[face]
        for i in range(m):
            d = surface - sign * local[axis, i]
            counts = (excess[one, i] <= edge_margin) & (excess[other, i] <= edge_margin)
            counts &= (d >= -outside_margin) & (d < deepest)
            depth[face, i] = packed(d) + work.index[i] if counts else inf
    return near


@loop
def outermost_points(m, wanted, constants, work, moments):
    """
    Find the outermost ones of m points on each of the five faces of one box.

    Writes their second moments (5, 4, 4), how many stand for each face, and their mean depth.

    """
    points, candidates, best = work.moved, work.candidates, work.best
    for face in range(FACES):
        own_strip, depth = work.strip[STRIP_AXIS[face]], work.depth[face]
        count = fill_candidates(depth, m, constants, candidates)
        for s in range(len(best)):
            for rank in range(wanted):
                best[s, rank] = inf
        for candidate in range(count):
            point = candidates[candidate]
            own = best[own_strip[np.int64(point) & (INDICES - 1)]]
            for place in range(wanted):  # without a branch: half would be predicted wrong
                here = own[place]
                own[place] = min(here, point)
                point = max(here, point)
        number, total = 0, 0.0
        x, y, z, xx, xy, xz, yy, yz, zz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for s in range(len(best)):
            for rank in range(wanted):
                point = best[s, rank]
                if point == inf:
                    break
                number += 1
                total += point
                i = np.int64(point) & (INDICES - 1)
                px, py, pz = points[0, i], points[1, i], points[2, i]
                x += px
                y += py
                z += pz
                xx += px * px
                xy += px * py
                xz += px * pz
                yy += py * py
                yz += py * pz
                zz += pz * pz
        share = 1 / max(number, 1)
        rows = ((xx, xy, xz, x), (xy, yy, yz, y), (xz, yz, zz, z), (x, y, z, float(number)))
        for a in range(4):
            for b in range(4):
                moments[face, a, b] = rows[a][b] * share
        work.number[face] = number
        work.mean_depth[face] = total * share / (DEPTH_UNITS * INDICES)


@loop
def to_middle(R, shift, lever, moment):
    """
    Move the second moments (4, 4) of points of the roof to the middle of the box across.

    Of q + u u'(shift - q), as high above the box as q, with its y axis u. `lever` (3,) is to work
    in.

    """
    middle, mean, variance = 0.0, 0.0, 0.0
    for i in range(3):
        middle += R[i, 1] * shift[i]
        mean += R[i, 1] * moment[i, 3]
    for i in range(3):
        lever[i] = middle * moment[i, 3]
        for j in range(3):
            lever[i] -= moment[i, j] * R[j, 1]
        variance -= R[i, 1] * lever[i]
    variance += middle * (middle - mean)
    for i in range(3):
        for j in range(3):
            moment[i, j] += lever[i] * R[j, 1] + R[i, 1] * (lever[j] + variance * R[j, 1])
        moment[i, 3] += R[i, 1] * (middle - mean)
        moment[3, i] = moment[i, 3]


@loop
def centre_of(points, centre):
    """Write the mean of points (M, 3); zero without points."""
    for k in range(3):
        centre[k] = 0.0
    for i in range(len(points)):
        for k in range(3):
            centre[k] += points[i, k]
    for k in range(3):
        centre[k] /= max(len(points), 1)


@loop
def fill_visibility(box, origins, points, R, toward, tangent):
    """Write the visibility of each face of one input box from its best sensor, (6,)."""
    fill_rotation(box[6], box[7], box[8], R)
    for face in range(4):
        tangent[face] = -inf
    for sensor in range(len(origins)):
        raise_visibility(box, origins[sensor], points, R, toward, tangent)
    tangent[4] = ALWAYS_VISIBLE
    tangent[5] = -ALWAYS_VISIBLE


@loop
def raise_visibility(box, origin, points, R, toward, tangent):
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
        tangent[face] = max(tangent[face], outward / max(along, MIN_ALONG))


@loop
def fill_insets(origins, ring_height, tangent, inputs, constants, shares, inset, weight):
    """
    Write the shares (2, 6) of occlusion and range inset, insets (6,) and weights (6,) of faces.

    The top is anywhere between the highest ring on an object and the next one, which misses it: h
    apart, half of that further out on average, with the variance of a uniform distribution.

    """
    reach = sqrt(origins[0, 0] ** 2 + origins[0, 1] ** 2)
    for sensor in range(1, len(origins)):
        reach = min(reach, sqrt(origins[sensor, 0] ** 2 + origins[sensor, 1] ** 2))
    beyond = 0.0 if isnan(reach) else (reach - constants.near_range) / constants.range_span
    beyond = max(beyond, 0.0)
    for face in range(6):
        u = tangent[face] + constants.edge_lead[face]
        occluded = 0.5 - 0.5 * u / sqrt(u**2 + constants.visibility_softness)
        shares[0, face] = occluded
        shares[1, face] = (1.0 - occluded) * beyond
        by_range = shares[1, face] * inputs.range_inset[face]
        inset[face] = occluded * inputs.occlusion_inset[face] + by_range
        seen = 1.0 if tangent[face] > 0.0 else constants.occluded_weight
        weight[face] = seen / (1.0 + (by_range / constants.face_deviations[face]) ** 2)
    inset[TOP] += ring_height / 2
    weight[TOP] /= 1.0 + ring_height**2 / 12 / constants.face_deviations[TOP] ** 2


@loop
def fill_velocity(poses, times, n, length, velocity):
    """Write the velocity (3,) of pose n: the mean over the steps before and after it."""
    before = max(n - 1, 0)
    after = min(n + 1, length - 1)
    duration = max(times[after] - times[before], 1e-9)
    for k in range(3):
        velocity[k] = (poses[after, k] - poses[before, k]) / duration


@loop
def fill_moved(b, n, problem, velocity, moved):
    """
    Write the points of one observation at the stamp of its box (M12), (3, M) [m].

    Returns their number with those that are `FAR`, which make it a multiple of `LANES`.

    """
    first, stride, m = problem.first[b, n], problem.stride, problem.counts[b, n]
    if stride == 1:  # written out: else the compiler gathers the points, which is slow
        for i in range(m):
            for k in range(3):
                moved[k, i] = problem.points[first + i, k]
    else:
        for i in range(m):
            for k in range(3):
                moved[k, i] = problem.points[first + i * stride, k]
    if problem.is_moving:
        for i in range(m):
            for k in range(3):
                moved[k, i] -= velocity[k] * problem.delays[first + i * stride]
    count = padded(m)
    for i in range(m, count):
        for k in range(3):
            moved[k, i] = FAR
    return count


@loop
def to_box_axes(m, moved, shift, R, local):
    """Write m points in box axes, (3, M) [m]; the box is `shift` (3,) from their origin."""
    for i in range(m):
        x = moved[0, i] - shift[0]
        y = moved[1, i] - shift[1]
        z = moved[2, i] - shift[2]
        local[0, i] = R[0, 0] * x + R[1, 0] * y + R[2, 0] * z
        local[1, i] = R[0, 1] * x + R[1, 1] * y + R[2, 1] * z
        local[2, i] = R[0, 2] * x + R[1, 2] * y + R[2, 2] * z


@loop
def add_road(shift, ground, half_height, gap, moment, distance):
    """Write the observation of the bottom: a point of the road under the centre of the box."""
    road = ground if isfinite(ground) else 0.0
    point = (shift[0], shift[1], road, 1.0)
    for a in range(4):
        for b in range(4):
            moment[a, b] = point[a] * point[b]
    distance[BOTTOM] = shift[2] - road - half_height + gap


class FaceWork(NamedTuple):
    """
    Arrays to work in, for observations of at most M points.

    Attributes
    ----------
    moved, local : array, shape (3, M)
        Points at the stamp of their box, from the centre of the input box, and in box axes [m].
    excess : array, shape (3, M)
        How far outside of the box they are along its axes [m].
    strip : array, shape (2, M)
        Strip that each point lies in, along x and along y.
    depth : array, shape (5, M)
        See `fill_depths`.
    index : array, shape (M,)
        Of the points: 0, 1, 2 ...
    candidates : array, shape (M + 1,)
        Depths of the points that may be outermost on one face; the last place is for one that may
        not.
    best : array
        Depths of the outermost points of each strip of one face.
    number, mean_depth : array, shape (5,)
        Of the outermost points of each face.

    """

    moved: Any
    local: Any
    excess: Any
    strip: Any
    depth: Any
    index: Any
    candidates: Any
    best: Any
    number: Any
    mean_depth: Any


@kernel
def empty_face_work(problem, constants):
    """Return arrays for the observations of a batch."""
    M = most_points(problem.counts)
    share = constants.outermost / constants.strips
    size = ceil(max(float(constants.min_face_points), share * M)) + 1
    index = np.empty(M)
    for i in range(M):
        index[i] = i
    return FaceWork(
        np.empty((3, M)), np.empty((3, M)), np.empty((3, M)), np.empty((2, M), np.int32),
        np.empty((FACES, M)), index, np.empty(M + 1), np.empty((constants.strips, size)),
        np.empty(FACES, np.int64), np.empty(FACES),
    )  # fmt: skip


@loop
def clear_padding(length, terms):
    """Set the terms of padding to zero."""
    for n in range(length, len(terms)):
        terms[n] = NO_TERMS[0]


@loop
def observe_window(b, problem, poses, shared, inputs, constants, work, terms):
    """
    Write the face observations of window `b`.

    Parameters
    ----------
    b : int
        The window.
    problem : Problem
        Input of the batch.
    poses, shared : array, shapes (N, 6) and (S,)
        Boxes of the window in this round.
    inputs : record `INPUTS`
        With the insets of its kind.
    constants : record of `Constants`
        Of the method, with the settings.
    work : FaceWork
        Arrays to work in.
    terms : array of `TERMS`, shape (N,)
        Of the window: its face observations are written, zero for padding.

    Notes
    -----
    The paper takes the K points closest to a face that is visible by the points' centre of mass
    [Eq. 4]. Here the outermost ones are taken: the closest points of a face that is given too far
    inside may lie anywhere. On a face with a wrong yaw the outermost points are all at one end:
    each strip has its own, so that the face is turned as well. Points far behind the outermost
    one belong to another surface.

    Bodies are round across, and one side of the roof is seen: its points show its height and its
    pitch, but would roll the body toward the sensor.

    """
    R = small_array(3, 3)
    half = small_array(3)
    shift = small_array(3)
    level = small_array(6)
    toward = small_array(3)
    lever = small_array(3)
    tangent = small_array(6)
    velocity = small_array(3)
    length = problem.lengths[b]
    clear_padding(length, terms)
    for k in range(3):
        velocity[k] = 0.0
        half[k] = shared[EXTENT + k] / 2
    for n in range(length):
        box, pose, origins = problem.boxes[b, n], poses[n], problem.origins[b, n]
        ground = problem.ground[b, n]
        term = terms[n]
        distance, weight, inset = term.distance, term.visibility, term.inset
        first, stride = problem.first[b, n], problem.stride
        points = problem.points[first : first + problem.counts[b, n] * stride : stride]
        fill_visibility(box, origins, points, R, toward, tangent)
        fill_insets(
            origins, problem.ring_heights[b, n], tangent, inputs, constants, term.inset_shares,
            inset, weight,
        )  # fmt: skip
        for k in range(3):
            shift[k] = pose[k] - box[k]
        for face in range(6):
            level[face] = shared[GAP + face] + inset[face]
        if problem.is_moving:
            fill_velocity(poses, problem.times[b], n, length, velocity)
        fill_rotation(pose[3], pose[4], pose[5], R)
        m = fill_moved(b, n, problem, velocity, work.moved)
        to_box_axes(m, work.moved, shift, R, work.local)
        near = fill_depths(m, half, level, constants, work)
        share = constants.outermost / constants.strips
        wanted = ceil(max(float(constants.min_face_points), share * near))
        outermost_points(m, wanted, constants, work, term.W_faces)
        to_middle(R, shift, lever, term.W_faces[TOP])
        for face in range(FACES):
            distance[face] = -work.mean_depth[face]
            if work.number[face] < constants.min_face_points:
                weight[face] = 0.0
        gap = shared[GAP + BOTTOM]
        add_road(shift, ground, half[2], gap, term.W_faces[BOTTOM], distance)
        weight[BOTTOM] = 1.0 if isfinite(ground) else 0.0
        terms[n].num_points = near


@kernel
def observe_faces(first, last, rows, problem, poses, shared, inputs, constants, terms):
    """
    Write the face observations of the windows `rows[first:last]`, see `observe_window`.

    Those of the window `rows[i]` are in `terms[i]`, of shape (b, N).

    """
    constants = constants[0]
    work = empty_face_work(problem, constants)
    for row in range(first, last):
        b = rows[row]
        kind = problem.kind[b]
        observe_window(b, problem, poses[b], shared[b], inputs[kind], constants, work, terms[row])
