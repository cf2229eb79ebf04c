"""
Face observations: the outermost points on each face of each box, as their second moments.

This is the correspondence search of every round. docs/method.md, section Face observations, has
the formulas (M10) to (M12).

"""

from typing import NamedTuple

from boxreg_ros.config import Config, KINDS
from boxreg_ros.core.arrowhead import product
from boxreg_ros.core.batch import EXTENT, GAP, Problem, State
from boxreg_ros.core.geometry import FACE_AXIS, FACE_SIGN, rotation_from_rpy
from boxreg_ros.core.kernels import compiled, contiguous
from boxreg_ros.core.kernels.arrays import FaceArrays, FaceNumbers
from boxreg_ros.core.threads import run
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
MIN_FACE_POINTS = 3
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
"""The range inset is that of an object this much beyond `NEAR_RANGE` [m]: at 70 m."""
MAX_RANGE_SHARE = 1.5
"""Largest multiple of the range inset."""
RANGE_INSET_HALF_WEIGHT = 0.1
"""A face whose points have this range inset has weight 1/2 [m]."""
MIN_ALONG = 0.5
"""Smallest distance along a face in the tangent of its visibility [m]."""
FAR = 1e9
"""Depth of points that are not on a face [m]."""


class FaceOffsets(NamedTuple):
    """
    Offsets of the outermost points from the face of a label, as estimated from the input.

    One row for each of `KINDS`; without that axis, the same for all kinds.

    Attributes
    ----------
    gap_correction : Tensor, shape (K, 6) or (6,)
        Labelling margin of each face less the one of the settings of its kind [m].
    occlusion_inset : Tensor, shape (K, 6) or (6,)
        How much further inside the points of an occluded face are [m]; 0 for roof and road.
    range_inset : Tensor, shape (K, 6) or (6,)
        How much further inside they are on an object 70 m away [m].

    """

    gap_correction: Tensor
    occlusion_inset: Tensor
    range_inset: Tensor

    def of(self, problem: Problem) -> 'FaceOffsets':
        """Return the offsets of each window of `problem`, shapes (B, 6)."""
        rows = (part.to(problem.boxes).expand(len(KINDS), 6) for part in self)
        return FaceOffsets(*(part[problem.kind] for part in rows))


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
    inset_shares : Tensor, shape (B, N, 2, 6)
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
    Return the visibility of each face from the sensor that sees it best, shape (B, N, 6).

    The tangent of the angle between the plane of the face and the line of sight, in the
    horizontal for the four upright faces: positive where the sensor is on the outer side,
    negative where the face is hidden behind its own edge. The roof is always visible, the bottom
    never. Without a known sensor position the faces on the side of the points' centre of mass are
    visible, as in the paper.

    """
    R = rotation_from_rpy(problem.pose[..., 3:])
    toward = problem.origins  # (B, N, K, 3)
    is_known = toward.isfinite().all(-1, keepdim=True)
    if not is_known.all():
        points, mask, _ = problem.padded()
        weight = mask.to(points)[..., None]
        mean = (points * weight).sum(-2) / weight.sum(-2).clamp(min=1)
        toward = torch.where(is_known, toward, 1e6 * mean[..., None, :])
    toward = (toward[..., None, :] @ R[..., None, :, :])[..., 0, :]
    half = problem.boxes[..., None, 3:6] / 2
    outward = toward[..., [0, 0, 1, 1]] * FACE_SIGN[:4].to(R) - half[..., [0, 0, 1, 1]]
    along = toward[..., [1, 1, 0, 0]].abs() - half[..., [1, 1, 0, 0]]
    sides = (outward / along.clamp(min=MIN_ALONG)).amax(-2)
    roof_and_bottom = sides.new_tensor([9.0, -9.0]).expand(*sides.shape[:2], 2)
    return torch.cat([sides, roof_and_bottom], -1)


def inset_shares(problem: Problem, tangent: Tensor, config: Config) -> Tensor:
    """
    Return the multiples of the two insets of `FaceOffsets` (M11), shape (B, N, 2, 6).

    Of the occlusion inset, by the `tangent` (B, N, 6) of `visibility`: a body is round at its
    edges. And of the range inset: fewer points reach the outermost parts of an object that is
    distant from its nearest sensor.

    """
    shifted = tangent + tangent.new_tensor(EDGE_LEAD)
    occluded = 0.5 - 0.5 * shifted / (shifted.square() + VISIBILITY_SOFTNESS).sqrt()
    if not config.ingredients.range_inset:
        return torch.stack([occluded, torch.zeros_like(occluded)], 2)
    reach = problem.origins[..., :2].norm(dim=-1).amin(-1, keepdim=True)
    beyond = reach.nan_to_num() - NEAR_RANGE
    distant = (1 - occluded) * (beyond / RANGE_SPAN).clamp(0, MAX_RANGE_SHARE)
    return torch.stack([occluded, distant], 2)


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
    observe = observe_faces_torch
    if compiled(problem.boxes) is not None:
        observe = observe_faces_compiled
    return observe(problem, state, offsets, config)


def observe_faces_compiled(
    problem: Problem, state: State, offsets: FaceOffsets, config: Config
) -> FaceObservations:
    """Return the same as `observe_faces`, by the kernel."""
    kernels = compiled(problem.boxes)
    assert kernels is not None
    B, N = problem.valid.shape
    faces = empty_faces(B, N)
    _, occlusion_inset, range_inset = map(contiguous, offsets.of(problem))
    run(
        kernels.face_support.observe_faces, B, problem.arrays(), contiguous(state.pose),
        contiguous(state.shared), occlusion_inset, range_inset, face_numbers(problem, config),
        faces,
    )  # fmt: skip
    return FaceObservations(*map(torch.from_numpy, faces))


def empty_faces(B: int, N: int) -> FaceArrays:
    """Return room for the face observations of B windows of N observations."""
    return FaceArrays(
        moments=np.empty((B, N, 6, 4, 4)),
        distance=np.empty((B, N, 6)),
        weight=np.empty((B, N, 6)),
        inset=np.empty((B, N, 6)),
        inset_shares=np.empty((B, N, 2, 6)),
        num_points=np.empty((B, N)),
    )


def face_numbers(problem: Problem, config: Config) -> FaceNumbers:
    """Return constants and settings for the kernel."""
    ingredients = config.ingredients
    strips = STRIPS if ingredients.strips else 1
    return FaceNumbers(
        outside_margin=OUTSIDE_MARGIN,
        edge_margin=EDGE_MARGIN,
        max_depth=MAX_DEPTH,
        deepest=OUTSIDE_MARGIN + INSIDE_EXTRA,
        min_points=float(MIN_FACE_POINTS),
        share=config.faces.outermost / strips,
        strips=strips,
        strip_axis=STRIP_AXIS,
        occluded_weight=OCCLUDED_FACE_WEIGHT if ingredients.occluded_faces else 0.0,
        softness=VISIBILITY_SOFTNESS,
        edge_lead=EDGE_LEAD,
        near_range=NEAR_RANGE,
        range_span=RANGE_SPAN,
        max_range_share=MAX_RANGE_SHARE if ingredients.range_inset else 0.0,
        range_half_weight=RANGE_INSET_HALF_WEIGHT,
        min_along=MIN_ALONG,
        is_moving=problem.returns.is_moving,
    )


def observe_faces_torch(
    problem: Problem, state: State, offsets: FaceOffsets, config: Config
) -> FaceObservations:
    """Return the same as `observe_faces`, by torch."""
    points = motion_compensated(problem, state)
    tangent = visibility(problem)
    shares = inset_shares(problem, tangent, config)
    _, occlusion_inset, range_inset = (part.to(shares)[:, None] for part in offsets.of(problem))
    range_inset = shares[:, :, 1] * range_inset
    inset = (shares[:, :, 0] * occlusion_inset + range_inset).to(state.pose)
    occluded_weight = OCCLUDED_FACE_WEIGHT if config.ingredients.occluded_faces else 0.0
    weight = torch.where(tangent > 0, 1.0, occluded_weight).to(state.pose)
    weight = weight / (1 + (range_inset / RANGE_INSET_HALF_WEIGHT) ** 2)
    weight[..., BOTTOM] = (problem.ground.isfinite() & problem.valid).to(weight)
    strips = STRIPS if config.ingredients.strips else 1
    search = FaceSearch(points, inset, weight, config.faces.outermost / strips, strips)
    found = outermost_points(problem, state, search)
    moments, distance, weight, num_points = found
    return FaceObservations(moments, distance, weight, inset, shares, num_points)


class FaceSearch(NamedTuple):
    """
    Inputs of the search for the outermost points of all faces, beside the boxes.

    Attributes
    ----------
    points : Tensor, shape (B, N, M, 3)
        Points minus the centre of their input box, motion-compensated [m].
    inset, weight : Tensor, shape (B, N, 6)
        How much further inside than the labelling margin points are expected [m]; weight of each
        face if it has points.
    share : float
        Part of the points of a box that is taken from each strip.
    strips : int
        Strips of each face.

    """

    points: Tensor
    inset: Tensor
    weight: Tensor
    share: float
    strips: int


Found = tuple[Tensor, Tensor, Tensor, Tensor]


def outermost_points(problem: Problem, state: State, search: FaceSearch) -> Found:
    """
    Find the outermost points in every strip of every face.

    Returns
    -------
    moments : Tensor, shape (B, N, 6, 4, 4)
        Second moments of these points.
    distance, weight : Tensor, shape (B, N, 6)
        Their mean signed distance from where they are expected [m], and the weight of the face.
    num_points : Tensor, shape (B, N)
        Points in and near the box.

    """
    points = search.points.to(state.pose)
    half = (state.shared[:, EXTENT] / 2)[:, None, :, None]  # (B, 1, 3, 1)
    margin = (state.shared[:, None, GAP] + search.inset)[..., None]
    local = to_box_frame(points, problem, state.pose)  # (B, N, 3, M)
    depth, num_points = _depth_in_faces(local, half, margin - half[..., FACE_AXIS, :])

    strips = search.strips
    strip = ((local[..., :2, :] / half[..., :2, :] + 1) * (strips / 2)).clamp(0, strips - 1)
    own_strip = strip.floor()[..., STRIP_AXIS, :]  # (B, N, 5, M)
    most = min(points.shape[2], max(MIN_FACE_POINTS, int(search.share * points.shape[2]) + 1))
    in_strip = [torch.where(own_strip == k, depth, FAR) for k in range(strips)]
    depth, index = torch.stack(in_strip, 3).topk(most, -1, largest=False)  # (B, N, 5, strips, K)
    limit = (depth.amin((-1, -2), keepdim=True) + MAX_DEPTH).clamp(
        max=OUTSIDE_MARGIN + INSIDE_EXTRA
    )
    wanted = (search.share * num_points).clamp(min=MIN_FACE_POINTS)[..., None, None, None]
    chosen = (depth <= limit) & (torch.arange(most, device=index.device) < wanted)

    number = chosen.sum((-1, -2))
    part = chosen / number.clamp(min=1)[..., None, None].to(points)
    moments = _second_moments(points, index, part)
    distance = -(torch.where(chosen, depth, 0.0) * part).sum((-1, -2))
    weight = search.weight.clone()
    weight[..., :BOTTOM] *= number >= MIN_FACE_POINTS
    road_moments, road_distance = _road_observation(problem, state)
    return (
        torch.cat([moments, road_moments[:, :, None]], 2),
        torch.cat([distance, road_distance[:, :, None]], 2),
        weight,
        num_points.to(distance),
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
        `FAR` for points that are not on the face.
    num_points : Tensor, shape (B, N)
        Points in and near the box.

    """
    x, y, z = (local.abs() - half).unbind(-2)
    num_points = (x.maximum(y).maximum(z) < OUTSIDE_MARGIN).sum(-1)
    beside_ends, beside_sides, beside_top = y.maximum(z), x.maximum(z), x.maximum(y)
    beside = torch.stack([beside_ends] * 2 + [beside_sides] * 2 + [beside_top], -2)
    x, y, z = local.unbind(-2)
    depth = torch.stack([-x, x, -y, y, -z], -2) - offset[..., :BOTTOM, :]
    is_on_face = (beside <= EDGE_MARGIN) & (depth >= -OUTSIDE_MARGIN)
    is_on_face &= depth < OUTSIDE_MARGIN + INSIDE_EXTRA
    return torch.where(is_on_face, depth, FAR), num_points


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


def _road_observation(problem: Problem, state: State) -> tuple[Tensor, Tensor]:
    """
    Return the observation of the bottom: one point of the road under the centre of each box.

    Its moments (B, N, 4, 4) and its signed distance from the bottom (B, N) [m].

    """
    shift = state.pose[..., :3] - problem.pose[..., :3]
    road = torch.where(problem.ground.isfinite(), problem.ground, 0.0)
    point = torch.stack([shift[..., 0], shift[..., 1], road, torch.ones_like(road)], -1)
    height = state.shared[:, None, 2]
    gap = state.shared[:, None, GAP][..., BOTTOM]
    distance = shift[..., 2] - road - height / 2 + gap
    return point[..., None] * point[..., None, :], distance


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
    points, _, delays = problem.padded()
    if not problem.returns.is_moving:
        return points
    position_and_time = torch.cat([state.pose[..., :3], problem.times[..., None]], -1)
    steps = position_and_time.diff(dim=1) * problem.valid[:, 1:, None]  # padding has none
    change = pad(steps, (0, 0, 1, 0)) + pad(steps, (0, 0, 0, 1))
    velocity = change[..., :3] / change[..., 3:].clamp(min=1e-9)
    return points - velocity[..., None, :].to(points) * delays[..., None]
