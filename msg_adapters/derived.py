"""
``derived_object_msgs``: ObjectArray and ObjectWithCovarianceArray.

The track id is `id`, the score the certainty of the classification. The pose is the centre of the
shape, whose dimensions are length, width and height. Objects that are not a BOX of three
dimensions are skipped when reading; when writing, they only change their frame.

"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from boxreg_ros.structures import BoxArray, Floats
from msg_adapters import poses
import numpy as np

BOX = 1
CLASS_NAMES = (
    'unknown', 'unknown_small', 'unknown_medium', 'unknown_big', 'pedestrian', 'bike', 'car',
    'truck', 'motorcycle', 'other_vehicle', 'barrier', 'sign',
)  # fmt: skip
CERTAIN = 255
"""Largest value of ``classification_certainty``."""
REQUIRED_FIELDS = (
    'id',
    'header',
    'pose',
    'shape.type',
    'shape.dimensions',
    'object_classified',
    'classification',
    'classification_certainty',
)


def from_msg(msg: Any) -> BoxArray:
    """
    Return the boxes; an object without classification has the class ``''`` and the score 1.

    Raises UnsupportedMessage if an object is in another frame than the array, or the definition
    lacks a field.

    """
    poses.require_fields('ObjectArray', msg.objects[:1], REQUIRED_FIELDS)
    objects = [o for o in msg.objects if _is_box(o)]
    header = poses.common_header('ObjectArray', msg.header, objects)
    return BoxArray(
        poses.stamp_ns(header),
        header.frame_id,
        tuple(str(o.id) for o in objects),
        tuple(_class_name(o) for o in objects),
        np.array([_score(o) for o in objects]),
        poses.boxes_of([_pose(o) for o in objects], [o.shape.dimensions for o in objects]),
    )


def to_msg(
    msg: Any, boxes: BoxArray, covariances: Floats | None = None, T_out_in: Floats | None = None
) -> Any:
    """
    Return a copy with the boxes replaced; see `Adapter.to_msg`.

    Twist and acceleration, in the axes of the frame, are those of the box where they are known.

    """
    quaternions_xyzw = poses.quaternions_of(boxes.boxes)
    kinematics = boxes.kinematics
    objects = []
    i = 0  # index of the next box
    for o in msg.objects:
        pose = poses.moved(_pose(o), T_out_in)
        size = o.shape.dimensions
        covariance = None
        twist = poses.rotated_motion(o.twist, 'twist', T_out_in)
        accel = poses.rotated_motion(o.accel, 'accel', T_out_in)
        if _is_box(o):
            pose, size = poses.with_box(pose, size, boxes.boxes[i], quaternions_xyzw[i])
            covariance = None if covariances is None else covariances[i]
            if kinematics is not None:
                own = kinematics[i : i + 1]
                twist = poses.with_motion(twist, 'twist', own, 'velocity')
                accel = poses.with_motion(accel, 'accel', own, 'acceleration')
            i += 1
        if hasattr(o.pose, 'covariance'):
            pose = poses.with_covariance(o.pose, pose, covariance, T_out_in)
        objects.append(
            poses.replaced(
                o,
                header=poses.with_frame(o.header, boxes.frame_id),
                pose=pose,
                twist=twist,
                accel=accel,
                shape=poses.replaced(o.shape, dimensions=size),
                polygon=poses.moved_polygon(o.polygon, T_out_in),
            )
        )
    return poses.replaced(
        msg, header=poses.with_frame(msg.header, boxes.frame_id), objects=objects
    )


def with_added(msg: Any, sources: Sequence[tuple[Any, int]]) -> Any:
    """Return a copy with objects of earlier messages added; see `Adapter.with_added`."""
    header = poses.common_header('ObjectArray', msg.header, [*filter(_is_box, msg.objects)])
    added = []
    for source, row in sources:
        o = [*filter(_is_box, source.objects)][row]
        added.append(poses.replaced(o, header=header, classification_certainty=0))
    return poses.replaced(msg, objects=[*msg.objects, *added])


def class_name_of(number: int) -> str:
    """Return the class of a classification."""
    return CLASS_NAMES[number] if number < len(CLASS_NAMES) else f'class_{number}'


def _is_box(o: Any) -> bool:
    return o.shape.type == BOX and len(o.shape.dimensions) == 3


def _class_name(o: Any) -> str:
    if not o.object_classified:
        return ''
    return class_name_of(o.classification)


def _score(o: Any) -> float:
    return o.classification_certainty / CERTAIN if o.object_classified else 1.0


def _pose(o: Any) -> Any:
    return o.pose.pose if hasattr(o.pose, 'covariance') else o.pose
