"""
``derived_object_msgs``: ObjectArray and ObjectWithCovarianceArray.

`id` is the track, the certainty of the classification the score. The pose is the centre of the
shape, whose dimensions are length, width and height. Objects that are no BOX are passed over
when reading, and move with their frame only when writing.

"""

from __future__ import annotations

from typing import Any

from boxreg_ros.structures import BoxArray, Floats
from msg_adapters import poses
import numpy as np

BOX = 1
CLASSES = (
    'unknown', 'unknown_small', 'unknown_medium', 'unknown_big', 'pedestrian', 'bike', 'car',
    'truck', 'motorcycle', 'other_vehicle', 'barrier', 'sign',
)  # fmt: skip
CERTAIN = 255


def from_msg(msg: Any) -> BoxArray:
    """
    Return the boxes; what is not classified has the class ``''`` and the score 1.

    Raises
    ------
    UnsupportedMessage
        If an object is in another frame than the array.

    """
    objects = [o for o in msg.objects if _is_box(o)]
    header = poses.one_header('ObjectArray', msg.header, objects)
    return BoxArray(
        poses.stamp_ns(header),
        header.frame_id,
        tuple(str(o.id) for o in objects),
        tuple(_class_name(o) for o in objects),
        np.array([o.classification_certainty / CERTAIN if o.object_classified else 1.0
                  for o in objects]),
        poses.boxes_of([_pose(o) for o in objects], [o.shape.dimensions for o in objects]),
    )  # fmt: skip


def to_msg(
    msg: Any, boxes: BoxArray, covariances: Floats | None = None, T_out_in: Floats | None = None
) -> Any:
    """Return a copy with the boxes replaced; see `Adapter.to_msg`."""
    quaternions_xyzw = poses.quaternions_of(boxes.boxes)
    objects, i = [], 0
    for o in msg.objects:
        pose, size, spread = poses.moved(_pose(o), T_out_in), o.shape.dimensions, None
        if _is_box(o):
            pose, size = poses.with_box(pose, size, boxes.boxes[i], quaternions_xyzw[i])
            spread = None if covariances is None else covariances[i]
            i += 1
        if hasattr(o.pose, 'covariance'):
            pose = poses.with_covariance(o.pose, pose, spread, T_out_in)
        objects.append(
            poses.replaced(
                o, header=poses.with_frame(o.header, boxes.frame_id), pose=pose,
                twist=poses.turned_motion(o.twist, 'twist', T_out_in),
                accel=poses.turned_motion(o.accel, 'accel', T_out_in),
                shape=poses.replaced(o.shape, dimensions=size),
                polygon=poses.moved_polygon(o.polygon, T_out_in),
            )
        )  # fmt: skip
    return poses.replaced(
        msg, header=poses.with_frame(msg.header, boxes.frame_id), objects=objects
    )


def _is_box(o: Any) -> bool:
    return o.shape.type == BOX and len(o.shape.dimensions) == 3


def _class_name(o: Any) -> str:
    if not o.object_classified:
        return ''
    number = o.classification
    return CLASSES[number] if number < len(CLASSES) else f'class_{number}'


def _pose(o: Any) -> Any:
    return o.pose.pose if hasattr(o.pose, 'covariance') else o.pose
