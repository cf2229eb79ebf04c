"""
Rotations of boxes and frames as arrays: angles, matrices, quaternions.

R = Rz(yaw) Ry(pitch) Rx(roll) maps box axes (x forward, y left, z up, REP 103) to the frame of
the box. Quaternions are x y z w. All functions but `interpolate_*` accept any number of
leading dimensions, also none and empty ones; NaN gives NaN.

"""

from __future__ import annotations

from typing import Any, overload, TYPE_CHECKING

from boxreg_ros.structures import Floats
import numpy as np
from numpy.typing import ArrayLike, NDArray

if TYPE_CHECKING:
    from torch import Tensor

MIN_QUATERNION_NORM = 1e-6
"""A shorter quaternion states no orientation."""
GIMBAL_LOCK = 1e-9
"""
Cosine of the pitch below which roll and yaw rotate about one axis; roll is then defined as zero.

Derived: the elements of R that give roll and yaw have this magnitude and rounding errors of
1e-16, so that above it their errors are below 1e-7 rad.

"""


@overload
def wrap_angle(angle: Tensor) -> Tensor: ...


@overload
def wrap_angle(angle: ArrayLike) -> Floats: ...


def wrap_angle(angle: Any) -> Any:
    """
    Return angles wrapped into [-pi, pi).

    Parameters
    ----------
    angle : array_like or Tensor, any shape
        Angles [rad].

    Returns
    -------
    wrapped : array or Tensor
        Of the same shape [rad]. For a Tensor the derivative is 1.

    """
    if not hasattr(angle, 'dtype'):
        angle = np.asarray(angle, float)
    return (angle + np.pi) % (2 * np.pi) - np.pi


def matrix_from_rpy(rpy: ArrayLike) -> Floats:
    """Return R (..., 3, 3) of roll, pitch and yaw (..., 3) [rad]."""
    angles = np.asarray(rpy, float)
    cos, sin = np.cos(angles), np.sin(angles)
    (cr, cp, cy), (sr, sp, sy) = ([of[..., k] for k in range(3)] for of in (cos, sin))
    R = np.empty((*angles.shape, 3))  # filled in place: `np.stack` takes three times as long
    R[..., 0, 0] = cy * cp
    R[..., 0, 1] = cy * sp * sr - sy * cr
    R[..., 0, 2] = cy * sp * cr + sy * sr
    R[..., 1, 0] = sy * cp
    R[..., 1, 1] = sy * sp * sr + cy * cr
    R[..., 1, 2] = sy * sp * cr - cy * sr
    R[..., 2, 0] = -sp
    R[..., 2, 1] = cp * sr
    R[..., 2, 2] = cp * cr
    return R


def rpy_from_matrix(R: ArrayLike) -> Floats:
    """
    Return the angles of rotation matrices.

    Parameters
    ----------
    R : array_like, shape (..., 3, 3)
        Rotation matrices.

    Returns
    -------
    rpy : array, shape (..., 3)
        Roll, pitch and yaw [rad]; pitch in [-pi/2, pi/2], roll and yaw in [-pi, pi]. Within
        `GIMBAL_LOCK` of a pitch of pi/2 roll is 0.

    """
    R = np.asarray(R, float)
    cos_pitch = np.hypot(R[..., 0, 0], R[..., 1, 0])
    is_locked = cos_pitch < GIMBAL_LOCK
    roll = np.where(is_locked, 0.0, np.arctan2(R[..., 2, 1], R[..., 2, 2]))
    pitch = np.arctan2(-R[..., 2, 0], cos_pitch)
    yaw = np.where(
        is_locked,
        np.arctan2(-R[..., 0, 1], R[..., 1, 1]),
        np.arctan2(R[..., 1, 0], R[..., 0, 0]),
    )
    return np.stack([roll, pitch, yaw], -1)


def matrix_from_quaternion(quaternion_xyzw: ArrayLike) -> Floats:
    """
    Return R (..., 3, 3) of quaternions (..., 4) of any norm.

    Raises
    ------
    ValueError
        If the norm of a quaternion is zero.

    """
    unit = _unit(quaternion_xyzw)
    products = 2 * unit[..., :, None] * unit[..., None, :]
    R = np.empty((*unit.shape[:-1], 3, 3))  # filled in place, as in `matrix_from_rpy`
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        R[..., i, i] = 1 - (products[..., j, j] + products[..., k, k])
        R[..., i, j] = products[..., i, j] - products[..., k, 3]
        R[..., j, i] = products[..., i, j] + products[..., k, 3]
    return R


def quaternion_from_matrix(R: ArrayLike) -> Floats:
    """Return unit quaternions (..., 4), x y z w with w >= 0, of R (..., 3, 3); NaN of NaN."""
    R = np.asarray(R, float)
    products = np.empty((*R.shape[:-2], 4, 4))  # 4 q q^T; its longest row has the least error
    diagonal = np.diagonal(R, axis1=-2, axis2=-1)
    products[..., 3, 3] = 1 + diagonal.sum(-1)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        products[..., i, i] = 1 + 2 * diagonal[..., i] - diagonal.sum(-1)
        products[..., i, j] = products[..., j, i] = R[..., i, j] + R[..., j, i]
        products[..., i, 3] = products[..., 3, i] = R[..., k, j] - R[..., j, k]
    longest = np.diagonal(products, axis1=-2, axis2=-1).argmax(-1)[..., None, None]
    quaternions = _unit(np.take_along_axis(products, longest, -2)[..., 0, :])
    return np.where(quaternions[..., 3:] < 0, -quaternions, quaternions)


def rpy_from_quaternion(quaternion_xyzw: ArrayLike) -> Floats:
    """
    Return the angles of quaternions.

    Parameters
    ----------
    quaternion_xyzw : array_like, shape (..., 4)
        Of any norm but zero.

    Returns
    -------
    rpy : array, shape (..., 3)
        Roll, pitch and yaw, as of `rpy_from_matrix` [rad]; NaN of a quaternion that is not finite.

    Raises
    ------
    ValueError
        If the norm of a quaternion is zero.

    """
    return rpy_from_matrix(matrix_from_quaternion(quaternion_xyzw))


def boxes_from_quaternions(
    centres: ArrayLike, extents: ArrayLike, quaternions_xyzw: ArrayLike
) -> Floats:
    """
    Return boxes (n, 9) from rows, or from one; the angles of no valid quaternion are NaN.

    Parameters
    ----------
    centres, extents : array_like, shape (n, 3) or (3,)
        In meters.
    quaternions_xyzw : array_like, shape (n, 4) or (4,)
        Of any length; one of zero, NaN or infinity is not valid.

    Returns
    -------
    boxes : array, shape (n, 9)
        Centre, extent, and roll, pitch, yaw [m, rad].

    """
    parts = [np.asarray(part, np.float64) for part in (centres, extents, quaternions_xyzw)]
    centre, extent, quaternion = (part.reshape(-1, part.shape[-1]) for part in parts)
    angles = np.full((len(centre), 3), np.nan)
    norms = np.linalg.norm(quaternion, axis=1)
    is_rotation = (norms > MIN_QUATERNION_NORM) & np.isfinite(norms)
    if is_rotation.any():
        angles[is_rotation] = rpy_from_quaternion(quaternion[is_rotation])
    return np.hstack([centre, extent, angles])


def quaternion_from_rpy(rpy: ArrayLike) -> Floats:
    """Return unit quaternions (..., 4), x y z w with w >= 0, of roll, pitch, yaw (..., 3)."""
    half = np.asarray(rpy, float) / 2
    cos, sin = np.cos(half), np.sin(half)
    (cr, cp, cy), (sr, sp, sy) = ([of[..., k] for k in range(3)] for of in (cos, sin))
    quaternions = np.empty((*half.shape[:-1], 4))  # filled in place, as in `matrix_from_rpy`
    quaternions[..., 0] = sr * cp * cy - cr * sp * sy
    quaternions[..., 1] = cr * sp * cy + sr * cp * sy
    quaternions[..., 2] = cr * cp * sy - sr * sp * cy
    quaternions[..., 3] = cr * cp * cy + sr * sp * sy
    return np.where(quaternions[..., 3:] < 0, -quaternions, quaternions)


def interpolate_rotation(first_xyzw: ArrayLike, second_xyzw: ArrayLike, share: float) -> Floats:
    """
    Return the rotation on the shortest path between two rotations.

    Parameters
    ----------
    first_xyzw, second_xyzw : array, shape (4,)
        Quaternions.
    share : float
        0 for the first, 1 for the second; outside, extrapolated at constant angular velocity.

    Returns
    -------
    R : array, shape (3, 3)
        Rotation matrix.

    """
    return matrix_from_quaternion(interpolate_quaternion(first_xyzw, second_xyzw, share))


def interpolate_quaternion(
    first_xyzw: ArrayLike, second_xyzw: ArrayLike, share: ArrayLike
) -> Floats:
    """
    Return the same rotations as `interpolate_rotation` as quaternions.

    Parameters
    ----------
    first_xyzw, second_xyzw : array_like, shape (..., 4)
        Quaternions of any norm but zero, of equal shapes.
    share : array_like, shape (...)
        0 for the first, 1 for the second; outside, extrapolated at constant angular velocity.

    Returns
    -------
    quaternion_xyzw : array, shape (..., 4)
        Unit quaternions.

    Raises
    ------
    ValueError
        If the norm of a quaternion is zero.

    """
    first, second = _unit(np.array([first_xyzw, second_xyzw]))
    is_opposite = (first * second).sum(-1, keepdims=True) < 0
    second = np.where(is_opposite, -second, second)  # the same rotation, on the shortest path
    apart = np.array([second - first, second + first])
    angle = 2 * np.arctan2(*np.sqrt((apart * apart).sum(-1)))
    # sin(part * angle) / sin(angle), with its limit for equal rotations
    whole = np.ones_like(share, float)
    parts = np.array([whole - share, share, whole])
    of_first, of_second, of_whole = parts * np.sinc(parts * angle / np.pi)
    weights = of_first / of_whole, of_second / of_whole
    interpolated: Floats = weights[0][..., None] * first + weights[1][..., None] * second
    return interpolated


def _unit(quaternion_xyzw: ArrayLike) -> Floats:
    """Return unit quaternions (..., 4); NaN where one is not finite."""
    q = np.asarray(quaternion_xyzw, float)
    largest = np.abs(q).max(-1, keepdims=True)
    if not largest.all():
        raise ValueError('quaternion_xyzw: expected a rotation, got a quaternion of zero norm')
    with np.errstate(invalid='ignore'):
        scaled = q / largest  # so that no square overflows or vanishes
    unit: Floats = scaled / np.sqrt((scaled * scaled).sum(-1, keepdims=True))
    return unit


def rotated_kinematics(kinematics: NDArray[np.void], R: Floats) -> NDArray[np.void]:
    """
    Return velocities and accelerations in other axes.

    Parameters
    ----------
    kinematics : array, shape (n,)
        Records `KINEMATICS`.
    R : array, shape (3, 3) or (n, 3, 3)
        Maps the axes of `kinematics` to the others.

    Returns
    -------
    array, shape (n,)
        A copy. Rates of yaw do not change: that is exact for rotations about z, and the tilt
        between frames in practice is small.

    """
    R = np.broadcast_to(R, (len(kinematics), 3, 3))
    J = np.tile(np.eye(4), (len(kinematics), 1, 1))
    J[:, :3, :3] = R
    found = kinematics.copy()
    for name, by in (('velocity', J), ('acceleration', R)):
        found[name] = (by @ kinematics[name][..., None])[..., 0]
        found[f'{name}_covariance'] = by @ kinematics[f'{name}_covariance'] @ by.swapaxes(1, 2)
    return found
