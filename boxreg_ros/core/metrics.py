"""How far boxes (n, 9) are from true ones, row by row in one frame: overlap and pose errors."""

from typing import NamedTuple

from boxreg_ros.core.geometry import rotation_from_rpy, wrap_angle
from boxreg_ros.structures import checked, Floats, HEIGHT, LENGTH, ROLL
import numpy as np
from numpy.typing import ArrayLike, NDArray
import torch

PAIRS_AT_ONCE = 1000  # bounds the memory of one clipping step to about 100 MB
EXTENT = slice(LENGTH, HEIGHT + 1)
SHIFT = 1e-9  # [m], so much the second box is grown: no two faces are ever in one plane


class PoseErrors(NamedTuple):
    """
    Predicted minus true, one row per pair.

    Attributes
    ----------
    translation, extent : array, shape (n, 3)
        Of the centre along the true box's axes; of length, width and height [m].
    rotation : array, shape (n, 3)
        Of roll, pitch and yaw, each wrapped to [-pi, pi] [rad].
    is_flipped : array, shape (n,)
        True where the heading points the wrong way: |yaw error| > pi / 2.

    """

    translation: Floats
    extent: Floats
    rotation: Floats
    is_flipped: NDArray[np.bool_]


def pose_errors(boxes: ArrayLike, truth: ArrayLike) -> PoseErrors:
    """Return the errors of `boxes` (n, 9) against `truth` (n, 9), as `PoseErrors` says."""
    a, b = _rows(boxes, truth)
    rotation = wrap_angle(torch.from_numpy((a - b)[:, ROLL:])).numpy()
    axes = rotation_from_rpy(torch.from_numpy(b[:, ROLL:])).numpy()
    along, is_flipped = ((a - b)[:, None, :3] @ axes)[:, 0], np.abs(rotation[:, 2]) > np.pi / 2
    return PoseErrors(along, (a - b)[:, EXTENT], rotation, is_flipped)


def iou_bev(boxes: ArrayLike, truth: ArrayLike) -> Floats:
    """
    Return the overlap of footprints, intersection over union, shape (n,).

    A footprint is the rectangle length x width turned by yaw; roll and pitch do not count.

    """
    upright, flat = np.array([1, 1, 0, 1, 1, 0, 0, 0, 1]), np.eye(9)[HEIGHT]
    a, b = _rows(boxes, truth)
    return iou_3d(a * upright + flat, b * upright + flat)


def iou_3d(boxes: ArrayLike, truth: ArrayLike) -> Floats:
    """
    Return the overlap of boxes turned in any way, intersection over union, shape (n,).

    Boxes that are not finite or have no volume overlap with nothing: 0.

    """
    a, b = _rows(boxes, truth)
    count = 1 + len(a) // PAIRS_AT_ONCE
    parts = zip(np.array_split(a, count), np.array_split(b, count), strict=True)
    overlap = np.concatenate([_intersection(*part) for part in parts])
    union = a[:, EXTENT].prod(axis=1) + b[:, EXTENT].prod(axis=1) - overlap
    valid = np.isfinite(overlap) & (overlap > 0)
    return np.asarray(np.divide(overlap, union, out=np.zeros(len(a)), where=valid)).clip(0.0, 1.0)


def _rows(boxes: ArrayLike, truth: ArrayLike) -> tuple[Floats, Floats]:
    a = checked('boxes', boxes, (None, 9))
    return a, checked('truth', truth, a.shape)


def _intersection(a: Floats, b: Floats) -> Floats:
    """
    Return the volume that both boxes of each pair fill [m^3], shape (n,).

    Both boxes together are twelve half-spaces n.x <= d. Where the planes i and j meet, the line is
    clipped by the other ten; what is left, of length L_ij, is an edge of the intersection. With
    c = n_i.n_j and s = |n_i x n_j|, the divergence theorem applied twice (volume by faces, face
    by edges) gives V = 1/6 sum_{i<j} L_ij (2 d_i d_j - c (d_i^2 + d_j^2)) / s.

    """
    axes = [rotation_from_rpy(torch.from_numpy(rows[:, ROLL:])).mT.numpy() for rows in (a, b)]
    normals = np.concatenate([axes[0], -axes[0], axes[1], -axes[1]], axis=1)  # (n, 12, 3)
    shift = np.einsum('nij,nj->ni', axes[1], b[:, :3] - a[:, :3])  # origin: the centre of a
    half_a, half_b = a[:, EXTENT] / 2, b[:, EXTENT] / 2 + SHIFT
    offsets = np.concatenate([half_a, half_a, half_b + shift, half_b - shift], axis=1)  # (n, 12)

    i, j = np.triu_indices(12, 1)
    d_i, d_j, dots = offsets[:, i], offsets[:, j], normals @ np.swapaxes(normals, 1, 2)
    along = np.cross(normals[:, i], normals[:, j])  # (n, 66, 3)
    sine, cosine = np.linalg.norm(along, axis=2), dots[:, i, j]
    parallel = sine < 1e-12
    sine[parallel] = 1.0
    slope = (along / sine[..., None]) @ np.swapaxes(normals, 1, 2)  # (n, 66, 12)
    foot_i, foot_j = (d_i - cosine * d_j) / sine**2, (d_j - cosine * d_i) / sine**2
    foot = foot_i[..., None] * dots[:, i] + foot_j[..., None] * dots[:, j]
    room = offsets[:, None] - foot
    room[:, np.arange(66), i] = room[:, np.arange(66), j] = np.inf  # a line, its planes
    with np.errstate(divide='ignore', invalid='ignore'):
        crossing = np.where(slope == 0, np.copysign(np.inf, room), room / slope)
        end = np.where(slope >= 0, crossing, np.inf).min(axis=2)
        start = np.where(slope < 0, crossing, -np.inf).max(axis=2)
        length = np.where((end > start) & ~parallel, end - start, 0.0)
    return np.asarray((length * (2 * d_i * d_j - cosine * (d_i**2 + d_j**2)) / (6 * sine)).sum(1))
