"""
Input and output of registration: the window of one track, and its estimate, in numpy.

A process that collects windows for another one to solve imports no torch, which takes a second
and 150 MB.

"""

from collections.abc import Sequence
from typing import NamedTuple

from boxreg_ros.core.observation import Observation
from boxreg_ros.structures import Floats, Ints
import numpy as np
from numpy.typing import NDArray

MARGIN_OBSERVATIONS = 30
"""Observations of a window that give labelling margins; measured: 130 add nothing."""
PRIOR_POSES = 2
"""Poses that the marginalisation prior refers to: no residual spans more than three poses."""


class MarginalisationPrior(NamedTuple):
    """
    Quadratic prior on a window from observations that have been marginalised.

    Its variables are the poses of the two oldest observations and the parameters that all
    observations of a track share (35 in all).

    Attributes
    ----------
    base : array, shape (3,)
        Fixed origin of all positions of the track, in the fixed frame [m].
    state : array, shape (35,)
        Linearisation point: the variables when the last observation was marginalised.
    step : array, shape (35,)
        Minimum of the quadratic form minus `state`.
    information : array, shape (35, 35)
        Hessian of the quadratic form.
    marginalised_extents : array, shape (4,)
        Sum of the input extents of marginalised observations [m], and their number.
    extent_range : array, shape (2, 3)
        Range of the input extents of all observations, see `articulation.extent_ranges`.

    """

    base: Floats
    state: Floats
    step: Floats
    information: Floats
    marginalised_extents: Floats
    extent_range: Floats


class Window(NamedTuple):
    """
    Consecutive observations of one track.

    Attributes
    ----------
    track_id, class_name : str
        Identity and category.
    observations : sequence of N Observation
        Ascending by stamp.
    num_new : int
        Observations, the last ones, that have been in no window before.
    start : array, shape (N - num_new, 9)
        Boxes of the other observations as estimated in the window before; empty without one.
    prior : MarginalisationPrior or None
        From observations before the window.

    """

    track_id: str
    class_name: str
    observations: Sequence[Observation]
    num_new: int
    start: Floats
    prior: MarginalisationPrior | None = None

    @property
    def is_warm(self) -> bool:
        """Return whether all observations but the newest have an estimate to start from."""
        return self.num_new == 1 and len(self.start) == len(self.observations) - 1 > 1

    def margin_columns(self) -> range:
        """
        Return which observations give labelling margins; each does so in one window only.

        The newest is left to the next window, which has an estimate to start from. Of many, every
        n-th is taken so that about `MARGIN_OBSERVATIONS` remain.

        """
        last = len(self.observations) - 1
        return range(max(0, last - self.num_new), last, 1 + self.num_new // MARGIN_OBSERVATIONS)


class Estimates(NamedTuple):
    """
    The refined boxes of many windows, one row each, window after window.

    Attributes
    ----------
    boxes : array, shape (n, 9)
        Refined boxes, or input boxes where those are kept; fixed frame [m, rad].
    status : array of str, shape (n,)
        ``refined`` or ``kept``.
    reasons : array of str, shape (n,)
        One of `KEPT_REASONS` for kept boxes, '' for refined ones.
    covariances : array, shape (n, 6, 6)
        Of x y z roll pitch yaw [m, rad]; the identity for kept boxes.
    extent_covariances : array, shape (n, 3, 3)
        Of length, width and height [m]; the identity for kept boxes.
    face_distances, near_points : array, shapes (n, 6) and (n, 2)
        As in `RefinedBoxes`.

    """

    boxes: Floats
    status: NDArray[np.str_]
    reasons: NDArray[np.str_]
    covariances: Floats
    extent_covariances: Floats
    face_distances: Floats
    near_points: Ints


class Estimate(NamedTuple):
    """
    The refined boxes of one window: some successive rows of `Estimates`.

    Attributes
    ----------
    table : Estimates
        Those of all windows that were solved together.
    begin, end : int
        First row of the window, and the one after its last.
    prior : MarginalisationPrior or None
        For the next window, if this one is full and was solved.

    """

    table: Estimates
    begin: int
    end: int
    prior: MarginalisationPrior | None = None

    @property
    def boxes(self) -> Floats:
        """Boxes of the window, (N, 9) [m, rad]."""
        return self.table.boxes[self._rows]

    @property
    def status(self) -> tuple[str, ...]:
        """``refined`` or ``kept``, N of them."""
        return tuple(self.table.status[self._rows].tolist())

    @property
    def reasons(self) -> tuple[str, ...]:
        """Why boxes are kept, N of them."""
        return tuple(self.table.reasons[self._rows].tolist())

    @property
    def covariances(self) -> Floats:
        """Covariances of the poses, (N, 6, 6) [m, rad]."""
        return self.table.covariances[self._rows]

    @property
    def _rows(self) -> slice:
        return slice(self.begin, self.end)
