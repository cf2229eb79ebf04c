"""Box geometry on tensors, for any leading batch dimensions."""

import torch
from torch import Tensor

# The six faces, front back left right top bottom: axis of the outward normal, and its sign.
FACE_AXIS = torch.tensor([0, 0, 1, 1, 2, 2])
FACE_SIGN = torch.tensor([1.0, -1.0, 1.0, -1.0, 1.0, -1.0], dtype=torch.float64)


def rotation_from_rpy(rpy: Tensor) -> Tensor:
    """Return R = Rz(yaw) Ry(pitch) Rx(roll), shape (..., 3, 3), of `rpy` (..., 3) [rad]."""
    cos, sin = torch.cos(rpy := rpy.contiguous()), torch.sin(rpy)  # of a slice 9 times as slow
    return torch.stack(_rotation(cos, sin), -1).view(*rpy.shape, 3)


def rotation_derivatives(rpy: Tensor) -> tuple[Tensor, Tensor]:
    """Return R (..., 3, 3) and its derivatives (..., 3, 3, 3) by roll, pitch and yaw, in front."""
    cos, sin = torch.cos(rpy := rpy.contiguous()), torch.sin(rpy)
    (cr, cp, cy), (sr, _, sy) = cos.unbind(-1), sin.unbind(-1)
    entries = _rotation(cos, sin)
    a, b, c, d, e, f, g, h, i = entries
    o = torch.zeros_like(a)
    # Roll turns the y axis into z, yaw turns the rows of x into those of y: no products needed.
    by_roll = [o, c, -b, o, f, -e, o, i, -h]
    by_pitch = [cy * g, cy * h, cy * i, sy * g, sy * h, sy * i, -cp, g * sr, g * cr]
    by_yaw = [-d, -e, -f, a, b, c, o, o, o]
    every = torch.stack([*entries, *by_roll, *by_pitch, *by_yaw], -1).unflatten(-1, (4, 3, 3))
    return every[..., 0, :, :], every[..., 1:, :, :]


def _rotation(cos: Tensor, sin: Tensor) -> list[Tensor]:
    """Return the nine entries of R, row by row."""
    (cr, cp, cy), (sr, sp, sy) = cos.unbind(-1), sin.unbind(-1)
    x = [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr]
    y = [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr]
    return [*x, *y, -sp, cp * sr, cp * cr]


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
