"""
Input and output of the estimation: the window of one track, and its estimate, in numpy.

A process that collects windows for another one to solve imports no torch, which takes a second
and 150 MB.

"""

from collections.abc import Sequence
from typing import NamedTuple

from boxreg_ros.core.observation import Observation
from boxreg_ros.structures import Floats, Ints
import numpy as np
from numpy.typing import NDArray

PRIOR_POSES = 2
"""Poses that the marginalisation prior refers to: no residual spans more than three poses."""


class MarginalisationPrior(NamedTuple):
    """
    Quadratic priors on n windows from observations that have been marginalised, one row each.

    Their variables are the poses of the two oldest observations and the parameters that all
    observations of a track share (29 in all).

    """

    base: Floats
    """(n, 3), fixed origin of all positions of the track, in the fixed frame [m]."""
    state: Floats
    """(n, 29), linearisation point: the variables when the last observation was marginalised."""
    step: Floats
    """(n, 29), minimum of the quadratic form minus `state`."""
    information: Floats
    """(n, 29, 29), Hessian of the quadratic form."""
    marginalised_extents: Floats
    """(n, 4), sum of the input extents of marginalised observations [m], and their number."""
    extent_range: Floats
    """(n, 2, 3), range of the input extents of all observations, see `extent_ranges`."""


class Window(NamedTuple):
    """Consecutive observations of one track."""

    track_id: str
    class_name: str
    observations: Sequence[Observation]
    """N of them, ascending by stamp."""
    num_new: int
    """The last ones, that have been in no window before."""
    start: Floats
    """(N - num_new, 9), boxes of the others as estimated in the window before; empty without
    one."""
    prior: tuple[MarginalisationPrior, int] | None = None
    """From observations before the window: a table, and the row in it."""

    @property
    def is_warm(self) -> bool:
        """Return whether all observations but the newest have an estimate to start from."""
        return self.num_new == 1 and len(self.start) == len(self.observations) - 1 > 1


class Estimates(NamedTuple):
    """The refined boxes of many windows, one row each, window after window."""

    boxes: Floats
    """(n, 9), refined boxes, or input boxes where those are kept; fixed frame [m, rad]."""
    status: NDArray[np.str_]
    """(n,), ``refined`` or ``kept``."""
    reasons: NDArray[np.str_]
    """(n,), one of `KEPT_REASONS`, '' for refined ones."""
    covariances: Floats
    """(n, 6, 6), of x y z roll pitch yaw [m, rad]; the identity for kept boxes."""
    extent_covariances: Floats
    """(n, 3, 3), of length, width and height [m]; the identity for kept boxes."""
    face_distances: Floats
    """(n, 6), as in `RefinedBoxes`."""
    near_points: Ints
    """(n, 2), likewise."""
    kinematics: NDArray[np.void]
    """(n,), records `KINEMATICS`; unknown for kept boxes."""


class Estimate(NamedTuple):
    """The refined boxes of one window: some successive rows of `Estimates`."""

    table: Estimates
    """Those of all windows that were solved together."""
    begin: int
    """First row of the window."""
    end: int
    """The row after its last."""
    prior: tuple[MarginalisationPrior, int] | None = None
    """For the next window, if this one is full and was solved: a table, and the row in it."""
