"""
MCAP files with channels that are not ROS: foxglove's schemas as protobuf and as JSON.

Their clouds and transforms are handed over as the ROS messages they correspond to, their
SceneUpdates as they are: adapters read by attribute.

"""

from __future__ import annotations

from base64 import b64decode
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import closing, ExitStack
from heapq import merge
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from boxreg_ros.errors import RecordingError, UnsupportedMessage
from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.records import Schema
from rosbags.highlevel import AnyReader, AnyReaderError
from rosbags.interfaces import (
    Connection,
    ConnectionExtRosbag2,
    MessageDefinition,
    MessageDefinitionFormat,
)
from rosbags.typesys import get_types_from_msg, get_typestore, Stores
from rosbags.typesys.store import Typestore

ROS_ENCODINGS = ('ros2msg', 'ros2idl', 'omgidl', '')
TYPES = {
    'foxglove.SceneUpdate': 'foxglove_msgs/msg/SceneUpdate',
    'foxglove.PointCloud': 'sensor_msgs/msg/PointCloud2',
    'foxglove.FrameTransform': 'tf2_msgs/msg/TFMessage',
    'foxglove.FrameTransforms': 'tf2_msgs/msg/TFMessage',
}
NUMBERS = (0, 2, 1, 4, 3, 6, 5, 7, 8)
"""``PointField.datatype`` of ROS by foxglove's number of the same type."""

Item = tuple[Connection, int, bytes]


class Reader:
    """
    Read recordings of all kinds as one, as an open `AnyReader` does.

    Parameters
    ----------
    paths : sequence of Path
        Recordings; MCAP files with other encodings than ROS's are told by looking into them.
    default_typestore : callable
        Returns definitions for recordings that bring none; few do, and loading them takes a
        tenth of a second.

    """

    def __init__(self, paths: Sequence[Path], default_typestore: Callable[[], Typestore]) -> None:
        foreign = [path for path in paths if _is_foreign(path)]
        ros = [path for path in paths if path not in foreign]
        with ExitStack() as stack:
            self._foreign = [stack.enter_context(closing(_Foreign(path))) for path in foreign]
            self._ros = None
            if ros:
                try:
                    self._ros = stack.enter_context(AnyReader(ros))
                except AnyReaderError:  # whatever else is wrong comes again
                    reader = AnyReader(ros, default_typestore=default_typestore())
                    self._ros = stack.enter_context(reader)
            self.is2 = self._ros is None or self._ros.is2
            self.typestore = self._ros.typestore if self._ros else get_typestore(Stores.EMPTY)
            for each in self._foreign:
                known, types = self.typestore.fielddefs, each.ros_types()
                self.typestore.register({k: v for k, v in types.items() if k not in known})
            self.connections = [c for reader in self._readers for c in reader.connections]
            self._opened = stack.pop_all()

    def close(self) -> None:
        """Close all files."""
        self._opened.close()

    @staticmethod
    def span_ns(connection: Connection) -> tuple[int, int]:
        """Return when the first message in the file of a connection came, and the end [ns]."""
        about: Any = getattr(connection.owner, 'metadata', connection.owner)
        return about.start_time, about.end_time

    def messages(
        self, connections: Collection[Connection], start: int | None, stop: int | None
    ) -> Iterator[Item]:
        """Yield connection, time of receipt [ns] and bytes of all messages on `connections`."""
        streams = []
        for reader in self._readers:
            own = [c for c in reader.connections if c in connections]
            if own:  # for the readers, none would mean all
                streams.append(reader.messages(own, start, stop))
        return merge(*streams, key=lambda item: item[1])

    def deserialize(self, data: bytes, msgtype: str) -> Any:
        """Return a message; how it is encoded shows from its first byte, or its being empty."""
        if data[:1] != b'\0' and self.is2:
            for reader in self._foreign:
                if msgtype in reader.decoders:
                    return reader.decoders[msgtype](data)
        if self._ros is not None:
            return self._ros.deserialize(data, msgtype)
        return self.typestore.deserialize_cdr(data, msgtype)

    @property
    def _readers(self) -> list[Any]:
        return [*filter(None, (self._ros,)), *self._foreign]


class _Foreign:
    """One MCAP file."""

    def __init__(self, path: Path) -> None:
        self.decoders: dict[str, Callable[[bytes], Any]] = {}
        self._file = path.open('rb')
        self._reader = make_reader(self._file)
        summary = self._reader.get_summary()
        assert summary is not None and summary.statistics is not None
        self._schemas = summary.schemas
        self.start_time = summary.statistics.message_start_time
        self.end_time = summary.statistics.message_end_time + 1
        self.connections: list[Connection] = []
        for channel in summary.channels.values():
            schema = self._schemas.get(channel.schema_id)
            name = schema.name if schema else channel.message_encoding
            msgtype = name
            if schema and channel.message_encoding in ('protobuf', 'json'):
                msgtype = TYPES.get(name, name)
                self.decoders[msgtype] = _Decoder(path, channel.topic, schema)
            self.connections.append(
                Connection(
                    channel.id,
                    channel.topic,
                    msgtype,
                    MessageDefinition(MessageDefinitionFormat.NONE, ''),
                    '',
                    summary.statistics.channel_message_counts.get(channel.id, 0),
                    ConnectionExtRosbag2(channel.message_encoding, []),
                    self,
                )
            )

    def close(self) -> None:
        self._file.close()

    def ros_types(self) -> Any:
        """Return the definitions of the ROS messages in the file."""
        types: dict[str, Any] = {}
        for schema in self._schemas.values():
            if schema.encoding == 'ros2msg':
                types.update(get_types_from_msg(schema.data.decode(), schema.name))
        return types

    def messages(
        self, connections: Sequence[Connection], start: int | None, stop: int | None
    ) -> Iterator[Item]:
        by_id = {connection.id: connection for connection in connections}
        topics = {connection.topic for connection in connections}
        part = self._reader.iter_messages(topics, starting_at=start, ending_before=stop)
        for _, channel, message in part:
            if channel.id in by_id:
                yield by_id[channel.id], message.log_time, message.data


class _Decoder:
    """Makes messages of one schema, whether they are JSON or protobuf."""

    def __init__(self, path: Path, topic: str, schema: Schema) -> None:
        self._what = f'{path}: messages on {topic!r}'
        self._schema = schema
        self._decode: Callable[[bytes], Any] | None = None

    def __call__(self, data: bytes) -> Any:
        if data[:1] == b'{':
            message = json.loads(data, object_hook=lambda fields: SimpleNamespace(**fields))
        else:
            self._decode = self._decode or self._protobuf()
            message = self._decode(data)
        return CONVERTERS.get(self._schema.name, lambda same: same)(message)

    def _protobuf(self) -> Callable[[bytes], Any]:
        try:
            from mcap_protobuf.decoder import DecoderFactory
        except ImportError:
            raise RecordingError(
                f'{self._what} are protobuf, and the package that reads it is not installed: pip '
                f'install mcap-protobuf-support'
            ) from None
        decode = DecoderFactory().decoder_for('protobuf', self._schema)
        if decode is None:
            raise RecordingError(f'{self._what}: expected a protobuf schema, got none')
        return decode


def encoded(message: Any) -> bytes:
    """Return the bytes of a message that is protobuf, or else JSON."""
    if hasattr(message, 'SerializeToString'):
        return bytes(message.SerializeToString())
    return json.dumps(message, default=vars).encode()


def time_of(time: Any) -> SimpleNamespace:
    """Return a time of protobuf or JSON as ROS has it."""
    if hasattr(time, 'nanos'):
        return SimpleNamespace(sec=time.seconds, nanosec=time.nanos)
    return SimpleNamespace(sec=time.sec, nanosec=time.nsec)


def _cloud(message: Any) -> Any:
    """Return a foxglove PointCloud as a PointCloud2."""
    pose = getattr(message, 'pose', None)
    if pose is not None:
        p, q = pose.position, pose.orientation
        if any((p.x, p.y, p.z, q.x, q.y, q.z)):
            raise UnsupportedMessage(
                'PointCloud: expected its pose to be that of its frame, got another; publish the '
                'pose as a transform'
            )
    data = message.data
    data = b64decode(data) if isinstance(data, str) else data
    fields = [
        SimpleNamespace(name=f.name, offset=f.offset, datatype=NUMBERS[f.type], count=1)
        for f in message.fields
    ]
    header = SimpleNamespace(stamp=time_of(message.timestamp), frame_id=message.frame_id)
    stride = message.point_stride
    return SimpleNamespace(
        header=header, height=1, width=len(data) // stride if stride else 0, fields=fields,
        is_bigendian=False, point_step=stride, row_step=len(data), data=data, is_dense=False,
    )  # fmt: skip


def _transforms(message: Any) -> Any:
    """Return foxglove's FrameTransform, or FrameTransforms, as a TFMessage."""
    return SimpleNamespace(
        transforms=[
            SimpleNamespace(
                header=SimpleNamespace(stamp=time_of(t.timestamp), frame_id=t.parent_frame_id),
                child_frame_id=t.child_frame_id,
                transform=SimpleNamespace(translation=t.translation, rotation=t.rotation),
            )
            for t in getattr(message, 'transforms', [message])
        ]
    )


CONVERTERS = {
    'foxglove.PointCloud': _cloud,
    'foxglove.FrameTransform': _transforms,
    'foxglove.FrameTransforms': _transforms,
}


def _is_foreign(path: Path) -> bool:
    """Tell whether a file is MCAP and has schemas that are not ROS's."""
    if path.suffix != '.mcap' or not path.is_file():
        return False
    try:
        with path.open('rb') as file:
            summary = make_reader(file).get_summary()
    except (McapError, OSError):
        return False  # whoever reads it says what is wrong
    schemas = summary.schemas.values() if summary else ()
    return any(schema.encoding not in ROS_ENCODINGS for schema in schemas)
