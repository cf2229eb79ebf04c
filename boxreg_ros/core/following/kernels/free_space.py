"""Space within a box that rays of the sensor have crossed: nothing of the object is there."""

from boxreg_ros.core.following.kernels.registration import axes, in_frame
from boxreg_ros.core.method.compile import kernel
import numpy as np

BIN = 0.1
"""Thickness of the layers behind each face [m]; chosen: the noise of a range is less."""
LAYERS = 30
"""Layers behind a face at most: a quarter of a bus of 12 m. Derived."""
BEFORE = 0.15
"""A ray is free up to this distance before its point [m]; chosen."""
CROSS_SECTIONS = np.array([
    [[0.0, 0.0], [-0.7, 0.7], [-0.45, -0.15]],
    [[-0.7, 0.7], [0.0, 0.0], [-0.45, -0.15]],
    [[-0.5, 0.5], [-0.6, 0.6], [0.0, 0.0]],
])  # fmt: skip
"""Part of the box across each axis that rays cross, in half extents; chosen: without corners,
hood, windows, and the air below a vehicle."""


@kernel
def crossings(points, origin, pose, tilt, half):
    """
    Return how many rays cross the layers behind each face, (3, 2, LAYERS).

    Of `points` (n, 3) measured from `origin` (3,), for a box at a `pose` (4,) with the rotation
    `tilt` by roll and pitch and `half` extents. Faces are ordered by axis, the lower first; layers
    from the face inwards.

    """
    counts = np.zeros((3, 2, LAYERS))
    R = axes(pose, tilt)
    o = np.empty(3)
    o[0], o[1], o[2] = in_frame(origin[0] - pose[0], origin[1] - pose[1], origin[2] - pose[2], R)
    away = np.hypot(o[0], o[1])
    radius = np.hypot(half[0], half[1])
    d = np.empty(3)
    for n in range(len(points)):
        x, y, z = in_frame(
            points[n, 0] - pose[0], points[n, 1] - pose[1], points[n, 2] - pose[2], R
        )
        d[0], d[1], d[2] = x - o[0], y - o[1], z - o[2]
        flat = np.hypot(d[0], d[1])
        if flat < away - radius or abs(o[0] * d[1] - o[1] * d[0]) > radius * flat:
            continue
        if o[0] * d[0] + o[1] * d[1] > 0 and away > radius:
            continue
        length = np.sqrt(flat * flat + d[2] * d[2])
        if length < BEFORE:
            continue
        for axis in range(3):
            for side in range(2):
                _cross(o, d, 1 - BEFORE / length, half, axis, side, counts[axis, side])
    return counts


@kernel
def _cross(o, d, stop, half, axis, side, counts):
    """Add a ray o + t d, t up to `stop`, to the layers behind a face that it crosses."""
    sign = 2.0 * side - 1.0
    depth = min(half[axis] / 2, LAYERS * BIN)
    t0, t1 = 0.0, stop
    for k in range(3):
        low, high = CROSS_SECTIONS[axis, k, 0] * half[k], CROSS_SECTIONS[axis, k, 1] * half[k]
        if k == axis:
            low, high = half[k] - depth, half[k]
            if sign < 0:
                low, high = -high, -low
        if abs(d[k]) < 1e-9:
            if o[k] < low or o[k] > high:
                return
            continue
        a, b = (low - o[k]) / d[k], (high - o[k]) / d[k]
        t0, t1 = max(t0, min(a, b)), min(t1, max(a, b))
    if t0 >= t1:
        return
    a = (half[axis] - sign * (o[axis] + t0 * d[axis])) / BIN
    b = (half[axis] - sign * (o[axis] + t1 * d[axis])) / BIN
    first, last = int(max(min(a, b), 0.0)), int(min(max(a, b), LAYERS - 1.0))
    for layer in range(first, last + 1):
        counts[layer] += 1
