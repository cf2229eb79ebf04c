"""
Boxes of serialised messages, read and rewritten as arrays.

`BOX_FIELDS` states where each type has pose, size, id, class and score. The adapter of the family
reads unusual messages (several frames in one message, another output frame, shapes that are no
boxes) after they have been deserialised.

"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

from boxreg_ros.structures import BoxArray, Floats, LENGTH, ROLL, WIDTH, YAW
from msg_adapters import autoware, derived, foxglove, markers, poses
from msg_adapters.cdr import Definitions, Fields, installed_definition, Layout
from msg_adapters.convention import Convention, STANDARD
from msg_adapters.protocol import Adapter
from msg_adapters.registry import adapter_for, ConvertingAdapter
import numpy as np
from numpy.typing import NDArray

MOST_WALKED = 32
"""Newest messages whose fields are kept from reading to writing; derived: the early boxes of one
are written at once, the final ones `lag` messages later, 10 by default."""
POSE_WIDTH, SIZE_WIDTH, COVARIANCE_WIDTH = 7, 3, 36
"""Numbers of a pose (position, quaternion), of a size and of a covariance."""
HALF_TURN_SIGNS = np.tile([-1.0, -1.0, 1.0], 2)
"""Signs of the numbers of a twist or acceleration that is rotated by 180 degrees about z."""

BoxLabels = tuple[list[str], list[str], Floats]
"""Ids, classes and scores of all boxes."""


@dataclass(frozen=True, slots=True)
class Rewrite:
    """The new boxes of a message, beside the old ones."""

    boxes: BoxArray
    """The new ones."""
    old_pose: Floats
    """(n, 7), position and quaternion; so is `new_pose`."""
    new_pose: Floats
    old_size: Floats
    """(n, 3) [m]."""
    covariance: Floats
    """(n, 36), NaN where that of the message remains."""


@dataclass(frozen=True, slots=True)
class BoxFields:
    """Where the messages of a type have their boxes."""

    frames: tuple[str, ...]
    """Of the array and of the boxes."""
    pose: str
    """First number of the pose; so is `size`."""
    size: str
    labels: Callable[[Fields], BoxLabels]
    """Reads ids, classes and scores."""
    others: tuple[str, ...] = ()
    """Further fields that the functions here use."""
    stamp: str = 'header.stamp.sec'
    """Seconds of the stamp, before its nanoseconds."""
    covariance: str = ''
    """First number of the covariance of the pose; empty if there is none."""
    is_ordinary: Callable[[Fields], bool] = lambda fields: True
    """Whether all its objects are boxes that arrays can represent."""
    rows: Callable[[Fields], NDArray[np.bool_]] | None = None
    """Which of the poses are those of boxes; by default all."""
    has_angles: Callable[[Fields], NDArray[np.bool_]] | None = None
    """Which boxes have an orientation; by default all."""
    write: Callable[[Fields, Rewrite], None] = lambda fields, rewrite: None
    """Writes what depends on the box beside pose, size and covariance."""


class BoxReader:
    """
    Reads the boxes of the serialised messages of a type, without an object for each.

    Raises UnsupportedMessage if the type is an older one that lacks a field.

    """

    def __init__(self, type_name: str, definitions: Definitions) -> None:
        at = self.at = BOX_FIELDS[type_name]
        paths = (at.stamp, *at.frames, at.pose, at.size, at.covariance, *at.others)
        self._layout = Layout(type_name, definitions, list(dict.fromkeys(filter(None, paths))))
        self._walked = deque[Fields](maxlen=MOST_WALKED)

    def reads_as(self, other: BoxReader) -> bool:
        """Return whether the fields have the types that they have for another reader."""
        return self._layout.kinds == other._layout.kinds

    def ordinary(self, msg: bytes) -> Fields | None:
        """Return the fields of a message with one frame and one stamp that has boxes, or None."""
        fields = self._fields_of(msg)
        if fields is None:
            return None
        at = self.at
        frames = {text for path in at.frames for text in fields.distinct(path)}
        stamps = fields.numbers(at.stamp, '<i4', 2)
        # Where the stamp is 0, those of the boxes may be known.
        is_stamped = bool((stamps == stamps[:1]).all() and stamps.any())
        is_one = len(frames) == 1 and '' not in frames and is_stamped
        has_boxes = len(fields.counts(at.pose)) > 0
        return fields if is_one and has_boxes and at.is_ordinary(fields) else None

    def boxes_of(self, fields: Fields) -> BoxArray:
        """Return the boxes of an ordinary message."""
        at = self.at
        rows = self.rows(fields)
        boxes = poses.boxes_from(
            fields.numbers(at.pose, '<f8', POSE_WIDTH)[rows],
            fields.numbers(at.size, '<f8', SIZE_WIDTH)[rows],
        )
        if at.has_angles is not None:
            boxes[~at.has_angles(fields), ROLL : YAW + 1] = np.nan
        ids, classes, scores = at.labels(fields)
        sec, nanosec = fields.numbers(at.stamp, '<i4', 2)[0].tolist()
        frame_id = fields.texts(at.frames[0])[0]
        return BoxArray(sec * 10**9 + nanosec, frame_id, tuple(ids), tuple(classes), scores, boxes)

    def rows(self, fields: Fields) -> Any:
        """Return which of the poses are those of boxes, as an index."""
        return slice(None) if self.at.rows is None else self.at.rows(fields)

    def _fields_of(self, msg: bytes) -> Fields | None:
        """Return the fields of a message, which is walked through once."""
        for known in self._walked:
            if known.data is msg:
                return known
        fields = self._layout.fields_of(msg)
        if fields is not None:
            self._walked.append(fields)
        return fields


@dataclass(eq=False, repr=False)
class SerializedAdapter:
    """
    An `Adapter` whose messages are bytes, as they arrive and as they are published.

    `kind` is the class of the type, of rclpy; `inner` is the adapter of the messages that
    `deserialize` makes. Raises UnsupportedMessage if the type is an older one that lacks a field.

    """

    type_name: str
    kind: Any
    inner: Adapter
    deserialize: Callable[[bytes, Any], Any]

    def __post_init__(self) -> None:
        """Find the fields in the definition of the type."""
        self._reader = BoxReader(self.type_name, installed_definition)

    def from_msg(self, msg: bytes) -> BoxArray:
        """Return the boxes of a message, see `Adapter`."""
        fields = self._reader.ordinary(msg)
        if fields is None:
            return self.inner.from_msg(self.deserialize(msg, self.kind))
        return self._reader.boxes_of(fields)

    def to_msg(
        self,
        msg: Any,
        boxes: BoxArray,
        covariances: Floats | None = None,
        T_out_in: Floats | None = None,
    ) -> Any:
        """
        Return a copy with its boxes replaced, see `Adapter`.

        Parameters
        ----------
        msg : bytes or message
            As `from_msg` has read it, or as `with_added` returns it.
        boxes : BoxArray
            As of `Adapter.to_msg`.
        covariances : array, shape (n, 6, 6), optional
            As there.
        T_out_in : array, shape (4, 4), optional
            As there.

        Returns
        -------
        bytes or message
            Bytes where `msg` is bytes that `BoxReader.ordinary` reads, and `boxes` are in its
            frame; else a message.

        """
        if not isinstance(msg, bytes):
            return self.inner.to_msg(msg, boxes, covariances, T_out_in)
        fields = self._reader.ordinary(msg) if T_out_in is None else None
        at = self._reader.at
        if fields is None or fields.texts(at.frames[0])[0] != boxes.frame_id:
            given = self.deserialize(msg, self.kind)
            return self.inner.to_msg(given, boxes, covariances, T_out_in)
        fields = fields.copied()  # the final boxes are written into the same message
        rows = self._reader.rows(fields)
        pose = fields.numbers(at.pose, '<f8', POSE_WIDTH)
        size = fields.numbers(at.size, '<f8', SIZE_WIDTH)
        old_pose, old_size = pose[rows].copy(), size[rows].copy()
        quaternions_xyzw = poses.quaternions_of(boxes.boxes)
        pose[rows, :3] = _finite_or(boxes.boxes[:, :3], old_pose[:, :3])
        pose[rows, 3:] = _finite_or(quaternions_xyzw, old_pose[:, 3:])
        size[rows] = _finite_or(boxes.boxes[:, LENGTH:ROLL], old_size)
        fields.put(at.pose, pose)
        fields.put(at.size, size)
        covariance = np.full((len(boxes.boxes), COVARIANCE_WIDTH), np.nan)
        if covariances is not None:
            covariance[:] = covariances.reshape(-1, COVARIANCE_WIDTH)
        if at.covariance:
            own = fields.numbers(at.covariance, '<f8', COVARIANCE_WIDTH)
            fields.put(at.covariance, _finite_or(covariance, own))
        at.write(fields, Rewrite(boxes, old_pose, pose[rows], old_size, covariance))
        return fields.message()

    def with_added(self, msg: bytes, sources: Sequence[tuple[bytes, int]]) -> Any:
        """Return a message with boxes of earlier ones added, see `Adapter`."""
        earlier = [(self.deserialize(source, self.kind), row) for source, row in sources]
        return self.inner.with_added(self.deserialize(msg, self.kind), earlier)


def serialized_adapter_for(
    type_name: str, convention: Convention, kind: Any, deserialize: Callable[[bytes, Any], Any]
) -> Adapter | None:
    """
    Return the adapter of serialised messages of a type.

    Parameters
    ----------
    type_name : str
        As ``package/msg/Type``.
    convention : Convention
        As of `adapter_for`.
    kind : class
        That of the message in rclpy.
    deserialize : callable
        Returns a message of bytes and its class, as ``rclpy.serialization.deserialize_message``.

    Returns
    -------
    adapter : Adapter or None
        Reads bytes; None if messages of this type are read by attribute only.

    Raises
    ------
    UnsupportedMessage
        As of `adapter_for`, or if the installed definition of the type lacks a field.

    """
    inner = adapter_for(type_name, replace(STANDARD, associate=convention.associate))
    if type_name not in BOX_FIELDS:
        return None
    adapter = SerializedAdapter(type_name, kind, inner, deserialize)
    return adapter if convention.is_standard else ConvertingAdapter(adapter, convention)


def _parts(counts: NDArray[np.int64]) -> Iterator[slice]:
    """Yield the rows of the elements of each item, of their numbers (n,)."""
    ends = np.append(0, np.cumsum(counts)).tolist()
    return map(slice, ends, ends[1:])


def _finite_or(new: Floats, old: Floats) -> Floats:
    """Return the rows of `new`, and those of `old` where they are not finite."""
    return np.where(np.isfinite(new).all(1, keepdims=True), new, old)


def _without_labels(fields: Fields) -> BoxLabels:
    """Return empty ids and classes, and the score 1."""
    n = len(fields.counts('boxes.center.position.x'))
    return [''] * n, [''] * n, np.ones(n)


# ---------------------------------------------------------------- vision_msgs/Detection3DArray

RESULT_POSE = 'detections.results.pose.pose.position.x'
RESULT_COVARIANCE = 'detections.results.pose.covariance'


def _detection_labels(fields: Fields) -> BoxLabels:
    """Return ids, and classes and scores of the hypotheses with the highest score."""
    classes = fields.texts('detections.results.hypothesis.class_id')
    scores = fields.numbers('detections.results.hypothesis.score', '<f8')[:, 0]
    counts = fields.counts('detections.results')
    if (counts == 1).all():
        return fields.texts('detections.id'), classes, scores
    best = []
    for part in _parts(counts):
        hypotheses = zip(classes[part], scores[part].tolist(), strict=True)
        best.append(max(hypotheses, key=lambda item: item[1], default=('', 1.0)))
    found_scores = np.array([score for _, score in best])
    return fields.texts('detections.id'), [name for name, _ in best], found_scores


def _write_hypotheses(fields: Fields, rewrite: Rewrite) -> None:
    """Write pose and covariance of each box into its hypotheses."""
    counts = fields.counts('detections.results')
    fields.put(RESULT_POSE, np.repeat(rewrite.new_pose, counts, axis=0))
    own = fields.numbers(RESULT_COVARIANCE, '<f8', COVARIANCE_WIDTH)
    fields.put(RESULT_COVARIANCE, _finite_or(np.repeat(rewrite.covariance, counts, axis=0), own))


# ---------------------------------------------------------------- visualization_msgs/MarkerArray


def _cubes(fields: Fields) -> NDArray[np.bool_]:
    """Return which markers are boxes."""
    _, kinds, actions = fields.numbers('markers.id', '<i4', 3).T
    is_box: NDArray[np.bool_] = (kinds == markers.CUBE) & (actions == markers.ADD)
    return is_box


def _marker_labels(fields: Fields) -> BoxLabels:
    """Return ids and namespaces of the boxes."""
    rows = _cubes(fields)
    ids = [str(number) for number in fields.numbers('markers.id', '<i4')[rows, 0].tolist()]
    names = np.array(fields.texts('markers.ns'), object)[rows].tolist()
    return ids, names, np.ones(len(ids))


# ---------------------------------------------------------------- autoware_perception_msgs

OF_OBJECTS = 'objects.kinematics.'
FOOTPRINT = 'objects.shape.footprint.points'
TWIST_FIELD = OF_OBJECTS + 'twist_with_covariance.twist.linear.x'
ACCELERATION_FIELD = OF_OBJECTS + 'acceleration_with_covariance.accel.linear.x'
HAS_COVARIANCE = OF_OBJECTS + 'has_position_covariance'
HAS_TWIST = OF_OBJECTS + 'has_twist'
AUTOWARE_FIELDS = (
    'objects.existence_probability', 'objects.classification', 'objects.classification.label',
    'objects.classification.probability', OF_OBJECTS + 'orientation_availability', TWIST_FIELD,
    'objects.shape.type', FOOTPRINT, FOOTPRINT + '.x',
)  # fmt: skip


def _autoware_labels(fields: Fields) -> BoxLabels:
    """Return the most probable classes and the probabilities of existence; no ids."""
    labels = fields.numbers('objects.classification.label', '|u1')[:, 0].tolist()
    probabilities = fields.numbers('objects.classification.probability', '<f4')[:, 0].tolist()
    classes = []
    for part in _parts(fields.counts('objects.classification')):
        best = max(range(part.start, part.stop), key=probabilities.__getitem__, default=None)
        classes.append('' if best is None else autoware.class_name_of(labels[best]))
    scores = fields.numbers('objects.existence_probability', '<f4')[:, 0].astype(np.float64)
    return [''] * len(scores), classes, scores


def _tracked_labels(fields: Fields) -> BoxLabels:
    """Return the same with the UUIDs in hexadecimal."""
    _, classes, scores = _autoware_labels(fields)
    uuids = fields.numbers('objects.object_id.uuid', '|u1', 16)
    ids = [row.tobytes().hex() if row.any() else '' for row in uuids]
    return ids, classes, scores


def _has_no_cylinder(fields: Fields) -> bool:
    return not (fields.numbers('objects.shape.type', '|u1') == autoware.CYLINDER).any()


def _is_oriented(fields: Fields) -> NDArray[np.bool_]:
    """Return which objects have an orientation."""
    availability = fields.numbers(OF_OBJECTS + 'orientation_availability', '|u1')[:, 0]
    is_oriented: NDArray[np.bool_] = availability != autoware.ORIENTATION_UNAVAILABLE
    return is_oriented


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


# ---------------------------------------------------------------- derived_object_msgs

DIMENSIONS = 'objects.shape.dimensions'
OBJECT_FIELDS = (
    'objects.id', 'objects.object_classified', 'objects.shape.type', 'objects.classification',
)  # fmt: skip


def _motion_fields(of_twist: str = '', of_accel: str = '') -> tuple[str, str]:
    """Return the first numbers of twist and acceleration, with the names of those within."""
    return f'objects.twist{of_twist}.linear.x', f'objects.accel{of_accel}.linear.x'


def _writes_motion(fields_of_motion: tuple[str, str], width: int) -> Callable[..., None]:
    """Return a function that writes twist and acceleration, of `width` numbers each."""

    def write(fields: Fields, rewrite: Rewrite) -> None:
        for path, name in zip(fields_of_motion, poses.MOTION_AXES, strict=True):
            own = fields.numbers(path, '<f8', width)
            fields.put(path, poses.with_kinematics(own, rewrite.boxes.kinematics, name))

    return write


PLAIN_MOTION = _motion_fields()
MOTION_WITH_COVARIANCE = _motion_fields('.twist', '.accel')


def _has_boxes_only(fields: Fields) -> bool:
    is_box = fields.numbers('objects.shape.type', '|u1') == derived.BOX
    return bool(is_box.all() and (fields.counts(DIMENSIONS) == SIZE_WIDTH).all())


def _object_labels(fields: Fields) -> BoxLabels:
    """Return ids, and classes and certainties where an object is classified."""
    ids = [str(number) for number in fields.numbers('objects.id', '<u4')[:, 0].tolist()]
    is_known = fields.numbers('objects.object_classified', '|u1')[:, 0] != 0
    numbers, certainties = fields.numbers('objects.classification', '|u1', 2).T
    classes = [
        derived.class_name_of(number) if known else ''
        for number, known in zip(numbers.tolist(), is_known.tolist(), strict=True)
    ]
    return ids, classes, np.where(is_known, certainties / derived.CERTAIN, 1.0)


# ---------------------------------------------------------------- foxglove_msgs/SceneUpdate


def _has_one_cube_each(fields: Fields) -> bool:
    return bool((fields.counts('entities.cubes') == 1).all())


def _entity_labels(fields: Fields) -> BoxLabels:
    """Return ids, and classes and scores by the metadata."""
    keys = fields.texts('entities.metadata.key')
    lower = {key: key.lower() for key in set(keys)}
    keys = [lower[key] for key in keys]
    values = fields.texts('entities.metadata.value')
    classes = []
    scores = []
    for part in _parts(fields.counts('entities.metadata')):
        metadata = dict(zip(keys[part], values[part], strict=True))
        class_name, score = foxglove.class_and_score(metadata)
        classes.append(class_name)
        scores.append(score)
    return fields.texts('entities.id'), classes, np.array(scores)


# ---------------------------------------------------------------- jsk_recognition_msgs


def _jsk_labels(fields: Fields) -> BoxLabels:
    """Return labels as classes, and values as scores; no ids."""
    classes = [str(label) for label in fields.numbers('boxes.label', '<u4')[:, 0].tolist()]
    scores = fields.numbers('boxes.value', '<f4')[:, 0].astype(np.float64)
    return [''] * len(classes), classes, scores


DETECTED_OBJECTS = BoxFields(
    ('header.frame_id',),
    OF_OBJECTS + 'pose_with_covariance.pose.position.x',
    'objects.shape.dimensions.x',
    _autoware_labels,
    others=(*AUTOWARE_FIELDS, HAS_COVARIANCE, HAS_TWIST),
    covariance=OF_OBJECTS + 'pose_with_covariance.covariance',
    is_ordinary=_has_no_cylinder,
    has_angles=_is_oriented,
    write=_write_detected,
)
OBJECT_ARRAY = BoxFields(
    ('header.frame_id', 'objects.header.frame_id'),
    'objects.pose.position.x',
    DIMENSIONS,
    _object_labels,
    others=(*OBJECT_FIELDS, *PLAIN_MOTION),
    is_ordinary=_has_boxes_only,
    write=_writes_motion(PLAIN_MOTION, 6),
)
BOX_FIELDS = {
    'vision_msgs/msg/Detection3DArray': BoxFields(
        ('header.frame_id', 'detections.header.frame_id'),
        'detections.bbox.center.position.x',
        'detections.bbox.size.x',
        _detection_labels,
        others=(
            'detections.id', 'detections.results', 'detections.results.hypothesis.class_id',
            'detections.results.hypothesis.score', RESULT_POSE, RESULT_COVARIANCE,
        ),
        is_ordinary=lambda fields: bool((fields.counts('detections.id') > 1).all()),
        write=_write_hypotheses,
    ),
    'vision_msgs/msg/BoundingBox3DArray': BoxFields(
        ('header.frame_id',), 'boxes.center.position.x', 'boxes.size.x', _without_labels
    ),
    'autoware_perception_msgs/msg/TrackedObjects': replace(
        DETECTED_OBJECTS,
        labels=_tracked_labels,
        others=(*AUTOWARE_FIELDS, ACCELERATION_FIELD, 'objects.object_id.uuid'),
        write=_write_tracked,
    ),
    'autoware_perception_msgs/msg/DetectedObjects': DETECTED_OBJECTS,
    'derived_object_msgs/msg/ObjectArray': OBJECT_ARRAY,
    'derived_object_msgs/msg/ObjectWithCovarianceArray': replace(
        OBJECT_ARRAY, pose='objects.pose.pose.position.x', covariance='objects.pose.covariance',
        others=(*OBJECT_FIELDS, *MOTION_WITH_COVARIANCE),
        write=_writes_motion(MOTION_WITH_COVARIANCE, 42),
    ),
    'foxglove_msgs/msg/SceneUpdate': BoxFields(
        ('entities.frame_id',),
        'entities.cubes.pose.position.x',
        'entities.cubes.size.x',
        _entity_labels,
        others=(
            'entities.id', 'entities.cubes', 'entities.metadata', 'entities.metadata.key',
            'entities.metadata.value',
        ),
        stamp='entities.timestamp.sec',
        is_ordinary=_has_one_cube_each,
    ),
    'jsk_recognition_msgs/msg/BoundingBoxArray': BoxFields(
        ('header.frame_id', 'boxes.header.frame_id'),
        'boxes.pose.position.x',
        'boxes.dimensions.x',
        _jsk_labels,
        others=('boxes.value', 'boxes.label'),
    ),
    'visualization_msgs/msg/MarkerArray': BoxFields(
        ('markers.header.frame_id',),
        'markers.pose.position.x',
        'markers.scale.x',
        _marker_labels,
        others=('markers.id', 'markers.ns'),
        stamp='markers.header.stamp.sec',
        rows=_cubes,
    ),
}  # fmt: skip
"""Message type -> where its messages have their boxes."""
