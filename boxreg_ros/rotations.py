"""
Rotations of boxes and frames as arrays: angles, matrices, quaternions.

R = Rz(yaw) Ry(pitch) Rx(roll) turns box axes (x forward, y left, z up, REP 103) into the frame
the box is given in. Quaternions are x y z w. All functions take any number of leading
dimensions, none and empty ones included, and NaN gives NaN.

"""

from boxreg_ros.structures import Floats
import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

GIMBAL_LOCK = 1e-9
"""Below this cosine of the pitch, roll and yaw turn about one axis: roll is then zero."""


def wrap_angle(angle: ArrayLike) -> Floats:
    """Return `angle` wrapped into [-pi, pi) [rad]."""
    return np.asarray((np.asarray(angle, float) + np.pi) % (2 * np.pi) - np.pi)


def matrix_from_rpy(rpy: ArrayLike) -> Floats:
    """Return R (..., 3, 3) of roll, pitch and yaw (..., 3) [rad]."""
    angles = np.asarray(rpy, float)
    cr, cp, cy = np.moveaxis(np.cos(angles), -1, 0)
    sr, sp, sy = np.moveaxis(np.sin(angles), -1, 0)
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.stack([np.stack(row, -1) for row in rows], -2)


def rpy_from_matrix(R: ArrayLike) -> Floats:
    """Return roll, pitch and yaw (..., 3) of R (..., 3, 3) [rad]; pitch is in [-pi/2, pi/2]."""
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
    """Return R (..., 3, 3) of quaternions (..., 4) of any length but zero."""
    q = np.asarray(quaternion_xyzw, float)
    if not q.size:
        return np.zeros((*q.shape[:-1], 3, 3))
    matrices = np.asarray(Rotation.from_quat(q.reshape(-1, 4)).as_matrix())
    return matrices.reshape(*q.shape[:-1], 3, 3)


def quaternion_from_matrix(R: ArrayLike) -> Floats:
    """Return unit quaternions (..., 4), x y z w with w >= 0, of R (..., 3, 3)."""
    R = np.asarray(R, float)
    if not R.size:
        return np.zeros((*R.shape[:-2], 4))
    known = np.isfinite(R).all((-2, -1))
    quaternions = np.full((*R.shape[:-2], 4), np.nan)
    found = Rotation.from_matrix(R[known]).as_quat() if known.any() else np.zeros((0, 4))
    quaternions[known] = np.where(found[:, 3:] < 0, -found, found)
    return quaternions


def rpy_from_quaternion(quaternion_xyzw: ArrayLike) -> Floats:
    """Return roll, pitch and yaw (..., 3) of quaternions (..., 4) [rad]."""
    return rpy_from_matrix(matrix_from_quaternion(quaternion_xyzw))


def quaternion_from_rpy(rpy: ArrayLike) -> Floats:
    """Return unit quaternions (..., 4), x y z w with w >= 0, of roll, pitch, yaw (..., 3)."""
    return quaternion_from_matrix(matrix_from_rpy(rpy))


def interpolate_rotation(first_xyzw: ArrayLike, second_xyzw: ArrayLike, share: float) -> Floats:
    """
    Return R (3, 3) on the shortest way between two quaternions (4,).

    `share` 0 is the first, 1 the second; beyond, the rotation goes on at the same rate.

    """
    first, second = Rotation.from_quat(np.asarray([first_xyzw, second_xyzw], float))
    step = (first.inv() * second).as_rotvec()
    return np.asarray((first * Rotation.from_rotvec(share * step)).as_matrix())
