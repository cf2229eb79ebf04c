"""
Pairs of a point and a box that are near each other, in plain loops.

The numpy twins are `crop_numpy` and `own_points_numpy` of `boxreg_ros.core.observation`.

"""

from boxreg_ros.core.kernels.compile import kernel
from boxreg_ros.core.kernels.selection import nth
import numpy as np

MIN_SIDE, MAX_SIDE = 16, 256
"""Cells of the raster along x and y; those of far places share a cell. Powers of two."""
LARGEST = 1e9
"""Coordinates are limited to this, so that they fit an integer [m]."""


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
    """Return the points (3, M) in cells that boxes touch, with their cells."""
    near = np.empty(points.shape[1], np.int32)
    cells = np.empty(points.shape[1], np.int32)
    is_touched = np.empty(side * side, np.bool_)  # small enough for the processor's cache
    for cell in range(side * side):
        is_touched[cell] = first[cell + 1] > first[cell]
    count = 0
    for i in range(points.shape[1]):
        cell = cell_of(metre(points[0, i]), metre(points[1, i]), side)
        if is_touched[cell]:
            near[count] = i
            cells[count] = cell
            count += 1
    return near[:count], cells[:count]


@kernel
def crop(points, centers, rotations, half, reach, margin):
    """
    Find the pairs of a point and a box within `margin` of each other, ascending by point.

    Parameters
    ----------
    points : array, shape (3, M)
        Coordinates [m].
    centers, rotations, half : array, shapes (n, 3), (n, 3, 3) and (n, 3)
        Boxes.
    reach : array, shape (n, 3)
        Half the upright bounding boxes, `margin` included [m].
    margin : float
        Distance from the faces of the box [m].

    Returns
    -------
    row, owner : array, shape (P,)
        Point and box of each pair.
    offset, outside : array, shape (P, 3)
        Point minus centre, and distance outside of the faces [m].

    """
    side = side_of(points.shape[1])
    first, boxes = raster(centers, reach, side)
    near, cells = near_points(points, first, side)
    capacity = 0
    for cell in cells:
        capacity += first[cell + 1] - first[cell]
    row = np.empty(capacity, np.int64)
    owner = np.empty(capacity, np.int64)
    offset = np.empty((capacity, 3))
    outside = np.empty((capacity, 3))
    P = 0
    for k in range(len(near)):
        i = near[k]
        for place in range(first[cells[k]], first[cells[k] + 1]):
            box = boxes[place]
            x = points[0, i] - centers[box, 0]
            y = points[1, i] - centers[box, 1]
            z = points[2, i] - centers[box, 2]
            if abs(x) > reach[box, 0] or abs(y) > reach[box, 1] or abs(z) > reach[box, 2]:
                continue
            R = rotations[box]
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
def road_heights(owner, height, offset, outside, half, numbers):
    """Return the height of the road beside each of n boxes (n,); NaN where not found [m]."""
    n = len(half)
    beside = np.empty(len(owner), np.bool_)
    square = np.hypot(half[:, 0], half[:, 1]) + numbers.road_width
    first = np.zeros(n + 1, np.int64)
    for k in range(len(owner)):
        box = owner[k]
        aside = max(outside[k, 0], outside[k, 1])
        beside[k] = (
            aside > numbers.road_gap
            and max(aside, outside[k, 2]) < numbers.road_width
            and abs(height[k]) < numbers.road_range
            and max(abs(offset[k, 0]), abs(offset[k, 1])) < square[box]
        )
        first[box + 1] += beside[k]
    for box in range(n):
        first[box + 1] += first[box]
    place = first[:-1].copy()
    levels = np.empty(first[-1])
    for k in range(len(owner)):
        if beside[k]:
            levels[place[owner[k]]] = height[k]
            place[owner[k]] += 1
    road = np.empty(n)
    for box in range(n):
        road[box] = flat_height(
            levels[first[box] : first[box + 1]], numbers.road_quantiles, numbers.road_flatness,
            numbers.min_road_points,
        )  # fmt: skip
    return road


@kernel
def least_depths(row, depth):
    """Return for each pair the least `depth` (P,) of all pairs of its point, its `row`."""
    least = np.empty(len(row))
    start = 0
    while start < len(row):
        end = start
        lowest = depth[start]
        while end < len(row) and row[end] == row[start]:
            lowest = min(lowest, depth[end])
            end += 1
        least[start:end] = lowest
        start = end
    return least


@kernel
def own_points(points, centers, rotations, half, reach, numbers):
    """
    Find the points that belong to each box, and the height of the road beside it.

    Parameters
    ----------
    points, centers, rotations, half, reach : array
        As for `crop`, with the margin `numbers.margin`.
    numbers : CropNumbers
        Constants and settings.

    Returns
    -------
    row, owner, x : array, shape (P,)
        Point and box of each pair, and the x coordinate of the point from the centre [m].
    road : array, shape (n,)
        Height of the road above the bottom of each box, along its z axis [m]; NaN if unknown.
    num_inside : array, shape (n,)
        Points inside each box.

    """
    row, owner, offset, outside = crop(points, centers, rotations, half, reach, numbers.margin)
    height = np.empty(len(row))
    depth = np.empty(len(row))
    num_inside = np.zeros(len(half), np.int64)
    for k in range(len(row)):
        R = rotations[owner[k]]
        height[k] = half[owner[k], 2]
        for j in range(3):
            height[k] += R[j, 2] * offset[k, j]
        depth[k] = max(outside[k, 0], outside[k, 1], outside[k, 2])
        num_inside[owner[k]] += depth[k] <= 0.0
    least = least_depths(row, depth)
    road = np.full(len(half), np.nan)
    if numbers.has_road:
        road = road_heights(owner, height, offset, outside, half, numbers)
    P = 0
    x = np.empty(len(row))
    for k in range(len(row)):
        ground = road[owner[k]] if road[owner[k]] == road[owner[k]] else 0.0
        if (
            depth[k] < numbers.own_margin
            and depth[k] <= least[k] + numbers.ownership_tolerance
            and height[k] > ground + numbers.clearance
        ):
            row[P], owner[P], x[P] = row[k], owner[k], offset[k, 0]
            P += 1
    return row[:P], owner[:P], x[:P], road, num_inside
