"""
Boxes of serialised messages, read and rewritten as arrays.

`BOX_FIELDS` states where each type has pose, size, id, class and score. The adapter of the family
reads unusual messages (several frames in one message, another output frame, shapes that are no
boxes) after they have been deserialised.

"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from typing import Any

from boxreg_ros.structures import BoxArray, Floats, LENGTH, ROLL
from msg_adapters import poses
from msg_adapters.box_fields import (
    BoxFields,
    COVARIANCE_WIDTH,
    finite_or,
    POSE_WIDTH,
    Rewrite,
    SIZE_WIDTH,
)
from msg_adapters.cdr import Definitions, Fields, installed_definition, Layout
from msg_adapters.convention import Convention, STANDARD
from msg_adapters.protocol import Adapter
from msg_adapters.registry import adapter_for, ADAPTERS, ConvertingAdapter
import numpy as np

MOST_WALKED = 32
"""Newest messages whose fields are kept from reading to writing; derived: the early boxes of one
are written at once, the final ones `lag` messages later, 10 by default."""
BOX_FIELDS: dict[str, BoxFields] = {
    type_name: fields
    for module in dict.fromkeys(ADAPTERS.values())
    for type_name, fields in getattr(import_module(module), 'BOX_FIELDS', {}).items()
}
"""Message type -> where its messages have their boxes, as the module of its adapter states."""


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
        # With all of them at the origin, the poses may be in other fields.
        has_boxes = bool(fields.numbers(at.pose, '<f8', POSE_WIDTH)[:, :3].any())
        return fields if is_one and has_boxes and at.is_ordinary(fields) else None

    def boxes_of(self, fields: Fields) -> BoxArray:
        """Return the boxes of an ordinary message."""
        at = self.at
        rows = self.rows(fields)
        boxes = poses.boxes_from(
            fields.numbers(at.pose, '<f8', POSE_WIDTH)[rows],
            fields.numbers(at.size, '<f8', SIZE_WIDTH)[rows],
        )
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
        pose[rows, :3] = finite_or(boxes.boxes[:, :3], old_pose[:, :3])
        pose[rows, 3:] = finite_or(quaternions_xyzw, old_pose[:, 3:])
        size[rows] = finite_or(boxes.boxes[:, LENGTH:ROLL], old_size)
        fields.put(at.pose, pose)
        fields.put(at.size, size)
        covariance = np.full((len(boxes.boxes), COVARIANCE_WIDTH), np.nan)
        if covariances is not None:
            covariance[:] = covariances.reshape(-1, COVARIANCE_WIDTH)
        if at.covariance:
            own = fields.numbers(at.covariance, '<f8', COVARIANCE_WIDTH)
            fields.put(at.covariance, finite_or(covariance, own))
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
