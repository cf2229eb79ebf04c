"""
``jsk_recognition_msgs/BoundingBoxArray``, of ROS 1 and its forks; it has no ids.

`value` is the score and the number `label` the class. Fields that forks have put behind them
are carried along: a recording brings its definition with it.

"""

from __future__ import annotations

from typing import Any

from boxreg_ros.structures import BoxArray, Floats
from msg_adapters import poses
import numpy as np


def from_msg(msg: Any) -> BoxArray:
    """
    Return the boxes of a BoundingBoxArray.

    Raises
    ------
    UnsupportedMessage
        If a box is in another frame than the array.

    """
    header = poses.one_header('BoundingBoxArray', msg.header, msg.boxes)
    return BoxArray(
        poses.stamp_ns(header),
        header.frame_id,
        ('',) * len(msg.boxes),
        tuple(str(box.label) for box in msg.boxes),
        np.array([box.value for box in msg.boxes], dtype=np.float64),
        poses.boxes_of([box.pose for box in msg.boxes], [box.dimensions for box in msg.boxes]),
    )


def to_msg(
    msg: Any, boxes: BoxArray, covariances: Floats | None = None, T_out_in: Floats | None = None
) -> Any:
    """Return a copy with the boxes replaced; it has no place for covariances."""
    found = []
    for own, box, turn in zip(
        msg.boxes, boxes.boxes, poses.quaternions_of(boxes.boxes), strict=True
    ):
        pose, size = poses.with_box(own.pose, own.dimensions, box, turn)
        header = poses.with_frame(own.header, boxes.frame_id)
        found.append(poses.replaced(own, header=header, pose=pose, dimensions=size))
    return poses.replaced(msg, header=poses.with_frame(msg.header, boxes.frame_id), boxes=found)
