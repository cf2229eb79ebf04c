"""
The objective: its terms, one function each.

The paper's come first, under their equation numbers, as functions of boxes and points for
automatic differentiation. Ours follow: every term is a residual r with its Jacobian and a weight
W, adding r' W r / 2; W holds the expected deviations and the robust weights of the present round.

"""

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import NamedTuple

from boxreg_ros.config import PaperConfig
from boxreg_ros.geometry import (
    FACE_AXIS,
    face_distances,
    FACE_SIGN,
    rotation_derivatives,
    rotation_from_rpy,
    wrap_angle,
)
from boxreg_ros.structures import POSE
import torch
from torch import Tensor

EPSILON = 1e-9  # inside roots, so that the paper's norms have a gradient at zero


@dataclass(frozen=True)
class Problem:
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
        Returns minus the centre of their input box [m]; True where real.
    delays : Tensor, shape (B, N, M)
        When each return was measured, relative to the stamp of its box [s].
    origins : Tensor, shape (B, N, 3)
        Sensor minus the centre of the input box [m]; NaN where unknown.
    ground : Tensor, shape (B, N)
        Height of the road minus that of the input centre [m]; NaN where unknown.
    deviations : dict of Tensors, shape (B,)
        The numbers of each window's `ClassConfig`.

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
    deviations: dict[str, Tensor]

    @property
    def pose(self) -> Tensor:
        """Input poses x y z roll pitch yaw, shape (B, N, 6)."""
        return self.boxes[..., POSE]

    def select(self, rows: Tensor) -> 'Problem':
        """Return the windows `rows` alone."""
        parts = {f.name: getattr(self, f.name) for f in fields(self) if f.name != 'deviations'}
        chosen = {name: value[rows] for name, value in parts.items()}
        return Problem(**chosen, deviations={k: v[rows] for k, v in self.deviations.items()})


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


def smoothness(boxes: Tensor, valid: Tensor) -> Tensor:
    """
    Return the mean change of the pose's step from box to box, shape (B,) [Eq. 6].

    Notes
    -----
    Steps of the angles are wrapped; a small number inside the root gives equal steps a gradient.

    """
    pose = boxes[..., POSE]
    step = pose[:, 1:] - pose[:, :-1]
    step = torch.cat([step[..., :3], wrap_angle(step[..., 3:])], -1).abs()
    change = (step[:, 1:] - step[:, :-1]).square().sum(-1)
    return _mean((change + EPSILON).sqrt(), valid[:, 2:])


def alignment(boxes: Tensor, valid: Tensor) -> Tensor:
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
    length = (step.square().sum(-1) + EPSILON).sqrt()
    direction = step / length[..., None]
    along = ((heading * step).sum(-1) * valid[:, 1:]).sum(-1)
    forward = torch.where(along < 0, -1.0, 1.0)[:, None, None]
    gap = ((heading - forward * direction).square().sum(-1) + EPSILON).sqrt()
    return _mean(gap * (length / 0.1).clamp(max=1.0), valid[:, 1:])


def total(
    boxes: Tensor, problem: Problem, weights: PaperConfig, multipliers: Tensor
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
    violation = torch.stack(
        [smoothness(boxes, problem.valid), alignment(boxes, problem.valid)], -1
    )
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
PIVOT = 15
ANCHOR = slice(16, 22)


class State(NamedTuple):
    """
    What is estimated: the poses of a window, and what all its observations share.

    Attributes
    ----------
    pose : Tensor, shape (B, N, 6)
        x y z roll pitch yaw [m, rad].
    shared : Tensor, shape (B, 16)
        Extent [m]; bias of the input poses, along their axes [m, rad]; gap from the outermost
        points of each face out to the face [m]; the point that does not slip sideways, behind the
        centre, as part of the length.

    """

    pose: Tensor
    shared: Tensor

    @classmethod
    def unpack(cls, x: Tensor, length: int) -> 'State':
        """Return views into variables (B, 6 N + 16)."""
        return cls(x[:, : 6 * length].unflatten(1, (length, 6)), x[:, 6 * length :])

    def pack(self) -> Tensor:
        """Return the variables as one row per window (B, 6 N + 16)."""
        return torch.cat([self.pose.flatten(1), self.shared], 1)


class Linearised(NamedTuple):
    """
    A term at one state: n stencils of k observations in a row, F groups of R residuals each.

    `residual` is (B, n, F, R), its derivative `by_pose` (B, n, F, R, k, 6) and `by_shared`
    (B, n, F, R, 16) or None.

    """

    residual: Tensor
    by_pose: Tensor
    by_shared: Tensor | None


class Term(NamedTuple):
    """A residual function of problem, state and data (B, ...), and its weight (B, n, F, R, R)."""

    function: Callable[..., Linearised]
    problem: Problem
    weight: Tensor
    data: Tensor | None = None

    def linearise(self, state: State) -> Linearised:
        """Return residual and derivatives at `state`."""
        return self.function(self.problem, state, self.data)

    def select(self, rows: Tensor) -> 'Term':
        """Return the term of the windows `rows` alone."""
        data = None if self.data is None else self.data[rows]
        return Term(self.function, self.problem.select(rows), self.weight[rows], data)


def value_and_gradient(terms: list[Term], x: Tensor, length: int) -> tuple[Tensor, Tensor]:
    """Return the sum of r' W r / 2 over all terms, shape (B,), and its gradient (B, D)."""
    state = State.unpack(x, length)
    value = x.new_zeros(len(x))
    gradient = torch.zeros_like(x)
    by_pose, by_shared = State.unpack(gradient, length)  # views
    for term in terms:
        r, J, J_shared = term.linearise(state)
        pull = (term.weight @ r[..., None])[..., 0]
        value += 0.5 * (r * pull).flatten(1).sum(1)
        moved = torch.einsum('bnfr,bnfrkp->bnkp', pull, J)
        for k in range(J.shape[-2]):
            by_pose[:, k : k + J.shape[1]] += moved[:, :, k]
        if J_shared is not None:
            by_shared += torch.einsum('bnfr,bnfrs->bs', pull, J_shared)
    return value, gradient


def curvature(terms: list[Term], x: Tensor, length: int) -> Tensor:
    """Return the Gauss-Newton matrix, the sum of J' W J over all terms, shape (B, D, D)."""
    state = State.unpack(x, length)
    H = x.new_zeros((len(x), x.shape[1], x.shape[1]))
    pose = 6 * length
    blocks = H[:, :pose, :pose].unflatten(1, (length, 6)).unflatten(3, (length, 6))
    border = H[:, :pose, pose:].unflatten(1, (length, 6))
    for term in terms:
        _, J, J_shared = term.linearise(state)
        n, span = J.shape[1], J.shape[-2]
        flat = J.flatten(-2)
        WJ = term.weight @ flat
        local = torch.einsum('bnfra,bnfrc->nbac', flat, WJ)
        rows = torch.arange(n)
        for a in range(span):
            for c in range(span):
                part = local[:, :, 6 * a : 6 * a + 6, 6 * c : 6 * c + 6]
                blocks[:, rows + a, :, rows + c, :] += part
        if J_shared is not None:
            across = torch.einsum('bnfra,bnfrs->bnas', WJ, J_shared)
            for a in range(span):
                border[:, a : a + n] += across[:, :, 6 * a : 6 * a + 6]
            H[:, pose:, pose:] += torch.einsum(
                'bnfrs,bnfrt->bst', J_shared, term.weight @ J_shared
            )
    H[:, pose:, :pose] = H[:, :pose, pose:].mT
    return H


def faces(problem: Problem, state: State, inset: Tensor) -> Linearised:
    """
    Planes of the six faces as 4-vectors v: v . (p, 1) is how far p stands out of the face [m].

    With p relative to the centre of the input box, and the gap added: zero for points that
    stand the expected gap inside. The weight of this term is the points' second moment, so its
    cost does not grow with their number.

    """
    R, dR = rotation_derivatives(state.pose[..., 3:])
    shift = state.pose[..., :3] - problem.pose[..., :3]
    sign = FACE_SIGN.to(R)
    normal = R.mT[..., FACE_AXIS, :] * sign[:, None]
    turned = dR.mT[..., FACE_AXIS, :] * sign[:, None]  # (B, N, 3, 6, 3)
    extent, gap = state.shared[:, EXTENT], state.shared[:, GAP]
    constant = (gap - extent[:, FACE_AXIS] / 2)[:, None] + inset
    offset = constant - (normal * shift[..., None, :]).sum(-1)
    residual = torch.cat([normal, offset[..., None]], -1)
    B, N = shift.shape[:2]
    by_pose = R.new_zeros((B, N, 6, 4, 1, 6))
    by_pose[..., 3, 0, :3] = -normal
    by_pose[..., :3, 0, 3:] = turned.permute(0, 1, 3, 4, 2)
    by_pose[..., 3, 0, 3:] = -(turned * shift[..., None, None, :]).sum(-1).mT
    by_shared = R.new_zeros((B, N, 6, 4, SHARED))
    face = torch.arange(6)
    by_shared[..., face, 3, FACE_AXIS] = -0.5
    by_shared[..., face, 3, 9 + face] = 1.0
    return Linearised(residual, by_pose, by_shared)


def shape(problem: Problem, state: State, data: Tensor) -> Linearised:
    """Pose against where the track's shape wants it, in body axes; data (B, N, 24)."""
    start, wanted = data[..., :6], data[..., 6:]
    by_body = start.new_zeros((*start.shape, 6))
    R = rotation_from_rpy(start[..., 3:])
    by_body[..., :3, :3] = R.mT
    by_body[..., 3:, 3:] = body_rates(start[..., 3:])
    moved = (by_body @ (state.pose - start)[..., None])[..., 0]
    residual = moved - wanted - state.shared[:, None, ANCHOR]
    by_shared = residual.new_zeros((*residual.shape[:2], 1, 6, SHARED))
    by_shared[..., ANCHOR] = -torch.eye(6).to(R)
    return Linearised(residual[:, :, None], by_body[:, :, None, :, None, :], by_shared)


def body_rates(rpy: Tensor) -> Tensor:
    """Return the matrix (..., 3, 3) from changes of roll pitch yaw to rotation in body axes."""
    cr, cp, _ = torch.cos(rpy).unbind(-1)
    sr, sp, _ = torch.sin(rpy).unbind(-1)
    zero, one = torch.zeros_like(cr), torch.ones_like(cr)
    return torch.stack([one, zero, -sp, zero, cr, sr * cp, zero, -sr, cr * cp], -1).unflatten(-1, (3, 3))


def prior(problem: Problem, state: State, axes: Tensor) -> Linearised:
    """Deviation of the poses from the input along `axes` (B, N, 3, 3), less the bias [m, rad]."""
    R = axes
    difference = state.pose - problem.pose
    along = (R.mT @ difference[..., :3, None])[..., 0]
    residual = torch.cat([along, difference[..., 3:]], -1) - state.shared[:, None, BIAS]
    by_pose = residual.new_zeros((*residual.shape[:2], 1, 6, 1, 6))
    by_pose[:, :, 0, :3, 0, :3] = R.mT
    by_pose[:, :, 0, 3:, 0, 3:] = torch.eye(3).to(R)
    by_shared = residual.new_zeros((*residual.shape[:2], 1, 6, SHARED))
    by_shared[..., BIAS] = -torch.eye(6).to(R)
    return Linearised(residual[:, :, None], by_pose, by_shared)


def acceleration(problem: Problem, state: State, _: None = None) -> Linearised:
    """Second differences of the pose over true time steps [m/s^2, rad/s^2]."""
    dt = problem.times.diff(dim=1)
    first, second = dt[:, :-1, None], dt[:, 1:, None]
    mean = (first + second) / 2
    p = state.pose
    residual = ((p[:, 2:] - p[:, 1:-1]) / second - (p[:, 1:-1] - p[:, :-2]) / first) / mean
    weights = torch.stack([1 / first, -1 / first - 1 / second, 1 / second], -1) / mean[..., None]
    eye = torch.eye(6).to(p)
    by_pose = weights[:, :, 0, None, :, None] * eye[:, None, :]
    return Linearised(residual[:, :, None], by_pose[:, :, None], None)


def rest(problem: Problem, state: State, _: None = None) -> Linearised:
    """First differences of the pose of what is parked [m, rad]."""
    p = state.pose
    eye = torch.eye(6).to(p)
    by_pose = torch.stack([-eye, eye], -2).expand(*p[:, 1:].shape[:2], 6, 2, 6)
    return Linearised((p[:, 1:] - p[:, :-1])[:, :, None], by_pose[:, :, None], None)


def slip(problem: Problem, state: State, _: None = None) -> Linearised:
    """Velocity of the pivot, to the left and upward in the body frame [m/s] [for Eq. 7]."""
    dt = problem.times.diff(dim=1)[..., None]
    p, length, ratio = state.pose, state.shared[:, :1, None], state.shared[:, PIVOT, None, None]
    across, by_angle = rotation_derivatives((p[:, 1:, 3:] + p[:, :-1, 3:]) / 2)
    across, by_angle = across[..., 1:].mT, by_angle[..., 1:].mT
    R, dR = rotation_derivatives(p[..., 3:])
    rear = p[..., :3] - length * ratio * R[..., 0]
    step = rear.diff(dim=1) / dt
    residual = (across @ step[..., None])[..., 0]
    by_pose = p.new_zeros((*residual.shape[:2], 1, 2, 2, 6))
    tilt = 0.5 * (by_angle @ step[..., None, :, None])[..., 0].mT
    for k, (sign, end) in enumerate(((-1.0, slice(None, -1)), (1.0, slice(1, None)))):
        swing = -(length * ratio)[..., None] * dR[:, end, :, :, 0] * sign / dt[..., None]
        by_pose[:, :, 0, :, k, :3] = sign * across / dt[..., None]
        by_pose[:, :, 0, :, k, 3:] = across @ swing.mT + tilt
    turned = -(across @ (R[..., 0].diff(dim=1) / dt)[..., None])[..., 0]
    by_shared = p.new_zeros((*residual.shape[:2], 1, 2, SHARED))
    by_shared[:, :, 0, :, 0], by_shared[:, :, 0, :, PIVOT] = ratio * turned, length * turned
    return Linearised(residual[:, :, None], by_pose, by_shared)


def shared_prior(problem: Problem, state: State, expected: Tensor) -> Linearised:
    """Deviation of what is shared from what is expected of it, (B, 16)."""
    residual = (state.shared - expected)[:, None, None]
    by_shared = torch.eye(SHARED).to(residual).expand(len(expected), 1, 1, SHARED, SHARED)
    by_pose = residual.new_zeros((len(expected), 1, 1, SHARED, 1, 6))
    return Linearised(residual, by_pose, by_shared)
