"""How far apart the rings of a LiDAR are at the top of an object, from its own points (M11)."""

from math import inf, isfinite, sqrt

from boxreg_ros.core.method.compile import kernel, loop
import numpy as np


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
    heights = np.zeros(len(counts))
    most = max(counts.max(), 1) if len(counts) else 0
    slopes, ordered = np.empty(most), np.empty(most)
    first = 0
    for i in range(len(counts)):
        m = counts[i]
        own, known = points[first : first + m], slopes[:m]
        first += m
        height = inf
        for k in range(origins.shape[1]):
            if m > 1 and isfinite(origins[i, k, 0]):
                fill_slopes(own, origins[i, k], known)
                ordered[:m] = known
                ordered[:m].sort()
                ring = covering_gap(ordered[:m])
                away = sqrt(origins[i, k, 0] ** 2 + origins[i, k, 1] ** 2)
                height = min(height, away * ring, height_of_highest(own, known, ring))
        if isfinite(height):
            heights[i] = height
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
        slopes[i] = (points[i, 2] - origin[2]) / sqrt(x**2 + y**2)


@kernel
def covering_gap(values):
    """
    Return the gap between neighbours that covers the middle of all gaps in their order; 0 without.

    Half of the range of the sorted `values` is covered by gaps up to this one: neither the many
    small ones within rings count, nor one large one where nothing returned.

    """
    n = len(values) - 1
    if n < 1:
        return 0.0
    gaps = values[1:] - values[:-1]
    gaps.sort()
    half = gaps.sum() / 2
    covered = 0.0
    for gap in gaps:
        covered += gap
        if covered >= half:
            return gap
    return 0.0
