"""Extents of a box that was drawn too small or too large, by the points along its track."""

from __future__ import annotations

from collections.abc import Sequence

from boxreg_ros.core.method.follow_numbers import FOLLOW
from boxreg_ros.structures import Floats, Ints
import numpy as np
from numpy.typing import NDArray


def faces(
    sweeps: Sequence[Floats], half: Floats, is_of_class: bool, sees_top: NDArray[np.bool_]
) -> Floats:
    """
    Return the faces of a rigid object by the edges of its points.

    Parameters
    ----------
    sweeps : sequence of arrays, shape (n_i, 3)
        Points within `max_growth` of its box in the frame of the box, without the road [m].
    half : array, shape (3,)
        Half the extents of the box.
    is_of_class : bool
        Whether it is known that a tool gave it the size of its class.
    sees_top : array, shape (m,)
        Whether the sensor sees points above the box, by sweep: points of the others end at the
        limit of its field of view.

    Returns
    -------
    faces : array, shape (2, 3)
        Smallest and largest x y z of the object; -half and half where points show no other.

    """
    found = np.stack([-half, half])
    points = np.concatenate(sweeps)
    owner = np.repeat(np.arange(len(sweeps)), [len(one) for one in sweeps])
    is_within = np.abs(points) < half + FOLLOW.bin_length
    steps = np.zeros((2, 3))
    for axis, side in ((0, 0), (0, 1), (1, 0), (1, 1), (2, 1)):  # the bottom is on the road
        others = [other for other in range(3) if other != axis]
        sign = 2 * side - 1
        own = is_within[:, others].all(1) & (sign * points[:, axis] > 0)
        if axis == 2:
            own &= sees_top[owner]
        edge = _edge(sign * points[own, axis], owner[own], float(half[axis]))
        if abs(edge - half[axis]) < FOLLOW.max_change * half[axis]:
            steps[side, axis] = edge - half[axis]
    is_of_class = is_of_class or bool((np.abs(steps) > FOLLOW.person_error).any())
    steps[np.abs(steps) <= (FOLLOW.bin_length if is_of_class else FOLLOW.person_error)] = 0.0
    return found + np.array([[-1.0], [1.0]]) * steps


def _edge(outwards: Floats, owner: Ints, half: float) -> float:
    """Return where the points of a side, (n,) from the centre, end; `half` if they do not show."""
    if len(np.unique(owner)) < FOLLOW.min_sweeps:
        return half
    num_bins = int(np.ceil((half + FOLLOW.max_growth) / FOLLOW.bin_length))
    row = (outwards / FOLLOW.bin_length).astype(int)
    counts = np.bincount(row, minlength=num_bins + FOLLOW.edge_bins)
    within = counts[: int(half / FOLLOW.bin_length) + 2]
    peak = int(within.argmax())  # what stands beside may be denser
    for edge in range(max(peak + 1, FOLLOW.edge_bins), num_bins):
        inside = counts[edge - FOLLOW.edge_bins : edge].mean()
        if counts[edge : edge + FOLLOW.edge_bins].mean() < FOLLOW.empty * inside:
            break
    else:  # they go on: a wall, or what stands beside
        return half
    beyond = counts[edge + 1 : int(half / FOLLOW.bin_length)].sum()
    least = FOLLOW.dense if edge * FOLLOW.bin_length < half else FOLLOW.dense_outside
    if inside < least or beyond > FOLLOW.stray * len(outwards):
        return half
    own = outwards[(row >= edge - FOLLOW.edge_bins) & (row <= edge)]
    return float(np.quantile(own, 1 - FOLLOW.stray)) + FOLLOW.face_margin
