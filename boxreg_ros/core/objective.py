"""
The objective: its terms, one function each.

The paper's come first, under their equation numbers, as functions of boxes and points for
automatic differentiation. Ours follow: every term is a residual r with its Jacobian and a weight
W, adding r' W r / 2; W holds the expected deviations and the robust weights of the present round.

"""

from collections.abc import Callable, Sequence
from dataclasses import fields
from typing import cast, NamedTuple

from boxreg_ros.config import ClassConfig, PaperConfig
from boxreg_ros.core.arrowhead import Chain, cholesky, Factor, LINK, product
from boxreg_ros.core.geometry import (
    face_distances,
    rotation_derivatives,
    rotation_from_rpy,
)
from boxreg_ros.core.lbfgs import select
from boxreg_ros.rotations import wrap_angle
from boxreg_ros.structures import POSE
import torch
from torch import Tensor
from torch.linalg import solve_triangular
from torch.nn.functional import pad

DEVIATIONS = [item.name for item in fields(ClassConfig)[1:]]
EPSILON = 1e-9  # inside roots, so that the paper's norms have a gradient at zero


class Problem(NamedTuple):
    """
    A batch of padded windows; centres are relative to one point per window.

    Attributes
    ----------
    boxes : Tensor, shape (B, N, 9)
        Input boxes, yaw unwrapped along the window and half turns undone [m, rad].
    start : Tensor, shape (B, N, 9)
        Where the search starts: the input, or what the window before made of it.
    valid : Tensor, shape (B, N)
        True where an observation is real.
    times : Tensor, shape (B, N)
        Since the first observation, growing over the padding too [s].
    points, mask : Tensor, shapes (B, N, M, 3) and (B, N, M)
        Returns minus the centre of their input box [m], very far away where not real; True where
        real.
    delays : Tensor, shape (B, N, M)
        When each return was measured, relative to the stamp of its box [s].
    origins : Tensor, shape (B, N, 3)
        Sensor minus the centre of the input box [m]; NaN where unknown.
    ground : Tensor, shape (B, N)
        Height of the road minus that of the input centre [m]; NaN where unknown.
    recalled, information : Tensor, shapes (B, 34) and (B, 34, 34)
        Where the quadratic form is least that stands for what has left the window, in its two
        oldest poses and what is shared, and its curvature.
    seen : Tensor, shape (B, 4)
        Sum of the input extents that have left, and their number.
    deviations : Tensor, shape (B, D)
        The numbers of each window's `ClassConfig`, in the order of `DEVIATIONS`.

    """

    boxes: Tensor
    start: Tensor
    valid: Tensor
    times: Tensor
    points: Tensor
    mask: Tensor
    delays: Tensor
    origins: Tensor
    ground: Tensor
    recalled: Tensor
    information: Tensor
    seen: Tensor
    deviations: Tensor

    @property
    def pose(self) -> Tensor:
        """Input poses x y z roll pitch yaw, shape (B, N, 6)."""
        return self.boxes[..., POSE]

    def of(self, *names: str) -> Tensor:
        """Return deviations by name, (B, n)."""
        return self.deviations[:, [DEVIATIONS.index(name) for name in names]]

    def thinned(self, enough: float) -> 'Problem':
        """Return the same with every n-th point, so that `enough` are left if there are."""
        names, stride = ('points', 'mask', 'delays'), max(1, self.points.shape[2] // enough)
        return self._replace(**{name: getattr(self, name)[:, :, ::stride] for name in names})


# --- the paper ----------------------------------------------------------------------------------


def closeness(boxes: Tensor, points: Tensor, mask: Tensor, nearest: int) -> Tensor:
    """
    Return the squared distances of the K points closest to each visible face [Eq. 4].

    Parameters
    ----------
    boxes : Tensor, shape (B, N, 9)
        Boxes [m, rad].
    points, mask : Tensor, shapes (B, N, M, 3) and (B, N, M)
        Points in the frame of the boxes [m]; True where real.
    nearest : int
        K.

    Returns
    -------
    loss : Tensor, shape (B,)
        Mean over observations and K, summed over the three axes [m^2].

    Notes
    -----
    One face per axis is visible, the one on the side of the points' centre of mass. The choice
    of faces and of points follows the boxes at every evaluation. Where fewer than K points are
    real the mean is over those.

    """
    distances = face_distances(points, boxes)
    weight = mask.to(boxes)
    outward = (distances[..., 0::2] - distances[..., 1::2]) * weight[..., None]
    front_is_seen = outward.sum(-2, keepdim=True) > 0
    squares = torch.where(front_is_seen, distances[..., 0::2], distances[..., 1::2]) ** 2
    squares = torch.where(mask[..., None], squares, torch.inf)
    closest = squares.topk(min(nearest, squares.shape[-2]), dim=-2, largest=False).values
    real = closest.isfinite()
    mean = torch.where(real, closest, 0.0).sum(-2) / real.sum(-2).clamp(min=1)
    return _mean(mean.sum(-1), mask.any(-1))


def enclosure(boxes: Tensor, points: Tensor, mask: Tensor) -> Tensor:
    """
    Return the mean L1 distance from the points to the six faces, shape (B,) [m] [Eq. 5].

    Constant while a point is inside, growing once it leaves: only escaped points pull.

    """
    weight = mask.to(boxes)
    distances = face_distances(points, boxes).abs().mean(-1) * weight
    return _mean(distances.sum(-1) / weight.sum(-1).clamp(min=1), mask.any(-1))


def smoothness(boxes: Tensor, valid: Tensor, rounding: float = EPSILON) -> Tensor:
    """
    Return the mean change of the pose's step from box to box, shape (B,) [Eq. 6].

    Notes
    -----
    Steps of the angles are wrapped; `rounding` inside the root gives equal steps a gradient.

    """
    pose = boxes[..., POSE]
    step = pose[:, 1:] - pose[:, :-1]
    step = torch.cat([step[..., :3], wrap_angle(step[..., 3:])], -1).abs()
    change = (step[:, 1:] - step[:, :-1]).square().sum(-1)
    return _mean((change + rounding).sqrt(), valid[:, 2:])


def alignment(boxes: Tensor, valid: Tensor, rounding: float = EPSILON) -> Tensor:
    """
    Return the mean distance between heading and direction of motion, shape (B,) [Eq. 7].

    Notes
    -----
    The direction of a step of no length is undefined: a step counts in full from 0.1 m on and
    fades to nothing at rest. A window that moves against its headings on the whole is that of a
    reversing object: its direction is turned around. The paper also wraps its alpha, the roll,
    into [-pi/2, pi/2], which this term does not depend on.

    """
    heading = rotation_from_rpy(boxes[:, :-1, 6:9])[..., 0]
    step = boxes[:, 1:, :3] - boxes[:, :-1, :3]
    length = (step.square().sum(-1) + rounding).sqrt()
    direction = step / length[..., None]
    along = ((heading * step).sum(-1) * valid[:, 1:]).sum(-1)
    forward = torch.where(along < 0, -1.0, 1.0)[:, None, None]
    gap = ((heading - forward * direction).square().sum(-1) + rounding).sqrt()
    return _mean(gap * (length / 0.1).clamp(max=1.0), valid[:, 1:])


def total(
    boxes: Tensor, problem: Problem, weights: PaperConfig, multipliers: Tensor, rounding: float
) -> tuple[Tensor, Tensor]:
    """
    Return the objective (B,) [Eq. 8] and the violation (B, 2) of its two constraints.

    Notes
    -----
    The paper names weights and augmented Lagrange multipliers without saying how they go
    together. Smoothness and alignment are constraints c = 0 here, each adding m c + w c^2 / 2
    with its weight w and its multiplier m, which `multipliers` (B, 2) holds.

    """
    points = problem.points + problem.boxes[..., None, :3]
    terms = smoothness, alignment
    violation = torch.stack([term(boxes, problem.valid, rounding) for term in terms], -1)
    penalty = violation.new_tensor([weights.smoothness, weights.alignment])
    loss = weights.closeness * closeness(boxes, points, problem.mask, weights.nearest)
    loss = loss + weights.enclosure * enclosure(boxes, points, problem.mask)
    return loss + (multipliers * violation + penalty * violation**2 / 2).sum(-1), violation


def _mean(values: Tensor, real: Tensor) -> Tensor:
    """Average (B, n) over what is real; nothing real gives 0."""
    weight = real.to(values)
    return (values * weight).sum(-1) / weight.sum(-1).clamp(min=1)


# --- ours ---------------------------------------------------------------------------------------

SHARED = 22  # extent (3), bias of the input (6), gap of the faces (6), pivot, anchor (6)
EXTENT, BIAS, GAP = slice(0, 3), slice(3, 9), slice(9, 15)
PIVOT, ANCHOR = 15, slice(16, 22)
ERRORS = 'position', 'lateral', 'height', 'tilt', 'tilt', 'heading'  # of a pose, by deviation
MEMORY = 12 + SHARED


class State(NamedTuple):
    """
    What is estimated: the poses of a window, and what all its observations share.

    Attributes
    ----------
    pose : Tensor, shape (B, N, 6)
        x y z roll pitch yaw [m, rad].
    shared : Tensor, shape (B, 22)
        Extent [m]; bias of the input poses, along their axes [m, rad]; gap from the outermost
        points of each face out to the face [m]; how far behind the centre the point is that
        does not slip sideways [m].

    """

    pose: Tensor
    shared: Tensor

    @classmethod
    def unpack(cls, x: Tensor, length: int) -> 'State':
        """Return views into variables (B, 6 N + 22)."""
        return cls(x[:, : 6 * length].unflatten(1, (length, 6)), x[:, 6 * length :])

    def pack(self) -> Tensor:
        """Return the variables as one row per window (B, 6 N + 22)."""
        return torch.cat([self.pose.flatten(1), self.shared], 1)


class Linearised(NamedTuple):
    """
    A term at one state: n stencils of k observations in a row, F groups of R residuals each.

    `residual` is (B, n, F, R), its derivative `by_pose` (B, n, F, R, 6 k) and, by the first s
    shared variables, `by_shared` (B, n, F, R, s), or (F, R, s) where that is the same for all.

    """

    residual: Tensor
    by_pose: Tensor
    by_shared: Tensor


class Term(NamedTuple):
    """A residual function of state and data (B, ...), and its weight (B, n, F, R, R)."""

    function: Callable[..., Linearised]
    weight: Tensor
    data: tuple[Tensor, ...] = ()

    def linearise(self, state: State) -> Linearised:
        """Return residual and derivatives at `state`, of as many stencils as have a weight."""
        r, J, S = self.function(state, *self.data)
        n = self.weight.shape[1]
        return Linearised(r[:, :n], J[:, :n], S[:, :n] if S.dim() > 3 else S)


def value_and_gradient(
    terms: Sequence[Term], x: Tensor, length: int, curvature: Chain | None = None
) -> tuple[Tensor, Tensor]:
    """
    Return the sum of r' W r / 2 over all terms, shape (B,), and its gradient (B, D).

    Their Gauss-Newton matrices J' W J are added to `curvature`.

    """
    state = State.unpack(x, length)
    value, gradient = x.new_zeros(len(x)), torch.zeros_like(x)
    by_pose, by_shared = State.unpack(gradient, length)  # views
    for term in terms:
        r, J, S = term.linearise(state)
        pull = (term.weight @ r[..., None])[..., 0]
        value += 0.5 * (r * pull).flatten(1).sum(1)
        n, flat = r.shape[1], pull.flatten(2)[:, :, None]
        moved = product(flat, J.flatten(2, 3))[:, :, 0].unflatten(2, (-1, 6))
        for k in range(moved.shape[2]):
            by_pose[:, k : k + n] += moved[:, :, k]
        by_shared[:, : S.shape[-1]] += (flat @ S.flatten(-3, -2)).sum((1, 2))
        if curvature is not None:
            W = term.weight if S.dim() > 3 else term.weight.sum(1, keepdim=True)
            corner = product(S.mT, product(W, S)).sum((1, 2))
            J, WJ = J.flatten(2, 3), product(term.weight, J).flatten(2, 3)
            curvature.add(product(J.mT, WJ), product(WJ.mT, S.flatten(-3, -2)), corner)
    return value, gradient


def remembered(terms: Sequence[Term], state: State) -> tuple[Tensor, Tensor, Tensor]:
    """
    Return what the oldest observation leaves behind when it is eliminated from the window.

    A quadratic form in the next two poses and what is shared: where they are (B, 34), the step
    from there to its minimum (B, 34), and its curvature (B, 34, 34). It stands for all terms of
    that observation, what these remember included, so nothing is counted twice.

    """
    head = State(state.pose[:, :3], state.shared)
    rows, weighted = list[Tensor](), list[Tensor]()
    for term in terms:
        if term.function is not shared_prior:
            data = tuple(part[:, :3] for part in term.data)
            r, J, S = Term(term.function, term.weight[:, :1], data).linearise(head)
            J, S = pad(J, (0, 3 * LINK - J.shape[-1])), pad(S, (0, SHARED - S.shape[-1]))
            # With the residual as a last column, one product gives curvature and gradient.
            A = torch.cat([J, S.expand(*J.shape[:-1], -1), r[..., None]], -1)[:, 0]
            rows.append(A.flatten(1, 2))
            weighted.append((term.weight[:, 0] @ A).flatten(1, 2))
    form = torch.cat(rows, 1).mT @ torch.cat(weighted, 1)
    root = cholesky(form[:, :LINK, :LINK] + 1e-9 * torch.eye(LINK).to(form))
    across = solve_triangular(root, form[:, :LINK, LINK:], upper=False)
    form = form[:, LINK:, LINK:] - across.mT @ across
    information, gradient = form[:, :-1, :-1], form[:, :-1, -1]
    # The ridge is for what is not known at all.
    step = torch.linalg.solve(information + 1e-6 * torch.eye(MEMORY).to(form), -gradient)
    return head.pack()[:, LINK:], step, information


class Sum:
    """
    The sum of terms, for a search in one round.

    Parameters
    ----------
    terms : sequence of Term
        What to sum up.
    start, free : Tensor, shape (B, D)
        Where the search starts, and 1 for the variables it may change.
    length : int
        N.

    Attributes
    ----------
    factor : Factor
        Of the curvature where the search starts.

    """

    def __init__(self, terms: Sequence[Term], start: Tensor, length: int, free: Tensor) -> None:
        self._terms, self._start, self._length, self._free = terms, start, length, free
        curvature = Chain.zeros(start, length)
        value, gradient = value_and_gradient(terms, start, length, curvature)
        self._first = value, gradient * free
        self.factor = curvature.factorised(free)

    def __call__(self, x: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Return values (b,) and gradients (b, D) at `x` (b, D) of the windows `rows`."""
        if x is self._start:
            return self._first
        terms, free = select((self._terms, self._free), rows)
        value, gradient = value_and_gradient(terms, x, self._length)
        return value, gradient * free

    def newton(self, vector: Tensor, rows: Tensor) -> Tensor:
        """Return the inverse of the curvature where the search started times `vector` (b, D)."""
        return cast(Factor, select(self.factor, rows)).solve(vector)


def faces(state: State, given: Tensor, inset: Tensor) -> Linearised:
    """
    Planes of the six faces as 4-vectors v: v . (p, 1) is how far p stands out of the face [m].

    With p relative to the centre of the `given` pose, and the gap added: zero for points that
    stand the expected gap inside. The weight of this term is the points' second moment, so its
    cost does not grow with their number.

    """
    R, dR = rotation_derivatives(state.pose[..., 3:])
    shift = state.pose[..., :3] - given[..., :3]
    # The planes through the centre, then those before and behind it.
    by_pose = R.new_zeros(*shift.shape[:2], 3, 4, 6)
    by_pose[..., 3, :3] = -R.mT
    by_pose[..., :3, 3:] = dR.permute(0, 1, 4, 3, 2)
    by_pose[..., 3, 3:] = -(shift[:, :, None, None] @ dR)[..., 0, :].mT
    planes = torch.cat([R.mT, by_pose[..., 3, :3] @ shift[..., None]], -1)
    residual, by_pose = (torch.stack([x, -x], 3).flatten(2, 3) for x in (planes, by_pose))
    by_shared, one = R.new_zeros(6, 4, GAP.stop), torch.eye(GAP.stop).to(R)
    by_shared[:, 3] = one[GAP] - one[EXTENT].repeat_interleave(2, 0) / 2
    residual[..., 3] += inset + (state.shared[:, : GAP.stop] @ by_shared[:, 3].mT)[:, None]
    return Linearised(residual, by_pose, by_shared)


def step(state: State, start: Tensor, axes: Tensor, part: slice) -> Linearised:
    """
    Step of the poses from `start` (B, N, 6) along `axes` (B, N, 3, 3) [m, rad].

    Less a `part` of what is shared, six variables that stand for a step of all of them.

    """
    along = torch.eye(6).to(start).repeat(*start.shape[:2], 1, 1, 1)
    along[..., :3, :3] = axes.mT[..., None, :, :]
    residual = (along @ (state.pose - start)[..., None, :, None])[..., 0]
    by_shared = -torch.eye(part.stop).to(start)[None, part]
    return Linearised(residual - state.shared[:, None, None, part], along, by_shared)


def prior(state: State, given: Tensor, axes: Tensor) -> Linearised:
    """Deviation of the poses from the `given` ones along `axes`, less the bias [m, rad]."""
    return step(state, given, axes, BIAS)


def shape(state: State, start: Tensor, wanted: Tensor) -> Linearised:
    """
    Step of the poses from `start`, in box axes, less the step `wanted` [m, rad].

    The shape of a track is known up to where it stands in its box: all steps less the anchor.
    Vehicles tilt so little that their turns are those of roll, pitch and yaw.

    """
    r, J, S = step(state, start, rotation_from_rpy(start[..., 3:]), ANCHOR)
    return Linearised(r - wanted[..., None, :], J, S)


def acceleration(state: State, times: Tensor) -> Linearised:
    """Second differences of the pose over true time steps [m/s^2, rad/s^2]."""
    dt, p, eye = times.diff(dim=1)[..., None], state.pose, torch.eye(6).to(times)
    first, second, mean = dt[:, :-1], dt[:, 1:], (dt[:, :-1] + dt[:, 1:]) / 2
    residual = ((p[:, 2:] - p[:, 1:-1]) / second - (p[:, 1:-1] - p[:, :-2]) / first) / mean
    weights = torch.stack([1 / first, -1 / first - 1 / second, 1 / second], -1) / mean[..., None]
    by_pose = (weights[..., None] * eye[:, None, :]).flatten(-2)[:, :, None]
    return Linearised(residual[:, :, None], by_pose, p.new_zeros(1, 6, 0))


def rest(state: State) -> Linearised:
    """First differences of the pose of what is parked [m, rad]."""
    step = state.pose.diff(dim=1)[:, :, None]
    by_pose = torch.cat([-torch.eye(6), torch.eye(6)], 1).to(step).expand(*step.shape, 12)
    return Linearised(step, by_pose, step.new_zeros(1, 6, 0))


def slip(state: State, times: Tensor) -> Linearised:
    """Velocity of the pivot, to the left and upward in the body frame [m/s] [for Eq. 7]."""
    dt, N = times.diff(dim=1)[..., None, None], state.pose.shape[1]
    p, arm = state.pose, state.shared[:, PIVOT, None, None, None]
    R, dR = rotation_derivatives(torch.cat([p[..., 3:], (p[:, 1:, 3:] + p[:, :-1, 3:]) / 2], 1))
    heading, swing = R[:, :N, :, 0], arm * dR[:, :N, ..., 0].mT
    across, by_angle = R[:, N:, :, 1:].mT / dt, dR[:, N:, ..., 1:] / dt[..., None]
    step = (p[..., :3] - arm[..., 0] * heading).diff(dim=1)
    residual = (across @ step[..., None]).mT
    tilt = (step[:, :, None, None] @ by_angle)[..., 0, :].mT / 2
    before, after = tilt + across @ swing[:, :-1], tilt - across @ swing[:, 1:]
    by_pose = torch.cat([-across, before, across, after], -1)[:, :, None]
    turned = -(across @ heading.diff(dim=1)[..., None]).mT
    by_shared = pad(turned[..., None], (PIVOT, 0))
    return Linearised(residual, by_pose, by_shared)


def shared_prior(state: State, expected: Tensor) -> Linearised:
    """Deviation of what is shared from what is expected of it, (B, 22)."""
    residual = (state.shared - expected)[:, None, None]
    by_pose = residual.new_zeros((len(expected), 1, 1, SHARED, 6))
    return Linearised(residual, by_pose, torch.eye(SHARED).to(residual)[None])


def memory(state: State, recalled: Tensor) -> Linearised:
    """Deviation of the two oldest poses and of what is shared from what is `recalled`."""
    residual = torch.cat([state.pose[:, :2].flatten(1), state.shared], 1) - recalled[:, 0]
    by_pose, by_shared = torch.eye(MEMORY).to(residual).split([MEMORY - SHARED, SHARED], 1)
    by_pose = by_pose.expand(len(residual), 1, 1, -1, -1)
    return Linearised(residual[:, None, None], by_pose, by_shared[None])
