"""
Pairs of a point and a box that are near each other, in plain loops.

The numpy twin is `boxreg_ros.core.observation.crop_numpy`.

"""

from boxreg_ros.core.kernels.compile import kernel
import numpy as np

SIDE = 256
"""Cells of the raster along x and y; those of far places share a cell."""
FAR = 1e9
"""Coordinates are limited to this, so that they fit an integer [m]."""


@kernel
def metre(value):
    """Return a coordinate as whole metres, truncated: the order of coordinates is kept."""
    return int(min(max(value, -FAR), FAR))


@kernel
def cell_of(x, y):
    """Return the cell of whole metres; `SIDE` is a power of two."""
    return (x & (SIDE - 1)) * SIDE + (y & (SIDE - 1))


@kernel
def raster(centers, reach):
    """
    Return which boxes touch each cell of 1 m: the boxes of cell c are boxes[first[c]:first[c + 1]].

    `centers` and `reach` are (n, 3) [m], `reach` half the upright bounding boxes.

    """
    first = np.zeros(SIDE * SIDE + 1, np.int64)
    boxes = np.empty(0, np.int64)
    for is_counted in (False, True):
        if is_counted:
            for cell in range(SIDE * SIDE):
                first[cell + 1] += first[cell]
            boxes = np.empty(first[-1], np.int64)
        for box in range(len(centers) - 1, -1, -1):
            x = metre(centers[box, 0] - reach[box, 0])
            y = metre(centers[box, 1] - reach[box, 1])
            for i in range(min(SIDE, metre(centers[box, 0] + reach[box, 0]) - x + 1)):
                for j in range(min(SIDE, metre(centers[box, 1] + reach[box, 1]) - y + 1)):
                    cell = cell_of(x + i, y + j)
                    if is_counted:
                        first[cell] -= 1
                        boxes[first[cell]] = box
                    else:
                        first[cell] += 1
    return first, boxes


@kernel
def crop(points, centers, rotations, half, reach, margin):
    """
    Find the pairs of a point and a box within `margin` of each other, ascending by box.

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
    row, owner, offset, outside : array
        As in `boxreg_ros.core.observation.Crop`.

    """
    first, boxes = raster(centers, reach)
    M = points.shape[1]
    near = np.empty(M, np.int32)
    cells = np.empty(M, np.int32)
    num_near = 0
    capacity = 0
    for i in range(M):
        cell = cell_of(metre(points[0, i]), metre(points[1, i]))
        count = first[cell + 1] - first[cell]
        if count:
            near[num_near] = i
            cells[num_near] = cell
            num_near += 1
            capacity += count
    # Pairs in the order of the points, then sorted by box.
    pairs = np.empty((capacity, 2), np.int64)
    places = np.empty((capacity, 6))
    counts = np.zeros(len(centers) + 1, np.int64)
    P = 0
    for k in range(num_near):
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
                pairs[P, 0], pairs[P, 1] = i, box
                places[P, 0], places[P, 1], places[P, 2] = x, y, z
                places[P, 3], places[P, 4], places[P, 5] = u, v, w
                counts[box + 1] += 1
                P += 1
    row = np.empty(P, np.int64)
    owner = np.empty(P, np.int64)
    offset = np.empty((3, P))
    outside = np.empty((3, P))
    for box in range(len(centers)):
        counts[box + 1] += counts[box]
    for k in range(P):
        box = pairs[k, 1]
        place = counts[box]
        counts[box] += 1
        row[place] = pairs[k, 0]
        owner[place] = box
        for axis in range(3):
            offset[axis, place] = places[k, axis]
            outside[axis, place] = places[k, 3 + axis]
    return row, owner, offset, outside
