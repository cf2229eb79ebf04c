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
CORE = np.array([[-0.5, 0.5], [-0.5, 0.5], [-0.45, -0.15]])
"""Part that is solid: rays through it show a wrong place of the sensor, or of the box; chosen."""


@kernel
def crossings(points, origin, pose, tilt, half):
    """
    Return how many rays cross the layers behind each face, (3, 2, LAYERS), and the core.

    Of `points` (n, 3) measured from `origin` (3,), for a box at a `pose` (4,) with the rotation
    `tilt` by roll and pitch and `half` extents. Faces are ordered by axis, the lower first; layers
    from the face inwards.

    """
    counts = np.zeros((3, 2, LAYERS))
    through = 0
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
        stop = 1 - BEFORE / length
        low, high = CORE[:, 0] * half, CORE[:, 1] * half
        t0, t1 = _span(o, d, stop, low, high)
        through += t0 < t1
        for axis in range(3):
            for side in range(2):
                _cross(o, d, stop, half, axis, side, counts[axis, side])
    return counts, through


@kernel
def _span(o, d, stop, low, high):
    """Return the part, from and to, of a ray o + t d, t up to `stop`, that is within bounds."""
    t0, t1 = 0.0, stop
    for k in range(3):
        if abs(d[k]) < 1e-9:
            if o[k] < low[k] or o[k] > high[k]:
                return 0.0, 0.0
            continue
        a, b = (low[k] - o[k]) / d[k], (high[k] - o[k]) / d[k]
        t0, t1 = max(t0, min(a, b)), min(t1, max(a, b))
    return t0, t1


@kernel
def _cross(o, d, stop, half, axis, side, counts):
    """Add a ray to the layers behind a face that it crosses."""
    sign = 2.0 * side - 1.0
    depth = min(half[axis] / 2, LAYERS * BIN)
    low, high = CROSS_SECTIONS[axis, :, 0] * half, CROSS_SECTIONS[axis, :, 1] * half
    low[axis] = half[axis] - depth if sign > 0 else -half[axis]
    high[axis] = low[axis] + depth
    t0, t1 = _span(o, d, stop, low, high)
    if t0 >= t1:
        return
    a = (half[axis] - sign * (o[axis] + t0 * d[axis])) / BIN
    b = (half[axis] - sign * (o[axis] + t1 * d[axis])) / BIN
    first, last = int(max(min(a, b), 0.0)), int(min(max(a, b), LAYERS - 1.0))
    for layer in range(first, last + 1):
        counts[layer] += 1
