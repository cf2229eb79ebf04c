"""
The residuals of the default objective, one function each, with their Jacobians.

The objective of a window is the sum over all terms of r' W r / 2 (M1), r a residual and W its
weight. The residuals are (M2) to (M9) of docs/method.md; their weights come from `weights`. The
solver needs value and gradient of the sum (`value_and_gradient`) and its Gauss-Newton curvature,
the sum of J' W J.

"""

from collections.abc import Callable, Sequence
from typing import cast, NamedTuple

from boxreg_ros.core.arrowhead import Chain, Factor, LINK, product
from boxreg_ros.core.batch import (
    ANCHOR,
    BIAS,
    EXTENT,
    GAP,
    PIVOT,
    PRIOR_SIZE,
    SHARED,
    SIDESLIP,
    State,
)
from boxreg_ros.core.geometry import rotation_derivatives, rotation_from_rpy
from boxreg_ros.core.lbfgs import select
from boxreg_ros.core.track_window import PRIOR_POSES
import torch
from torch import Tensor


class Linearised(NamedTuple):
    """
    A term at one state: n stencils of k consecutive observations, F groups of R residuals each.

    Attributes
    ----------
    residual : Tensor, shape (B, n, F, R)
        r.
    by_pose : Tensor, shape (B, n, F, R, 6 k)
        Derivative of r by the k poses of each stencil.
    by_shared : Tensor, shape (B, n, F, R, s) or (F, R, s)
        Derivative of r by the first s shared variables; without B and n if it is constant.

    """

    residual: Tensor
    by_pose: Tensor
    by_shared: Tensor


class Term(NamedTuple):
    """
    A residual function of the state and of data (B, ...), with its weight.

    Attributes
    ----------
    function : callable
        Maps a `State` and `data` to a `Linearised`.
    weight : Tensor, shape (B, n, F, R, R)
        W, symmetric and positive semidefinite; n may be less than the residual's.
    data : tuple of Tensor
        The other arguments of `function`.

    """

    function: Callable[..., Linearised]
    weight: Tensor
    data: tuple[Tensor, ...] = ()

    def linearise(self, state: State) -> Linearised:
        """Return residual and Jacobians at `state`, for as many stencils as have a weight."""
        r, J, S = self.function(state, *self.data)
        n = self.weight.shape[1]
        is_constant = S.dim() == 3
        return Linearised(r[:, :n], J[:, :n], S if is_constant else S[:, :n])


def value_and_gradient(
    terms: Sequence[Term], x: Tensor, length: int, curvature: Chain | None = None
) -> tuple[Tensor, Tensor]:
    """
    Return the sum of r' W r / 2 over all terms, shape (B,), and its gradient (B, 6 N + 23) (M1).

    The Gauss-Newton matrices J' W J are added to `curvature`, if that is given.

    """
    state = State.unpack(x, length)
    value = x.new_zeros(len(x))
    gradient = torch.zeros_like(x)
    by_pose, by_shared = State.unpack(gradient, length)  # views
    for term in terms:
        r, J, S = term.linearise(state)
        weighted = (term.weight @ r[..., None])[..., 0]  # W r
        value += 0.5 * (r * weighted).flatten(1).sum(1)
        n = r.shape[1]
        row = weighted.flatten(2)[:, :, None]  # (B, n, 1, F R)
        pose_part = product(row, J.flatten(2, 3))[:, :, 0].unflatten(2, (-1, LINK))
        for k in range(pose_part.shape[2]):
            by_pose[:, k : k + n] += pose_part[:, :, k]
        by_shared[:, : S.shape[-1]] += (row @ S.flatten(-3, -2)).sum((1, 2))
        if curvature is not None:
            _add_curvature(curvature, term.weight, J, S)
    return value, gradient


def _add_curvature(curvature: Chain, weight: Tensor, J: Tensor, S: Tensor) -> None:
    """Add J' W J of one term; `J` and `S` are the Jacobians of `Linearised`."""
    is_constant = S.dim() == 3
    shared_weight = weight.sum(1, keepdim=True) if is_constant else weight
    shared_block = product(S.mT, product(shared_weight, S)).sum((1, 2))
    WJ = product(weight, J).flatten(2, 3)
    J = J.flatten(2, 3)
    curvature.add(product(J.mT, WJ), product(WJ.mT, S.flatten(-3, -2)), shared_block)


class Objective:
    """
    The sum of all terms as a function to minimise, with fixed weights: one round.

    Parameters
    ----------
    terms : sequence of Term
        The terms.
    start, free : Tensor, shape (B, D)
        Start of the search; 1 for the variables it may change, 0 for the others.
    length : int
        N.

    Attributes
    ----------
    factor : Factor
        Cholesky factor of the Gauss-Newton curvature at the start.

    """

    def __init__(self, terms: Sequence[Term], start: Tensor, length: int, free: Tensor) -> None:
        self._terms = terms
        self._start = start
        self._length = length
        self._free = free
        curvature = Chain.zeros(start, length)
        value, gradient = value_and_gradient(terms, start, length, curvature)
        self.factor = curvature.factorised(free)
        self._at_start = value, gradient * free

    def __call__(self, x: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Return values (b,) and gradients (b, D) at `x` (b, D) of the windows `rows`."""
        if x is self._start:
            return self._at_start
        terms, free = select((self._terms, self._free), rows)
        value, gradient = value_and_gradient(terms, x, self._length)
        return value, gradient * free

    def newton(self, vector: Tensor, rows: Tensor) -> Tensor:
        """Return the inverse curvature at the start times `vector` (b, D), for `rows`."""
        return cast(Factor, select(self.factor, rows)).solve(vector)


def faces(state: State, given: Tensor, inset: Tensor) -> Linearised:
    """
    Return the planes of the six faces as 4-vectors (M2) [m].

    For each, v . (q, 1) is the signed distance of a point q, relative to the centre of the `given`
    pose (B, N, 6), from where the outermost surface points of the face are expected: the face
    less labelling margin and `inset` (B, N, 6). Positive outside. The weight of this term is the
    second moment of the points, so that its cost does not grow with their number.

    """
    R, dR = rotation_derivatives(state.pose[..., 3:])
    shift = state.pose[..., :3] - given[..., :3]
    # Planes through the centre first: (B, N, 3 axes, 4 of v, 6 of the pose).
    by_pose = R.new_zeros(*shift.shape[:2], 3, 4, 6)
    by_pose[..., 3, :3] = -R.mT
    by_pose[..., :3, 3:] = dR.permute(0, 1, 4, 3, 2)
    by_pose[..., 3, 3:] = -(shift[:, :, None, None] @ dR)[..., 0, :].mT
    planes = torch.cat([R.mT, by_pose[..., 3, :3] @ shift[..., None]], -1)
    # Then those of the faces: the front is like the axis, the back like its negative.
    residual = torch.stack([planes, -planes], 3).flatten(2, 3)
    by_pose = torch.stack([by_pose, -by_pose], 3).flatten(2, 3)
    by_shared = R.new_zeros(6, 4, GAP.stop)
    one = torch.eye(GAP.stop).to(R)
    by_shared[:, 3] = one[GAP] - one[EXTENT].repeat_interleave(2, 0) / 2
    offset = state.shared[:, : GAP.stop] @ by_shared[:, 3].mT  # (B, 6): margin - extent / 2
    residual[..., 3] += inset + offset[:, None]
    return Linearised(residual, by_pose, by_shared)


def input_pose(state: State, given: Tensor, axes: Tensor) -> Linearised:
    """
    Return the deviation of the poses from the input, less its bias (M3) [m, rad].

    `given` (B, N, 6) are the input poses, positions are along `axes` (B, N, 3, 3).

    """
    return _pose_step(state, given, axes, BIAS)


def rigid_shape(state: State, start: Tensor, wanted: Tensor) -> Linearised:
    """
    Return the steps of the poses from `start`, less those `wanted` by the rigid shape (M4).

    In box axes, (B, N, 6) both [m, rad]. The shape of a track is known up to its place in the
    box: all steps less the anchor. Vehicles tilt so little that small rotations about the box
    axes are changes of roll, pitch and yaw.

    """
    r, J, S = _pose_step(state, start, rotation_from_rpy(start[..., 3:]), ANCHOR)
    return Linearised(r - wanted[..., None, :], J, S)


def _pose_step(state: State, start: Tensor, axes: Tensor, offset: slice) -> Linearised:
    """
    Return the step of the poses from `start` (B, N, 6) along `axes` (B, N, 3, 3) [m, rad].

    The six shared variables `offset`, a common step of all poses, are subtracted.

    """
    along = torch.eye(6).to(start).repeat(*start.shape[:2], 1, 1, 1)  # (B, N, 1, 6, 6)
    along[..., :3, :3] = axes.mT[..., None, :, :]
    step = (along @ (state.pose - start)[..., None, :, None])[..., 0]
    by_shared = -torch.eye(offset.stop).to(start)[None, offset]
    return Linearised(step - state.shared[:, None, None, offset], along, by_shared)


def acceleration(state: State, times: Tensor) -> Linearised:
    """Return second differences of the pose over true time steps (M5) [m/s^2, rad/s^2]."""
    pose = state.pose
    dt = times.diff(dim=1)[..., None]
    before, after = dt[:, :-1], dt[:, 1:]
    mean = (before + after) / 2
    velocity_after = (pose[:, 2:] - pose[:, 1:-1]) / after
    velocity_before = (pose[:, 1:-1] - pose[:, :-2]) / before
    residual = (velocity_after - velocity_before) / mean
    coefficients = [1 / before, -1 / before - 1 / after, 1 / after]
    stencil = torch.stack(coefficients, -1) / mean[..., None]  # (B, N - 2, 1, 3)
    eye = torch.eye(6).to(times)
    by_pose = (stencil[..., None] * eye[:, None, :]).flatten(-2)[:, :, None]
    return Linearised(residual[:, :, None], by_pose, pose.new_zeros(1, 6, 0))


def zero_motion(state: State) -> Linearised:
    """Return first differences of the pose (M6), zero for parked objects [m, rad]."""
    difference = state.pose.diff(dim=1)[:, :, None]
    stencil = torch.cat([-torch.eye(6), torch.eye(6)], 1).to(difference)
    by_pose = stencil.expand(*difference.shape, 12)
    return Linearised(difference, by_pose, difference.new_zeros(1, 6, 0))


def slip(state: State, times: Tensor) -> Linearised:
    """Return the velocity of the pivot across the path and upward (M7) [m/s] [for Eq. 7]."""
    N = state.pose.shape[1]
    dt = times.diff(dim=1)[..., None, None]
    position, angles = state.pose[..., :3], state.pose[..., 3:]
    arm = state.shared[:, PIVOT, None, None, None]
    mid_angles = (angles[:, 1:] + angles[:, :-1]) / 2
    # One call for the axes at the N poses and at the N - 1 midpoints between them.
    R, dR = rotation_derivatives(torch.cat([angles, mid_angles], 1))
    heading = R[:, :N, :, 0]
    arm_by_angle = arm * dR[:, :N, ..., 0].mT
    sideslip = state.shared[:, SIDESLIP, None, None, None]
    to_path = torch.eye(3).to(R)[:, 1:].repeat(len(R), 1, 1, 1)  # (B, 1, 3, 2) in body axes
    to_path[:, :, :1, :1] = -sideslip
    # (B, N - 1, 2, 3): left of the path, and up, at the midpoints
    across = (R[:, N:] @ to_path).mT / dt
    across_by_angle = dR[:, N:] @ to_path[:, None] / dt[..., None]
    step = (position - arm[..., 0] * heading).diff(dim=1)
    residual = (across @ step[..., None]).mT
    tilt = (step[:, :, None, None] @ across_by_angle)[..., 0, :].mT / 2
    by_angle_before = tilt + across @ arm_by_angle[:, :-1]
    by_angle_after = tilt - across @ arm_by_angle[:, 1:]
    by_pose = torch.cat([-across, by_angle_before, across, by_angle_after], -1)[:, :, None]
    by_shared = residual.new_zeros((*residual.shape, SHARED))
    by_shared[..., PIVOT] = -(across @ heading.diff(dim=1)[..., None]).mT
    forward = R[:, N:, :, :1].mT / dt
    by_shared[..., 0, SIDESLIP] = -(forward @ step[..., None])[..., 0]
    return Linearised(residual, by_pose, by_shared)


def shared_prior(state: State, expected: Tensor) -> Linearised:
    """Return the deviation of the shared variables from those `expected` (B, 23) (M8)."""
    residual = (state.shared - expected)[:, None, None]
    by_pose = residual.new_zeros((len(expected), 1, 1, SHARED, LINK))
    return Linearised(residual, by_pose, torch.eye(SHARED).to(residual)[None])


def marginalisation_prior(state: State, mean: Tensor) -> Linearised:
    """
    Return the deviation of the oldest two poses and the shared variables from a mean (M9).

    `mean` (B, 1, 35) is the minimum of the marginalisation prior.

    """
    known = torch.cat([state.pose[:, :PRIOR_POSES].flatten(1), state.shared], 1)
    residual = known - mean[:, 0]
    by_pose, by_shared = torch.eye(PRIOR_SIZE).to(residual).split([PRIOR_SIZE - SHARED, SHARED], 1)
    by_pose = by_pose.expand(len(residual), 1, 1, -1, -1)
    return Linearised(residual[:, None, None], by_pose, by_shared[None])
