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
from collections.abc import Collection, Iterator
from contextlib import closing
from copy import copy
from dataclasses import asdict, replace
from functools import partial
from heapq import merge
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple, TypeVar

from boxreg_ros.errors import ConfigError, UnsupportedMessage
from boxreg_ros.io.markers import MarkerBoard
from boxreg_ros.io.session import covariances_to_write
from boxreg_ros.io.storage.files import opened
from boxreg_ros.io.storage.mcap import McapFile
from boxreg_ros.io.storage.record import Definition
from boxreg_ros.io.transforms import boxes_to_frame, inverse
from boxreg_ros.labels.protocol import Format, LabelFrame, Options, Provenance
from boxreg_ros.structures import ADDED, BoxArray, RefinedBoxes
from mcap.records import Attachment
from mcap.writer import Writer as McapWriter
from msg_adapters.poses import turned_covariances
import numpy as np
from rosbags.interfaces import (
    Connection,
    ConnectionExtRosbag2,
    MessageDefinitionFormat,
    Nodetype,
)
from rosbags.rosbag2.metadata import dump_qos_v9
from rosbags.typesys import get_typestore, Stores
from rosbags.typesys.store import Typestore
import yaml

FORMAT = Format(
    name='mcap',
    title='MCAP, with all of the recording',
    frame='that of the input message',
    reference='that of the input message',
    sizes='those of the input message',
    rotation='that of the input message',
    files='overlay.mcap, beside boxes.csv',
)
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
STATIC_SUFFIX = 'tf_static'
"""Topics with this suffix are copied from the whole recording, also if a part is requested."""


_T = TypeVar('_T')


class RawMessage(NamedTuple):
    """An encoded message of the recording, with the fields of its MCAP channel."""

    topic: str
    schema: tuple[str, str, bytes] | None
    encoding: str
    metadata: tuple[tuple[str, str], ...]
    log_time: int
    publish_time: int
    sequence: int
    data: bytes


class Writer:
    """
    Copy the recording while its boxes are refined; it is read up to the newest refined boxes.

    Sources are MCAP files, rosbag2 folders, ``.db3`` files and ROS 1 bags. Messages of ROS 1 are
    not converted: Foxglove and mcap read such a file, ``ros2 bag play`` does not.

    """

    def __init__(self, folder: Path, provenance: Provenance, options: Options) -> None:
        if options.recording is None or not options.recording.has_boxes:
            raise ConfigError(
                "format 'mcap' copies a recording with its boxes refined: expected a recording "
                'with boxes, got labels from a file; choose another format'
            )
        self.dropped: Counter[str] = Counter()
        self._recording = copy(options.recording).__enter__()
        self._topic = self._recording.boxes_topic
        files = self._recording.files
        sources = [self._read(file) for file in files]
        self._messages = merge(*sources, key=lambda raw: raw.log_time)
        self._next = next(self._messages, None)
        self._waiting: dict[int, deque[LabelFrame]] = {}
        self._channels: dict[tuple[object, ...], int] = {}
        self._schemas: dict[tuple[str, str, bytes], int] = {}
        self._refined_topic = self._topic + BOXES_SUFFIX
        while self._refined_topic in self._recording.topics:
            self._refined_topic += BOXES_SUFFIX
        is_ros1 = not self._recording.is2
        self._markers = _MarkerEncoder(self._recording.typestore, is_ros1)
        self._writer = McapWriter(str(folder / 'overlay.mcap'))
        self._writer.start('ros1' if is_ros1 else 'ros2')
        origin = asdict(provenance) | {'recordings': ', '.join(provenance.recordings)}
        self._writer.add_metadata('boxreg_ros', origin)
        for path in files:
            _copy_extras(path, self._writer)

    def write(self, frame: LabelFrame) -> None:
        """Add the boxes of a message, and copy messages up to the next missing boxes."""
        if _without_added(frame.refined).status:
            stamp_ns = frame.refined.boxes.stamp_ns
            self._waiting.setdefault(stamp_ns, deque()).append(frame)
        self._copy(is_end=False)

    def close(self) -> None:
        """Copy the remaining messages, and complete the file."""
        self._copy(is_end=True)
        self._recording.__exit__()
        self._writer.finish()
        for frames in self._waiting.values():
            self.dropped['no_message'] += sum(len(frame.refined.status) for frame in frames)

    def _read(self, file: Path) -> Iterator[RawMessage]:
        """Yield the messages of a file; topics recorded apart get the time of their clouds."""
        start_ns, end_ns = self._recording.part_ns
        apart = self._recording.apart
        for raw in self._read_file(file, start_ns, end_ns, apart):
            if raw.topic not in apart:
                yield raw
                continue
            time_ns = self._recording.received_ns(raw.topic, raw.log_time, raw.data)
            if (start_ns or 0) <= time_ns and (end_ns is None or time_ns < end_ns):
                is_same = time_ns == raw.log_time
                yield raw if is_same else raw._replace(log_time=time_ns, publish_time=time_ns)

    def _read_file(
        self, path: Path, start_ns: int | None, end_ns: int | None, whole: Collection[str]
    ) -> Iterator[RawMessage]:
        """
        Yield the messages of a file from `start_ns` to `end_ns`.

        Topics in `whole` and those of static transforms are read from the whole file.

        """
        with closing(opened(path)) as file:
            channels = {c.id: self._channel(c) for c in file.connections}
            uncut = [
                c for c in file.connections if c.topic.endswith(STATIC_SUFFIX) or c.topic in whole
            ]
            for wanted, begin, end in _intervals(file.connections, uncut, start_ns, end_ns):
                for record in file.messages(wanted, begin, end):
                    yield RawMessage(
                        record.connection.topic,
                        *channels[record.connection.id],
                        record.received_ns,
                        record.published_ns,
                        record.sequence,
                        record.data,
                    )

    def _channel(self, connection: Connection) -> Definition:
        """Return schema, encoding and metadata of the channel of a connection."""
        owner: Any = connection.owner
        if isinstance(owner, McapFile):
            return owner.definition_of(connection)
        return _definition(connection, self._recording.typestore)

    def _copy(self, is_end: bool) -> None:
        """Copy messages up to the first whose boxes are not refined yet."""
        while self._next is not None:
            raw = self._next
            additional = self._refined(raw) if raw.topic == self._topic else []
            if additional is None and not is_end:
                return
            self._add(raw)
            for item in additional or ():
                self._add(item)
            self._next = next(self._messages, None)

    def _refined(self, raw: RawMessage) -> list[RawMessage] | None:
        """Return the message with refined boxes, and its markers; None if they are missing."""
        try:
            message, given = self._recording.box_message(raw.data)
        except UnsupportedMessage:
            return []  # skipped and counted by `relabel` too
        copied = raw._replace(topic=self._refined_topic)
        if not given.track_ids:
            return [copied]
        waiting = self._waiting.get(given.stamp_ns)
        if not waiting:
            return None
        frame = waiting.popleft()
        if not waiting:
            del self._waiting[given.stamp_ns]
        refined = _without_added(frame.refined)
        T = frame.T_fixed_given
        if refined.boxes.frame_id != given.frame_id and T is not None:
            refined = replace(
                refined,
                boxes=boxes_to_frame(refined.boxes, inverse(T), given.frame_id),
                covariances=turned_covariances(refined.covariances, inverse(T)),
            )
        covariances = covariances_to_write(refined)
        data = self._recording.with_boxes(message, refined.boxes, covariances)
        markers = self._markers.encode(copied, given, refined)
        return [copied._replace(data=data), markers]

    def _add(self, raw: RawMessage) -> None:
        """Write a message, and its channel before the first message on it."""
        key = (raw.topic, raw.schema, raw.encoding, raw.metadata)
        if key not in self._channels:
            schema_id = self._schema_id(raw.schema)
            self._channels[key] = self._writer.register_channel(
                raw.topic, raw.encoding, schema_id, dict(raw.metadata)
            )
        self._writer.add_message(
            self._channels[key], raw.log_time, raw.data, raw.publish_time, raw.sequence
        )

    def _schema_id(self, schema: tuple[str, str, bytes] | None) -> int:
        """Return the id of a schema, registered once; 0 for none, as MCAP defines."""
        if not schema:
            return 0
        if schema not in self._schemas:
            self._schemas[schema] = self._writer.register_schema(*schema)
        return self._schemas[schema]


class _MarkerEncoder:
    """Encodes the markers of the node as the recording encodes its messages."""

    def __init__(self, known: Typestore, is_ros1: bool) -> None:
        stock = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_JAZZY)
        self._store = known if MARKERS in known.types else stock
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


def _without_added(refined: RefinedBoxes) -> RefinedBoxes:
    """Return the boxes without added ones, for which the message has no entry."""
    rows = [i for i, status in enumerate(refined.status) if status not in ADDED]
    if len(rows) == len(refined.status):
        return refined
    return refined.take(rows)


def _intervals(
    every: _T, uncut: _T, start_ns: int | None, end_ns: int | None
) -> list[tuple[_T, int | None, int | None]]:
    """
    Return selections of topics with their begin and end, in order of time.

    `every` is read from `start_ns` to `end_ns`, `uncut` also before and after.

    """
    intervals: list[tuple[_T, int | None, int | None]] = [(every, start_ns, end_ns)]
    if uncut and start_ns is not None:
        intervals.insert(0, (uncut, None, start_ns))
    if uncut and end_ns is not None:
        intervals.append((uncut, end_ns, None))
    return intervals


def _definition(connection: Connection, store: Typestore) -> Definition:
    """Return schema, encoding and metadata of a channel for a connection of another format."""
    kind = connection.msgtype
    text = connection.msgdef.data
    if isinstance(connection.ext, ConnectionExtRosbag2):
        encoding = connection.ext.serialization_format
        is_idl = connection.msgdef.format is MessageDefinitionFormat.IDL
        language = 'ros2idl' if is_idl else 'ros2msg'
        if connection.msgdef.format is MessageDefinitionFormat.NONE:
            text = ''
            if kind in store.fielddefs:
                text = store.generate_msgdef(kind, ros_version=2)[0]
        qos = yaml.safe_dump(dump_qos_v9(connection.ext.offered_qos_profiles), sort_keys=False)
        metadata = {'offered_qos_profiles': qos, 'topic_type_hash': connection.digest or ''}
    else:
        encoding = 'ros1'
        language = 'ros1msg'
        kind = kind.replace('/msg/', '/')
        metadata = {
            'callerid': connection.ext.callerid or '',
            'latching': str(int(bool(connection.ext.latching))),
            'md5sum': connection.digest or '',
        }
    return Definition((kind, language, text.encode()), encoding, tuple(metadata.items()))


def _copy_extras(path: Path, writer: McapWriter) -> None:
    """Copy attachments and metadata of an MCAP file."""
    with closing(opened(path)) as file:
        if not isinstance(file, McapFile):
            return
        for item in file.extras():
            if isinstance(item, Attachment):
                writer.add_attachment(
                    item.create_time, item.log_time, item.name, item.media_type, item.data
                )
            else:
                writer.add_metadata(item.name, item.metadata)
