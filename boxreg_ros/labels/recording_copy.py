"""All messages of a recording on their way to an MCAP file, in any encoding."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import closing
from dataclasses import asdict
from heapq import merge
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from boxreg_ros.io.recording import Recording
from boxreg_ros.io.storage.files import as_ros, opened
from boxreg_ros.io.storage.mcap import McapFile
from boxreg_ros.io.storage.record import Definition
from boxreg_ros.labels.protocol import Provenance
from mcap.records import Attachment
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.interfaces import Connection, ConnectionExtRosbag2, MessageDefinitionFormat
from rosbags.rosbag2.metadata import dump_qos_v9
from rosbags.typesys.store import Typestore
import yaml

STATIC_SUFFIX = 'tf_static'
"""Topics with this suffix are copied from the whole recording, also if a part is requested."""
COMPRESSION_TYPES = {
    '': CompressionType.NONE,
    'lz4': CompressionType.LZ4,
    'zstd': CompressionType.ZSTD,
}
_T = TypeVar('_T')


class RawMessage(NamedTuple):
    """An encoded message of the recording, with the fields of its MCAP channel."""

    connection: Connection
    """It was recorded on; `topic` is that of the copy."""
    topic: str
    schema: tuple[str, str, bytes] | None
    encoding: str
    metadata: tuple[tuple[str, str], ...]
    log_time: int
    publish_time: int
    sequence: int
    data: bytes


class RecordingCopy:
    """
    Copy a recording message by message; attachments and metadata of MCAP files too.

    Sources are MCAP files, rosbag2 folders, ``.db3`` files and ROS 1 bags. Messages of ROS 1 are
    not converted: Foxglove and mcap read such a file, ``ros2 bag play`` does not. Chunks are
    compressed as those of an MCAP file; of the others by zstd. The provenance is written to the
    metadata of the file; None where the source has it.

    """

    def __init__(self, path: Path, recording: Recording, provenance: Provenance | None) -> None:
        self.recording = recording
        self._channels: dict[tuple[object, ...], int] = {}
        self._schemas: dict[tuple[str, str, bytes], int] = {}
        self._writer = McapWriter(str(path), compression=compression_of(recording.files[0]))
        self._writer.start('ros2' if self.recording.is2 else 'ros1')
        if provenance is not None:
            origin = asdict(provenance) | {'recordings': ', '.join(provenance.recordings)}
            self._writer.add_metadata('boxreg_ros', origin)
        for file in self.recording.files:
            _copy_extras(file, self._writer)

    def messages(self) -> Iterator[RawMessage]:
        """Yield all messages by time; topics recorded apart get the time of their clouds."""
        sources = [self._read(file) for file in self.recording.files]
        return merge(*sources, key=lambda raw: raw.log_time)

    def close(self) -> None:
        """Complete the file."""
        self._writer.finish()

    def add(self, raw: RawMessage) -> None:
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

    def _read(self, file: Path) -> Iterator[RawMessage]:
        """Yield the messages of a file; topics recorded apart get the time of their clouds."""
        start_ns, end_ns = self.recording.part_ns
        apart = self.recording.apart
        for raw in self._read_file(file, start_ns, end_ns, apart):
            if raw.topic not in apart:
                yield raw
                continue
            time_ns = self.recording.timeline.received_ns(raw.connection, raw.log_time, raw.data)
            if (start_ns or 0) <= time_ns and (end_ns is None or time_ns < end_ns):
                is_same = time_ns == raw.log_time
                yield raw if is_same else raw._replace(log_time=time_ns, publish_time=time_ns)

    def _read_file(
        self, path: Path, start_ns: int | None, end_ns: int | None, whole: Collection[str]
    ) -> Iterator[RawMessage]:
        """Yield the messages of a part of a file; all static transforms and topics in `whole`."""
        with closing(opened(path)) as file:
            connections = {c.id: as_ros(c) for c in file.connections}
            channels = {c.id: self._channel(c) for c in file.connections}
            uncut = [
                c for c in file.connections if c.topic.endswith(STATIC_SUFFIX) or c.topic in whole
            ]
            for wanted, begin, end in _intervals(file.connections, uncut, start_ns, end_ns):
                for record in file.messages(wanted, begin, end):
                    yield RawMessage(
                        connections[record.connection.id],
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
        store = None
        if connection.msgdef.format is MessageDefinitionFormat.NONE:
            self.recording.choose_definition(connection)
            store = self.recording.decoder.store_of(connection)
        return _definition(connection, store)


def _intervals(
    every: _T, uncut: _T, start_ns: int | None, end_ns: int | None
) -> list[tuple[_T, int | None, int | None]]:
    """Return selections of topics with begin and end, by time; `uncut` also before and behind."""
    intervals: list[tuple[_T, int | None, int | None]] = [(every, start_ns, end_ns)]
    if uncut and start_ns is not None:
        intervals.insert(0, (uncut, None, start_ns))
    if uncut and end_ns is not None:
        intervals.append((uncut, end_ns, None))
    return intervals


def _definition(connection: Connection, store: Typestore | None) -> Definition:
    """Return schema, encoding and metadata of a channel for a connection of another format."""
    kind = connection.msgtype
    text = connection.msgdef.data
    if isinstance(connection.ext, ConnectionExtRosbag2):
        encoding = connection.ext.serialization_format
        is_idl = connection.msgdef.format is MessageDefinitionFormat.IDL
        language = 'ros2idl' if is_idl else 'ros2msg'
        if store is not None:
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


def compression_of(path: Path) -> CompressionType:
    """Return the compression that a copy of a file has: its own; of another format zstd."""
    with closing(opened(path)) as file:
        return COMPRESSION_TYPES[file.compression if isinstance(file, McapFile) else 'zstd']


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
