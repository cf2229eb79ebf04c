"""Which points tell where a face is: the outermost ones on each, as their moments."""

from typing import Any, NamedTuple

from boxreg_ros.core.arrowhead import product
from boxreg_ros.core.geometry import FACE_AXIS, FACE_SIGN, rotation_from_rpy
from boxreg_ros.core.objective import EXTENT, GAP, Problem, State
import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import embedding, pad

BOTTOM = 5
MARGIN = 0.35  # outside a face, points still count for it [m]
LEAST = 3  # points without which a face is not seen
STRIPS = 3  # of a face side by side: each has outermost points of its own
ACROSS = [1, 1, 0, 0, 1]  # axis along which they lie
BEHIND = 0.2  # what is this far behind the outermost point of all is not on the face [m]
BESIDE = 0.2  # outside the edges of a face, points still count for it [m]
INSIDE = 0.35  # more room on the inner side of a face than on its outer side [m]
VEILED = 0.25  # say of a face that is hidden behind its edge
TURN = 0.25  # how fast a face is lost when it turns away; its edges are rounder at the ends
FAR = 1e9
LEAD = (0.0, 0.0, 0.2, 0.2, 0.0, 0.0)
# Up to the first range [m] points stand as far out as they ever do, a second further away
# further in by what is learnt, and by half as much again at most.
DISTANCE = 20.0, 50.0
BLURRED = 0.1  # a face whose points stand so much further in by its distance has half its say [m]


class Rule(NamedTuple):
    """
    How faces stand to the points on them.

    Attributes
    ----------
    gaps : Tensor, shape (6,)
        Gap of each face less the one expected of its class [m].
    depths : Tensor, shape (6,)
        How much further in points stand on a face that is hidden [m]; 0 for roof and road.
    distant : Tensor, shape (6,)
        How much further in they stand where the object is 70 m away [m].

    """

    gaps: Tensor
    depths: Tensor
    distant: Tensor


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
    shares : Tensor, shape (2, B, N, 6)
        Of the depth and of the distance of the rule in that.
    points : Tensor, shape (B, N)
        How many are in and near the box.

    """

    moments: Tensor
    outwardness: Tensor
    trust: Tensor
    retreat: Tensor
    shares: Tensor
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
    toward, known = problem.origins, problem.origins.isfinite().all(-1, keepdim=True)
    if not known.all():
        weight = problem.mask.to(problem.points)[..., None]
        mean = (problem.points * weight).sum(-2) / weight.sum(-2).clamp(min=1)
        toward = torch.where(known, toward, 1e6 * mean)
    toward = (toward[..., None, :] @ R)[..., 0, :]
    outward = toward[..., [0, 0, 1, 1]] * FACE_SIGN[:4].to(R)
    half = problem.boxes[..., 3:6] / 2
    across = toward[..., [1, 1, 0, 0]].abs() - half[..., [1, 1, 0, 0]]
    sides = (outward - half[..., [0, 0, 1, 1]]) / across.clamp(min=0.5)
    return torch.cat([sides, sides.new_tensor([9.0, -9.0]).expand(*sides.shape[:2], 2)], -1)


def retreat(problem: Problem, openness: Tensor) -> Tensor:
    """
    Return how much further in the outermost points of the faces stand, shape (2, B, N, 6).

    As parts of what the rule tells: of its depths for how hidden a face is by its `openness`
    (B, N, 6), see `aspect`, since a body is round at its edges, and of what it tells of distant
    ones, where fewer points reach the outermost parts.

    """
    shifted = openness + openness.new_tensor(LEAD)
    hidden = 0.5 - 0.5 * shifted / (shifted.square() + TURN).sqrt()
    beyond = problem.origins[..., :2].norm(dim=-1, keepdim=True).nan_to_num() - DISTANCE[0]
    return torch.stack([hidden, (1 - hidden) * (beyond / DISTANCE[1]).clamp(0, 1.5)])


def support(problem: Problem, state: State, outermost: float, rule: Rule) -> Support:
    """
    Find the outermost points of each face, the part `outermost` of all [for Eq. 4].

    Parameters
    ----------
    problem : Problem
        Windows.
    state : State
        Where their boxes are in this round.
    outermost : float
        Part of the points in and near the box that stands for a face.
    rule : Rule
        How far in its points stand on each face.

    Returns
    -------
    support : Support
        Of every observation and face; the bottom is the road beside the box.

    Notes
    -----
    The paper takes the K points closest to a face, visible by their centre of mass. We take
    those furthest out: the closest ones may lie anywhere on a face that is given too far inside.
    On a face that is given askew these are all at one end: each of three strips has its own, so
    that the face turns as well. What is far behind the outermost point of all shows something
    else, say a wheel or a hood. What moves is measured at its own time: points are carried along
    to the stamp of the box.

    """
    points, shares = carried(problem, state), retreat(problem, openness := aspect(problem))
    half = (state.shared[:, EXTENT] / 2).to(points)[:, None, :, None]
    distant = shares[1] * rule.distant.to(shares)
    inset = shares[0] * rule.depths.to(shares) + distant
    offset = (state.shared[:, None, GAP] + inset).to(points)[..., None] - half[..., FACE_AXIS, :]
    local = in_box_axes(points, problem, state.pose)
    x, y, z = local.abs().sub_(half).unbind(-2)
    count = (x.maximum(y).maximum(z) < MARGIN).sum(-1)
    # Masks cost five times as much as sums: what does not count is made to lie very far inside.
    aside = torch.stack([y.maximum(z), x.maximum(z), x.maximum(y)], -2).sub_(BESIDE).mul_(FAR)
    x, y, z = local.unbind(-2)
    depth = torch.stack([-x, x, -y, y, -z], -2).sub_(offset[..., :BOTTOM, :]).float()
    for k in (0, 1):  # front left top, back right
        side = depth[..., k::2, :]
        torch.maximum(side, aside[..., : 3 - k, :], out=side)
    strip = (local[..., :2, :] / half[..., :2, :]).add_(1).mul_(STRIPS / 2).clamp_(0, STRIPS - 1)
    most = max(LEAST, int((share := outermost / STRIPS) * points.shape[2]) + 1)
    depth, index = smallest(depth, strip.floor_(), most)  # (B, N, 5, 3, K)
    limit = (depth.amin((-1, -2), keepdim=True) + BEHIND).clamp(max=MARGIN + INSIDE)
    wanted = (share * count).clamp(min=LEAST)[..., None, None, None]
    chosen = (depth <= limit) & (torch.arange(most, device=index.device) < wanted)
    number = chosen.sum((-1, -2))
    weight = chosen / number.clamp(min=1)[..., None, None].to(points)
    first = points.shape[2] * torch.arange(count.numel(), device=index.device)
    best = embedding(index + first.view(*count.shape, 1, 1, 1), points.flatten(0, 2))
    best = pad(best, (0, 1), value=1.0)
    moments = product((best * weight[..., None]).flatten(3, 4).mT, best.flatten(3, 4))
    out = -(torch.where(chosen, depth, 0.0) * weight).sum((-1, -2))
    trust = (number >= LEAST) * torch.where(openness[..., :BOTTOM] > 0, 1.0, VEILED)
    trust = trust / (1 + (distant[..., :BOTTOM] / BLURRED) ** 2)
    # The bottom is where a point of the road is, under the centre of the box.
    shift = state.pose[..., :3] - problem.pose[..., :3]
    known, road = problem.ground.isfinite() & problem.valid, torch.nan_to_num(problem.ground)
    point = torch.stack([shift[..., 0], shift[..., 1], road, torch.ones_like(road)], -1)
    height, gap = state.shared[:, None, 2], state.shared[:, None, GAP][..., BOTTOM]
    bottom = point[..., None] * point[..., None, :], shift[..., 2] - road - height / 2 + gap, known
    pairs = zip((moments, out, trust), bottom, strict=True)
    found: Any = (torch.cat([five.to(road), one[:, :, None].to(road)], 2) for five, one in pairs)
    return Support(*[*found, inset, shares, count.to(road)])


def smallest(depth: Tensor, strip: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """
    Find the outermost points in every strip of every face.

    Parameters
    ----------
    depth : Tensor, shape (..., 5, M)
        How far inside of each face but the bottom each point is [m], float32; written to.
    strip : Tensor, shape (..., 2, M)
        0, 1 or 2: the strip each point is in, along x and along y of the box.
    count : int
        K, the points wanted of each strip.

    Returns
    -------
    depth : Tensor, shape (..., 5, 3, K)
        The least of each strip, ascending [m]; above 2 where there are not as many.
    index : Tensor, shape (..., 5, 3, K)
        Which of the M points these are.

    Notes
    -----
    One integer holds strip, depth and place of a point: numpy sorts these faster than torch finds
    the least. Fresh memory would cost more than what is done in it, so `depth` is reused.

    """
    size, device = depth.shape[-1], depth.device
    scale = 2.0 ** (27 - (bits := max(8, (size - 1).bit_length())))  # of a number below 12 [1/m]
    strip.mul_(4 * scale).add_(scale + 2**23)  # above it a float ends in the bits of its integer
    for values, axis in zip(depth.clamp_(-1, 2.5).unbind(-2), ACROSS, strict=True):
        torch.add(strip[..., axis, :], values, alpha=scale, out=values)
    places = torch.arange(size, dtype=torch.int32, device=device)  # 64 bits would cost a third
    keys = depth.view(torch.int32).bitwise_left_shift_(bits).add_(places)
    keys = torch.from_numpy(np.sort(keys.numpy())) if keys.is_cpu else keys.sort().values
    edges = 4 * torch.arange(STRIPS, device=device)
    first = ((edges + 1 - MARGIN) * scale).int().expand(*keys.shape[:-1], -1) << bits
    places = torch.searchsorted(keys, first)[..., None] + torch.arange(count, device=device)
    keys = keys.gather(-1, places.clamp(max=size - 1).flatten(-2)).unflatten(-1, (STRIPS, count))
    depth = torch.where(places < size, (keys >> bits) / scale - edges[:, None] - 1, FAR)
    return depth, (keys & (1 << bits) - 1).long()


def in_box_axes(points: Tensor, problem: Problem, pose: Tensor) -> Tensor:
    """Return `points` (B, N, M, 3) of `problem` in boxes at `pose` (B, N, 6), (B, N, 3, M)."""
    shift = (pose[..., :3] - problem.pose[..., :3]).to(points)
    R = rotation_from_rpy(pose[..., 3:]).to(points).mT.contiguous()  # ten times as fast
    return (R @ points.mT).sub_(R @ shift[..., None])


def carried(problem: Problem, state: State) -> Tensor:
    """Return the points (B, N, M, 3), each carried with its box to the stamp of that."""
    if not bool(problem.delays.any()):
        return problem.points
    where = torch.cat([state.pose[..., :3], problem.times[..., None]], -1)
    steps = where.diff(dim=1) * problem.valid[:, 1:, None]
    change = pad(steps, (0, 0, 1, 0)) + pad(steps, (0, 0, 0, 1))  # real steps on either side
    velocity = change[..., :3] / change[..., 3:].clamp(min=1e-9)  # a single observation rests
    return problem.points - velocity[..., None, :].to(problem.points) * problem.delays[..., None]
