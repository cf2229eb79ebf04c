"""All files of a recording as one stream, with the definitions of their messages."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import closing, contextmanager, ExitStack, suppress
from functools import lru_cache
from types import SimpleNamespace
from typing import Any

from boxreg_ros.errors import BoxregError, RecordingError, UnsupportedMessage
from boxreg_ros.io.foxglove import ChannelDecoder, FOXGLOVE_ENCODINGS, ros_type
from boxreg_ros.io.storage.files import Files, merged_streams, Part
from boxreg_ros.io.storage.record import Damage, one_line, Record
from rosbags.interfaces import Connection, MessageDefinition, MessageDefinitionFormat
from rosbags.serde import SerdeError
from rosbags.typesys import get_types_from_idl, get_types_from_msg, get_typestore, Stores
from rosbags.typesys.base import TypesysError
from rosbags.typesys.store import Typestore
import zstandard

MESSAGE_MARKS = ('__msgtype__', 'DESCRIPTOR', 'get_fields_and_field_types')
"""Class attributes of messages: of rosbags, of protobuf, of rclpy."""
ZSTD_MAGIC = b'\x28\xb5\x2f\xfd'
"""Begin of a message that rosbag2 has compressed; CDR begins with 0 and 0 to 3."""
MAX_MESSAGE_BYTES = 2**30
"""Compressed messages that claim to be larger are damaged [bytes]."""
IDL_SEPARATOR = '=' * 80 + '\n'
Definitions = tuple[tuple[str, MessageDefinition], ...]
"""Names of types and their definitions; code is made of them for 50 ms."""


class Reader:
    """
    Read the files of a recording as one, by the message definitions of all of them.

    It `is2` unless its messages are of ROS 1. Raises RecordingError if a path has no readable
    file, or messages of ROS 1 and ROS 2 are mixed.

    """

    def __init__(self, parts: Sequence[Part]) -> None:
        self._origin = ', '.join(str(part.path) for part in parts)
        self._decoders: dict[str, Callable[[bytes], Any]] = {}
        with ExitStack() as stack:
            self._files = [stack.enter_context(closing(Files(part))) for part in parts]
            self.connections = [
                self._known(connection) for file in self._files for connection in file.connections
            ]
            encodings = {_encoding(connection) for connection in self.connections}
            self.is2 = 'ros1' not in encodings
            if not self.is2 and 'cdr' in encodings:
                raise RecordingError(
                    'recordings of ROS 1 and ROS 2 cannot be merged; relabel them one by one'
                )
            self.typestore = _typestore(_definitions(self.connections))
            self._opened = stack.pop_all()

    def close(self) -> None:
        """Close all files."""
        self._opened.close()

    def complete_definitions(self, stock: Typestore) -> None:
        """Add the definitions of `stock` that the recording does not have."""
        own = _typestore.__wrapped__(_definitions(self.connections))  # not that of other readers
        own.register({k: v for k, v in stock.fielddefs.items() if k not in own.fielddefs})
        self.typestore = own

    @property
    def damages(self) -> list[Damage]:
        """Return the parts that cannot be read, as far as they are known."""
        return [damage for file in self._files for damage in file.damages]

    def presence(self) -> dict[str, list[tuple[int, int]]]:
        """Return first and last receive times [ns] of parts with messages, by topic, ascending."""
        found: dict[str, set[tuple[int, int]]] = {c.topic: set() for c in self.connections}
        for file in self._files:
            topics = {connection.id: connection.topic for connection in file.connections}
            for number, first_ns, last_ns in file.spans():
                found[topics[number]].add((first_ns, last_ns))
        return {topic: sorted(parts) for topic, parts in found.items()}

    @staticmethod
    def span_ns(connection: Connection) -> tuple[int, int]:
        """Return the receive times of the first message and of the end of a path [ns]."""
        owner: Any = connection.owner
        return owner.start_time, owner.end_time

    def messages(
        self, connections: Collection[Connection], start: int | None, stop: int | None
    ) -> Iterator[Record]:
        """Yield the messages on `connections` by receive time; damage is added to `damages`."""
        streams = []
        for file in self._files:
            wanted = {c.id: c for c in connections if c.owner is file}
            own = [c for c in file.connections if c.id in wanted]
            if own:
                streams.append(
                    (file.start_time, _renamed(file.messages(own, start, stop), wanted))
                )
        with readable(self._origin):  # no code of ours runs in the streams
            yield from merged_streams(streams)

    def deserialize(self, data: bytes, msgtype: str) -> Any:
        """Return a message, encoded as its first byte shows, or raise UnsupportedMessage."""
        if msgtype in self._decoders and data[:1] != b'\0':
            return self._decoders[msgtype](data)
        if data[:4] == ZSTD_MAGIC:
            data = _decompressed(data)
        if msgtype not in self.typestore.fielddefs:
            raise UnsupportedMessage(
                f'expected its definition in the recording, got none; install the package '
                f'{msgtype.split("/")[0]} and record it again, or convert the recording'
            )
        decode = self.typestore.deserialize_cdr if self.is2 else self.typestore.deserialize_ros1
        view: Any = memoryview(data)  # parts of it are no copies
        try:
            return decode(view, msgtype)
        # rosbags turns all errors of malformed bytes into SerdeError; the others mean that a
        # definition refers to a type without one.
        except (SerdeError, TypesysError, KeyError) as error:
            raise UnsupportedMessage(one_line(error)) from None

    def _known(self, connection: Connection) -> Connection:
        """Return a connection; one with a schema of Foxglove gets the ROS type it is read as."""
        if _encoding(connection) not in FOXGLOVE_ENCODINGS:
            return connection
        owner: Any = connection.owner
        schema = owner.schema_of(connection)
        if schema is None:
            return connection
        kind = ros_type(schema.name)
        self._decoders[kind] = ChannelDecoder(self._origin, connection.topic, schema)
        return connection._replace(msgtype=kind)


def _renamed(records: Iterator[Record], wanted: dict[int, Connection]) -> Iterator[Record]:
    for record in records:
        yield record._replace(connection=wanted[record.connection.id])


def _encoding(connection: Connection) -> str:
    """Return the encoding of a connection's messages."""
    return getattr(connection.ext, 'serialization_format', 'ros1')


def _definitions(connections: Sequence[Connection]) -> Definitions:
    return tuple((connection.msgtype, connection.msgdef) for connection in connections)


@lru_cache(maxsize=8)
def _typestore(definitions: Definitions) -> Typestore:
    """
    Return a store of message definitions, which readers of a recording share.

    A definition that cannot be parsed is left out: messages of its type are unreadable then,
    unless the type is among the stock definitions.

    """
    store = get_typestore(Stores.EMPTY)
    found: dict[str, Any] = {}
    for name, definition in definitions:
        try:
            found.update(_types_of(definition, name))
        except Exception:  # of the parsers, for any malformed definition
            continue
    try:
        store.register(found)
    except Exception:  # of the code generator, for any malformed definition
        for name, fields in found.items():
            with suppress(Exception):
                store.register({name: fields})
    return store


def _types_of(definition: MessageDefinition, name: str) -> Any:
    """Return the types in a message definition."""
    if definition.format == MessageDefinitionFormat.MSG:
        return get_types_from_msg(definition.data, name)
    types: dict[str, Any] = {}
    if definition.format == MessageDefinitionFormat.IDL:
        for text in definition.data.split(IDL_SEPARATOR):
            body = text.partition('\n')[2] if text.startswith('IDL: ') else text
            if body.strip():
                types.update(get_types_from_idl(body))
    return types


def _decompressed(data: bytes) -> bytes:
    """Return a message that was compressed by itself."""
    try:
        size = zstandard.frame_content_size(data)
        if size > MAX_MESSAGE_BYTES:
            raise UnsupportedMessage(f'compressed message of {size} bytes')
        return zstandard.decompress(data, MAX_MESSAGE_BYTES if size < 0 else size)
    except zstandard.ZstdError as error:
        raise UnsupportedMessage(one_line(error)) from None


@contextmanager
def readable(origin: str) -> Iterator[None]:
    """
    Turn errors of the formats' libraries into RecordingError; `origin` names the files.

    Damaged files make these libraries, sqlite3 and the decompressors raise errors of any class,
    so only calls of these libraries may stand in the block.

    """
    try:
        yield
    except BoxregError:
        raise
    except Exception as error:
        raise RecordingError(
            f'{origin}: expected an MCAP file, rosbag2 folder, .db3 file or ROS 1 bag, got: '
            f'{one_line(error)}; copy or record it again'
        ) from None


def is_message(value: object) -> bool:
    """Return whether a value is a message, or a part of one, of any library that decodes them."""
    return isinstance(value, SimpleNamespace) or any(
        hasattr(type(value), mark) for mark in MESSAGE_MARKS
    )
