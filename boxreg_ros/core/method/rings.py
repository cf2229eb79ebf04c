"""How far apart the rings of a LiDAR are at an object, seen from its own points."""

from math import inf, isfinite, sqrt

from boxreg_ros.core.method.compile import kernel, loop
import numpy as np


@kernel
def ring_heights(points, counts, origins):
    """
    Return the height between two rings of the LiDAR at each of n objects, 0 if unknown [m].

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
        With several sensors, whose rings lie between each other, that of the densest.

    """
    heights = np.zeros(len(counts))
    slopes = np.empty(max(counts.max(), 1)) if len(counts) else np.empty(0)
    first = 0
    for i in range(len(counts)):
        own, known = points[first : first + counts[i]], slopes[: counts[i]]
        first += counts[i]
        height = inf
        for k in range(origins.shape[1]):
            origin = origins[i, k]
            if not isfinite(origin[0]):
                continue
            fill_slopes(own, origin, known)
            known.sort()
            distance = sqrt(origin[0] ** 2 + origin[1] ** 2)
            height = min(height, distance * covering_gap(known))
        if isfinite(height):
            heights[i] = height
    return heights


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
