"""Messages from the bytes of a recording, with those that cannot be decoded counted."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from typing import Any

from boxreg_ros.errors import UnsupportedMessage
from boxreg_ros.io.storage.reader import is_message, Reader
from boxreg_ros.io.storage.record import one_line, Record
from rosbags.interfaces import Nodetype
from rosbags.typesys import get_types_from_msg, get_typestore, Stores
from rosbags.typesys.store import Typestore

# Definitions that recordings before ROS 2 Iron lack, and rosbags does not include.
VISION_DEFINITIONS = {
    'vision_msgs/msg/ObjectHypothesis': 'string class_id\nfloat64 score',
    'vision_msgs/msg/ObjectHypothesisWithPose': (
        'vision_msgs/ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose'
    ),
    'vision_msgs/msg/BoundingBox3D': 'geometry_msgs/Pose center\ngeometry_msgs/Vector3 size',
    'vision_msgs/msg/Detection3D': (
        'std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n'
        'vision_msgs/BoundingBox3D bbox\nstring id'
    ),
    'vision_msgs/msg/Detection3DArray': (
        'std_msgs/Header header\nvision_msgs/Detection3D[] detections'
    ),
}

NAMES = {'bool': 'boolean', 'byte': 'octet', 'float32': 'float', 'float64': 'double'}
"""Names of rclpy where those of definitions differ."""


class MessageDecoder:
    """
    Decode the messages of a recording, called `origin`, by the definitions in it.

    `unreadable` counts the messages of each topic that could not be decoded; `first_errors` says
    why.

    """

    def __init__(self, reader: Reader, origin: str) -> None:
        self._reader = reader
        self.origin = origin
        self.unreadable: Counter[str] = Counter()
        self.first_errors: dict[str, UnsupportedMessage] = {}

    def complete_definitions(self, kinds: Collection[str]) -> None:
        """Add the definitions that ROS 2 has of types that the recording does not define."""
        known = self._reader.typestore.fielddefs
        if not known.keys() >= {kind for kind in kinds if '/msg/' in kind}:
            self._reader.complete_definitions(stock_types())

    def message(self, record: Record) -> Any:
        """Return a message decoded; UnsupportedMessage if its bytes are not of its type."""
        connection = record.connection
        kind = connection.msgtype
        origin = f'{self.origin}: a message on {connection.topic!r} is not a {kind}'
        with malformed(f'{origin} as defined there'):
            return self._reader.deserialize(record.data, kind)

    def count_unreadable(self, topic: str, error: UnsupportedMessage) -> None:
        """Count a message of a topic that cannot be decoded."""
        self.unreadable[topic] += 1
        self.first_errors.setdefault(topic, error)

    def reset(self) -> None:
        """Forget the counts."""
        self.unreadable.clear()
        self.first_errors.clear()


class RecordedType:
    """Stand-in for the class of a message type; KeyError if the recording does not define it."""

    def __init__(self, store: Typestore, name: str) -> None:
        package, _, kind = name.replace('/msg/', '/').partition('/')
        self.__name__ = name
        self._fields = store.fielddefs[f'{package}/msg/{kind}'][1]

    def get_fields_and_field_types(self) -> dict[str, str]:
        """Return the type of each field, as ``double[36]``."""
        return {name: _field_type(kind) for name, kind in self._fields}


def _field_type(kind: Any) -> str:
    """Return the type of a field."""
    node, value = kind
    if node == Nodetype.BASE:
        return NAMES.get(value[0], str(value[0]))
    if node == Nodetype.NAME:
        return str(value).replace('/msg/', '/')
    element, count = value
    inner = _field_type(element)
    return f'{inner}[{count}]' if node == Nodetype.ARRAY else f'sequence<{inner}>'


def stock_types() -> Typestore:
    """Return the definitions used where a recording has none (before ROS 2 Iron)."""
    store = get_typestore(Stores.ROS2_JAZZY)
    types = {}
    for name, text in VISION_DEFINITIONS.items():
        types.update(get_types_from_msg(text, name))
    store.register(types)
    return store


@contextmanager
def malformed(origin: str) -> Iterator[None]:
    """
    Turn errors that malformed messages cause into UnsupportedMessage; `origin` comes first.

    Decoders and adapters raise UnsupportedMessage for bytes, sizes and values that contradict
    each other. Beyond these, a message may lack a field because its definition in the recording
    is another one; that is an AttributeError of the message. Every other error, also an
    AttributeError of a module or of an object of ours, is a fault of boxreg_ros and goes on.

    """
    try:
        yield
    except UnsupportedMessage as error:
        raise UnsupportedMessage(f'{origin}: {one_line(error)}') from None
    except AttributeError as error:
        if not is_message(error.obj):
            raise
        raise UnsupportedMessage(
            f'{origin}: expected a field {error.name!r} in its {type(error.obj).__name__}, got '
            f'none; the definition in the recording is not the one that is known'
        ) from None
