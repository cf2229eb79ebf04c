"""
``autoware_perception_msgs``: TrackedObjects, and DetectedObjects, which have no ids.

The UUID in hexadecimal is the track, the likeliest label the class, `existence_probability` the
score. The pose is the centre, `dimensions` are length, width and height.

"""

from __future__ import annotations

from typing import Any

from boxreg_ros.structures import BoxArray, Floats, LENGTH, ROLL, WIDTH, YAW
from msg_adapters import poses
import numpy as np

LABELS = ('unknown', 'car', 'truck', 'bus', 'trailer', 'motorcycle', 'bicycle', 'pedestrian',
          'animal', 'hazard', 'over_drivable', 'under_drivable')  # fmt: skip
UNAVAILABLE, CYLINDER = 0, 1
HALF_TURN = np.diag([-1.0, -1.0, 1.0])


def from_msg(msg: Any) -> BoxArray:
    """
    Return the boxes of TrackedObjects or DetectedObjects.

    An object whose orientation is not available has NaN angles, so that the core keeps it,
    unless it is a cylinder. The sign of a heading is what its track agrees on.

    """
    boxes = poses.boxes_of(
        [o.kinematics.pose_with_covariance.pose for o in msg.objects],
        [o.shape.dimensions for o in msg.objects],
    )
    for box, o in zip(boxes, msg.objects, strict=True):
        if o.kinematics.orientation_availability == UNAVAILABLE and o.shape.type != CYLINDER:
            box[ROLL : YAW + 1] = np.nan
    return BoxArray(
        poses.stamp_ns(msg.header),
        msg.header.frame_id,
        tuple(_track_id(o) for o in msg.objects),
        tuple(_class_name(o) for o in msg.objects),
        np.array([o.existence_probability for o in msg.objects], np.float64),
        boxes,
    )


def to_msg(
    msg: Any, boxes: BoxArray, covariances: Floats | None = None, T_out_in: Floats | None = None
) -> Any:
    """
    Return a copy with the boxes replaced; see `Adapter.to_msg`.

    What is given in the object's own frame goes with it: the footprint is stretched like the
    box, twist and acceleration are turned around where the heading is.

    """
    objects, quaternions_xyzw = [], poses.quaternions_of(boxes.boxes)
    for i, (o, box) in enumerate(zip(msg.objects, boxes.boxes, strict=True)):
        own = o.kinematics.pose_with_covariance
        given = poses.moved(own.pose, T_out_in)
        spread = None if covariances is None else covariances[i]
        pose, size = poses.with_box(given, o.shape.dimensions, box, quaternions_xyzw[i])
        if o.shape.type == CYLINDER and np.isfinite(box).all():
            across = float(box[LENGTH : WIDTH + 1].mean())  # it has one diameter
            size = poses.replaced(size, x=across, y=across)
        fields = {'pose_with_covariance': poses.with_covariance(own, pose, spread, T_out_in)}
        if hasattr(o.kinematics, 'has_position_covariance'):
            is_ours = spread is not None and bool(np.isfinite(spread).all())
            fields['has_position_covariance'] = is_ours or o.kinematics.has_position_covariance
        for name, inner in (('twist', 'twist'), ('acceleration', 'accel')):
            motion = getattr(o.kinematics, f'{name}_with_covariance', None)
            if motion is not None and poses.forward_of(given) @ poses.forward_of(pose) < 0:
                fields[f'{name}_with_covariance'] = poses.turned_motion(motion, inner, HALF_TURN)
        shape = poses.replaced(o.shape, dimensions=size, footprint=_stretched(o.shape, box))
        kinematics = poses.replaced(o.kinematics, **fields)
        objects.append(poses.replaced(o, kinematics=kinematics, shape=shape))
    header = poses.with_frame(msg.header, boxes.frame_id)
    return poses.replaced(msg, header=header, objects=objects)


def _track_id(o: Any) -> str:
    """Return the UUID in hexadecimal; without one, or with none but zeros, ''."""
    uuid = bytes(o.object_id.uuid) if hasattr(o, 'object_id') else b''
    return uuid.hex() if any(uuid) else ''


def _class_name(o: Any) -> str:
    if not o.classification:
        return ''
    label = max(o.classification, key=lambda item: item.probability).label
    return LABELS[label] if label < len(LABELS) else f'label_{label}'


def _stretched(shape: Any, box: Floats) -> Any:
    """Return the footprint, its points moved as the sides of the box are."""
    old = np.array([shape.dimensions.x, shape.dimensions.y])
    if not (old > 0).all() or not np.isfinite(box[LENGTH : WIDTH + 1]).all():
        return shape.footprint
    along, across = (box[LENGTH : WIDTH + 1] / old).tolist()
    points = [poses.replaced(p, x=p.x * along, y=p.y * across) for p in shape.footprint.points]
    return poses.replaced(shape.footprint, points=points)
