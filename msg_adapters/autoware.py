"""
``autoware_perception_msgs``: TrackedObjects, PredictedObjects; DetectedObjects, which have no ids.

Those of ``autoware_auto_perception_msgs``, their package before, are read as well. The track id is
the UUID in hexadecimal, the class the most probable label, the score `existence_probability`. The
pose is the centre, `dimensions` are length, width and height.

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from boxreg_ros.structures import BoxArray, Floats, LENGTH, WIDTH
from msg_adapters import poses
from msg_adapters.box_fields import BoxFields, BoxLabels, parts, Rewrite
from msg_adapters.cdr import Fields
import numpy as np
from numpy.typing import NDArray

LABELS = (
    'unknown', 'car', 'truck', 'bus', 'trailer', 'motorcycle', 'bicycle', 'pedestrian', 'animal',
    'hazard', 'over_drivable', 'under_drivable',
)  # fmt: skip
"""Names of ``ObjectClassification.label``, by value."""
CYLINDER = 1
HALF_TURN = np.diag([-1.0, -1.0, 1.0])
"""Rotation by 180 degrees about z."""
REQUIRED_FIELDS = (
    'kinematics',
    'shape.type',
    'shape.dimensions',
    'classification',
    'existence_probability',
)
KINEMATICS_FIELDS = ('pose_with_covariance.pose',)
PREDICTED_FIELDS = ('initial_pose_with_covariance.pose', 'predicted_paths')
"""Fields of the kinematics that are read, and those of a PredictedObject."""
INITIAL = 'initial_'
"""Begin of the names of pose, twist and acceleration in the kinematics of a PredictedObject."""
TWIST_AND_ACCEL = (('twist', 'twist', 'velocity'), ('acceleration', 'accel', 'acceleration'))
"""Names of a motion in the kinematics, of the message within, and in `KINEMATICS`."""


def from_msg(msg: Any) -> BoxArray:
    """
    Return the boxes of objects of any of the types; UnsupportedMessage without a field.

    `orientation_availability` is not read: the sign of each heading is resolved per track later,
    and detectors that call it unavailable, as CenterPoint of pedestrians and bicycles, give one.

    """
    poses.require_fields('TrackedObjects', msg.objects[:1], REQUIRED_FIELDS)
    for o in msg.objects[:1]:
        names = PREDICTED_FIELDS if _prefix_of(o.kinematics) else KINEMATICS_FIELDS
        poses.require_fields('TrackedObjects', [o.kinematics], names)
    boxes = poses.boxes_of(
        [_posed(o.kinematics).pose for o in msg.objects],
        [o.shape.dimensions for o in msg.objects],
    )
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

    Fields in the frame of the object follow its box: the footprint is scaled. Twist and
    acceleration are those of the box where they are known, else they are rotated where the heading
    flips by 180 degrees. Predicted paths change their frame only.

    """
    quaternions_xyzw = poses.quaternions_of(boxes.boxes)
    own_motion = poses.kinematics_of_axes(boxes)
    objects = []
    for i, (o, box) in enumerate(zip(msg.objects, boxes.boxes, strict=True)):
        covariance = None if covariances is None else covariances[i]
        given_pose = poses.moved(_posed(o.kinematics).pose, T_out_in)
        pose, size = poses.with_box(given_pose, o.shape.dimensions, box, quaternions_xyzw[i])
        if o.shape.type == CYLINDER and np.isfinite(box).all():
            diameter = float(box[LENGTH : WIDTH + 1].mean())
            size = poses.replaced(size, x=diameter, y=diameter)
        before, after = (poses.forward_of(poses.quaternion_of(p)) for p in (given_pose, pose))
        is_flipped = bool(before @ after < 0)
        kinematics = _with_pose(o.kinematics, pose, covariance, T_out_in, is_flipped)
        if own_motion is not None:
            kinematics = _with_motion(kinematics, own_motion[i : i + 1])
        shape = poses.replaced(o.shape, dimensions=size, footprint=_scaled_footprint(o.shape, box))
        objects.append(poses.replaced(o, kinematics=kinematics, shape=shape))
    header = poses.with_frame(msg.header, boxes.frame_id)
    return poses.replaced(msg, header=header, objects=objects)


def with_added(msg: Any, sources: Sequence[tuple[Any, int]]) -> Any:
    """Return a copy with objects of earlier messages added; see `Adapter.with_added`."""
    added = [
        poses.replaced(source.objects[row], existence_probability=0.0) for source, row in sources
    ]
    return poses.replaced(msg, objects=[*msg.objects, *added])


def _name_of(label: int) -> str:
    """Return the class of a label."""
    return LABELS[label] if label < len(LABELS) else f'label_{label}'


def _with_pose(
    kinematics: Any,
    pose: Any,
    covariance: Floats | None,
    T_out_in: Floats | None,
    is_flipped: bool,
) -> Any:
    """Return a copy of the kinematics with another pose and covariance."""
    prefix = _prefix_of(kinematics)
    posed = poses.with_covariance(_posed(kinematics), pose, covariance, T_out_in)
    fields: dict[str, Any] = {f'{prefix}pose_with_covariance': posed}
    if hasattr(kinematics, 'has_position_covariance'):
        is_estimated = covariance is not None and bool(np.isfinite(covariance).all())
        fields['has_position_covariance'] = is_estimated or kinematics.has_position_covariance
    if is_flipped:
        for name, inner, _ in TWIST_AND_ACCEL:
            motion = getattr(kinematics, f'{prefix}{name}_with_covariance', None)
            if motion is not None:
                rotated = poses.rotated_motion(motion, inner, HALF_TURN)
                fields[f'{prefix}{name}_with_covariance'] = rotated
    if prefix and T_out_in is not None:
        fields['predicted_paths'] = [
            poses.replaced(path, path=[poses.moved(step, T_out_in) for step in path.path])
            for path in kinematics.predicted_paths
        ]
    return poses.replaced(kinematics, **fields)


def _with_motion(kinematics: Any, found: NDArray[np.void]) -> Any:
    """Return a copy with twist and acceleration of `found` (1,), in the axes of the object."""
    prefix = _prefix_of(kinematics)
    fields: dict[str, Any] = {}
    for name, inner, key in TWIST_AND_ACCEL:
        field = f'{prefix}{name}_with_covariance'
        motion = getattr(kinematics, field, None)
        if motion is not None:
            fields[field] = poses.with_motion(motion, inner, found, key)
    if hasattr(kinematics, 'has_twist') and found['has_velocity'][0]:
        fields |= {'has_twist': True, 'has_twist_covariance': True}
    return poses.replaced(kinematics, **fields)


def _prefix_of(kinematics: Any) -> str:
    """Return the begin of the names of pose, twist and acceleration."""
    return INITIAL if hasattr(kinematics, f'{INITIAL}pose_with_covariance') else ''


def _posed(kinematics: Any) -> Any:
    """Return the pose with its covariance."""
    return getattr(kinematics, f'{_prefix_of(kinematics)}pose_with_covariance')


def _track_id(o: Any) -> str:
    """Return the UUID in hexadecimal; '' if there is none or it is zero."""
    uuid = bytes(o.object_id.uuid) if hasattr(o, 'object_id') else b''
    return uuid.hex() if any(uuid) else ''


def _class_name(o: Any) -> str:
    if not o.classification:
        return ''
    return _name_of(max(o.classification, key=lambda item: item.probability).label)


def _scaled_footprint(shape: Any, box: Floats) -> Any:
    """Return the footprint, scaled like length and width of the box."""
    old = np.array([shape.dimensions.x, shape.dimensions.y])
    if not (old > 0).all() or not np.isfinite(box[LENGTH : WIDTH + 1]).all():
        return shape.footprint
    scale_x, scale_y = (box[LENGTH : WIDTH + 1] / old).tolist()
    points = [poses.replaced(p, x=p.x * scale_x, y=p.y * scale_y) for p in shape.footprint.points]
    return poses.replaced(shape.footprint, points=points)


HALF_TURN_SIGNS = np.tile([-1.0, -1.0, 1.0], 2)
"""Signs of the numbers of a twist or acceleration that is rotated by 180 degrees about z."""
OF_OBJECTS = 'objects.kinematics.'
FOOTPRINT = 'objects.shape.footprint.points'
TWIST_FIELD = OF_OBJECTS + 'twist_with_covariance.twist.linear.x'
ACCELERATION_FIELD = OF_OBJECTS + 'acceleration_with_covariance.accel.linear.x'
HAS_COVARIANCE = OF_OBJECTS + 'has_position_covariance'
HAS_TWIST = OF_OBJECTS + 'has_twist'
AUTOWARE_FIELDS = (
    'objects.existence_probability', 'objects.classification', 'objects.classification.label',
    'objects.classification.probability', TWIST_FIELD, 'objects.shape.type', FOOTPRINT,
    FOOTPRINT + '.x',
)  # fmt: skip


def _detected_labels(fields: Fields) -> BoxLabels:
    """Return the most probable classes and the probabilities of existence; no ids."""
    labels = fields.numbers('objects.classification.label', '|u1')[:, 0].tolist()
    probabilities = fields.numbers('objects.classification.probability', '<f4')[:, 0].tolist()
    classes = []
    for part in parts(fields.counts('objects.classification')):
        best = max(range(part.start, part.stop), key=probabilities.__getitem__, default=None)
        classes.append('' if best is None else _name_of(labels[best]))
    scores = fields.numbers('objects.existence_probability', '<f4')[:, 0].astype(np.float64)
    return [''] * len(scores), classes, scores


def _tracked_labels(fields: Fields) -> BoxLabels:
    """Return the same with the UUIDs in hexadecimal."""
    _, classes, scores = _detected_labels(fields)
    uuids = fields.numbers('objects.object_id.uuid', '|u1', 16)
    ids = [row.tobytes().hex() if row.any() else '' for row in uuids]
    return ids, classes, scores


def _has_no_cylinder(fields: Fields) -> bool:
    return not (fields.numbers('objects.shape.type', '|u1') == CYLINDER).any()


def _write_footprints_and_motion(fields: Fields, rewrite: Rewrite, *motions: str) -> None:
    """Scale footprints with their boxes; write the motion, or rotate it with the heading."""
    new_size = rewrite.boxes.boxes[:, LENGTH : WIDTH + 1]
    old_size = rewrite.old_size[:, :2]
    is_scaled = (old_size > 0).all(1) & np.isfinite(new_size).all(1)
    scale = np.ones((len(new_size), 3))
    scale[is_scaled, :2] = new_size[is_scaled] / old_size[is_scaled]
    corners = fields.numbers(FOOTPRINT + '.x', '<f4', 3)
    scaled = corners * np.repeat(scale, fields.counts(FOOTPRINT), axis=0)
    fields.put(FOOTPRINT + '.x', scaled.astype('<f4'))
    old, new = (poses.forward_of(p[:, 3:].T) for p in (rewrite.old_pose, rewrite.new_pose))
    is_flipped = (old * new).sum(0) < 0
    signs = np.concatenate([HALF_TURN_SIGNS, np.outer(HALF_TURN_SIGNS, HALF_TURN_SIGNS).ravel()])
    known = poses.kinematics_of_axes(rewrite.boxes)
    for path, name in zip(motions, poses.MOTION_AXES, strict=False):
        motion = fields.numbers(path, '<f8', len(signs))
        motion[is_flipped] *= signs
        fields.put(path, poses.with_kinematics(motion, known, name))


def _write_tracked(fields: Fields, rewrite: Rewrite) -> None:
    _write_footprints_and_motion(fields, rewrite, TWIST_FIELD, ACCELERATION_FIELD)


def _write_detected(fields: Fields, rewrite: Rewrite) -> None:
    _write_footprints_and_motion(fields, rewrite, TWIST_FIELD)
    own = fields.numbers(HAS_COVARIANCE, '|u1')
    is_estimated = np.isfinite(rewrite.covariance).all(1, keepdims=True)
    fields.put(HAS_COVARIANCE, own | is_estimated.astype('|u1'))
    has_velocity = rewrite.boxes.known_kinematics['has_velocity']
    has_twist = fields.numbers(HAS_TWIST, '|u1', 2)
    fields.put(HAS_TWIST, has_twist | has_velocity[:, None].astype('|u1'))


DETECTED_OBJECTS = BoxFields(
    ('header.frame_id',),
    OF_OBJECTS + 'pose_with_covariance.pose.position.x',
    'objects.shape.dimensions.x',
    _detected_labels,
    others=(*AUTOWARE_FIELDS, HAS_COVARIANCE, HAS_TWIST),
    covariance=OF_OBJECTS + 'pose_with_covariance.covariance',
    is_ordinary=_has_no_cylinder,
    write=_write_detected,
)
BOX_FIELDS = {
    'autoware_perception_msgs/msg/TrackedObjects': replace(
        DETECTED_OBJECTS,
        labels=_tracked_labels,
        others=(*AUTOWARE_FIELDS, ACCELERATION_FIELD, 'objects.object_id.uuid'),
        write=_write_tracked,
    ),
    'autoware_perception_msgs/msg/DetectedObjects': DETECTED_OBJECTS,
}
