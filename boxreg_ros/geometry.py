"""Box geometry on tensors, for any leading batch dimensions."""

import torch
from torch import Tensor

# The six faces, front back left right top bottom: axis of the outward normal, and its sign.
FACE_AXIS = torch.tensor([0, 0, 1, 1, 2, 2])
FACE_SIGN = torch.tensor([1.0, -1.0, 1.0, -1.0, 1.0, -1.0], dtype=torch.float64)


def rotation_from_rpy(rpy: Tensor) -> Tensor:
    """Return R = Rz(yaw) Ry(pitch) Rx(roll), shape (..., 3, 3), of `rpy` (..., 3) [rad]."""
    cr, cp, cy = torch.cos(rpy).unbind(-1)
    sr, sp, sy = torch.sin(rpy).unbind(-1)
    entries = [
        *(cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
        *(sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
        *(-sp, cp * sr, cp * cr),
    ]
    return torch.stack(entries, -1).reshape(*rpy.shape[:-1], 3, 3)


def rotation_derivatives(rpy: Tensor) -> tuple[Tensor, Tensor]:
    """Return R (..., 3, 3) and its derivatives (..., 3, 3, 3) by roll, pitch and yaw, in front."""
    cr, cp, cy = torch.cos(rpy).unbind(-1)
    sr, sp, sy = torch.sin(rpy).unbind(-1)
    R = rotation_from_rpy(rpy)
    # Roll turns the y axis into z, yaw turns the rows of x into those of y: no products needed.
    by_roll = torch.stack([torch.zeros_like(R[..., 0]), R[..., 2], -R[..., 1]], -1)
    by_yaw = torch.stack([-R[..., 1, :], R[..., 0, :], torch.zeros_like(R[..., 0, :])], -2)
    by_pitch = torch.stack(
        [
            *(-cy * sp, cy * cp * sr, cy * cp * cr),
            *(-sy * sp, sy * cp * sr, sy * cp * cr),
            *(-cp, -sp * sr, -sp * cr),
        ],
        -1,
    ).unflatten(-1, (3, 3))
    return R, torch.stack([by_roll, by_pitch, by_yaw], -3)


def wrap_angle(angle: Tensor) -> Tensor:
    """Return `angle` [rad] wrapped into [-pi, pi]."""
    return torch.atan2(torch.sin(angle), torch.cos(angle))


def to_box_frame(points: Tensor, boxes: Tensor) -> Tensor:
    """Return `points` (..., M, 3) in the frame of their box (..., 9)."""
    R = rotation_from_rpy(boxes[..., 6:9])
    return (points - boxes[..., None, :3]) @ R


def face_distances(points: Tensor, boxes: Tensor) -> Tensor:
    """
    Return signed distances (..., M, 6) from the six faces to `points` (..., M, 3) [m].

    Positive outside; the plane distances D of Eq. 4 and 5 are their magnitudes.

    """
    local = to_box_frame(points, boxes)
    sign = FACE_SIGN.to(local)
    half = boxes[..., None, 3:6][..., FACE_AXIS] / 2
    return local[..., FACE_AXIS] * sign - half
