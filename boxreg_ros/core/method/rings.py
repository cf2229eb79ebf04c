"""How far apart the rings of a LiDAR are at the top of an object, from its own points (M11)."""

from math import inf, isfinite, sqrt

from boxreg_ros.core.method.arrays import copy
from boxreg_ros.core.method.compile import kernel, loop
from boxreg_ros.core.method.selection import sort_in_place
import numpy as np

LEAST_RUN = 1e-9
"""Points are at least this far beside the sensor [m]. Derived: no slope is NaN."""
MOST_RANKED = 400
"""Points that are ordered by comparing all pairs. Measured: of more, a sort is faster."""


@kernel
def ring_heights(points, counts, origins):
    """
    Return the height between the two highest rings on each of n objects, 0 if unknown [m].

    On a wall it is the angle between rings times the distance. Where several rings meet a roof it
    is nearly 0: then the top itself is seen.

    Parameters
    ----------
    points : array, shape (P, 3)
        Points minus the centre of their object, those of one object after those of the other [m].
    counts : array, shape (n,)
        Points of each object.
    origins : array, shape (n, K, 3)
        Each sensor that sees an object minus its centre [m]; NaN if unknown.

    Returns
    -------
    heights : array, shape (n,)
        With several sensors, whose rings lie between each other, the least.

    """
    heights = np.empty(len(counts))
    most = 0
    for i in range(len(counts)):
        most = max(most, counts[i])
    slopes, gaps = np.empty(most, np.float32), np.empty(most, np.float32)
    rank, ordered = np.empty(most, np.float32), np.empty(most, np.float32)
    first = 0
    for i in range(len(counts)):
        m = counts[i]
        own, known = points[first : first + m], slopes[:m]
        first += m
        height = inf
        for k in range(origins.shape[1]):
            if m > 1 and isfinite(origins[i, k, 0]):
                fill_slopes(own, origins[i, k], known)
                ring = covering_gap(known, gaps, rank, ordered[:m])
                away = sqrt(origins[i, k, 0] ** 2 + origins[i, k, 1] ** 2)
                height = min(height, away * ring, height_of_highest(own, known, ring))
        heights[i] = height if isfinite(height) else 0.0
    return heights


@loop
def height_of_highest(points, slopes, ring):
    """Return the height of the highest ring above the next, on points (M, 3) of some slopes."""
    top = 0
    for i in range(len(points)):
        if points[i, 2] > points[top, 2]:
            top = i
    height = inf
    for i in range(len(points)):
        if abs(slopes[i] - slopes[top]) > ring / 2:
            height = min(height, points[top, 2] - points[i, 2])
    return height


@loop
def fill_slopes(points, origin, slopes):
    """Write the rise of the rays to points (M, 3) from a sensor over their run, (M,)."""
    for i in range(len(points)):
        x, y = points[i, 0] - origin[0], points[i, 1] - origin[1]
        slopes[i] = (points[i, 2] - origin[2]) / max(sqrt(x**2 + y**2), LEAST_RUN)


@loop
def fill_slopes_of(points, rows, origin, slopes):
    """Write the same of some rows (n,) of the points of a sweep, -inf where it is no number."""
    for i in range(len(rows)):
        x, y, z = points[rows[i], 0], points[rows[i], 1], points[rows[i], 2]
        run = max(sqrt((x - origin[0]) ** 2 + (y - origin[1]) ** 2), LEAST_RUN)
        slope = (z - origin[2]) / run
        slopes[i] = slope if isfinite(slope) else -inf


@loop
def sort_by_rank(values, rank, ordered):
    """
    Write values (n,) in ascending order; `rank` (n,) is to work in.

    All pairs are compared, by vector instructions: a sort of a hundred takes twice as long, since
    half of its branches are predicted wrong. All is in 32 bits: two thirds of the time of 64.

    """
    none, one = np.float32(0.0), np.float32(1.0)
    for j in range(len(values)):
        before = none
        for i in range(j):
            is_after = one if values[i] > values[j] else none
            rank[i] += is_after
            before += one - is_after
        rank[j] = before
    for i in range(len(values)):
        ordered[int(rank[i])] = values[i]


@loop
def sort(values, rank, ordered):
    """Write values (n,) in ascending order; `rank` (n,) is to work in."""
    if len(values) <= MOST_RANKED:
        sort_by_rank(values, rank, ordered)
    else:
        copy(values, ordered)
        sort_in_place(ordered)


@loop
def covering_gap(values, gaps, rank, ordered):
    """
    Return the gap between neighbours that covers the middle of all gaps in their order.

    Half of the range of the `values` (n,), at least two, is covered by gaps up to this one:
    neither the many small ones within rings count, nor one large one where nothing returned.
    `gaps`, `rank` and `ordered` (n,) are to work in.

    """
    n = len(values)
    sort(values, rank, ordered)
    half = (ordered[n - 1] - ordered[0]) / 2
    for i in range(n - 1):
        gaps[i] = ordered[i + 1] - ordered[i]
    sort(gaps[: n - 1], rank, ordered[: n - 1])
    place, covered = 0, ordered[0]
    while covered < half and place < n - 2:
        place += 1
        covered += ordered[place]
    return ordered[place]
