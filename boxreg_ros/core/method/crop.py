"""Pairs of a point and a box that are near each other, and the road beside the boxes."""

from math import sqrt
from typing import Any, NamedTuple

from boxreg_ros.core.method.compile import kernel, loop
from boxreg_ros.core.method.selection import nth
import numpy as np

MIN_SIDE, MAX_SIDE = 16, 256
"""Cells of the raster along x and y; those of far places share a cell. Powers of two."""
LARGEST = np.float32(1e9)
"""Coordinates are limited to this, so that they fit an integer [m]; of the type of most points."""


ROW_BITS = 31
"""Bits of the row of a point; derived: those that 32 for its place leave."""


class Shapes(NamedTuple):
    """
    Boxes as points near them are found.

    Attributes
    ----------
    centers : array, shape (n, 3)
        In the frame of the points [m].
    turn : array, shape (3, 3)
        Rotation from the frame of the points to that of the boxes.
    rotations : array, shape (n, 3, 3)
        From the axes of each box to the frame of the boxes.
    half : array, shape (n, 3)
        Half the extents [m].
    reach : array, shape (n, 3)
        Half the bounding boxes along the axes of the points, with a margin [m].

    """

    centers: Any
    turn: Any
    rotations: Any
    half: Any
    reach: Any


class CropNumbers(NamedTuple):
    """Constants and settings of `boxreg_ros.core.observation`; there they are described."""

    margin: float
    own_margin: float
    ownership_tolerance: float
    clearance: float
    has_road: bool
    road_width: float
    road_gap: float
    road_range: float
    road_quantiles: tuple[float, ...]
    road_flatness: float
    min_road_points: int


@loop
def metre(value):
    """Return a coordinate as whole metres, truncated: the order of coordinates is kept."""
    return np.int32(min(max(np.float32(value), -LARGEST), LARGEST))


@loop
def side_of(num_points):
    """Return the side of the raster: it has at least as many cells as there are points."""
    side = MIN_SIDE
    while side < MAX_SIDE and side * side < num_points:
        side *= 2
    return side


@loop
def cell_of(x, y, side):
    """Return the cell of whole metres; `side` is a power of two."""
    return (x & (side - 1)) * side + (y & (side - 1))


@kernel
def cells_of_boxes(shapes, side):
    """
    Return the cells of 1 m that boxes touch, as `spans` (2, R): first, and after the last.

    The spans of box b are start[b] to start[b + 1] - 1; `start` is the other result. There are two
    for each metre along x, since the cells along y may go on at the other side of the raster,
    which has `side` cells along x and y.

    """
    centers, reach = shapes.centers, shapes.reach
    start = np.empty(len(centers) + 1, np.int64)
    start[0] = 0
    for box in range(len(centers)):
        x = metre(centers[box, 0] - reach[box, 0])
        across = min(side, metre(centers[box, 0] + reach[box, 0]) - x + 1)
        start[box + 1] = start[box] + 2 * across
    spans = np.empty((2, start[len(start) - 1]), np.int64)
    for box in range(len(centers)):
        x = metre(centers[box, 0] - reach[box, 0])
        y = metre(centers[box, 1] - reach[box, 1])
        along = min(side, metre(centers[box, 1] + reach[box, 1]) - y + 1)
        y &= side - 1
        rest = max(y + along - side, 0)
        for k in range(start[box], start[box + 1], 2):
            row = cell_of(x, 0, side)
            spans[0, k], spans[1, k] = row + y, row + y + along - rest
            spans[0, k + 1], spans[1, k + 1] = row, row + rest
            x += 1
    return spans, start


class NearPoints(NamedTuple):
    """
    The points in the cells that n boxes touch, in the order of these cells.

    Attributes
    ----------
    rows : array, shape (K,)
        Of the points in the sweep.
    at : array, shape (3, K)
        Their coordinates [m].
    spans, start : array, shapes (2, R) and (n + 1,)
        Those of box b are `spans[:, start[b] : start[b + 1]]`: the first of each, and after it.
    pairs, most : int
        Points in the cells of each box, summed, and the most of one box.

    """

    rows: Any
    at: Any
    spans: Any
    start: Any
    pairs: int
    most: int


class Room(NamedTuple):
    """
    Arrays to work in, for the m points near one box.

    Attributes
    ----------
    places : array, shape (M,)
        Of these points in `NearPoints`.
    at : array, shape (3, M)
        Their coordinates [m].
    x, depth, height, is_beside : array, shape (M,)
        See `measure`.
    level : array, shape (M,)
        Heights of those that may be of the road.

    """

    places: Any
    at: Any
    x: Any
    depth: Any
    height: Any
    is_beside: Any
    level: Any


@kernel
def near_points(points, shapes):
    """
    Return the `NearPoints` of boxes.

    The cells are found in a loop that is compiled to vector instructions, the points in one
    without a branch: a quarter of them, in no order, would be mispredicted. The other kernels take
    what is returned, of one type for points of either precision: they are compiled once.

    Parameters
    ----------
    points : array, shape (3, M)
        Coordinates [m].
    shapes : Shapes
        Boxes, with bounding boxes that include the margin.

    """
    side = side_of(points.shape[1])
    spans, start = cells_of_boxes(shapes, side)
    is_touched = np.empty(side * side, np.bool_)  # small enough for the processor's cache
    is_any = np.empty(side * side // 8, np.bool_)  # of eight cells
    for cell in range(len(is_touched)):
        is_touched[cell] = is_any[cell // 8] = False
    for k in range(spans.shape[1]):
        for cell in range(spans[0, k], spans[1, k]):
            is_touched[cell] = is_any[cell // 8] = True
    number, T = np.empty(side * side, np.int32), 0  # of each touched cell, in their order
    for eight in range(len(is_any)):
        if is_any[eight]:
            for cell in range(8 * eight, 8 * eight + 8):
                number[cell] = T
                T += is_touched[cell]
    rows = np.empty(points.shape[1], np.int32)
    cells = np.empty(points.shape[1], np.int32)
    for i in range(points.shape[1]):
        cells[i] = cell_of(metre(points[0, i]), metre(points[1, i]), np.int32(side))
    K = 0
    for i in range(points.shape[1]):
        rows[K] = i
        cells[K] = cells[i]
        K += is_touched[cells[i]]
    for k in range(K):
        cells[k] = number[cells[k]]
    rows, first = grouped(rows[:K], cells[:K], T)
    at = np.empty((3, K))
    for axis in range(3):
        for k in range(K):
            at[axis, k] = points[axis, rows[k]]
    pairs, most = 0, 0
    for box in range(len(start) - 1):
        before = pairs
        for k in range(start[box], start[box + 1]):
            if spans[1, k] > spans[0, k]:
                spans[0, k] = first[number[spans[0, k]]]
                spans[1, k] = first[number[spans[1, k] - 1] + 1]
            pairs += spans[1, k] - spans[0, k]
        most = max(most, pairs - before)
    return NearPoints(rows, at, spans, start, pairs, most)


@kernel
def empty_room(near):
    """Return room for the points near any one box."""
    most = near.most
    return Room(
        np.empty(most, np.int32), np.empty((3, most)), np.empty(most), np.empty(most),
        np.empty(most), np.empty(most, np.bool_), np.empty(most),
    )  # fmt: skip


@loop
def gather(box, near, room):
    """Write the places of the points near a box and their coordinates; return their number m."""
    spans, at = near.spans, near.at
    m = 0
    for k in range(near.start[box], near.start[box + 1]):
        for i in range(spans[0, k], spans[1, k]):
            room.places[m] = i
            for axis in range(3):
                room.at[axis, m] = at[axis, i]
            m += 1
    return m


@loop
def turned(turn, x, y, z):
    """Return an offset in the frame of the points along the axes of the frame of the boxes."""
    return (
        turn[0, 0] * x + turn[0, 1] * y + turn[0, 2] * z,
        turn[1, 0] * x + turn[1, 1] * y + turn[1, 2] * z,
        turn[2, 0] * x + turn[2, 1] * y + turn[2, 2] * z,
    )


@loop
def offset_of(points, i, shapes, box):
    """Return point `i` minus the centre of a box, along the axes of the frame [m]."""
    dx = points[0, i] - shapes.centers[box, 0]
    dy = points[1, i] - shapes.centers[box, 1]
    dz = points[2, i] - shapes.centers[box, 2]
    return turned(shapes.turn, dx, dy, dz)


@kernel
def crop(near, shapes, margin):
    """
    Find the pairs of a point and a box within `margin` of each other, ascending by box.

    Parameters
    ----------
    near, shapes
        Points and boxes, as of `near_points`.
    margin : float
        Distance from the faces of the box [m].

    Returns
    -------
    row, owner : array, shape (P,)
        Point and box of each pair.
    offset, outside : array, shape (P, 3)
        Point minus centre, and distance outside of the faces [m].

    """
    room = empty_room(near)
    row, owner = np.empty(near.pairs, np.int64), np.empty(near.pairs, np.int64)
    offset, outside = np.empty((near.pairs, 3)), np.empty((near.pairs, 3))
    P = 0
    for box in range(len(shapes.half)):
        half, R = shapes.half[box], shapes.rotations[box]
        for j in range(gather(box, near, room)):
            x, y, z = offset_of(room.at, j, shapes, box)
            u = abs(R[0, 0] * x + R[1, 0] * y + R[2, 0] * z) - half[0]
            v = abs(R[0, 1] * x + R[1, 1] * y + R[2, 1] * z) - half[1]
            w = abs(R[0, 2] * x + R[1, 2] * y + R[2, 2] * z) - half[2]
            if max(u, v, w) < margin:
                row[P], owner[P] = near.rows[room.places[j]], box
                offset[P, 0], offset[P, 1], offset[P, 2] = x, y, z
                outside[P, 0], outside[P, 1], outside[P, 2] = u, v, w
                P += 1
    return row[:P], owner[:P], offset[:P], outside[:P]


@loop
def flat_height(heights, quantiles, flatness, min_points):
    """Return the height of a road from heights beside a box; NaN where it is not flat."""
    n = len(heights)
    if n < min_points:
        return np.nan
    first, middle, last = int(quantiles[0] * n), int(quantiles[1] * n), int(quantiles[2] * n)
    high = nth(heights, last)  # all before it are lower
    low = nth(heights[: last + 1], first)
    return nth(heights[first : last + 1], middle - first) if high - low < flatness else np.nan


@kernel
def grouped(values, owner, n):
    """
    Return the values (P,) of each of n owners, in their order.

    Those of owner b are values[first[b]:first[b + 1]]; `first` is the other result.

    """
    first = np.empty(n + 2, np.int64)
    for b in range(n + 2):
        first[b] = 0
    for k in range(len(owner)):
        first[owner[k] + 2] += 1
    for b in range(n):
        first[b + 2] += first[b + 1]
    ordered = np.empty(len(values), np.int32)
    for k in range(len(owner)):  # the places after the next ones end as the first of the next
        ordered[first[owner[k] + 1]] = values[k]
        first[owner[k] + 1] += 1
    return ordered, first[:-1]


@loop
def measure(box, near, shapes, numbers, room):
    """
    Write where the m points near a box are in and around it; return m.

    Their offset from its centre along x of the fixed frame, their distance outside of the face
    that they are least inside of, their height above its bottom along its z axis, and whether
    they may be of the road beside it.

    """
    at, x, depth, height, is_beside = room.at, room.x, room.depth, room.height, room.is_beside
    half, R = shapes.half[box], shapes.rotations[box]
    square = sqrt(half[0] ** 2 + half[1] ** 2) + numbers.road_width
    m = gather(box, near, room)
    for j in range(m):  # compiled to vector instructions
        dx, dy, dz = offset_of(at, j, shapes, box)
        up = R[0, 2] * dx + R[1, 2] * dy + R[2, 2] * dz
        u = abs(R[0, 0] * dx + R[1, 0] * dy + R[2, 0] * dz) - half[0]
        v = abs(R[0, 1] * dx + R[1, 1] * dy + R[2, 1] * dz) - half[1]
        w = abs(up) - half[2]
        aside = u if u > v else v
        deep = aside if aside > w else w
        high = half[2] + up
        x[j], depth[j], height[j] = dx, deep, high
        is_beside[j] = (
            (aside > numbers.road_gap)
            & (deep < numbers.road_width)
            & (abs(high) < numbers.road_range)
            & (abs(dx) < square)
            & (abs(dy) < square)
        )
    return m


@loop
def road_height(m, numbers, room):
    """Return the height of the road above the bottom of a box; NaN where not found [m]."""
    level, count = room.level, 0
    for j in range(m if numbers.has_road else 0):
        level[count] = room.height[j]  # without a branch: the next one replaces one too far
        count += room.is_beside[j]
    return flat_height(
        level[:count], numbers.road_quantiles, numbers.road_flatness, numbers.min_road_points
    )


@kernel
def sorted_by_x(owner, x, rows, n):
    """
    Return the `rows` of P pairs by `owner`, one of `n`, then by `x`, then by row, (P,).

    The first two are packed into 32 bits, which a radix sort takes 11 at a time. Values closer
    than 2^-23 of the largest one, with 64 boxes, may count as equal: every machine sorts them
    alike.

    """
    P = len(owner)
    scale = 1.0
    for k in range(P):
        scale = max(scale, abs(x[k]))
    unit = 2.0**32
    while n > 0:  # as many bits less as `n` has
        unit /= 2
        n //= 2
    order, other = np.empty(P, np.int64), np.empty(P, np.int64)
    count = np.empty((3, 2048), np.int64)
    for value in range(2048):
        count[0, value] = count[1, value] = count[2, value] = 0
    for k in range(P):
        place = np.int64((owner[k] + 0.5 + x[k] / scale / 4) * unit)
        order[k] = place << ROW_BITS | rows[k]
        for digit in range(3):
            count[digit, (place >> (11 * digit)) & 2047] += 1
    for digit in range(3):
        of_digit, total = count[digit], 0
        for value in range(2048):
            of_digit[value], total = total, total + of_digit[value]
        for k in range(P):
            value = (order[k] >> (ROW_BITS + 11 * digit)) & 2047
            other[of_digit[value]] = order[k]
            of_digit[value] += 1
        order, other = other, order
    for k in range(1, P):  # the rows of equal ones
        place, pair = k, order[k]
        while place and order[place - 1] > pair:
            order[place] = order[place - 1]
            place -= 1
        order[place] = pair
    for k in range(P):
        order[k] &= (1 << ROW_BITS) - 1
    return order


@kernel
def own_points(near, shapes, numbers):
    """
    Find the points that belong to each box, and the height of the road beside it.

    Parameters
    ----------
    near, shapes
        As for `crop`, with the margin `numbers.margin`.
    numbers : CropNumbers
        Constants and settings.

    Returns
    -------
    row, owner : array, shape (P,)
        Point and box of each pair, ascending by box, then by the x coordinate of the point.
    road : array, shape (n,)
        Height of the road above the bottom of each box, along its z axis [m]; NaN if unknown.
    num_inside : array, shape (n,)
        Points inside each box.

    """
    n = len(shapes.half)
    room = empty_room(near)
    own, owner = np.empty(near.pairs, np.int32), np.empty(near.pairs, np.int32)
    x, depth, chosen = np.empty(near.pairs), np.empty(near.pairs), np.empty(near.most, np.int32)
    road, num_inside = np.empty(n), np.empty(n, np.int64)
    deepest = np.empty(len(near.rows))  # of each point in any box
    for i in range(len(deepest)):
        deepest[i] = np.inf
    P = 0
    for box in range(n):
        m = measure(box, near, shapes, numbers, room)
        road[box] = road_height(m, numbers, room)
        least = numbers.clearance + (road[box] if road[box] == road[box] else 0.0)
        count, inside = 0, 0
        for j in range(m):
            chosen[count] = j
            count += room.depth[j] < numbers.own_margin
            inside += room.depth[j] <= 0.0
        num_inside[box] = inside
        for k in range(count):
            j = chosen[k]
            i = room.places[j]
            deepest[i] = min(deepest[i], room.depth[j])
            own[P], owner[P], x[P], depth[P] = i, box, room.x[j], room.depth[j]
            P += room.height[j] > least
    count = 0
    for k in range(P):
        limit = deepest[own[k]] + numbers.ownership_tolerance
        own[count], owner[count], x[count] = near.rows[own[k]], owner[k], x[k]
        count += depth[k] <= limit
    owner = owner[:count]  # ascending, before and after
    return sorted_by_x(owner, x[:count], own[:count], n), owner, road, num_inside


@loop
def step_of(count, most):
    """Return the least step by which no more than `most` of some items are taken, at least 1."""
    return max(1, (count + most - 1) // most)


@kernel
def thinned(points, shapes, row, owner, most):
    """
    Keep every n-th pair of each box, so that none has more than `most`.

    Parameters
    ----------
    points, shapes
        As for `near_points`.
    row, owner : array, shape (P,)
        Point and box of each pair, ascending by box.
    most : int
        Pairs of a box.

    Returns
    -------
    rows : array, shape (Q,)
        Points of the pairs that are kept.
    offsets : array, shape (Q, 3)
        These minus the centres of their boxes, axes of the frame of the boxes [m].
    counts : array, shape (n,)
        How many each box keeps.

    """
    given, counts = np.empty(len(shapes.half), np.int64), np.empty(len(shapes.half), np.int64)
    for box in range(len(given)):
        given[box] = 0
    for k in range(len(owner)):
        given[owner[k]] += 1
    Q = 0
    for box in range(len(given)):
        step = step_of(given[box], most)
        counts[box] = (given[box] + step - 1) // step
        Q += counts[box]
    rows, offsets = np.empty(Q, np.int64), np.empty((Q, 3), np.float32)
    first, q = 0, 0
    for box in range(len(given)):
        step = step_of(given[box], most)
        for k in range(counts[box]):
            rows[q] = row[first + k * step]
            offsets[q, 0], offsets[q, 1], offsets[q, 2] = offset_of(points, rows[q], shapes, box)
            q += 1
        first += given[box]
    return rows, offsets, counts
