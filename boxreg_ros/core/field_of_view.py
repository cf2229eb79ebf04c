"""The upper edge of the field of view of a LiDAR, which may hide the top of an object (M11)."""

from boxreg_ros.core.method.rings import fill_slopes_of
from boxreg_ros.structures import Floats, Ints, Sweep
import numpy as np
from numpy.typing import NDArray

MIN_RETURNS = 5
"""Fewer are no evidence of a ring; chosen: stray points."""
POINT_STEP = 7
"""Every n-th point of a sweep is looked at. Chosen: a ring of a thousand still has a hundred. No
usual number of rings is a multiple: all are met where one column follows the other."""


class FieldOfView:
    """
    The highest rays of one LiDAR, known from its sweeps so far.

    The highest ring on an object is evidence of its top only if the next ring passes above. An
    object that reaches up to the highest ring of the LiDAR may be of any height.

    """

    def __init__(self) -> None:
        self._highest = -np.inf  # slope of the highest rays so far

    def hidden_tops(
        self,
        sweep: Sweep,
        origin: Floats,
        centers: Floats,
        extents: Floats,
        row: Ints,
        owner: Ints,
        ring_heights: Floats,
    ) -> NDArray[np.bool_]:
        """
        Return which objects reach up to the highest ring of the LiDAR.

        That is, no ray of this sweep or those before it is higher, and rays to other objects end
        at the same ring: a single high object is no evidence of an edge. With several LiDARs at
        once no top is hidden.

        Parameters
        ----------
        sweep : Sweep
            Its points, in the frame that they are stored in, are used.
        origin : array, shape (3,)
            Position of the sensor in this frame [m].
        centers, extents : array, shape (n, 3)
            Of the boxes: centres in this frame, and length, width and height [m].
        row, owner : array, shape (P,)
            Point and object of each pair that belongs together, ascending by object.
        ring_heights : array, shape (n,)
            Between two rings at each object [m]; 0 if unknown.

        Returns
        -------
        is_hidden : array of bool, shape (n,)
            False too where the height of the rings is unknown.

        """
        is_hidden = np.zeros(len(centers), bool)
        if sweep.origins is not None:
            return is_hidden
        looked_at = np.arange(0, len(sweep.points), POINT_STEP, dtype=row.dtype)
        slopes = _slopes(sweep.points, looked_at, origin)
        higher = slopes[slopes > self._highest]
        if len(higher) >= MIN_RETURNS:
            self._highest = float(np.partition(higher, -MIN_RETURNS)[-MIN_RETURNS])
        x, y, z = (centers - origin).T
        run = np.hypot(x, y)
        nearest = run - np.hypot(extents[:, 0], extents[:, 1]) / 2
        may_reach = z + extents[:, 2] > self._highest * nearest  # half a height above its top
        may_reach &= ring_heights > 0
        ends = np.searchsorted(owner, np.arange(len(centers) + 1))
        for k in np.flatnonzero(may_reach).tolist():
            own = row[ends[k] : ends[k + 1]]
            of_own = _slopes(sweep.points, own, origin)
            top = of_own.max(initial=-np.inf)
            half_ring = ring_heights[k] / run[k] / 2
            if top > self._highest - half_ring:
                others = np.count_nonzero(slopes > top - half_ring)
                others -= np.count_nonzero(of_own[own % POINT_STEP == 0] > top - half_ring)
                is_hidden[k] = others >= MIN_RETURNS
        return is_hidden


def _slopes(points: NDArray[np.floating], rows: Ints, origin: Floats) -> Floats:
    """Return the rise of rays from the sensor to `rows` of points (M, 3) over their run."""
    slopes = np.empty(len(rows))
    fill_slopes_of(points, rows, origin, slopes)
    return slopes
