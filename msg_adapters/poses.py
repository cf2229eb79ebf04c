"""Stamps, poses and copies that all box messages share."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from typing import Any

from boxreg_ros.structures import Floats, HEIGHT, LENGTH, ROLL, X, YAW, Z
import numpy as np
from scipy.spatial.transform import Rotation

UNIT_TOLERANCE = 0.01
"""How far a squared quaternion norm may be from 1; what tf2 accepts."""


def stamp_ns(header: Any) -> int:
    """Return the stamp of a header [ns]."""
    return int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec)


def boxes_of(poses: Sequence[Any], sizes: Sequence[Any]) -> Floats:
    """
    Return boxes (n, 9) from ``geometry_msgs`` poses and full extents.

    A quaternion that is not of unit length says nothing about the orientation: such a box gets
    NaN angles, which the core recognises as an invalid box.

    """
    boxes = np.full((len(poses), 9), np.nan)
    if not len(poses):
        return boxes
    boxes[:, X : Z + 1] = [(p.position.x, p.position.y, p.position.z) for p in poses]
    boxes[:, LENGTH : HEIGHT + 1] = [(s.x, s.y, s.z) for s in sizes]
    quaternions_xyzw = np.array(
        [(q.x, q.y, q.z, q.w) for q in (pose.orientation for pose in poses)], dtype=np.float64
    )
    unit = np.abs(np.square(quaternions_xyzw).sum(axis=1) - 1.0) < UNIT_TOLERANCE
    boxes[unit, ROLL : YAW + 1] = Rotation.from_quat(quaternions_xyzw[unit]).as_euler(
        'ZYX', suppress_warnings=True
    )[:, ::-1]
    return boxes


def quaternions_of(boxes: Floats) -> Floats:
    """Return quaternions (n, 4), x y z w with w >= 0, of boxes (n, 9); NaN stays NaN."""
    quaternions_xyzw = np.full((len(boxes), 4), np.nan)
    known = np.isfinite(boxes[:, ROLL : YAW + 1]).all(axis=1)
    angles = boxes[known, ROLL : YAW + 1][:, ::-1]
    quaternions_xyzw[known] = Rotation.from_euler('ZYX', angles).as_quat(canonical=True)
    return quaternions_xyzw


def replaced(msg: Any, **fields: Any) -> Any:
    """Return a shallow copy of `msg` with some fields set; the rest is shared."""
    new = copy(msg)
    for name, value in fields.items():
        setattr(new, name, value)
    return new


def with_frame(header: Any, frame_id: str) -> Any:
    """Return a header of the same stamp in another frame."""
    return replaced(header, frame_id=frame_id)


def with_box(pose: Any, size: Any, box: Floats, quaternion_xyzw: Floats) -> tuple[Any, Any]:
    """
    Return copies of a pose and a size that hold `box`.

    Parts of the box that are not finite keep what the message says: NaN is not sent out.

    """
    x, y, z, length, width, height, *_ = box.tolist()
    if np.isfinite(box[X : Z + 1]).all():
        pose = replaced(pose, position=replaced(pose.position, x=x, y=y, z=z))
    if np.isfinite(quaternion_xyzw).all():
        qx, qy, qz, qw = quaternion_xyzw.tolist()
        turned = replaced(pose.orientation, x=qx, y=qy, z=qz, w=qw)
        pose = replaced(pose, orientation=turned)
    if np.isfinite(box[LENGTH : HEIGHT + 1]).all():
        size = replaced(size, x=length, y=width, z=height)
    return pose, size
