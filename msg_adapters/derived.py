"""
``derived_object_msgs``: ObjectArray and ObjectWithCovarianceArray.

The track id is `id`, the score the certainty of the classification. The pose is the centre of the
shape, whose dimensions are length, width and height. An object that is not a BOX of three
dimensions is an invalid box when read; when written, it only changes its frame.

"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from boxreg_ros.structures import BoxArray, Floats
from msg_adapters import poses
from msg_adapters.box_fields import BoxFields, BoxLabels, Rewrite, SIZE_WIDTH
from msg_adapters.cdr import Fields
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
    objects = msg.objects
    header = poses.common_header('ObjectArray', msg.header, objects)
    return BoxArray(
        poses.stamp_ns(header),
        header.frame_id,
        tuple(str(o.id) for o in objects),
        tuple(_class_name(o) for o in objects),
        np.array([_score(o) for o in objects]),
        poses.boxes_of([_pose(o) for o in objects], [_size(o) for o in objects]),
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
    for i, o in enumerate(msg.objects):
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
    header = poses.common_header('ObjectArray', msg.header, msg.objects)
    added = [
        poses.replaced(source.objects[row], header=header, classification_certainty=0)
        for source, row in sources
    ]
    return poses.replaced(msg, objects=[*msg.objects, *added])


def _name_of(number: int) -> str:
    """Return the class of a classification."""
    return CLASS_NAMES[number] if number < len(CLASS_NAMES) else f'class_{number}'


def _is_box(o: Any) -> bool:
    return o.shape.type == BOX and len(o.shape.dimensions) == SIZE_WIDTH


def _size(o: Any) -> Sequence[float]:
    """Return the extents of a box [m]; NaN for another shape, which makes it an invalid box."""
    return o.shape.dimensions if _is_box(o) else (np.nan,) * SIZE_WIDTH


def _class_name(o: Any) -> str:
    if not o.object_classified:
        return ''
    return _name_of(o.classification)


def _score(o: Any) -> float:
    return o.classification_certainty / CERTAIN if o.object_classified else 1.0


def _pose(o: Any) -> Any:
    return o.pose.pose if hasattr(o.pose, 'covariance') else o.pose


DIMENSIONS = 'objects.shape.dimensions'
OBJECT_FIELDS = (
    'objects.id', 'objects.object_classified', 'objects.shape.type', 'objects.classification',
)  # fmt: skip


def _motion_fields(of_twist: str = '', of_accel: str = '') -> tuple[str, str]:
    """Return the first numbers of twist and acceleration, with the names of those within."""
    return f'objects.twist{of_twist}.linear.x', f'objects.accel{of_accel}.linear.x'


PLAIN_MOTION = _motion_fields()
MOTION_WITH_COVARIANCE = _motion_fields('.twist', '.accel')


def _writes_motion(fields_of_motion: tuple[str, str], width: int) -> Callable[..., None]:
    """Return a function that writes twist and acceleration, of `width` numbers each."""

    def write(fields: Fields, rewrite: Rewrite) -> None:
        for path, name in zip(fields_of_motion, poses.MOTION_AXES, strict=True):
            own = fields.numbers(path, '<f8', width)
            fields.put(path, poses.with_kinematics(own, rewrite.boxes.kinematics, name))

    return write


def _has_boxes_only(fields: Fields) -> bool:
    is_box = fields.numbers('objects.shape.type', '|u1') == BOX
    return bool(is_box.all() and (fields.counts(DIMENSIONS) == SIZE_WIDTH).all())


def _labels(fields: Fields) -> BoxLabels:
    """Return ids, and classes and certainties where an object is classified."""
    ids = [str(number) for number in fields.numbers('objects.id', '<u4')[:, 0].tolist()]
    is_known = fields.numbers('objects.object_classified', '|u1')[:, 0] != 0
    numbers, certainties = fields.numbers('objects.classification', '|u1', 2).T
    classes = [
        _name_of(number) if known else ''
        for number, known in zip(numbers.tolist(), is_known.tolist(), strict=True)
    ]
    return ids, classes, np.where(is_known, certainties / CERTAIN, 1.0)


OBJECT_ARRAY = BoxFields(
    ('header.frame_id', 'objects.header.frame_id'),
    'objects.pose.position.x',
    DIMENSIONS,
    _labels,
    others=(*OBJECT_FIELDS, *PLAIN_MOTION),
    is_ordinary=_has_boxes_only,
    write=_writes_motion(PLAIN_MOTION, 6),
)
BOX_FIELDS = {
    'derived_object_msgs/msg/ObjectArray': OBJECT_ARRAY,
    'derived_object_msgs/msg/ObjectWithCovarianceArray': replace(
        OBJECT_ARRAY,
        pose='objects.pose.pose.position.x',
        covariance='objects.pose.covariance',
        others=(*OBJECT_FIELDS, *MOTION_WITH_COVARIANCE),
        write=_writes_motion(MOTION_WITH_COVARIANCE, 42),
    ),
}
