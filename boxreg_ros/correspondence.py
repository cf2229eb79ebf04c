"""Which points tell where a face is: the outermost ones on each, as their moments."""

from typing import NamedTuple

from boxreg_ros.geometry import FACE_AXIS, FACE_SIGN, rotation_from_rpy
from boxreg_ros.objective import EXTENT, GAP, Problem, State
import torch
from torch import Tensor
from torch.nn.functional import pad

BOTTOM = 5
LEAST = 3  # points without which a face is not seen
BESIDE = 0.2  # outside the edges of a face, points still count for it [m]
INSIDE = 0.3  # more room on the inner side of a face than on its outer side [m]
VEILED = 0.25  # say of a face that is hidden behind its edge
TURN = 0.25  # how fast a face is lost when it turns away; its edges are rounder at the ends
LEAD = (0.0, 0.0, 0.2, 0.2, 0.0, 0.0)


class Support(NamedTuple):
    """
    What stands out furthest on each face, in one round.

    Attributes
    ----------
    moments : Tensor, shape (B, N, 6, 4, 4)
        Mean of (p, 1)(p, 1)' over the outermost points, p minus the centre of the input box.
    outwardness : Tensor, shape (B, N, 6)
        How far these stand out of where they are expected, on average [m].
    trust : Tensor, shape (B, N, 6)
        1 for a face that is seen, less for one hidden behind its edge, 0 without points.
    retreat : Tensor, shape (B, N, 6)
        How much further in than the gap of the face they are expected [m].
    points : Tensor, shape (B, N)
        How many are in and near the box.

    """

    moments: Tensor
    outwardness: Tensor
    trust: Tensor
    retreat: Tensor
    points: Tensor


def aspect(problem: Problem) -> Tensor:
    """
    Return how openly the sensor sees each face, shape (B, N, 6).

    The tangent of the angle between the plane of the face and the line of sight, in the
    horizontal for the four upright faces: above 0 the sensor is on the outer side, below 0 the
    face is hidden behind its own edge. The roof is always open, the bottom hidden. Where no
    sensor is known the side of the points' centre of mass is open, as in the paper.

    """
    R = rotation_from_rpy(problem.pose[..., 3:])
    weight = problem.mask.to(problem.points)[..., None]
    mean = (problem.points * weight).sum(-2) / weight.sum(-2).clamp(min=1)
    known = problem.origins.isfinite().all(-1, keepdim=True)
    toward = (torch.where(known, problem.origins, 1e6 * mean)[..., None, :] @ R)[..., 0, :]
    outward = toward[..., [0, 0, 1, 1]] * FACE_SIGN[:4].to(R)
    half = problem.boxes[..., 3:6] / 2
    across = toward[..., [1, 1, 0, 0]].abs() - half[..., [1, 1, 0, 0]]
    sides = (outward - half[..., [0, 0, 1, 1]]) / across.clamp(min=0.5)
    return torch.cat([sides, sides.new_tensor([9.0, -9.0]).expand(*sides.shape[:2], 2)], -1)


def retreat(aspect: Tensor, depths: Tensor) -> Tensor:
    """
    Return how much further in the outermost points of a face stand for its aspect [m].

    A body is round at its edges: what is seen of a face from the side, or of its edge from
    behind, stands further in the less open the face is, up to `depths` (6,).

    """
    shifted = aspect + aspect.new_tensor(LEAD)
    return depths.to(aspect) * (0.5 - 0.5 * shifted / (shifted.square() + TURN).sqrt())


def support(
    problem: Problem, state: State, margin: float, outermost: float, depths: Tensor
) -> Support:
    """
    Find the outermost points of each face, the part `outermost` of all [for Eq. 4].

    Parameters
    ----------
    problem : Problem
        Windows.
    state : State
        Where their boxes are in this round.
    margin : float
        Only points this close to the outer side of a face count for it [m].
    outermost : float
        Part of the points in and near the box that stands for a face.
    depths : Tensor, shape (6,)
        How much further in a face's points stand if it is quite hidden [m].

    Returns
    -------
    support : Support
        Of every observation and face; the bottom is the road beside the box.

    Notes
    -----
    The paper takes the K points closest to a face, visible by their centre of mass. We take
    those furthest out: the closest ones may lie anywhere on a face that is given too far inside.
    What moves is measured at its own time: points are carried along to the stamp of the box.

    """
    shift = state.pose[..., :3] - problem.pose[..., :3]
    points = problem.points
    if bool(problem.delays.any()):
        points = (
            points - _velocity(problem, state)[..., None, :].to(points) * problem.delays[..., None]
        )
    R = rotation_from_rpy(state.pose[..., 3:]).to(points)
    local = ((points - shift[..., None, :].to(points)) @ R).mT  # (B, N, 3, M)
    half = (state.shared[:, EXTENT] / 2).to(points)[:, None, :, None]
    beyond = torch.where(problem.mask[..., None, :], local.abs() - half, torch.inf)
    count = (beyond.amax(-2) < margin).sum(-1)
    far = beyond[..., [1, 0, 0], :].maximum(beyond[..., [2, 2, 1], :]) >= BESIDE
    inset = retreat(aspect(problem), depths)
    offset = (state.shared[:, None, GAP] + inset).to(points)[..., None] - half[..., FACE_AXIS, :]
    out = local[..., FACE_AXIS, :] * FACE_SIGN.to(points)[:, None] + offset
    out.masked_fill_(
        far[..., FACE_AXIS, :] | (out > margin) | (out < -margin - INSIDE), -torch.inf
    )
    most = min(out.shape[-1], max(LEAST, int(outermost * out.shape[-1]) + 1))
    height, index = out.topk(most)  # (B, N, 6, K)
    wanted = (outermost * count).clamp(min=LEAST)[..., None, None]
    chosen = height.isfinite() & (torch.arange(most, device=out.device) < wanted)
    number = chosen.sum(-1)
    share = chosen / number.clamp(min=1)[..., None].to(points)
    flat = torch.arange(count.numel(), device=out.device).view_as(count)[..., None, None]
    best = points.flatten(0, 2)[index + flat * out.shape[-1]]
    best = torch.cat([best, torch.ones_like(best[..., :1])], -1)
    moments = (best * share[..., None]).mT @ best
    outwardness = (torch.where(chosen, height, 0.0) * share).sum(-1)
    trust = (number >= LEAST) * torch.where(aspect(problem) > 0, 1.0, VEILED)
    moments, outwardness, trust = moments.to(shift), outwardness.to(shift), trust.to(shift)
    sights = Support(moments, outwardness, trust, inset, count.to(shift))
    return _with_road(problem, state, sights)


def _velocity(problem: Problem, state: State) -> Tensor:
    """Return the velocity of the centres (B, N, 3), over the real steps beside each [m/s]."""
    where = torch.cat([state.pose[..., :3], problem.times[..., None]], -1)
    steps = where.diff(dim=1) * problem.valid[:, 1:, None]
    change = pad(steps, (0, 0, 1, 0)) + pad(steps, (0, 0, 0, 1))
    return change[..., :3] / change[..., 3:].clamp(min=1e-9)  # a single observation rests


def _with_road(problem: Problem, state: State, support: Support) -> Support:
    """Let a point of the road under the centre of the box stand for its bottom face."""
    known = problem.ground.isfinite() & problem.valid
    road = torch.nan_to_num(problem.ground)
    shift = state.pose[..., :3] - problem.pose[..., :3]
    point = torch.stack([shift[..., 0], shift[..., 1], road, torch.ones_like(road)], -1)
    support.moments[..., BOTTOM, :, :] = point[..., :, None] * point[..., None, :]
    height, gap = state.shared[:, None, 2], state.shared[:, None, GAP][..., BOTTOM]
    support.outwardness[..., BOTTOM] = shift[..., 2] - road - height / 2 + gap
    support.trust[..., BOTTOM] = known.to(road)
    support.retreat[..., BOTTOM] = 0.0
    return support
