"""How badly points fit the boxes of an object, for each latency that its boxes may have (M12a)."""

from math import cos, sin

from boxreg_ros.core.method.compile import kernel
from boxreg_ros.core.method.selection import sum_of
import numpy as np

PATH_REACH = 0.3
"""Points up to this far outside of the predicted boxes are compared with them [m]. Chosen."""
FACE_DEPTH = 0.35
"""Distances from a face beyond this are no worse [m]. Chosen."""
DEPTH_SHARE = 1.5
"""What a mean distance of `FACE_DEPTH` costs, over all points being outside. Chosen."""


@kernel
def fill_costs(points, times, velocity, boxes, fewest, costs):
    """
    Write how badly C boxes fit points; return False where too few points are near them.

    Parameters
    ----------
    points, times : array, shapes (3, M) and (M,)
        Points, and their times relative to the stamp [m, s].
    velocity : array, shape (3,)
        Of the object [m/s].
    boxes : array, shape (C, 9)
        Where the object is, by latency; upright.
    fewest : int
        Points that are needed.
    costs : array, shape (2, C)
        Written: the part of the points outside of a box, which is robust, and their mean distance
        from its faces, which is precise. First for the points where they were seen, then for
        those at the stamp.

    """
    outside = np.empty((len(boxes), len(times)))
    inside, depth = np.empty(len(boxes)), np.empty(len(boxes))
    for way in range(2):
        is_near = np.empty(len(times), np.bool_)
        for i in range(len(times)):
            is_near[i] = False
        for c in range(len(boxes)):
            box = boxes[c]
            along, across = cos(box[8]), sin(box[8])
            for i in range(len(times)):
                x = points[0, i] - way * times[i] * velocity[0] - box[0]
                y = points[1, i] - way * times[i] * velocity[1] - box[1]
                u = abs(along * x + across * y) - box[3] / 2
                v = abs(along * y - across * x) - box[4] / 2
                outside[c, i] = max(u, v)
                is_near[i] |= outside[c, i] < PATH_REACH
        count = sum_of(is_near)
        if count < fewest:
            return False
        most = float(fewest)
        for c in range(len(boxes)):
            inside[c], depth[c] = 0.0, 0.0
            for i in range(len(times)):
                if is_near[i]:
                    inside[c] += outside[c, i] < PATH_REACH / 2
                    depth[c] += min(abs(outside[c, i]), FACE_DEPTH)
            most = max(most, inside[c])
        for c in range(len(boxes)):
            mean_depth = depth[c] / count
            costs[way, c] = DEPTH_SHARE * mean_depth / FACE_DEPTH - inside[c] / most
    return True
