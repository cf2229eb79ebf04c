"""All files of a recording as one stream of encoded messages."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from contextlib import closing, ExitStack
from types import SimpleNamespace
from typing import Any

from boxreg_ros.errors import one_line, RecordingError, UnsupportedMessage
from boxreg_ros.io.storage.files import encoding_of, Files, merged_streams, Part
from boxreg_ros.io.storage.record import Damage, readable, Record
from rosbags.interfaces import Connection
import zstandard

MESSAGE_MARKS = ('__msgtype__', 'DESCRIPTOR', 'get_fields_and_field_types')
"""Class attributes of messages: of rosbags, of protobuf, of rclpy."""
READ_FORMATS = 'an MCAP file, rosbag2 folder, .db3 file or ROS 1 bag'
ZSTD_MAGIC = b'\x28\xb5\x2f\xfd'
"""Begin of a message that rosbag2 has compressed; CDR begins with 0 and 0 to 3."""
MAX_MESSAGE_BYTES = 2**30
"""Compressed messages that claim to be larger are damaged [bytes]."""


class Reader:
    """
    Read the files of a recording as one.

    It `is2` unless its messages are of ROS 1. Raises RecordingError if a path has no readable
    file, or messages of ROS 1 and ROS 2 are mixed.

    """

    def __init__(self, parts: Sequence[Part]) -> None:
        self._origin = ', '.join(str(part.path) for part in parts)
        with ExitStack() as stack:
            self._files = [stack.enter_context(closing(Files(part))) for part in parts]
            self.connections = [
                connection for file in self._files for connection in file.connections
            ]
            encodings = {encoding_of(connection) for connection in self.connections}
            self.is2 = 'ros1' not in encodings
            if not self.is2 and 'cdr' in encodings:
                raise RecordingError(
                    'recordings of ROS 1 and ROS 2 cannot be merged; relabel them one by one'
                )
            self._opened = stack.pop_all()

    def close(self) -> None:
        """Close all files."""
        self._opened.close()

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
            own = [connection for connection in connections if connection.owner is file]
            if own:
                streams.append((file.start_time, file.messages(own, start, stop)))
        with readable(self._origin, READ_FORMATS, 'copy it again, or leave it out'):
            yield from merged_streams(streams)


def decompressed(data: bytes) -> bytes:
    """Return a message, unpacked if rosbag2 has compressed it by itself."""
    if data[:4] != ZSTD_MAGIC:
        return data
    try:
        size = zstandard.frame_content_size(data)
        if size > MAX_MESSAGE_BYTES:
            raise UnsupportedMessage(f'compressed message of {size} bytes')
        return zstandard.decompress(data, MAX_MESSAGE_BYTES if size < 0 else size)
    except zstandard.ZstdError as error:
        raise UnsupportedMessage(one_line(error)) from None


def is_message(value: object) -> bool:
    """Return whether a value is a message, or a part of one, of any library that decodes them."""
    return isinstance(value, SimpleNamespace) or any(
        hasattr(type(value), mark) for mark in MESSAGE_MARKS
    )
