"""Adapter of ``example_msgs/msg/ObstacleArray``: obstacles with id, class, pose and size."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from boxreg_ros.structures import BoxArray, Floats
from msg_adapters import poses
import numpy as np

REQUIRED_FIELDS = ('id', 'category', 'confidence', 'pose', 'size')


def from_msg(msg: Any) -> BoxArray:
    """Return the boxes of a message, in the frame of the message."""
    poses.require_fields('ObstacleArray', msg.obstacles[:1], REQUIRED_FIELDS)
    return BoxArray(
        poses.stamp_ns(msg.header),
        msg.header.frame_id,
        tuple(str(item.id) for item in msg.obstacles),
        tuple(item.category for item in msg.obstacles),
        np.array([item.confidence for item in msg.obstacles], np.float64),
        poses.boxes_of(
            [item.pose for item in msg.obstacles], [item.size for item in msg.obstacles]
        ),
    )


def to_msg(
    msg: Any, boxes: BoxArray, covariances: Floats | None = None, T_out_in: Floats | None = None
) -> Any:
    """Return a copy of the message with its boxes replaced; covariances are not written."""
    quaternions_xyzw = poses.quaternions_of(boxes.boxes)
    obstacles = []
    for i, item in enumerate(msg.obstacles):
        pose, size = poses.with_box(item.pose, item.size, boxes.boxes[i], quaternions_xyzw[i])
        velocity = poses.rotated(item.velocity, T_out_in)
        obstacles.append(poses.replaced(item, pose=pose, size=size, velocity=velocity))
    header = poses.with_frame(msg.header, boxes.frame_id)
    return poses.replaced(msg, header=header, obstacles=obstacles)


def with_added(msg: Any, sources: Sequence[tuple[Any, int]]) -> Any:
    """Return a copy of the message with obstacles of earlier messages added, confidence 0."""
    added = [poses.replaced(earlier.obstacles[row], confidence=0.0) for earlier, row in sources]
    return poses.replaced(msg, obstacles=[*msg.obstacles, *added])
