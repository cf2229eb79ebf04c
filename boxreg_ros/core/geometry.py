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


def rotation_derivatives(rpy: Tensor) -> tuple[Tensor, Tensor]:
    """
    Return the rotation of roll, pitch and yaw, and its derivatives.

    Parameters
    ----------
    rpy : Tensor, shape (..., 3)
        Roll, pitch and yaw [rad].

    Returns
    -------
    R : Tensor, shape (..., 3, 3)
        As `rotation_from_rpy` returns it.
    dR : Tensor, shape (..., 3, 3, 3)
        Derivatives by roll, pitch and yaw, in the first of the three axes.

    """
    R = rotation_from_rpy(rpy)
    cos_yaw, sin_yaw = rpy[..., 2:].cos(), rpy[..., 2:].sin()
    _, left, up = R.unbind(-1)  # columns: y and z axis of the box
    x, y, z = R.unbind(-2)  # rows
    # Roll turns the y axis into z, yaw turns the row x into y: no matrix products needed.
    by_roll = torch.stack([0 * up, up, -left], -1)
    by_pitch = torch.stack([cos_yaw * z, sin_yaw * z, -cos_yaw * x - sin_yaw * y], -2)
    by_yaw = torch.stack([-y, x, 0 * z], -2)
    return R, torch.stack([by_roll, by_pitch, by_yaw], -3)


def face_distances(points: Tensor, boxes: Tensor) -> Tensor:
    """
    Return the signed distances of points from the planes of the six faces of their box.

    Parameters
    ----------
    points : Tensor, shape (..., M, 3)
        Points [m].
    boxes : Tensor, shape (..., 9)
        Boxes in the frame of the points [m, rad].

    Returns
    -------
    distances : Tensor, shape (..., M, 6)
        In the order of `FACE_AXIS`, positive outside the face [m]. Their magnitudes are the plane
        distances D of Eq. 4 and 5.

    """
    local = (points - boxes[..., None, :3]) @ rotation_from_rpy(boxes[..., 6:9])
    half = boxes[..., None, 3:6][..., FACE_AXIS] / 2
    return local[..., FACE_AXIS] * FACE_SIGN.to(local) - half
