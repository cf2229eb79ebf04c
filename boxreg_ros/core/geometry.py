"""Box geometry on tensors, for any leading batch dimensions."""

import torch
from torch import Tensor

# Of the six faces front, back, left, right, top, bottom: the axis of the outward normal, its sign.
FACE_AXIS = torch.tensor([0, 0, 1, 1, 2, 2])
FACE_SIGN = torch.tensor([1.0, -1.0, 1.0, -1.0, 1.0, -1.0], dtype=torch.float64)


def rotation_from_rpy(rpy: Tensor) -> Tensor:
    """Return R = Rz(yaw) Ry(pitch) Rx(roll), shape (..., 3, 3), of `rpy` (..., 3) [rad]."""
    rpy = rpy.contiguous()  # sines of a slice take 9 times as long
    cr, cp, cy = rpy.cos().unbind(-1)
    sr, sp, sy = rpy.sin().unbind(-1)
    first_row = [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr]
    second_row = [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr]
    third_row = [-sp, cp * sr, cp * cr]
    return torch.stack([*first_row, *second_row, *third_row], -1).view(*rpy.shape, 3)


def face_distances(points: Tensor, boxes: Tensor) -> Tensor:
    """
    Return the signed distances of points from the six faces of their box, (..., M, 6).

    In the order of `FACE_AXIS`, positive outside the face [m], of `points` (..., M, 3) and `boxes`
    (..., 9) in their frame [m, rad]. Their magnitudes are the plane distances D of Eq. 4 and 5.

    """
    local = (points - boxes[..., None, :3]) @ rotation_from_rpy(boxes[..., 6:9])
    half = boxes[..., None, 3:6][..., FACE_AXIS] / 2
    return local[..., FACE_AXIS] * FACE_SIGN.to(local) - half
