"""
MCAP: the recording again, with the refined boxes on a topic beside it, as ``overlay.mcap``.

Everything of the recording is copied as it is, byte by byte: topics of any encoding, and of MCAP
files also attachments and metadata. Of every message with boxes there is a second one under the
same times, with the boxes refined, on its topic with ``_refined`` behind, and for the eyes what
the node shows as markers, on that topic with ``_markers`` behind. What was recorded apart from the
clouds comes under the times of its clouds, so that all can be looked at together.

"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Collection, Iterator
from copy import copy
from dataclasses import asdict, replace
from functools import partial
from heapq import merge
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple, TypeVar

from boxreg_ros.errors import ConfigError, UnsupportedMessage
from boxreg_ros.io.markers import MarkerBoard
from boxreg_ros.io.recording import stock_types
from boxreg_ros.io.session import covariances_to_write
from boxreg_ros.io.transforms import boxes_to_frame, inverse
from boxreg_ros.labels import Format, LabelFrame, Options, Provenance
from boxreg_ros.structures import BoxArray, INTERPOLATED, RefinedBoxes
from mcap.reader import make_reader
from mcap.writer import Writer as McapWriter
from msg_adapters.poses import turned_covariances
import numpy as np
from rosbags.highlevel import AnyReader
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
SUFFIX, MARKERS_SUFFIX = '_refined', '_markers'
MARKERS = 'visualization_msgs/msg/MarkerArray'
MESSAGES = (
    'builtin_interfaces/msg/Time', 'geometry_msgs/msg/Point', 'geometry_msgs/msg/Pose',
    'geometry_msgs/msg/Quaternion', 'geometry_msgs/msg/Vector3', 'std_msgs/msg/ColorRGBA',
    'std_msgs/msg/Header', 'visualization_msgs/msg/Marker', MARKERS,
)  # fmt: skip
STATIC = 'tf_static'
"""Topics that end so are copied from the whole recording, whatever part is asked for."""


_T = TypeVar('_T')


class Raw(NamedTuple):
    """A message as it is in the recording, with all that a channel of MCAP says of it."""

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
    Copy the recording alongside the results: it is read only as far as boxes are ready.

    Sources are MCAP files, rosbag2 folders and ``.db3`` files, and ROS 1 bags. Messages of ROS 1
    stay what they are: Foxglove and mcap read such a file, the players of ROS do not.

    """

    def __init__(self, folder: Path, provenance: Provenance, options: Options) -> None:
        if options.recording is None or not options.recording.has_boxes:
            raise ConfigError(
                "format 'mcap' writes a recording again, with its boxes refined: expected one "
                'with boxes, got labels from a file; choose another format'
            )
        self.dropped: Counter[str] = Counter()
        self._recording = copy(options.recording).__enter__()
        self._topic = self._recording.boxes_topic
        part = self._recording.part_ns
        files = [file for path in self._recording.files for file in _storage_files(path)]
        uncut = self._recording.apart
        sources = [(_mcap if f.suffix == '.mcap' else _bag)(f, *part, uncut) for f in files]
        placed = [self._placed(source, *part) for source in sources]
        self._messages = merge(*placed, key=lambda raw: raw.log_time)
        self._next = next(self._messages, None)
        self._waiting: dict[int, deque[LabelFrame]] = {}
        self._channels: dict[tuple[object, ...], int] = {}
        self._schemas: dict[tuple[str, str, bytes], int] = {}
        self._refined_topic = self._topic + SUFFIX
        while self._refined_topic in self._recording.topics:
            self._refined_topic += SUFFIX
        self._markers = _Markers(self._recording.typestore, is_ros1=files[0].suffix == '.bag')
        self._writer = McapWriter(str(folder / 'overlay.mcap'))
        self._writer.start('ros1' if files[0].suffix == '.bag' else 'ros2')
        origin = asdict(provenance) | {'recordings': ', '.join(provenance.recordings)}
        self._writer.add_metadata('boxreg_ros', origin)
        for file in files:
            if file.suffix == '.mcap':
                _copy_extras(file, self._writer)

    def write(self, frame: LabelFrame) -> None:
        """Take the boxes of a message, and copy what comes before those that are missing."""
        if _without_interpolated(frame.refined).status:
            stamp_ns = frame.refined.boxes.stamp_ns
            self._waiting.setdefault(stamp_ns, deque()).append(frame)
        self._copy(is_end=False)

    def close(self) -> None:
        """Copy the rest, and complete the file."""
        self._copy(is_end=True)
        self._recording.__exit__()
        self._writer.finish()
        left = sum(len(f.refined.status) for frames in self._waiting.values() for f in frames)
        self.dropped['no_message'] += left

    def _placed(
        self, messages: Iterator[Raw], start_ns: int | None, end_ns: int | None
    ) -> Iterator[Raw]:
        """Yield messages; those that were recorded apart come with their clouds."""
        apart = self._recording.apart
        for raw in messages:
            if raw.topic not in apart:
                yield raw
                continue
            seen_ns = self._recording.received_ns(raw.topic, raw.log_time, raw.data)
            if (start_ns or 0) <= seen_ns and (end_ns is None or seen_ns < end_ns):
                is_same = seen_ns == raw.log_time
                yield raw if is_same else raw._replace(log_time=seen_ns, publish_time=seen_ns)

    def _copy(self, is_end: bool) -> None:
        """Copy messages up to the first whose boxes are not ready yet."""
        while (raw := self._next) is not None:
            refined = self._refined(raw) if raw.topic == self._topic else []
            if refined is None and not is_end:
                return
            for item in (raw, *(refined or ())):
                self._add(item)
            self._next = next(self._messages, None)

    def _refined(self, raw: Raw) -> list[Raw] | None:
        """Return the message with its boxes refined, and markers; None if they are not ready."""
        try:
            message, given = self._recording.box_message(raw.data)
        except UnsupportedMessage:
            return []  # `relabel` passes it over too, and counts it
        copied = raw._replace(topic=self._refined_topic)
        if not given.track_ids:
            return [copied]
        waiting = self._waiting.get(given.stamp_ns)
        if not waiting:
            return None
        frame = waiting.popleft()
        if not waiting:
            del self._waiting[given.stamp_ns]
        refined, T = _without_interpolated(frame.refined), frame.T_fixed_given
        if refined.boxes.frame_id != given.frame_id and T is not None:
            refined = replace(
                refined,
                boxes=boxes_to_frame(refined.boxes, inverse(T), given.frame_id),
                covariances=turned_covariances(refined.covariances, inverse(T)),
            )
        covariances = covariances_to_write(refined)
        data = self._recording.with_boxes(message, refined.boxes, covariances)
        shown = self._markers.of(copied, given, refined)
        return [copied._replace(data=data), shown]

    def _add(self, raw: Raw) -> None:
        """Write a message, and its channel where it is the first on it."""
        key = (raw.topic, raw.schema, raw.encoding, raw.metadata)
        if key not in self._channels:
            if raw.schema and raw.schema not in self._schemas:
                self._schemas[raw.schema] = self._writer.register_schema(*raw.schema)
            number = self._schemas[raw.schema] if raw.schema else 0  # 0: there is none
            self._channels[key] = self._writer.register_channel(
                raw.topic, raw.encoding, number, dict(raw.metadata)
            )
        self._writer.add_message(
            self._channels[key], raw.log_time, raw.data, raw.publish_time, raw.sequence
        )


class _Markers:
    """Makes markers of rosbags' classes, in the encoding of the recording."""

    def __init__(self, known: Typestore, is_ros1: bool) -> None:
        stock = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_JAZZY)
        self._store = known if MARKERS in known.types else stock
        self._is_ros1 = is_ros1
        text = self._store.generate_msgdef(MARKERS, ros_version=1 if is_ros1 else 2)[0]
        name = MARKERS.replace('/msg/', '/') if is_ros1 else MARKERS
        self._schema = (name, 'ros1msg' if is_ros1 else 'ros2msg', text.encode())
        kinds = {kind.rpartition('/')[2]: kind for kind in MESSAGES}
        makers = {name: partial(_made, self._store, kind) for name, kind in kinds.items()}
        self._board = MarkerBoard(SimpleNamespace(**makers))

    def of(self, raw: Raw, given: BoxArray, refined: RefinedBoxes) -> Raw:
        """Return the markers of boxes, received when the message `raw` was."""
        encode = self._store.serialize_ros1 if self._is_ros1 else self._store.serialize_cdr
        return raw._replace(
            topic=raw.topic + MARKERS_SUFFIX,
            schema=self._schema,
            encoding='ros1' if self._is_ros1 else 'cdr',
            metadata=(),
            data=bytes(encode(self._board.update(given, refined), MARKERS)),
        )


def _made(store: Typestore, kind: str, **fields: Any) -> Any:
    """Return a message; fields that are not given are empty or zero."""
    definition: Any = store.fielddefs[kind][1]
    for name, (node, inner) in definition:
        if name in fields:
            continue
        if node is Nodetype.NAME:
            fields[name] = _made(store, inner)
        elif node is Nodetype.BASE:
            fields[name] = {'string': str, 'bool': bool}.get(inner[0], int)()
        else:
            is_number = inner[0][0] is Nodetype.BASE
            fields[name] = np.zeros(0, inner[0][1][0]) if is_number else []
    return store.types[kind](**fields)


def _without_interpolated(refined: RefinedBoxes) -> RefinedBoxes:
    """Return the boxes that the message has: those put in between have no place in it."""
    rows = [i for i, status in enumerate(refined.status) if status != INTERPOLATED]
    if len(rows) == len(refined.status):
        return refined
    boxes = refined.boxes
    return RefinedBoxes(
        BoxArray(
            boxes.stamp_ns,
            boxes.frame_id,
            tuple(boxes.track_ids[i] for i in rows),
            tuple(boxes.class_names[i] for i in rows),
            boxes.scores[rows],
            boxes.boxes[rows],
        ),
        tuple(refined.status[i] for i in rows),
        tuple(refined.reasons[i] for i in rows),
        refined.num_points[rows],
        refined.covariances[rows],
        refined.is_final,
    )


def _storage_files(path: Path) -> list[Path]:
    """Return the MCAP files of a rosbag2 folder that has no others, else the path itself."""
    if path.is_dir():
        about = yaml.safe_load((path / 'metadata.yaml').read_text(encoding='utf-8'))
        names = about['rosbag2_bagfile_information']['relative_file_paths']
        if all(name.endswith('.mcap') for name in names):
            return [path / name for name in names]
    return [path]


def _mcap(
    path: Path, start_ns: int | None, end_ns: int | None, whole: Collection[str]
) -> Iterator[Raw]:
    """Yield the messages of an MCAP file in a part, all of static transforms and of `whole`."""
    with path.open('rb') as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        topics = {c.topic for c in summary.channels.values()} if summary else set()
        uncut = [topic for topic in topics if topic.endswith(STATIC) or topic in whole]
        for wanted, begin, end in _parts(None, uncut, start_ns, end_ns):
            for schema, channel, message in reader.iter_messages(
                wanted, starting_at=begin, ending_before=end
            ):
                yield Raw(
                    channel.topic,
                    (schema.name, schema.encoding, schema.data) if schema else None,
                    channel.message_encoding,
                    tuple(channel.metadata.items()),
                    message.log_time,
                    message.publish_time,
                    message.sequence,
                    message.data,
                )


def _bag(
    path: Path, start_ns: int | None, end_ns: int | None, whole: Collection[str]
) -> Iterator[Raw]:
    """Yield the same of any other storage, which has one time per message and counts none."""
    with AnyReader([path], default_typestore=stock_types()) as reader:
        uncut = [c for c in reader.connections if c.topic.endswith(STATIC) or c.topic in whole]
        channels = {(c.id, id(c.owner)): _channel(c, reader) for c in reader.connections}
        for part in _parts(reader.connections, uncut, start_ns, end_ns):
            for connection, time_ns, data in reader.messages(*part):
                channel = channels[connection.id, id(connection.owner)]
                yield Raw(*channel, time_ns, time_ns, 0, bytes(data))


def _parts(
    every: _T, uncut: _T, start_ns: int | None, end_ns: int | None
) -> list[tuple[_T, int | None, int | None]]:
    """Return what to read from when to when: before and after the part, what is not cut."""
    parts: list[tuple[_T, int | None, int | None]] = [(every, start_ns, end_ns)]
    if uncut and start_ns is not None:
        parts.insert(0, (uncut, None, start_ns))
    if uncut and end_ns is not None:
        parts.append((uncut, end_ns, None))
    return parts


def _channel(
    connection: Connection, reader: AnyReader
) -> tuple[str, tuple[str, str, bytes], str, tuple[tuple[str, str], ...]]:
    """Return topic, schema, encoding and metadata of a channel for what rosbags reads."""
    definition, kind = connection.msgdef, connection.msgtype
    text = definition.data
    if isinstance(connection.ext, ConnectionExtRosbag2):
        encoding = connection.ext.serialization_format
        language = 'ros2idl' if definition.format is MessageDefinitionFormat.IDL else 'ros2msg'
        if definition.format is MessageDefinitionFormat.NONE:
            known = kind in reader.typestore.fielddefs
            text = reader.typestore.generate_msgdef(kind, ros_version=2)[0] if known else ''
        qos = yaml.safe_dump(dump_qos_v9(connection.ext.offered_qos_profiles), sort_keys=False)
        metadata = {'offered_qos_profiles': qos, 'topic_type_hash': connection.digest or ''}
    else:
        encoding, language = 'ros1', 'ros1msg'
        kind = kind.replace('/msg/', '/')
        metadata = {
            'callerid': connection.ext.callerid or '',
            'latching': str(int(bool(connection.ext.latching))),
            'md5sum': connection.digest or '',
        }
    return connection.topic, (kind, language, text.encode()), encoding, tuple(metadata.items())


def _copy_extras(path: Path, writer: McapWriter) -> None:
    """Copy attachments and metadata of an MCAP file."""
    with path.open('rb') as file:
        reader = make_reader(file)
        for item in reader.iter_attachments():
            writer.add_attachment(
                item.create_time, item.log_time, item.name, item.media_type, item.data
            )
        for note in reader.iter_metadata():
            writer.add_metadata(note.name, note.metadata)
