"""Extents of a box that was drawn too small or too large, by the points along its track."""

from __future__ import annotations

from collections.abc import Sequence

from boxreg_ros.core.following.kernels.free_space import BIN
from boxreg_ros.structures import Floats
import numpy as np

MAX_GROWTH = 1.0
"""A face moves by no more than this [m]; chosen: half the difference of a hatchback and a van."""
MOST_GROWTH = 0.25
"""And no more than this part of the extent: farther points are of what stands beside; chosen."""
MIN_GROWTH = 0.2
"""A face nearer to the outermost points stays: the labelling margin and the error of a person [m];
chosen."""
MIN_SHRINKAGE = 0.3
"""The same inwards [m]; chosen: corners are round, and rays pass them."""
FACE_MARGIN = 0.05
"""Labelling margin of a face that moves [m]; as the settings of the classes."""
LEAST_SWEEPS, LEAST_POINTS = 5, 50
"""Fewer are no evidence for a face; chosen."""
MIN_SHARE, MIN_SHARE_SWEEPS = 0.01, 0.3
"""Bins with a smaller part of the points, or in a smaller part of the sweeps, are no part of the
object: mirrors, and what it passes; chosen."""
LEAST_RAYS, LEAST_RAY_SWEEPS = 50, 3
"""Rays through a layer that show that nothing is there, and sweeps of these; chosen."""
MOST_THROUGH = 0.1
"""Rays through the core as part of those through a layer that is free; chosen."""
OUTERMOST = 0.98
"""Quantile of the points that counts as the outermost one; chosen."""


def faces(sweeps: Sequence[Floats], half: Floats) -> Floats:
    """
    Return the faces of an object by its points.

    Parameters
    ----------
    sweeps : sequence of arrays, shape (n_i, 3)
        Points within `MAX_GROWTH` of its box in the frame of the box, without the road [m].
    half : array, shape (3,)
        Half the extents of the box.

    Returns
    -------
    faces : array, shape (2, 3)
        Smallest and largest x y z of the object; -half and half where they need not grow.

    """
    found = np.stack([-half, half])
    points = np.concatenate(sweeps)
    owner = np.repeat(np.arange(len(sweeps)), [len(one) for one in sweeps])
    is_within = np.abs(points) < half + MIN_GROWTH / 2
    for axis, side in ((0, 0), (0, 1), (1, 0), (1, 1), (2, 1)):  # the bottom is on the road
        others = [other for other in range(3) if other != axis]
        sign = 2 * side - 1
        own = is_within[:, others].all(1) & (sign * points[:, axis] > half[axis] / 2)
        found[side, axis] = sign * _face(sign * points[own, axis], owner[own], float(half[axis]))
    return found


def freed(
    found: Floats, sweeps: Sequence[Floats], crossed: Floats, through: int, half: Floats
) -> Floats:
    """
    Return faces (2, 3) moved inwards, past the space that rays have crossed.

    Parameters
    ----------
    found : array, shape (2, 3)
        Faces, see `faces`.
    sweeps : sequence of arrays, shape (n_i, 3)
        Points in the box and beside it, as of `faces`.
    crossed : array, shape (m, 3, 2, LAYERS)
        Rays of some sweeps through the layers behind each face, see `free_space.crossings`.
    through : int
        Rays of all of them through the core.
    half : array, shape (3,)
        Half the extents of the box.

    """
    points = np.concatenate(sweeps)
    points = points[(np.abs(points) < half + MIN_GROWTH / 2).all(1)]
    faces = found.copy()
    if len(points) < LEAST_POINTS:
        return faces
    least = max(LEAST_RAYS, through / MOST_THROUGH)
    is_free = (crossed.sum(0) >= least) & ((crossed > 0).sum(0) >= LEAST_RAY_SWEEPS)
    for axis, side in ((0, 0), (0, 1), (1, 0), (1, 1), (2, 1)):
        sign = 2 * side - 1
        layers = is_free[axis, side]
        depth = BIN * (len(layers) if layers.all() else int(np.argmin(layers)))
        outermost = float(np.quantile(sign * points[:, axis], OUTERMOST)) + FACE_MARGIN
        face = max(half[axis] - depth, outermost)
        has_grown = sign * found[side, axis] > half[axis]
        if not has_grown and half[axis] - face > MIN_SHRINKAGE:
            faces[side, axis] = sign * face
    return faces


def _face(outwards: Floats, owner: Floats, half: float) -> float:
    """Return where the points of a side end, by their distances (n,) from the centre."""
    num_sweeps = len(np.unique(owner))
    if len(outwards) < LEAST_POINTS or num_sweeps < LEAST_SWEEPS:
        return half
    edges = np.arange(half / 2, half + MAX_GROWTH, BIN)
    row = np.searchsorted(edges, outwards) - 1
    counts = np.bincount(row, minlength=len(edges))
    seen = np.unique(owner * len(edges) + row) % len(edges)
    sweeps = np.bincount(seen, minlength=len(edges))
    is_filled = (counts > MIN_SHARE * len(row)) & (sweeps > MIN_SHARE_SWEEPS * num_sweeps)
    peak = int(counts.argmax())
    empty = np.flatnonzero(~is_filled[peak:])
    if not len(empty):  # it goes on: a wall, or what stands beside
        return half
    own = outwards[row < peak + empty[0]]
    face = float(np.quantile(own, OUTERMOST)) + FACE_MARGIN if len(own) else half
    grows = MIN_GROWTH < face - half < 2 * MOST_GROWTH * half
    return face if grows else half
