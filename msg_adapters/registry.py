"""The table of message types, and access to their adapters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from typing import Any, cast

from boxreg_ros.errors import UnsupportedMessage
from boxreg_ros.structures import BoxArray, Floats
from msg_adapters.convention import Convention
from msg_adapters.protocol import Adapter


@dataclass(frozen=True, slots=True)
class MessageType:
    """A type of box messages; texts are empty where the type has none."""

    module: str
    """Implements `Adapter`."""
    track_id: str = ''
    """Field of the track id."""
    class_and_score: str = ''
    """Fields of class name and score."""
    also_written: str = ''
    """Fields that are written besides pose and size."""


TRACKED_TYPE = MessageType(
    'msg_adapters.autoware',
    track_id='UUID in hexadecimal',
    class_and_score='most probable label, `existence_probability`',
    also_written=(
        'covariance; twist and acceleration in the axes of the object; footprint, scaled with the '
        'box'
    ),
)
PREDICTED_TYPE = replace(
    TRACKED_TYPE, also_written=f'{TRACKED_TYPE.also_written}; predicted paths are copied'
)
DETECTED_TYPE = MessageType(
    'msg_adapters.autoware',
    class_and_score='most probable label, `existence_probability`',
    also_written=(
        'covariance and `has_position_covariance`; twist in the axes of the object, `has_twist`; '
        'footprint, scaled with the box'
    ),
)
OBJECT_TYPE = MessageType(
    'msg_adapters.derived',
    track_id='`id`',
    class_and_score='`classification`, `classification_certainty`',
    also_written='twist and acceleration; objects that are not a BOX only change their frame',
)
MESSAGE_TYPES = {
    'vision_msgs/msg/Detection3DArray': MessageType(
        'msg_adapters.vision',
        track_id='`id`, `tracking_id` of vision_msgs 2; an empty one is filled in',
        class_and_score='hypothesis with the highest score',
        also_written='poses of the hypotheses and their covariance',
    ),
    'vision_msgs/msg/BoundingBox3DArray': MessageType('msg_adapters.vision'),
    'autoware_perception_msgs/msg/TrackedObjects': TRACKED_TYPE,
    'autoware_perception_msgs/msg/PredictedObjects': PREDICTED_TYPE,
    'autoware_perception_msgs/msg/DetectedObjects': DETECTED_TYPE,
    'autoware_auto_perception_msgs/msg/TrackedObjects': TRACKED_TYPE,
    'autoware_auto_perception_msgs/msg/PredictedObjects': PREDICTED_TYPE,
    'autoware_auto_perception_msgs/msg/DetectedObjects': DETECTED_TYPE,
    'derived_object_msgs/msg/ObjectArray': OBJECT_TYPE,
    'derived_object_msgs/msg/ObjectWithCovarianceArray': replace(
        OBJECT_TYPE, also_written=f'covariance, {OBJECT_TYPE.also_written}'
    ),
    'foxglove_msgs/msg/SceneUpdate': MessageType(
        'msg_adapters.foxglove',
        track_id='`id` of an entity with a cube; `id/0`, `id/1` ... if it has several',
        class_and_score='metadata `class` and `score`',
    ),
    'jsk_recognition_msgs/msg/BoundingBoxArray': MessageType(
        'msg_adapters.jsk', class_and_score='`label` as a number, `value`'
    ),
    'visualization_msgs/msg/MarkerArray': MessageType(
        'msg_adapters.markers', track_id='`id` of a CUBE', class_and_score='`ns`, 1'
    ),
}
"""Type name -> its adapter and the fields it reads and writes."""
ADAPTERS = {name: item.module for name, item in MESSAGE_TYPES.items()}
"""Type name -> module that implements `Adapter`."""
WITHOUT_IDS = tuple(name for name, item in MESSAGE_TYPES.items() if not item.track_id)
"""Types without track ids; their boxes need data association."""


@dataclass(frozen=True, slots=True)
class ConvertingAdapter:
    """An adapter whose messages follow another convention than their type defines."""

    inner: Adapter
    convention: Convention

    def from_msg(self, msg: Any) -> BoxArray:
        """Return the boxes, see `Adapter`."""
        return self.convention.to_centers(self.inner.from_msg(msg))

    def to_msg(
        self,
        msg: Any,
        boxes: BoxArray,
        covariances: Floats | None = None,
        T_out_in: Floats | None = None,
    ) -> Any:
        """Return a copy with its boxes replaced, see `Adapter`."""
        if covariances is not None:
            covariances = self.convention.covariances_from_centers(boxes, covariances)
        return self.inner.to_msg(msg, self.convention.from_centers(boxes), covariances, T_out_in)

    def with_added(self, msg: Any, sources: Sequence[tuple[Any, int]]) -> Any:
        """Return a copy with boxes of earlier messages added, see `Adapter`."""
        return self.inner.with_added(msg, sources)


def canonical(type_name: str) -> str:
    """Return ``package/msg/Type`` for ``package/Type``; other spellings are not changed."""
    package, slash, name = type_name.partition('/')
    is_short = package and slash and '/' not in name
    return f'{package}/msg/{name}' if is_short else type_name


def adapter_for(type_name: str, convention: Convention | None = None) -> Adapter:
    """
    Return the adapter of a message type.

    Parameters
    ----------
    type_name : str
        ``package/msg/Type``, or ``package/Type``.
    convention : Convention, optional
        How the publisher fills pose and size. Without one they are as the type defines them, and
        types without ids are accepted.

    Returns
    -------
    adapter : Adapter
        Its boxes have their centre as reference and x forward, whatever the convention.

    Raises
    ------
    UnsupportedMessage
        If no adapter reads the type, or it has no track ids and `convention` assigns none.

    """
    name = canonical(type_name)
    if name not in ADAPTERS:
        raise UnsupportedMessage(
            f'message type {type_name!r}: expected a type of boxes, one of {", ".join(ADAPTERS)}'
        )
    if name in WITHOUT_IDS and convention and not convention.associate:
        raise UnsupportedMessage(
            f'boxes of type {type_name} have no ids that identify objects over time; run a '
            f'tracker before, or have ids associated: associate:=true for the node, --associate '
            f'for boxreg relabel'
        )
    adapter = cast(Adapter, import_module(ADAPTERS[name]))
    if convention is None or convention.is_standard:
        return adapter
    return ConvertingAdapter(adapter, convention)
