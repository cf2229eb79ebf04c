"""
A batch of windows as padded tensors, its estimated variables, and its solution.

The estimated variables of a window of N observations are x = (p_1, ..., p_N, s): poses p_i of six
numbers each and the shared variables s, the same for all observations, see `State`.

"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cache
from itertools import chain
from operator import attrgetter
from typing import Any, NamedTuple

from boxreg_ros.config import ClassConfig, Config
from boxreg_ros.core.arrowhead import LINK
from boxreg_ros.core.kernels import contiguous
from boxreg_ros.core.kernels.arrays import ClassArrays, WindowArrays
from boxreg_ros.core.track_window import PRIOR_POSES
from boxreg_ros.structures import Floats, Ints, POSE
import numpy as np
import torch
from torch import Tensor

CLASS_NUMBERS = [item.name for item in fields(ClassConfig)[1:]]
"""Names of the columns of `Problem.class_numbers`."""
numbers_of = attrgetter(*CLASS_NUMBERS)
"""Returns the numbers of a `ClassConfig`, in this order."""
ACCELERATIONS = ('acceleration', 'cornering', 'vertical', 'tilting', 'tilting', 'turning')
"""Settings of `ClassConfig` that are the deviations of the accelerations of a pose."""
FACE_GAPS = ('gap_ends', 'gap_ends', 'gap_sides', 'gap_sides', 'gap_top', 'gap_bottom')
"""Settings of `ClassConfig` that are the expected margins of the six faces."""
POSE_ERRORS = ('position', 'lateral', 'height', 'tilt', 'tilt', 'heading')
"""The settings of `ClassConfig` that are the deviations of an input pose: x y z roll pitch yaw."""

SHARED = 23
"""
Shared variables: extent (3), input bias (6), labelling margins (6), pivot, shape anchor (6),
sideslip.

"""
EXTENT = slice(0, 3)
BIAS = slice(3, 9)
GAP = slice(9, 15)
PIVOT = 15
ANCHOR = slice(16, 22)
SIDESLIP = 22

PADDING_POSITION = 1e6
"""Coordinate of padding points [m]; derived: near no box, and finite in float32."""

PADDING_PERIOD = 0.1
"""Time step of padding observations [s]; any positive number keeps times increasing."""
PRIOR_SIZE = PRIOR_POSES * LINK + SHARED


@cache
def _columns_of(*names: str) -> Ints:
    """Return the columns of `Problem.class_numbers` with these names."""
    return np.array([CLASS_NUMBERS.index(name) for name in names])


@dataclass(frozen=True, slots=True)
class Returns:
    """
    The returns of all observations of a batch, one observation after the other.

    Attributes
    ----------
    points : Tensor, shape (P, 3)
        Returns minus the centre of their input box [m].
    delays : Tensor, shape (P,)
        Their measurement times relative to the stamp of their box [s].
    is_moving : bool
        Whether any delay is not zero.
    width : int
        Most returns of an observation, at least 1: M.
    stride : int
        Every n-th return of an observation is used.

    """

    points: Tensor
    delays: Tensor
    is_moving: bool
    width: int
    stride: int = 1

    def padded(self, first: Tensor, counts: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """
        Return points (B, N, M, 3), their validity mask (B, N, M), and delays (B, N, M).

        `first` and `counts` (B, N) as in `Problem`. Padding comes last, at `PADDING_POSITION`.

        """
        place = torch.arange(self.width, device=counts.device)
        mask = place < counts[..., None]
        index = (first[..., None] + self.stride * place)[mask]
        points = self.points.new_full((*mask.shape, 3), PADDING_POSITION)
        points[mask] = self.points[index]
        delays = self.delays.new_zeros(mask.shape)
        delays[mask] = self.delays[index]
        return points, mask, delays


class Problem(NamedTuple):
    """
    A batch of padded windows; centres are relative to one point per window.

    Attributes
    ----------
    boxes : Tensor, shape (B, N, 9)
        Input boxes, yaw unwrapped along the window and 180° flips corrected [m, rad].
    start : Tensor, shape (B, N, 9)
        Start of the search: the input, or the estimate of the window before.
    valid : Tensor, shape (B, N)
        True for observations, False for padding.
    times : Tensor, shape (B, N)
        Time since the first observation, increasing over the padding too [s].
    returns : Returns
        The returns of all observations.
    first, counts : Tensor, shape (B, N)
        First of the returns of each observation, and their number.
    origins : Tensor, shape (B, N, K, 3)
        Each sensor that sees the object minus the centre of the input box [m]; NaN if unknown.
    ground : Tensor, shape (B, N)
        Height of the road minus that of the input centre [m]; NaN if unknown.
    prior_mean, prior_information : Tensor, shapes (B, 35) and (B, 35, 35)
        Marginalisation prior on the two oldest poses and the shared variables: the minimum of its
        quadratic form, and its information matrix. The information is 0 without a prior.
    marginalised_extents : Tensor, shape (B, 4)
        Sum of the input extents of marginalised observations, and the number of these.
    class_numbers : Tensor, shape (B, C)
        The numbers of each window's `ClassConfig`, in the order of `CLASS_NUMBERS`.
    pinned : Tensor, shape (B, N)
        True for boxes that a person has corrected.
    kind : Tensor, shape (B,)
        Index of the kind of each window's object among `KINDS`.

    """

    boxes: Tensor
    start: Tensor
    valid: Tensor
    times: Tensor
    returns: Returns
    first: Tensor
    counts: Tensor
    origins: Tensor
    ground: Tensor
    prior_mean: Tensor
    prior_information: Tensor
    marginalised_extents: Tensor
    class_numbers: Tensor
    pinned: Tensor
    kind: Tensor

    @property
    def pose(self) -> Tensor:
        """Input poses x y z roll pitch yaw, shape (B, N, 6)."""
        return self.boxes[..., POSE]

    @property
    def length(self) -> int:
        """Observations per window, padding included: N."""
        return self.boxes.shape[1]

    def padded(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return points (B, N, M, 3), their validity mask (B, N, M), and delays, see `Returns`."""
        return self.returns.padded(self.first, self.counts)

    @property
    def points(self) -> Tensor:
        """Return the padded points minus the centre of their input box, (B, N, M, 3) [m]."""
        return self.padded()[0]

    @property
    def mask(self) -> Tensor:
        """Return the validity of the padded `points`, shape (B, N, M)."""
        return self.padded()[1]

    def of_class(self, *names: str) -> Tensor:
        """Return the settings `names` of the class of each window, shape (B, number of names)."""
        columns = torch.from_numpy(_columns_of(*names))
        return self.class_numbers.index_select(1, columns.to(self.class_numbers.device))

    def arrays(self) -> WindowArrays:
        """Return the windows for the kernels, which take no padding."""
        return WindowArrays(
            contiguous(self.boxes),
            contiguous(self.valid.sum(1)),
            contiguous(self.times),
            contiguous(self.origins),
            contiguous(self.ground),
            contiguous(self.returns.points),
            contiguous(self.returns.delays),
            contiguous(self.first),
            contiguous(self.counts),
            self.returns.stride,
            contiguous(self.pinned),
            contiguous(self.marginalised_extents),
            contiguous(self.kind),
        )

    def class_arrays(self) -> ClassArrays:
        """Return the settings of the class of each window for the kernels."""
        numbers = contiguous(self.class_numbers)

        def of_class(*names: str) -> Floats:
            found: Floats = numbers.take(_columns_of(*names), axis=1)
            return found[:, 0] if len(names) == 1 else found

        return ClassArrays(
            acceleration=of_class(*ACCELERATIONS),
            slip=of_class('slip', 'climb'),
            drift=of_class('drift'),
            pose=of_class(*POSE_ERRORS),
            extent=of_class('extent'),
            gap_spread=of_class('gap_spread'),
            sideslip=of_class('sideslip'),
            shape=of_class('shape'),
            gaps=of_class(*FACE_GAPS),
            pivot=of_class('pivot'),
        )

    def part(self, windows: Sequence[int], columns: Sequence[Sequence[int]]) -> 'Problem':
        """
        Return some windows with some of their observations only.

        Marginalised observations are left out, with their prior and their extents.

        Parameters
        ----------
        windows : sequence of b int
            Rows of the windows.
        columns : sequence of b sequences of int
            Columns of the observations of each of them, ascending, at least one.

        Returns
        -------
        part : Problem
            Of b windows, padded to the most observations that one of them has.

        """
        lengths = torch.tensor(list(map(len, columns)))
        valid = torch.arange(int(lengths.max())) < lengths[:, None]
        last = torch.tensor([of_window[-1] for of_window in columns])
        column = last[:, None].repeat(1, valid.shape[1])
        column[valid] = torch.tensor(list(chain.from_iterable(columns)))
        device = self.valid.device
        valid, column = valid.to(device), column.to(device)
        row = torch.tensor(windows, device=device)[:, None]
        observed = {name: getattr(self, name)[row, column] for name in OBSERVED}
        observed['times'] = observed['times'] + PADDING_PERIOD * (~valid).cumsum(1)
        kept = {name: getattr(self, name)[row[:, 0]] for name in OF_CLASS}
        none: dict[str, Any] = {
            name: self.boxes.new_zeros(()).expand(len(windows), *sizes)
            for name, sizes in SIZES_OF_PRIOR.items()
        }
        return self._replace(**observed, **kept, **none, valid=valid)

    def thinned(self, points: float) -> 'Problem':
        """Return the problem with every n-th point: at least `points` per box, if there are."""
        returns = self.returns
        stride = max(1, int(returns.width // points))
        width = -(-returns.width // stride)
        counts = -(-self.counts // stride)
        returns = replace(returns, width=width, stride=stride * returns.stride)
        return self._replace(returns=returns, counts=counts)


OBSERVED = ('boxes', 'start', 'times', 'first', 'counts', 'origins', 'ground', 'pinned')
"""Fields of `Problem` with one value per observation, besides `valid`."""
OF_CLASS = ('class_numbers', 'kind')
"""Fields of `Problem` with the class of each window."""
SIZES_OF_PRIOR = {
    'prior_mean': (PRIOR_SIZE,),
    'prior_information': (PRIOR_SIZE, PRIOR_SIZE),
    'marginalised_extents': (4,),
}
"""Fields of `Problem` about marginalised observations, and the sizes of their values."""


class State(NamedTuple):
    """
    The estimated variables: the poses of a window, and those shared by all its observations.

    Attributes
    ----------
    pose : Tensor, shape (B, N, 6)
        x y z roll pitch yaw [m, rad].
    shared : Tensor, shape (B, 23)
        Extent of the object [m]; bias of the input poses, along their axes [m, rad]; labelling
        margin of each face, from its outermost points out to the face [m]; distance of the pivot
        behind the centre, where the object has no sideways velocity [m]; anchor of the rigid
        shape, a step of all poses in box axes [m, rad]; angle from the heading to the path [rad].

    """

    pose: Tensor
    shared: Tensor

    @classmethod
    def unpack(cls, x: Tensor, length: int) -> 'State':
        """Return views into variables `x` (B, 6 N + 23)."""
        return cls(x[:, : LINK * length].unflatten(1, (length, LINK)), x[:, LINK * length :])

    def pack(self) -> Tensor:
        """Return the variables as one row per window, shape (B, 6 N + 23)."""
        return torch.cat([self.pose.flatten(1), self.shared], 1)


class MarginalPrior(NamedTuple):
    """
    The prior that the oldest observation of a window leaves behind, see `prior.marginalise`.

    Attributes
    ----------
    state, step : Tensor, shape (B, 35)
        The linearisation point, and the step from there to the minimum.
    information : Tensor, shape (B, 35, 35)
        The information matrix.

    """

    state: Tensor
    step: Tensor
    information: Tensor


class Posterior(NamedTuple):
    """
    Covariances of the estimate of B windows, and the residuals of its faces.

    Attributes
    ----------
    poses : Tensor, shape (B, N, 6, 6)
        Covariances of x y z roll pitch yaw [m, rad].
    extents : Tensor, shape (B, 3, 3)
        Covariances of length, width and height [m].
    face_distances : Tensor, shape (B, N, 6)
        Signed distance of the outermost points of each face from where they are expected, by the
        estimated extents and the margins of other tracks, positive outside [m]; 0 without points.

    """

    poses: Tensor
    extents: Tensor
    face_distances: Tensor

    @classmethod
    def zeros(cls, pose: Tensor) -> 'Posterior':
        """Return zeros for windows with the poses `pose` (B, N, 6)."""
        B, N, _ = pose.shape
        return cls(pose.new_zeros(B, N, 6, 6), pose.new_zeros(B, 3, 3), pose.new_zeros(B, N, 6))


class Solution(NamedTuple):
    """
    A solved batch.

    Attributes
    ----------
    state : State
        Poses and shared variables.
    posterior : Posterior
        Covariances of poses and extents, and residuals of the faces.
    prior : MarginalPrior or None
        Marginalisation prior that full sliding windows leave to the next ones; NaN for others.
    marginalised_extents : Tensor or None, shape (B, 4)
        `Problem.marginalised_extents` of the next window.
    extent_evidence : Tensor, shape (B, 3, 3)
        Evidence of the points alone about the extents, see `Population`.

    """

    state: State
    posterior: Posterior
    prior: MarginalPrior | None = None
    marginalised_extents: Tensor | None = None
    extent_evidence: Tensor = torch.zeros(0)


def free_variables(problem: Problem, config: Config) -> Tensor:
    """Return 1 for every variable (B, 6 N + 23) that is estimated, 0 for those held fixed."""
    pose = problem.valid[..., None].to(problem.boxes).expand(-1, -1, LINK).clone()
    shared = pose.new_ones((len(pose), SHARED))
    if config.mode == 'bev':
        pose[..., [2, 3, 4]] = 0.0
        shared[:, 2] = 0.0
    if config.extent == 'fixed':
        shared[:, EXTENT] = 0.0
    if not config.ingredients.input_bias:
        shared[:, BIAS] = 0.0
    return State(pose, shared).pack()
