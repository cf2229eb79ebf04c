"""Box geometry on tensors, for any leading batch dimensions."""

import torch
from torch import Tensor

# The six faces, front back left right top bottom: axis of the outward normal, and its sign.
FACE_AXIS = torch.tensor([0, 0, 1, 1, 2, 2])
FACE_SIGN = torch.tensor([1.0, -1.0, 1.0, -1.0, 1.0, -1.0], dtype=torch.float64)


def rotation_from_rpy(rpy: Tensor) -> Tensor:
    """Return R = Rz(yaw) Ry(pitch) Rx(roll), shape (..., 3, 3), of `rpy` (..., 3) [rad]."""
    rpy = rpy.contiguous()  # of a slice sines take 9 times as long
    (cr, cp, cy), (sr, sp, sy) = rpy.cos().unbind(-1), rpy.sin().unbind(-1)
    x = [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr]
    y = [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr]
    return torch.stack([*x, *y, -sp, cp * sr, cp * cr], -1).view(*rpy.shape, 3)


def rotation_derivatives(rpy: Tensor) -> tuple[Tensor, Tensor]:
    """Return R (..., 3, 3) and its derivatives (..., 3, 3, 3) by roll, pitch and yaw, in front."""
    R, cos, sin = rotation_from_rpy(rpy), rpy[..., 2:].cos(), rpy[..., 2:].sin()
    # Roll turns the y axis into z, yaw turns the rows of x into those of y: no products needed.
    (_, left, up), (x, y, z) = R.unbind(-1), R.unbind(-2)
    by_roll = torch.stack([0 * up, up, -left], -1)
    by_pitch = torch.stack([cos * z, sin * z, -cos * x - sin * y], -2)
    return R, torch.stack([by_roll, by_pitch, torch.stack([-y, x, 0 * z], -2)], -3)


def wrap_angle(angle: Tensor) -> Tensor:
    """Return `angle` [rad] wrapped into [-pi, pi]."""
    return torch.atan2(torch.sin(angle), torch.cos(angle))


def face_distances(points: Tensor, boxes: Tensor) -> Tensor:
    """
    Return signed distances (..., M, 6) from the six faces to `points` (..., M, 3) [m].

    Positive outside; the plane distances D of Eq. 4 and 5 are their magnitudes.

    """
    local = (points - boxes[..., None, :3]) @ rotation_from_rpy(boxes[..., 6:9])
    half = boxes[..., None, 3:6][..., FACE_AXIS] / 2
    return local[..., FACE_AXIS] * FACE_SIGN.to(local) - half
