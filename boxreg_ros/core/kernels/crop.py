"""
Points of a sweep in and near boxes, and the height of the road beside them, in plain loops.

The numpy twin is `boxreg_ros.core.observation.observe`, which has the rules.

"""

from math import floor, hypot, inf, nan

from boxreg_ros.core.kernels.compile import kernel
import numpy as np

CELLS = 256
"""Cells of the raster over the boxes, along x and along y."""
MIN_CELL = 1.0
"""[m]"""


@kernel
def raster(centers, reach):
    """
    Return a raster of lists: which boxes (n,) lie over each cell of the ground plane.

    Its corner and cell size [m], where the list of each cell begins (CELLS**2 + 1,), and the
    boxes of all lists.

    """
    low_x, low_y, size = inf, inf, MIN_CELL
    for b in range(len(centers)):
        low_x = min(low_x, centers[b, 0] - reach[b, 0])
        low_y = min(low_y, centers[b, 1] - reach[b, 1])
    for b in range(len(centers)):
        size = max(size, (centers[b, 0] + reach[b, 0] - low_x) / (CELLS - 1))
        size = max(size, (centers[b, 1] + reach[b, 1] - low_y) / (CELLS - 1))
    high_x, high_y = 0, 0
    for b in range(len(centers)):
        high_x = max(high_x, int((centers[b, 0] + reach[b, 0] - low_x) / size) + 1)
        high_y = max(high_y, int((centers[b, 1] + reach[b, 1] - low_y) / size) + 1)
    first = np.zeros(high_x * high_y + 1, np.int32)
    for turn in range(2):
        if turn == 1:
            for cell in range(high_x * high_y):
                first[cell + 1] += first[cell]
            boxes = np.empty(first[high_x * high_y], np.int32)
        for b in range(len(centers) - 1, -1, -1):
            for i in range(
                int((centers[b, 0] - reach[b, 0] - low_x) / size),
                int((centers[b, 0] + reach[b, 0] - low_x) / size) + 1,
            ):
                for j in range(
                    int((centers[b, 1] - reach[b, 1] - low_y) / size),
                    int((centers[b, 1] + reach[b, 1] - low_y) / size) + 1,
                ):
                    if turn == 0:
                        first[i * high_y + j] += 1
                    else:
                        first[i * high_y + j] -= 1
                        boxes[first[i * high_y + j]] = b
    return low_x, low_y, size, high_x, high_y, first, boxes


@kernel
def pairs_near(points, centers, R, half, reach, ring, either, margin):
    """
    Return all pairs of a point and a box that are less than `ring` apart.

    Row of the point, row of the box, how far the point is outside of the box and outside of its
    sides (negative inside), its height above the bottom along z [m], and whether no other box has
    it much deeper inside.

    """
    low_x, low_y, size, high_x, high_y, first, boxes = raster(centers, reach)
    capacity = max(1024, len(points))
    per_cell = 1.0 / size
    count = 0
    row = np.empty(capacity, np.int64)
    owner = np.empty(capacity, np.int64)
    values = np.empty((capacity, 3))
    is_own = np.empty(capacity, np.bool_)
    for i in range(len(points)):
        place_x = (points[i, 0] - low_x) * per_cell
        place_y = (points[i, 1] - low_y) * per_cell
        if not (place_x >= 0.0 and place_x < high_x and place_y >= 0.0 and place_y < high_y):
            continue
        cell = int(place_x) * high_y + int(place_y)
        if first[cell] == first[cell + 1]:
            continue
        begin = count
        nearest = inf
        for entry in range(first[cell], first[cell + 1]):
            b = boxes[entry]
            x = points[i, 0] - centers[b, 0]
            y = points[i, 1] - centers[b, 1]
            z = points[i, 2] - centers[b, 2]
            aside = max(
                abs(R[b, 0, 0] * x + R[b, 1, 0] * y + R[b, 2, 0] * z) - half[b, 0],
                abs(R[b, 0, 1] * x + R[b, 1, 1] * y + R[b, 2, 1] * z) - half[b, 1],
            )
            if not aside < ring:
                continue
            up = R[b, 0, 2] * x + R[b, 1, 2] * y + R[b, 2, 2] * z
            depth = max(aside, abs(up) - half[b, 2])
            if not depth < ring:
                continue
            if count == capacity:
                capacity *= 2
                row = grown(row, capacity)
                owner = grown(owner, capacity)
                is_own = grown(is_own, capacity)
                larger = np.empty((capacity, 3))
                larger[:count] = values
                values = larger
            row[count] = i
            owner[count] = b
            values[count, 0] = depth
            values[count, 1] = aside
            values[count, 2] = up + half[b, 2]
            count += 1
            nearest = min(nearest, depth)
        for pair in range(begin, count):
            is_own[pair] = values[pair, 0] < margin and values[pair, 0] <= nearest + either
    return row[:count], owner[:count], values[:count], is_own[:count]


@kernel
def grown(array, capacity):
    """Return a copy with room for `capacity` entries."""
    larger = np.empty(capacity, array.dtype)
    larger[: len(array)] = array
    return larger


@kernel
def road_height(heights, limits):
    """Return the height of flat ground among `heights` (k,) above a box's bottom; else NaN [m]."""
    fewest, low, middle, high, flat = limits
    if len(heights) < fewest:
        return nan
    heights.sort()
    k = len(heights)
    is_flat = heights[int(high * k)] - heights[int(low * k)] < flat
    return heights[int(middle * k)] if is_flat else nan


@kernel
def observe_boxes(points, centers, R, half, settings, road_limits):
    """
    Return what each box sees: rows of its points, where those of each box begin, road and counts.

    Rows (P,) are in the order of x along the frame; `first` (n + 1,); height of the road above
    the bottom of the box (n,), NaN where none is seen [m]; and points inside (n,).

    """
    ring, margin, either, clearance, beside, tallest = settings
    n = len(centers)
    reach = np.empty((n, 2))
    for b in range(n):
        for k in range(2):
            reach[b, k] = 0.0
            for m in range(3):
                reach[b, k] += abs(R[b, k, m]) * (half[b, m] + max(ring, margin))
    row, owner, values, is_own = pairs_near(
        points, centers, R, half, reach, max(ring, margin), either, margin
    )
    inside = np.zeros(n, np.int64)
    road = np.full(n, nan)
    start = np.zeros(n + 1, np.int64)
    for pair in range(len(row)):
        start[owner[pair] + 1] += 1
    for b in range(n):
        start[b + 1] += start[b]
    order = np.empty(len(row), np.int64)
    place = start.copy()
    for pair in range(len(row)):  # by box, points ascending
        order[place[owner[pair]]] = pair
        place[owner[pair]] += 1
    kept = np.empty(len(row), np.int64)
    first = np.zeros(n + 1, np.int64)
    heights = np.empty(len(row))
    key = np.empty(len(row))
    for b in range(n):
        corner = hypot(half[b, 0], half[b, 1]) + ring
        found = 0
        for p in order[start[b] : start[b + 1]]:
            depth, aside, height = values[p]
            inside[b] += depth <= 0.0
            if aside > beside and depth < ring and abs(height) < tallest:
                x = abs(points[row[p], 0] - centers[b, 0])
                y = abs(points[row[p], 1] - centers[b, 1])
                if max(x, y) < corner:
                    heights[found] = height
                    found += 1
        road[b] = road_height(heights[:found], road_limits)
        lowest = (road[b] if road[b] == road[b] else 0.0) + clearance
        own = 0
        for p in order[start[b] : start[b + 1]]:
            if is_own[p] and values[p, 2] > lowest:
                key[own] = points[row[p], 0]
                kept[first[b] + own] = row[p]
                own += 1
        sorted_rows = kept[first[b] : first[b] + own][np.argsort(key[:own], kind='mergesort')]
        kept[first[b] : first[b] + own] = sorted_rows
        first[b + 1] = first[b] + own
    return kept[: first[n]], first, road, inside
