"""
MCAP: a copy of the recording with the refined boxes on an additional topic, ``overlay.mcap``.

All messages are copied unchanged, in any encoding; attachments and metadata of MCAP files too.
Each message with boxes is followed by a copy with the refined boxes, with the same times, on its
topic with the suffix ``_refined``, and by the markers of the node on that topic with the suffix
``_markers``. Topics recorded apart from the clouds get the times of their clouds, so that a viewer
shows both together.

"""

from __future__ import annotations

from collections import Counter, deque
from copy import copy
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from boxreg_ros.errors import ConfigError, UnsupportedMessage
from boxreg_ros.io.definitions import known_store
from boxreg_ros.io.joining import Repeats
from boxreg_ros.io.markers import MarkerBoard
from boxreg_ros.io.session import covariances_to_write, refined_to_frame
from boxreg_ros.io.transforms import inverse
from boxreg_ros.labels.protocol import Format, LabelFrame, Options, Provenance
from boxreg_ros.labels.recording_copy import RawMessage, RecordingCopy
from boxreg_ros.structures import ADDED, BoxArray, RefinedBoxes
import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys.store import Typestore

FORMAT = Format(
    name='mcap',
    title='MCAP, with all of the recording',
    frame='that of the input message',
    reference='that of the input message',
    sizes='those of the input message',
    rotation='that of the input message',
    files='overlay.mcap, beside boxes.csv',
)
OVERLAY = 'overlay.mcap'
BOXES_SUFFIX = '_refined'
MARKERS_SUFFIX = '_markers'
MARKERS = 'visualization_msgs/msg/MarkerArray'
MARKER_MESSAGES = (
    'builtin_interfaces/msg/Time',
    'geometry_msgs/msg/Point',
    'geometry_msgs/msg/Pose',
    'geometry_msgs/msg/Quaternion',
    'geometry_msgs/msg/Vector3',
    'std_msgs/msg/ColorRGBA',
    'std_msgs/msg/Header',
    'visualization_msgs/msg/Marker',
    MARKERS,
)
"""Message types of which `MarkerBoard` makes markers."""


class Writer:
    """Copy the recording while its boxes are refined, up to the newest refined boxes."""

    def __init__(self, folder: Path, provenance: Provenance, options: Options) -> None:
        if options.recording is None or not options.recording.has_boxes:
            raise ConfigError(
                "format 'mcap' copies a recording with its boxes refined: expected a recording "
                'with boxes, got labels from a file; choose another format'
            )
        self.dropped: Counter[str] = Counter()
        self._recording = copy(options.recording).__enter__()
        self._copied = RecordingCopy(folder / OVERLAY, self._recording, provenance)
        self._topic = self._recording.boxes_topic
        self._repeats = Repeats()
        self._messages = ((raw, self._has_boxes(raw)) for raw in self._copied.messages())
        self._next = next(self._messages, None)
        self._waiting: dict[int, deque[LabelFrame]] = {}
        self._refined_topic = self._topic + BOXES_SUFFIX
        while self._refined_topic in self._recording.topics:
            self._refined_topic += BOXES_SUFFIX
        is_ros1 = not self._recording.is2
        known = self._recording.store_of_type(MARKERS) or known_store(MARKER_MESSAGES, is_ros1)
        self._markers = _MarkerEncoder(known, is_ros1)

    def write(self, frame: LabelFrame) -> None:
        """Add the boxes of a message, and copy messages up to the next missing boxes."""
        if frame.refined.without(*ADDED).status:
            stamp_ns = frame.refined.boxes.stamp_ns
            self._waiting.setdefault(stamp_ns, deque()).append(frame)
        self._copy(is_end=False)

    def close(self) -> None:
        """Copy the remaining messages, and complete the file."""
        self._copy(is_end=True)
        self._copied.close()
        self._recording.__exit__()
        for frames in self._waiting.values():
            self.dropped['no_message'] += sum(len(frame.refined.status) for frame in frames)

    def _copy(self, is_end: bool) -> None:
        """Copy messages up to the first whose boxes are not refined yet."""
        while self._next is not None:
            raw, has_boxes = self._next
            additional = self._refined(raw) if has_boxes else []
            if additional is None and not is_end:
                return
            self._copied.add(raw)
            for item in additional or ():
                self._copied.add(item)
            self._next = next(self._messages, None)

    def _has_boxes(self, raw: RawMessage) -> bool:
        """Return whether a message, the next one, has boxes that none before it had."""
        is_of_boxes = raw.topic == self._topic
        return is_of_boxes and not self._repeats.has(raw.log_time, raw.topic, raw.data)

    def _refined(self, raw: RawMessage) -> list[RawMessage] | None:
        """Return the message with refined boxes, and its markers; None if they are missing."""
        try:
            message, given = self._recording.box_message(raw.connection, raw.data)
        except UnsupportedMessage:
            return []  # skipped and counted by `relabel` too
        copied = raw._replace(topic=self._refined_topic)
        if not given.track_ids:
            return [copied]
        waiting = self._waiting.get(given.stamp_ns)
        if not waiting:
            return None
        frame = waiting.popleft()
        refined = frame.refined.without(*ADDED)
        count = len(given.track_ids)
        if len(refined.status) > count:  # of several messages, which have a part of the boxes each
            rest = refined.take(range(count, len(refined.status)))
            waiting.appendleft(replace(frame, refined=rest))
            refined = refined.take(range(count))
        if not waiting:
            del self._waiting[given.stamp_ns]
        T = frame.T_fixed_given
        if T is not None:
            refined = refined_to_frame(refined, inverse(T), given.frame_id)
        covariances = covariances_to_write(refined)
        data = self._recording.with_boxes(raw.connection, message, refined.boxes, covariances)
        markers = self._markers.encode(copied, given, refined)
        return [copied._replace(data=data), markers]


class _MarkerEncoder:
    """Encodes the markers of the node as the recording encodes its messages."""

    def __init__(self, known: Typestore, is_ros1: bool) -> None:
        self._store = known
        self._is_ros1 = is_ros1
        text = self._store.generate_msgdef(MARKERS, ros_version=1 if is_ros1 else 2)[0]
        name = MARKERS.replace('/msg/', '/') if is_ros1 else MARKERS
        self._schema = (name, 'ros1msg' if is_ros1 else 'ros2msg', text.encode())
        kinds = {kind.rpartition('/')[2]: kind for kind in MARKER_MESSAGES}
        makers = {name: partial(_new_message, self._store, kind) for name, kind in kinds.items()}
        self._board = MarkerBoard(SimpleNamespace(**makers))

    def encode(self, raw: RawMessage, given: BoxArray, refined: RefinedBoxes) -> RawMessage:
        """Return the markers of boxes as a message with the times of `raw`."""
        encode = self._store.serialize_ros1 if self._is_ros1 else self._store.serialize_cdr
        return raw._replace(
            topic=raw.topic + MARKERS_SUFFIX,
            schema=self._schema,
            encoding='ros1' if self._is_ros1 else 'cdr',
            metadata=(),
            data=bytes(encode(self._board.update(given, refined), MARKERS)),
        )


def _new_message(store: Typestore, kind: str, **fields: Any) -> Any:
    """Return a message; fields that are not given are empty or zero."""
    definition: Any = store.fielddefs[kind][1]
    for name, (node, inner) in definition:
        if name in fields:
            continue
        if node is Nodetype.NAME:
            fields[name] = _new_message(store, inner)
        elif node is Nodetype.BASE:
            fields[name] = {'string': str, 'bool': bool}.get(inner[0], int)()
        else:
            is_number = inner[0][0] is Nodetype.BASE
            fields[name] = np.zeros(0, inner[0][1][0]) if is_number else []
    return store.types[kind](**fields)
