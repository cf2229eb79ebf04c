"""Overlap and pose errors of boxes (n, 9) against true boxes, row by row in one frame."""

from typing import NamedTuple

from boxreg_ros.rotations import matrix_from_rpy, wrap_angle
from boxreg_ros.structures import BOX_AXES, BOX_EXTENT, checked, Floats, HEIGHT, ROLL
import numpy as np
from numpy.typing import ArrayLike, NDArray

MAX_PAIRS = 1000
"""Pairs whose intersection is computed at once; derived: about 100 MB of temporary arrays."""
FACE_OFFSET = 1e-9
"""The second box is larger by this on each side [m], so that no two faces are coplanar; derived:
far above float64 rounding at 1 km, far below any error of interest."""
PARALLEL_SINE = 1e-12
"""Planes at a smaller sine do not intersect in an edge; derived: float64 rounding."""


class PoseErrors(NamedTuple):
    """Predicted minus true, one row per pair."""

    translation: Floats
    """(n, 3), of the centre along the axes of the true box [m]."""
    extent: Floats
    """(n, 3), of length, width, height [m]."""
    rotation: Floats
    """(n, 3), of roll, pitch and yaw, each wrapped into [-pi, pi) [rad]."""
    is_flipped: NDArray[np.bool_]
    """(n,), True for the wrong heading sign: abs(yaw error) > pi / 2."""


def pose_errors(boxes: ArrayLike, truth: ArrayLike) -> PoseErrors:
    """
    Return the errors of boxes against true ones.

    Parameters
    ----------
    boxes, truth : array_like, shape (n, 9)
        Pairs of boxes, row by row: x y z length width height roll pitch yaw, in one frame
        [m, rad].

    Returns
    -------
    errors : PoseErrors
        Of n pairs.

    Raises
    ------
    ShapeError
        If an array has another shape.

    """
    a, b = _rows(boxes, truth)
    difference = a - b
    rotation = wrap_angle(difference[:, ROLL:])
    axes = matrix_from_rpy(b[:, ROLL:])
    translation = (difference[:, None, :3] @ axes)[:, 0]
    is_flipped = np.abs(rotation[:, 2]) > np.pi / 2
    return PoseErrors(translation, difference[:, BOX_EXTENT], rotation, is_flipped)


def iou_bev(boxes: ArrayLike, truth: ArrayLike) -> Floats:
    """
    Return the intersection over union of footprints.

    A footprint is the rectangle length x width turned by yaw; roll and pitch are ignored.

    Parameters
    ----------
    boxes, truth : array_like, shape (n, 9)
        Pairs of boxes, row by row: x y z length width height roll pitch yaw, in one frame
        [m, rad].

    Returns
    -------
    iou : array, shape (n,)
        From 0 to 1; 0 for boxes that are not finite or have no area.

    Raises
    ------
    ShapeError
        If an array has another shape.

    """
    # Footprints become upright boxes from z = -1/2 to 1/2.
    kept = np.array([1, 1, 0, 1, 1, 0, 0, 0, 1])
    unit_height = np.eye(9)[HEIGHT]
    a, b = _rows(boxes, truth)
    return iou_3d(a * kept + unit_height, b * kept + unit_height)


def iou_3d(boxes: ArrayLike, truth: ArrayLike) -> Floats:
    """
    Return the intersection over union of volumes, for boxes with any rotation.

    Parameters
    ----------
    boxes, truth : array_like, shape (n, 9)
        Pairs of boxes, row by row: x y z length width height roll pitch yaw, in one frame
        [m, rad].

    Returns
    -------
    iou : array, shape (n,)
        From 0 to 1; 0 for boxes that are not finite or have no volume.

    Raises
    ------
    ShapeError
        If an array has another shape.

    """
    a, b = _rows(boxes, truth)
    count = 1 + len(a) // MAX_PAIRS
    parts = zip(np.array_split(a, count), np.array_split(b, count), strict=True)
    overlap = np.concatenate([_intersection(*part) for part in parts])
    union = a[:, BOX_EXTENT].prod(axis=1) + b[:, BOX_EXTENT].prod(axis=1) - overlap
    is_valid = np.isfinite(overlap) & (overlap > 0)
    iou = np.divide(overlap, union, out=np.zeros(len(a)), where=is_valid)
    return np.asarray(iou).clip(0.0, 1.0)


def _rows(boxes: ArrayLike, truth: ArrayLike) -> tuple[Floats, Floats]:
    a = checked('boxes', boxes, (None, 9), BOX_AXES)
    return a, checked('truth', truth, a.shape)


def _intersection(a: Floats, b: Floats) -> Floats:
    """
    Return the volume of the intersection of each pair of boxes, shape (n,) [m^3].

    Both boxes together are twelve half-spaces n.x <= d. The line in which the planes i and j
    intersect is clipped by the other ten; the rest, of length L_ij, is an edge of the
    intersection. With c = n_i.n_j and s = |n_i x n_j|, the divergence theorem applied twice
    (volume by faces, face by edges) gives

        V = 1/6 sum_{i<j} L_ij (2 d_i d_j - c (d_i^2 + d_j^2)) / s.

    """
    normals, offsets = _half_spaces(a, b)
    dots = normals @ np.swapaxes(normals, 1, 2)  # (n, 12, 12)
    i, j = np.triu_indices(12, 1)  # 66 lines
    d_i, d_j = offsets[:, i], offsets[:, j]  # (n, 66)
    along = np.cross(normals[:, i], normals[:, j])  # (n, 66, 3)
    sine = np.linalg.norm(along, axis=2)
    cosine = dots[:, i, j]
    is_parallel = sine < PARALLEL_SINE
    sine[is_parallel] = 1.0

    # Along a line x = foot + t * direction, plane k allows t * slope_k <= room_k: (n, 66, 12).
    slope = (along / sine[..., None]) @ np.swapaxes(normals, 1, 2)
    foot_i = (d_i - cosine * d_j) / sine**2
    foot_j = (d_j - cosine * d_i) / sine**2
    foot = foot_i[..., None] * dots[:, i] + foot_j[..., None] * dots[:, j]
    room = offsets[:, None] - foot
    lines = np.arange(len(i))
    room[:, lines, i] = np.inf  # the two planes of a line do not clip it
    room[:, lines, j] = np.inf
    with np.errstate(divide='ignore', invalid='ignore'):
        crossing = np.where(slope == 0, np.copysign(np.inf, room), room / slope)
        end = np.where(slope >= 0, crossing, np.inf).min(axis=2)
        start = np.where(slope < 0, crossing, -np.inf).max(axis=2)
        length = np.where((end > start) & ~is_parallel, end - start, 0.0)
    terms = length * (2 * d_i * d_j - cosine * (d_i**2 + d_j**2)) / (6 * sine)
    return np.asarray(terms.sum(1))


def _half_spaces(a: Floats, b: Floats) -> tuple[Floats, Floats]:
    """Return the normals (n, 12, 3) and offsets (n, 12) of both boxes, origin: the centre of a."""
    axes_a, axes_b = (np.swapaxes(matrix_from_rpy(rows[:, ROLL:]), 1, 2) for rows in (a, b))
    normals = np.concatenate([axes_a, -axes_a, axes_b, -axes_b], axis=1)
    shift = np.einsum('nij,nj->ni', axes_b, b[:, :3] - a[:, :3])
    half_a = a[:, BOX_EXTENT] / 2
    half_b = b[:, BOX_EXTENT] / 2 + FACE_OFFSET
    offsets = np.concatenate([half_a, half_a, half_b + shift, half_b - shift], axis=1)
    return normals, offsets
