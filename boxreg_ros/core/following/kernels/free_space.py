"""Space within a box that rays of the sensor have crossed: nothing of the object is there."""

from boxreg_ros.core.following.kernels.registration import axes, in_frame
from boxreg_ros.core.method.compile import kernel
import numpy as np

SECTORS = 720
"""By azimuth, that the points of a sweep are sorted into; chosen: half a degree."""
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
def by_azimuth(points, origin):
    """Return the rows (n,) of points (n, 3) by sector around an origin, and where each begins."""
    sectors = np.empty(len(points), np.int32)
    ends = np.zeros(SECTORS + 1, np.int64)
    for n in range(len(points)):
        sectors[n] = _sector(points[n, 0] - origin[0], points[n, 1] - origin[1])
        ends[sectors[n] + 1] += 1
    ends = np.cumsum(ends)
    rows = np.empty(len(points), np.int32)
    filled = ends.copy()
    for n in range(len(points)):
        rows[filled[sectors[n]]] = n
        filled[sectors[n]] += 1
    return rows, ends


@kernel
def _sector(x, y):
    return int((np.arctan2(y, x) / (2 * np.pi) + 0.5) * SECTORS) % SECTORS


@kernel
def crossings(points, rows, ends, origin, pose, tilt, half):
    """
    Return how many rays cross the layers behind each face, (3, 2, LAYERS), and the core.

    Of `points` (n, 3) measured from `origin` (3,), with `rows` and `ends` of `by_azimuth`, for a
    box at a `pose` (4,) with the rotation `tilt` by roll and pitch and `half` extents. Faces are
    ordered by axis, the lower first; layers from the face inwards.

    """
    counts = np.zeros((3, 2, LAYERS))
    through = 0
    R = axes(pose, tilt)
    o = np.empty(3)
    o[0], o[1], o[2] = in_frame(origin[0] - pose[0], origin[1] - pose[1], origin[2] - pose[2], R)
    away = np.hypot(o[0], o[1])
    radius = np.hypot(half[0], half[1])
    reach = SECTORS // 2
    if away > radius:
        reach = int(np.arcsin(radius / away) / (2 * np.pi) * SECTORS) + 1
    middle = _sector(pose[0] - origin[0], pose[1] - origin[1])
    layers = _layers(half)
    core = (CORE * half.reshape(3, 1)).T.copy()
    box = np.stack((-half, half))
    d = np.empty(3)
    for k in range(middle - reach, middle + min(reach + 1, SECTORS - reach)):
        sector = k % SECTORS
        for n in rows[ends[sector] : ends[sector + 1]]:
            d[0], d[1], d[2] = in_frame(
                points[n, 0] - origin[0], points[n, 1] - origin[1], points[n, 2] - origin[2], R
            )
            length = np.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
            if length < max(away - radius, BEFORE):
                continue
            stop = 1 - BEFORE / length
            if not _crosses(o, d, stop, box):
                continue
            through += _crosses(o, d, stop, core)
            for axis in range(3):
                for side in range(2):
                    _cross(o, d, stop, half, axis, side, layers[axis, side], counts[axis, side])
    return counts, through


@kernel
def _layers(half):
    """Return the bounds (3, 2, 2, 3), lowest and highest, of the layers behind each face."""
    bounds = np.empty((3, 2, 2, 3))
    for axis in range(3):
        depth = min(half[axis] / 2, LAYERS * BIN)
        for side in range(2):
            for k in range(3):
                bounds[axis, side, :, k] = CROSS_SECTIONS[axis, k] * half[k]
            bounds[axis, side, 0, axis] = half[axis] - depth if side else -half[axis]
            bounds[axis, side, 1, axis] = bounds[axis, side, 0, axis] + depth
    return bounds


@kernel
def _crosses(o, d, stop, bounds):
    t0, t1 = _span(o, d, stop, bounds)
    return t0 < t1


@kernel
def _span(o, d, stop, bounds):
    """Return the part, from and to, of a ray o + t d, t up to `stop`, within bounds (2, 3)."""
    t0, t1 = 0.0, stop
    for k in range(3):
        if abs(d[k]) < 1e-9:
            if o[k] < bounds[0, k] or o[k] > bounds[1, k]:
                return 0.0, 0.0
            continue
        a, b = (bounds[0, k] - o[k]) / d[k], (bounds[1, k] - o[k]) / d[k]
        t0, t1 = max(t0, min(a, b)), min(t1, max(a, b))
    return t0, t1


@kernel
def _cross(o, d, stop, half, axis, side, bounds, counts):
    """Add a ray to the layers behind a face that it crosses."""
    sign = 2.0 * side - 1.0
    t0, t1 = _span(o, d, stop, bounds)
    if t0 >= t1:
        return
    a = (half[axis] - sign * (o[axis] + t0 * d[axis])) / BIN
    b = (half[axis] - sign * (o[axis] + t1 * d[axis])) / BIN
    first, last = int(max(min(a, b), 0.0)), int(min(max(a, b), LAYERS - 1.0))
    for layer in range(first, last + 1):
        counts[layer] += 1
