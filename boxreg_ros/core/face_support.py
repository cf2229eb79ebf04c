"""
Face observations: the outermost points on each face of each box, as their second moments.

This is the correspondence search of every round. docs/method.md, section Face observations, has
the formulas (M10) to (M12).

"""

from typing import NamedTuple

from boxreg_ros.config import Config
from boxreg_ros.core.arrowhead import product
from boxreg_ros.core.batch import EXTENT, GAP, Problem, State
from boxreg_ros.core.geometry import FACE_AXIS, FACE_SIGN, rotation_from_rpy
import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import embedding, pad

# Constants whose origin is not stated are chosen; `boxreg bench sensitivity` halves and doubles
# each of them.
BOTTOM = 5
"""Index of the bottom face. It is observed by the road, not by points of the object."""
OUTSIDE_MARGIN = 0.35
"""Points up to this far outside a face are taken for points of the object [m]."""
EDGE_MARGIN = 0.2
"""The same beside the edges of the face [m]."""
INSIDE_EXTRA = 0.35
"""Points may be further inside a face than `OUTSIDE_MARGIN` by this much [m]."""
MAX_DEPTH = 0.2
"""Points further behind the outermost one of a face are on another surface, e.g. a wheel [m]."""
MIN_POINTS = 3
"""Fewest points that make a face observation, and that are taken from a strip. Three span a
plane."""
STRIPS = 3
"""Strips side by side on each face, each with outermost points of its own. With three, the yaw of
a face stays observable where one strip is empty."""
STRIP_AXIS = (1, 1, 0, 0, 1)
"""Box axis along which the strips of each face but the bottom lie side by side."""
OCCLUDED_FACE_WEIGHT = 0.25
"""Weight of a face that is turned away from the sensor, hidden behind its own edge."""
VISIBILITY_SOFTNESS = 0.25
"""Square of the tangent over which a face turns from visible to occluded, in (M11)."""
EDGE_LEAD = (0.0, 0.0, 0.2, 0.2, 0.0, 0.0)
"""Added to the tangent of each face: vehicles are rounder at the ends than at the sides."""
NEAR_RANGE = 20.0
"""Up to this range points reach the outermost parts of a surface [m]."""
RANGE_SPAN = 50.0
"""The range inset is learnt for this much more range [m]: at 70 m."""
MAX_RANGE_SHARE = 1.5
"""Largest multiple of the learnt range inset."""
RANGE_INSET_HALF_WEIGHT = 0.1
"""A face whose points have this range inset has weight 1/2 [m]."""
MIN_ALONG = 0.5
"""Smallest distance along a face in the tangent of its visibility [m]."""
FAR = 1e9
"""Depth of points that are not on a face [m]."""


class FaceOffsets(NamedTuple):
    """
    Offsets of the outermost points from the face of a label, as learnt from the input.

    Attributes
    ----------
    gap_correction : Tensor, shape (6,)
        Labelling margin of each face less the one its class lets expect [m].
    occlusion_inset : Tensor, shape (6,)
        How much further inside the points of an occluded face are [m]; 0 for roof and road.
    range_inset : Tensor, shape (6,)
        How much further inside they are on an object 70 m away [m].

    """

    gap_correction: Tensor
    occlusion_inset: Tensor
    range_inset: Tensor


class FaceObservations(NamedTuple):
    """
    The outermost points of each face, in one round.

    Attributes
    ----------
    moments : Tensor, shape (B, N, 6, 4, 4)
        Mean of (q, 1)(q, 1)' over the outermost points, q minus the centre of the input box.
    distance : Tensor, shape (B, N, 6)
        Their mean signed distance from where they are expected, positive outside [m].
    weight : Tensor, shape (B, N, 6)
        1 for a visible face, less for an occluded or distant one, 0 without points.
    inset : Tensor, shape (B, N, 6)
        How far further inside than the labelling margin they are expected [m].
    inset_shares : Tensor, shape (2, B, N, 6)
        Multiples of `occlusion_inset` and of `range_inset` in that.
    num_points : Tensor, shape (B, N)
        Points in and near the box.

    """

    moments: Tensor
    distance: Tensor
    weight: Tensor
    inset: Tensor
    inset_shares: Tensor
    num_points: Tensor


def visibility(problem: Problem) -> Tensor:
    """
    Return how openly the sensor sees each face, shape (B, N, 6).

    The tangent of the angle between the plane of the face and the line of sight, in the
    horizontal for the four upright faces: positive where the sensor is on the outer side,
    negative where the face is hidden behind its own edge. The roof is always visible, the bottom
    never. Without a known sensor position the faces on the side of the points' centre of mass are
    visible, as in the paper.

    """
    R = rotation_from_rpy(problem.pose[..., 3:])
    toward = problem.origins
    is_known = toward.isfinite().all(-1, keepdim=True)
    if not is_known.all():
        weight = problem.mask.to(problem.points)[..., None]
        mean = (problem.points * weight).sum(-2) / weight.sum(-2).clamp(min=1)
        toward = torch.where(is_known, toward, 1e6 * mean)
    toward = (toward[..., None, :] @ R)[..., 0, :]
    half = problem.boxes[..., 3:6] / 2
    outward = toward[..., [0, 0, 1, 1]] * FACE_SIGN[:4].to(R) - half[..., [0, 0, 1, 1]]
    along = toward[..., [1, 1, 0, 0]].abs() - half[..., [1, 1, 0, 0]]
    sides = outward / along.clamp(min=MIN_ALONG)
    roof_and_bottom = sides.new_tensor([9.0, -9.0]).expand(*sides.shape[:2], 2)
    return torch.cat([sides, roof_and_bottom], -1)


def inset_shares(problem: Problem, tangent: Tensor, config: Config) -> Tensor:
    """
    Return the multiples of the two insets of `FaceOffsets` (M11), shape (2, B, N, 6).

    Of the occlusion inset, by the `tangent` (B, N, 6) of `visibility`: a body is round at its
    edges. And of the range inset: fewer points reach the outermost parts of a distant object.

    """
    shifted = tangent + tangent.new_tensor(EDGE_LEAD)
    occluded = 0.5 - 0.5 * shifted / (shifted.square() + VISIBILITY_SOFTNESS).sqrt()
    if not config.ingredients.range_inset:
        return torch.stack([occluded, torch.zeros_like(occluded)])
    beyond = problem.origins[..., :2].norm(dim=-1, keepdim=True).nan_to_num() - NEAR_RANGE
    distant = (1 - occluded) * (beyond / RANGE_SPAN).clamp(0, MAX_RANGE_SHARE)
    return torch.stack([occluded, distant])


def observe_faces(
    problem: Problem, state: State, offsets: FaceOffsets, config: Config
) -> FaceObservations:
    """
    Find the outermost points of each face (M10) [for Eq. 4].

    Parameters
    ----------
    problem : Problem
        Windows.
    state : State
        Boxes of this round.
    offsets : FaceOffsets
        Where the points of each face are expected.
    config : Config
        Settings; `faces.outermost` is the part of the points that makes one face observation.

    Returns
    -------
    observations : FaceObservations
        Of every observation and face; the bottom is the road beside the box.

    Notes
    -----
    The paper takes the K points closest to a face that is visible by the points' centre of mass.
    We take the outermost ones: the closest points of a face that is given too far inside may lie
    anywhere. On a face with a wrong yaw the outermost points are all at one end: each of three
    strips has its own, so that the face is turned as well. Points far behind the outermost one
    belong to another surface, e.g. a wheel or a hood. Points are motion-compensated to the stamp
    of their box.

    """
    points = motion_compensated(problem, state)
    tangent = visibility(problem)
    shares = inset_shares(problem, tangent, config)
    range_inset = shares[1] * offsets.range_inset.to(shares)
    inset = shares[0] * offsets.occlusion_inset.to(shares) + range_inset
    half = (state.shared[:, EXTENT] / 2).to(points)[:, None, :, None]  # (B, 1, 3, 1)
    margin = (state.shared[:, None, GAP] + inset).to(points)[..., None]
    local = to_box_frame(points, problem, state.pose)  # (B, N, 3, M)
    depth, num_points = _depth_in_faces(local, half, margin - half[..., FACE_AXIS, :])

    strips = STRIPS if config.ingredients.strips else 1
    share = config.faces.outermost / strips
    most = max(MIN_POINTS, int(share * points.shape[2]) + 1)
    strip = (local[..., :2, :] / half[..., :2, :]).add_(1).mul_(strips / 2).clamp_(0, strips - 1)
    depth, index = outermost_in_strips(depth, strip.floor_(), strips, most)  # (B, N, 5, 3, K)
    limit = (depth.amin((-1, -2), keepdim=True) + MAX_DEPTH).clamp(
        max=OUTSIDE_MARGIN + INSIDE_EXTRA
    )
    wanted = (share * num_points).clamp(min=MIN_POINTS)[..., None, None, None]
    chosen = (depth <= limit) & (torch.arange(most, device=index.device) < wanted)

    number = chosen.sum((-1, -2))
    part = chosen / number.clamp(min=1)[..., None, None].to(points)
    moments = _second_moments(points, index, part)
    distance = -(torch.where(chosen, depth, 0.0) * part).sum((-1, -2))
    occluded_weight = OCCLUDED_FACE_WEIGHT if config.ingredients.occluded_faces else 0.0
    weight = (number >= MIN_POINTS) * torch.where(tangent[..., :BOTTOM] > 0, 1.0, occluded_weight)
    weight = weight / (1 + (range_inset[..., :BOTTOM] / RANGE_INSET_HALF_WEIGHT) ** 2)

    road_moments, road_distance, has_road = _road_observation(problem, state)
    return FaceObservations(
        torch.cat([moments.to(road_moments), road_moments[:, :, None]], 2),
        torch.cat([distance.to(road_distance), road_distance[:, :, None]], 2),
        torch.cat([weight.to(road_distance), has_road[:, :, None].to(road_distance)], 2),
        inset,
        shares,
        num_points.to(road_distance),
    )


def _depth_in_faces(local: Tensor, half: Tensor, offset: Tensor) -> tuple[Tensor, Tensor]:
    """
    Return how far inside each face but the bottom each point is [m], and the points per box.

    Parameters
    ----------
    local : Tensor, shape (B, N, 3, M)
        Points in box axes [m].
    half : Tensor, shape (B, 1, 3, 1)
        Half the extents [m].
    offset : Tensor, shape (B, N, 6, 1)
        Where the outermost points of each face are expected: minus their distance from the
        centre [m].

    Returns
    -------
    depth : Tensor, shape (B, N, 5, M)
        Float32; points beside a face are very far inside.
    num_points : Tensor, shape (B, N)
        Points in and near the box.

    """
    x, y, z = local.abs().sub_(half).unbind(-2)
    num_points = (x.maximum(y).maximum(z) < OUTSIDE_MARGIN).sum(-1)
    # Masks cost five times as much as sums: points beside a face get a large depth instead.
    beside = [y.maximum(z), x.maximum(z), x.maximum(y)]
    aside = torch.stack(beside, -2).sub_(EDGE_MARGIN).mul_(FAR)
    x, y, z = local.unbind(-2)
    depth = torch.stack([-x, x, -y, y, -z], -2).sub_(offset[..., :BOTTOM, :]).float()
    front_left_top, back_right = depth[..., 0::2, :], depth[..., 1::2, :]
    torch.maximum(front_left_top, aside, out=front_left_top)
    torch.maximum(back_right, aside[..., :2, :], out=back_right)
    return depth, num_points


def _second_moments(points: Tensor, index: Tensor, part: Tensor) -> Tensor:
    """
    Return the sum of (q, 1)(q, 1)' over chosen points, shape (B, N, 5, 4, 4).

    Of `points` (B, N, M, 3) by their `index` among M (B, N, 5, 3, K), each weighted with its
    `part` (B, N, 5, 3, K).

    """
    B, N, M = points.shape[:3]
    first = M * torch.arange(B * N, device=index.device)
    chosen = embedding(index + first.view(B, N, 1, 1, 1), points.flatten(0, 2))
    chosen = pad(chosen, (0, 1), value=1.0)
    return product((chosen * part[..., None]).flatten(3, 4).mT, chosen.flatten(3, 4))


def _road_observation(problem: Problem, state: State) -> tuple[Tensor, Tensor, Tensor]:
    """
    Return the observation of the bottom: one point of the road under the centre of each box.

    Its moments (B, N, 4, 4), its signed distance from the bottom (B, N) [m], and where there is
    one (B, N).

    """
    shift = state.pose[..., :3] - problem.pose[..., :3]
    has_road = problem.ground.isfinite() & problem.valid
    road = torch.nan_to_num(problem.ground)
    point = torch.stack([shift[..., 0], shift[..., 1], road, torch.ones_like(road)], -1)
    height = state.shared[:, None, 2]
    gap = state.shared[:, None, GAP][..., BOTTOM]
    distance = shift[..., 2] - road - height / 2 + gap
    return point[..., None] * point[..., None, :], distance, has_road


def outermost_in_strips(
    depth: Tensor, strip: Tensor, strips: int, count: int
) -> tuple[Tensor, Tensor]:
    """
    Find the outermost points in every strip of every face.

    Parameters
    ----------
    depth : Tensor, shape (..., 5, M)
        How far inside of each face but the bottom each point is [m], float32; overwritten.
    strip : Tensor, shape (..., 2, M)
        Index of the strip each point is in, along x and along y of the box; overwritten.
    strips : int
        Number of strips.
    count : int
        K, points wanted of each strip.

    Returns
    -------
    depth : Tensor, shape (..., 5, strips, K)
        Smallest depths of each strip, ascending [m]; above 2 where there are fewer points.
    index : Tensor, shape (..., 5, strips, K)
        Indices of these points among the M.

    Notes
    -----
    One 32-bit integer holds strip, depth and index of a point: numpy sorts these faster than
    torch finds the smallest depths. Fresh memory would cost more than the arithmetic, so `depth`
    is reused.

    """
    size = depth.shape[-1]
    device = depth.device
    bits = max(8, (size - 1).bit_length())
    scale = 2.0 ** (27 - bits)  # of a number below 12 [1/m]
    strip.mul_(4 * scale).add_(scale + 2**23)  # above it a float ends in the bits of its integer
    for values, axis in zip(depth.clamp_(-1, 2.5).unbind(-2), STRIP_AXIS, strict=True):
        torch.add(strip[..., axis, :], values, alpha=scale, out=values)
    places = torch.arange(size, dtype=torch.int32, device=device)  # 64 bits would cost a third
    keys = depth.view(torch.int32).bitwise_left_shift_(bits).add_(places)
    keys = torch.from_numpy(np.sort(keys.numpy())) if keys.is_cpu else keys.sort().values
    edges = 4 * torch.arange(strips, device=device)
    first = ((edges + 1 - OUTSIDE_MARGIN) * scale).int().expand(*keys.shape[:-1], -1) << bits
    places = torch.searchsorted(keys, first)[..., None] + torch.arange(count, device=device)
    keys = keys.gather(-1, places.clamp(max=size - 1).flatten(-2)).unflatten(-1, (strips, count))
    depth = torch.where(places < size, (keys >> bits) / scale - edges[:, None] - 1, FAR)
    return depth, (keys & (1 << bits) - 1).long()


def to_box_frame(points: Tensor, problem: Problem, pose: Tensor) -> Tensor:
    """
    Transform points into the frames of boxes, shape (B, N, 3, M).

    `points` (B, N, M, 3) are those of `problem`, the boxes are at `pose` (B, N, 6).

    """
    shift = (pose[..., :3] - problem.pose[..., :3]).to(points)
    R = rotation_from_rpy(pose[..., 3:]).to(points).mT.contiguous()  # ten times as fast
    return (R @ points.mT).sub_(R @ shift[..., None])


def motion_compensated(problem: Problem, state: State) -> Tensor:
    """
    Return the points (B, N, M, 3), each moved with its box to the stamp of that (M12).

    The velocity of a box is the mean over the steps before and after it; a single observation has
    none.

    """
    if not bool(problem.delays.any()):
        return problem.points
    position_and_time = torch.cat([state.pose[..., :3], problem.times[..., None]], -1)
    steps = position_and_time.diff(dim=1) * problem.valid[:, 1:, None]  # padding has none
    change = pad(steps, (0, 0, 1, 0)) + pad(steps, (0, 0, 0, 1))
    velocity = change[..., :3] / change[..., 3:].clamp(min=1e-9)
    return problem.points - velocity[..., None, :].to(problem.points) * problem.delays[..., None]
