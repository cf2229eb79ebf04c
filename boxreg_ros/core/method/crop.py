"""Pairs of a point and a box that are near each other, and the road beside the boxes."""

from math import sqrt
from typing import Any, NamedTuple

from boxreg_ros.core.method.compile import kernel, loop
from boxreg_ros.core.method.selection import nth
import numpy as np

MIN_SIDE, MAX_SIDE = 16, 256
"""Cells of the raster along x and y; those of far places share a cell. Powers of two."""
LARGEST = 1e9
"""Coordinates are limited to this, so that they fit an integer [m]."""


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


@kernel
def metre(value):
    """Return a coordinate as whole metres, truncated: the order of coordinates is kept."""
    return int(min(max(value, -LARGEST), LARGEST))


@kernel
def side_of(num_points):
    """Return the side of the raster: it has at least as many cells as there are points."""
    side = MIN_SIDE
    while side < MAX_SIDE and side * side < num_points:
        side *= 2
    return side


@kernel
def cell_of(x, y, side):
    """Return the cell of whole metres; `side` is a power of two."""
    return (x & (side - 1)) * side + (y & (side - 1))


@kernel
def raster(centers, reach, side):
    """
    Return which boxes touch each cell of 1 m, as `first` and `boxes`.

    Those of cell c are boxes[first[c]:first[c + 1]]. `centers` and `reach` are (n, 3) [m], `reach`
    half the upright bounding boxes. The raster has `side` cells along x and y.

    """
    first = np.zeros(side * side + 1, np.int64)
    boxes = np.empty(0, np.int64)
    for is_counted in (False, True):
        if is_counted:
            for cell in range(side * side):
                first[cell + 1] += first[cell]
            boxes = np.empty(first[-1], np.int64)
        for box in range(len(centers) - 1, -1, -1):
            x = metre(centers[box, 0] - reach[box, 0])
            y = metre(centers[box, 1] - reach[box, 1])
            for i in range(min(side, metre(centers[box, 0] + reach[box, 0]) - x + 1)):
                for j in range(min(side, metre(centers[box, 1] + reach[box, 1]) - y + 1)):
                    cell = cell_of(x + i, y + j, side)
                    if is_counted:
                        first[cell] -= 1
                        boxes[first[cell]] = box
                    else:
                        first[cell] += 1
    return first, boxes


@kernel
def near_points(points, first, side):
    """
    Return the points (3, M) in cells that boxes touch, with their cells.

    The cells are found in a loop that is compiled to vector instructions, the points in one
    without a branch: a quarter of them, in no order, would be mispredicted.

    """
    near = np.empty(points.shape[1], np.int32)
    cells = np.empty(points.shape[1], np.int32)
    is_touched = np.empty(side * side, np.bool_)  # small enough for the processor's cache
    for cell in range(side * side):
        is_touched[cell] = first[cell + 1] > first[cell]
    for i in range(points.shape[1]):
        cells[i] = cell_of(metre(points[0, i]), metre(points[1, i]), np.int32(side))
    count = 0
    for i in range(points.shape[1]):
        near[count] = i
        cells[count] = cells[i]
        count += is_touched[cells[i]]
    return near[:count], cells[:count]


@kernel
def candidates(points, shapes):
    """
    Return the pairs of a point and a box that touches its cell, cell by cell.

    Parameters
    ----------
    points, shapes
        As for `crop`.

    Returns
    -------
    near, cells : array, shape (K,)
        Points in cells that boxes touch, and their cells.
    first, boxes : array
        The boxes of each cell, see `raster`.
    count : int
        Number of pairs.

    """
    side = side_of(points.shape[1])
    first, boxes = raster(shapes.centers, shapes.reach, side)
    near, cells = near_points(points, first, side)
    count = 0
    for cell in cells:
        count += first[cell + 1] - first[cell]
    return near, cells, first, boxes, count


@kernel
def turned(turn, x, y, z):
    """Return an offset in the frame of the points along the axes of the frame of the boxes."""
    return (
        turn[0, 0] * x + turn[0, 1] * y + turn[0, 2] * z,
        turn[1, 0] * x + turn[1, 1] * y + turn[1, 2] * z,
        turn[2, 0] * x + turn[2, 1] * y + turn[2, 2] * z,
    )


@kernel
def offset_of(points, i, shapes, box):
    """Return point `i` minus the centre of a box, along the axes of the frame [m]."""
    dx = points[0, i] - shapes.centers[box, 0]
    dy = points[1, i] - shapes.centers[box, 1]
    dz = points[2, i] - shapes.centers[box, 2]
    return turned(shapes.turn, dx, dy, dz)


@kernel
def crop(points, shapes, margin):
    """
    Find the pairs of a point and a box within `margin` of each other, ascending by point.

    Parameters
    ----------
    points : array, shape (3, M)
        Coordinates [m].
    shapes : Shapes
        Boxes, with bounding boxes that include the margin.
    margin : float
        Distance from the faces of the box [m].

    Returns
    -------
    row, owner : array, shape (P,)
        Point and box of each pair.
    offset, outside : array, shape (P, 3)
        Point minus centre, and distance outside of the faces [m].

    """
    near, cells, first, boxes, capacity = candidates(points, shapes)
    half = shapes.half
    row = np.empty(capacity, np.int64)
    owner = np.empty(capacity, np.int64)
    offset = np.empty((capacity, 3))
    outside = np.empty((capacity, 3))
    P = 0
    for k in range(len(near)):
        i = near[k]
        for place in range(first[cells[k]], first[cells[k] + 1]):
            box = boxes[place]
            x, y, z = offset_of(points, i, shapes, box)
            R = shapes.rotations[box]
            u = abs(R[0, 0] * x + R[1, 0] * y + R[2, 0] * z) - half[box, 0]
            v = abs(R[0, 1] * x + R[1, 1] * y + R[2, 1] * z) - half[box, 1]
            w = abs(R[0, 2] * x + R[1, 2] * y + R[2, 2] * z) - half[box, 2]
            if max(u, v, w) < margin:
                row[P], owner[P] = i, box
                offset[P, 0], offset[P, 1], offset[P, 2] = x, y, z
                outside[P, 0], outside[P, 1], outside[P, 2] = u, v, w
                P += 1
    return row[:P], owner[:P], offset[:P], outside[:P]


@kernel
def flat_height(heights, quantiles, flatness, min_points):
    """Return the height of a road from heights beside a box; NaN where it is not flat."""
    n = len(heights)
    if n < min_points:
        return np.nan
    low = nth(heights, int(quantiles[0] * n))
    high = nth(heights, int(quantiles[2] * n))
    return nth(heights, int(quantiles[1] * n)) if high - low < flatness else np.nan


@kernel
def grouped(values, owner, n):
    """
    Return the values (P,) of each of n owners, in their order.

    Those of owner b are values[first[b]:first[b + 1]]; `first` is the other result.

    """
    first = np.zeros(n + 1, np.int64)
    for k in range(len(owner)):
        first[owner[k] + 1] += 1
    for b in range(n):
        first[b + 1] += first[b]
    place = first[:-1].copy()
    ordered = np.empty_like(values)
    for k in range(len(owner)):
        ordered[place[owner[k]]] = values[k]
        place[owner[k]] += 1
    return ordered, first


@kernel
def road_heights(owner, height, n, numbers):
    """
    Return the height of the road beside each of n boxes (n,); NaN where not found [m].

    Points beside them are at `height` (P,) above the bottom of box `owner` (P,).

    """
    levels, first = grouped(height, owner, n)
    road = np.empty(n)
    for box in range(n):
        road[box] = flat_height(
            levels[first[box] : first[box + 1]], numbers.road_quantiles, numbers.road_flatness,
            numbers.min_road_points,
        )  # fmt: skip
    return road


@kernel
def pairs_of_boxes(cells, first, boxes, count, n):
    """
    Return which points are near each of n boxes, in their order.

    Those of box b are place[start[b]:start[b + 1]], indices of `cells` (K,), the cells of all
    points; `first`, `boxes` and `count` are those of `candidates`.

    """
    point, box = np.empty(count, np.int32), np.empty(count, np.int32)
    pair = 0
    for i in range(len(cells)):
        for k in range(first[cells[i]], first[cells[i] + 1]):
            point[pair], box[pair] = i, boxes[k]
            pair += 1
    return grouped(point, box, n)


@loop
def measure(points, near, place, shapes, box, numbers, offset, x, depth, height, is_beside):
    """
    Write where the points `near[place]` (m,) are in and around a box.

    Their offset from its centre along x of the fixed frame, their distance outside of the face
    that they are least inside of, their height above its bottom along its z axis, and whether
    they may be of the road beside it, (m,) each. `offset` (3, m) is to work in.

    """
    center, half = shapes.centers[box], shapes.half[box]
    turn, R = shapes.turn, shapes.rotations[box]
    square = sqrt(half[0] ** 2 + half[1] ** 2) + numbers.road_width
    for j in range(len(place)):  # the next loop is compiled to vector instructions
        for k in range(3):
            offset[k, j] = points[k, near[place[j]]]
    for j in range(len(place)):
        dx, dy, dz = offset[0, j] - center[0], offset[1, j] - center[1], offset[2, j] - center[2]
        dx, dy, dz = turned(turn, dx, dy, dz)
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


@kernel
def sorted_by_x(owner, x, n):
    """
    Return the order of P pairs by `owner`, one of `n`, then by `x`, (P,).

    Both are packed into 32 bits, which a radix sort takes 8 at a time. Values closer than 2^-23 of
    the largest one, with 64 boxes, may count as equal and keep their order: every machine sorts
    them alike.

    """
    P = len(owner)
    scale = 1.0
    for k in range(P):
        scale = max(scale, abs(x[k]))
    unit = 2.0**32
    while n > 0:  # as many bits less as `n` has
        unit /= 2
        n //= 2
    place = np.empty(P, np.uint32)
    for k in range(P):
        place[k] = np.uint32((owner[k] + 0.5 + x[k] / scale / 4) * unit)
    order, other = np.empty(P, np.int64), np.empty(P, np.int64)
    for k in range(P):
        order[k] = k
    count = np.empty(256, np.int64)
    for shift in range(0, 32, 8):
        count[:] = 0
        for k in range(P):
            count[(place[k] >> shift) & 255] += 1
        total = 0
        for digit in range(256):
            count[digit], total = total, total + count[digit]
        for k in range(P):
            digit = (place[order[k]] >> shift) & 255
            other[count[digit]] = order[k]
            count[digit] += 1
        order, other = other, order
    return order


@kernel
def own_points(points, shapes, numbers):
    """
    Find the points that belong to each box, and the height of the road beside it.

    Parameters
    ----------
    points, shapes
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
    near, cells, first, boxes, P = candidates(points, shapes)
    place, start = pairs_of_boxes(cells, first, boxes, P, n)
    x, depth, height = np.empty(P), np.empty(P), np.empty(P)
    most = 0
    for box in range(n):
        most = max(most, start[box + 1] - start[box])
    offset, level, is_beside = np.empty((3, most)), np.empty(most), np.empty(most, np.bool_)
    road, num_inside = np.full(n, np.nan), np.zeros(n, np.int64)
    deepest = np.full(len(near), np.inf)  # of each point in any box
    for box in range(n):
        begin, end = start[box], start[box + 1]
        measure(
            points, near, place[begin:end], shapes, box, numbers, offset, x[begin:end],
            depth[begin:end], height[begin:end], is_beside,
        )  # fmt: skip
        count, inside = 0, 0  # without branches: the next one replaces one too far
        for k in range(begin, end):
            level[count] = height[k]
            count += is_beside[k - begin]
            inside += depth[k] <= 0.0
            if depth[k] < deepest[place[k]]:
                deepest[place[k]] = depth[k]
        num_inside[box] = inside
        if numbers.has_road:
            road[box] = flat_height(
                level[:count], numbers.road_quantiles, numbers.road_flatness,
                numbers.min_road_points,
            )  # fmt: skip
    own = np.empty(P, np.int32)
    owner = np.empty(P, np.int32)
    count = 0
    for box in range(n):
        least = numbers.clearance + (road[box] if road[box] == road[box] else 0.0)
        for k in range(start[box], start[box + 1]):
            own[count], owner[count] = k, box
            count += (
                (depth[k] < numbers.own_margin)
                & (height[k] > least)
                & (depth[k] <= deepest[place[k]] + numbers.ownership_tolerance)
            )
    own, owner = own[:count], owner[:count]
    order = sorted_by_x(owner, x[own], n)
    return near[place[own[order]]], owner[order], road, num_inside
