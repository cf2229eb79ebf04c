"""Files of recordings: ROS bags and MCAP files of ROS and Foxglove, read as one stream."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import closing, contextmanager, ExitStack
from heapq import merge
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from boxreg_ros.errors import BoxregError, RecordingError, UnsupportedMessage
from boxreg_ros.io.foxglove_mcap import FoxgloveFile, is_foxglove
from rosbags.highlevel import AnyReader, AnyReaderError
from rosbags.interfaces import Connection
from rosbags.serde import SerdeError
from rosbags.typesys import get_typestore, Stores
from rosbags.typesys.base import TypesysError
from rosbags.typesys.store import Typestore

EncodedMessage = tuple[Connection, int, bytes]
"""Connection, receive time [ns] and bytes."""

MESSAGE_MARKS = ('__msgtype__', 'DESCRIPTOR', 'get_fields_and_field_types')
"""Class attributes of messages: of rosbags, of protobuf, of rclpy."""


class Reader:
    """
    Read recordings of all kinds as one, as an open `AnyReader` does.

    Parameters
    ----------
    paths : sequence of Path
        Recordings. MCAP files with other encodings than those of ROS are found by their schemas.
    default_typestore : callable
        Returns message definitions for recordings without any. Few need them, and loading them
        takes 0.1 s.

    Attributes
    ----------
    connections : list of Connection
        Of all files.
    typestore : Typestore
        Message definitions of all files.
    is2 : bool
        False for ROS 1 bags.

    """

    def __init__(self, paths: Sequence[Path], default_typestore: Callable[[], Typestore]) -> None:
        foxglove_paths = [path for path in paths if is_foxglove(path)]
        ros_paths = [path for path in paths if path not in foxglove_paths]
        self._origin = ', '.join(map(str, paths))
        with ExitStack() as stack:
            self._foxglove = [
                stack.enter_context(closing(FoxgloveFile(path))) for path in foxglove_paths
            ]
            self._ros = None
            if ros_paths:
                try:
                    self._ros = stack.enter_context(AnyReader(ros_paths))
                except AnyReaderError:  # any other cause is raised again here
                    reader = AnyReader(ros_paths, default_typestore=default_typestore())
                    self._ros = stack.enter_context(reader)
            self.is2 = self._ros is None or self._ros.is2
            self.typestore = self._ros.typestore if self._ros else get_typestore(Stores.EMPTY)
            for file in self._foxglove:
                known = self.typestore.fielddefs
                types = file.ros_types()
                self.typestore.register({k: v for k, v in types.items() if k not in known})
            self.connections = [c for reader in self._readers for c in reader.connections]
            self._opened = stack.pop_all()

    def close(self) -> None:
        """Close all files."""
        self._opened.close()

    @staticmethod
    def span_ns(connection: Connection) -> tuple[int, int]:
        """Return the receive times of the first message and of the end of a file [ns]."""
        about: Any = getattr(connection.owner, 'metadata', connection.owner)
        return about.start_time, about.end_time

    def messages(
        self, connections: Collection[Connection], start: int | None, stop: int | None
    ) -> Iterator[EncodedMessage]:
        """
        Yield the messages on `connections` in the order they were received.

        Raises
        ------
        RecordingError
            If a file is damaged.

        """
        streams = []
        for reader in self._readers:
            own = [c for c in reader.connections if c in connections]
            if own:  # an empty list means all connections to the readers
                streams.append(reader.messages(own, start, stop))
        with readable(self._origin):  # no code of ours runs in the streams
            yield from merge(*streams, key=lambda message: message[1])

    def deserialize(self, data: bytes, msgtype: str) -> Any:
        """
        Return a message; its first byte shows the encoding.

        Raises
        ------
        UnsupportedMessage
            If the bytes do not follow the definition, or there is none.

        """
        if data[:1] != b'\0' and self.is2:
            for file in self._foxglove:
                if msgtype in file.decoders:
                    return file.decoders[msgtype](data)
        if msgtype not in self.typestore.fielddefs:
            raise UnsupportedMessage(
                f'expected its definition in the recording, got none; install the package '
                f'{msgtype.split("/")[0]} and record it again, or convert the recording'
            )
        try:
            view: Any = memoryview(data)  # parts of it are no copies
            if self._ros is not None:
                return self._ros.deserialize(view, msgtype)
            return self.typestore.deserialize_cdr(view, msgtype)
        # rosbags turns all errors of malformed bytes into SerdeError or AnyReaderError; the others
        # mean that a definition refers to a type without one.
        except (SerdeError, AnyReaderError, TypesysError, KeyError) as error:
            raise UnsupportedMessage(one_line(error)) from None

    @property
    def _readers(self) -> list[Any]:
        ros = [] if self._ros is None else [self._ros]
        return [*ros, *self._foxglove]


@contextmanager
def readable(origin: str) -> Iterator[None]:
    """
    Turn errors of rosbags and mcap into RecordingError; `origin` names the files.

    Damaged files make these libraries, sqlite3 and the decompressors raise errors of any class,
    so only calls of these libraries may stand in the block.

    """
    try:
        yield
    except BoxregError:
        raise
    except PermissionError as error:
        raise RecordingError(
            f'{error.filename or origin}: expected a file that may be read, got '
            f'{error.strerror}; change its permissions (chmod u+r) or the user'
        ) from None
    except Exception as error:
        raise RecordingError(
            f'{origin}: {one_line(error)}; expected a whole MCAP file, rosbag2 folder, .db3 file '
            f'or ROS 1 bag; mcap recover, ros2 bag reindex and rosbag reindex repair damaged ones'
        ) from None


def is_message(value: object) -> bool:
    """Return whether a value is a message, or a part of one, of any library that decodes them."""
    return isinstance(value, SimpleNamespace) or any(
        hasattr(type(value), mark) for mark in MESSAGE_MARKS
    )


def one_line(error: Exception) -> str:
    """Return the text of an error in one line."""
    return ' '.join(str(error).split()).rstrip('.') or type(error).__name__
