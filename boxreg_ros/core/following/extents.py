"""Extents of a box that was drawn too small or too large, by the points along its track."""

from __future__ import annotations

from collections.abc import Sequence

from boxreg_ros.structures import Floats, Ints
import numpy as np
from numpy.typing import NDArray

MAX_GROWTH = 1.0
"""A face moves outwards by no more than this [m]; chosen: half the difference of a hatchback and a
van."""
MOST_CHANGE = 0.5
"""And no face by more than this part of half the extent: farther points are of what stands beside;
chosen."""
PERSON_ERROR, EDGE_ERROR = 0.3, 0.1
"""Faces nearer to the edge of the points stay [m]; chosen: the error of a person, the labelling
margin, and the error of the edge, 0.1. Of boxes with the size of a class the last alone: they are
known by another object of the same size, or by one face that is farther off."""
FACE_MARGIN = 0.05
"""Labelling margin of a face that moves [m]; as the settings of the classes."""
LEAST_SWEEPS, LEAST_POINTS = 5, 50
"""Fewer are no evidence for a face; chosen."""
BIN = 0.1
"""Points are counted by their distance from the centre in bins of this length [m]."""
BESIDE_EDGE = 3
"""Bins on each side of an edge that are compared; chosen: 0.3 m."""
DENSE, DENSE_OUTSIDE = 30, 20
"""Points in a bin on its inner side, of all sweeps: fewer end before the object does, since the
sensor hardly sees so far along it; points outside of the box are evidence by themselves. Swept:
15 lose PandaSet .01, 50 resimulated drives .01."""
EMPTY = 0.1
"""Points on its outer side as part of these; chosen."""
BEYOND = 0.02
"""And in all of the box behind it, as part of all: a gap is no edge; chosen."""
OUTERMOST = 0.98
"""Quantile of the points beside an edge that counts as the outermost one; chosen."""


def faces(
    sweeps: Sequence[Floats], half: Floats, is_of_class: bool, sees_top: NDArray[np.bool_]
) -> Floats:
    """
    Return the faces of a rigid object by the edges of its points.

    Parameters
    ----------
    sweeps : sequence of arrays, shape (n_i, 3)
        Points within `MAX_GROWTH` of its box in the frame of the box, without the road [m].
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
    is_within = np.abs(points) < half + BIN
    steps = np.zeros((2, 3))
    for axis, side in ((0, 0), (0, 1), (1, 0), (1, 1), (2, 1)):  # the bottom is on the road
        others = [other for other in range(3) if other != axis]
        sign = 2 * side - 1
        own = is_within[:, others].all(1) & (sign * points[:, axis] > 0)
        if axis == 2:
            own &= sees_top[owner]
        edge = _edge(sign * points[own, axis], owner[own], float(half[axis]))
        if abs(edge - half[axis]) < MOST_CHANGE * half[axis]:
            steps[side, axis] = edge - half[axis]
    is_of_class = is_of_class or bool((np.abs(steps) > PERSON_ERROR).any())
    steps[np.abs(steps) <= (EDGE_ERROR if is_of_class else PERSON_ERROR)] = 0.0
    return found + np.array([[-1.0], [1.0]]) * steps


def _edge(outwards: Floats, owner: Ints, half: float) -> float:
    """Return where the points of a side, (n,) from the centre, end; `half` if they do not show."""
    if len(outwards) < LEAST_POINTS or len(np.unique(owner)) < LEAST_SWEEPS:
        return half
    num_bins = int(np.ceil((half + MAX_GROWTH) / BIN))
    row = (outwards / BIN).astype(int)
    counts = np.bincount(row, minlength=num_bins + BESIDE_EDGE)
    peak = int(counts[: int(half / BIN) + 2].argmax())  # what stands beside may be denser
    for edge in range(max(peak + 1, BESIDE_EDGE), num_bins):
        inside = counts[edge - BESIDE_EDGE : edge].mean()
        if counts[edge : edge + BESIDE_EDGE].mean() < EMPTY * inside:
            break
    else:  # they go on: a wall, or what stands beside
        return half
    beyond = counts[edge + 1 : int(half / BIN)].sum()
    least = DENSE if edge * BIN < half else DENSE_OUTSIDE
    if inside < least or beyond > BEYOND * len(outwards):
        return half
    own = outwards[(row >= edge - BESIDE_EDGE) & (row <= edge)]
    return float(np.quantile(own, OUTERMOST)) + FACE_MARGIN
