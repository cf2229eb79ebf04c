"""ROS 1 bags, read by rosbags."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import AbstractContextManager
from pathlib import Path

from boxreg_ros.io.storage.record import Damage, Damages, readable, Record
from rosbags.interfaces import Connection
from rosbags.rosbag1 import Reader
from rosbags.rosbag1.reader import ChunkInfo


class Rosbag1File:
    """
    An open ROS 1 bag; see `StorageFile`.

    Parameters
    ----------
    path
        A file of this machine.
    origin
        The file that `path` was unpacked or copied from, to name in messages.

    Raises
    ------
    RecordingError
        If it is no whole bag with an index; while messages are read, too.

    """

    def __init__(self, path: Path, origin: Path | None = None) -> None:
        self.name = str(origin or path)
        self.damages: Damages = {}
        self._reader = _Reader(path)
        with self._readable():
            self._reader.open()
        self.start_time, self.end_time = self._reader.start_time, self._reader.end_time
        self.connections = [c._replace(owner=self) for c in self._reader.connections]
        self._check_index(path.stat().st_size)

    def close(self) -> None:
        """Close the file."""
        self._reader.close()

    def messages(
        self, connections: Collection[Connection], start: int | None, stop: int | None
    ) -> Iterator[Record]:
        """Yield the messages on `connections`, ordered by receive time; see `StorageFile`."""
        wanted = {connection.id: connection for connection in connections}
        if not wanted:
            return  # rosbags would yield all
        with self._readable():
            for own, received_ns, data in self._reader.messages(connections, start, stop):
                yield Record(wanted[own.id], received_ns, data, received_ns)

    def spans(self) -> Iterator[tuple[int, int, int]]:
        """Yield connection id, first and last receive time [ns] of chunks with its messages."""
        for chunk in self._reader.chunk_infos:
            for number in chunk.connection_counts:
                yield number, chunk.start_time, chunk.end_time - 1

    def _check_index(self, size: int) -> None:
        """Note messages that the index does not lead to."""
        counted = sum(sum(c.connection_counts.values()) for c in self._reader.chunk_infos)
        lost = counted - sum(c.msgcount for c in self.connections)
        if lost:
            self.damages[Damage(self.name, f'{abs(lost)} messages are not in the index')] = None
        end_byte = self._reader.index_end
        if end_byte not in (None, size):
            reason = 'bytes behind the index are not read'
            self.damages[Damage(self.name, reason, end_byte, size)] = None

    def _readable(self) -> AbstractContextManager[None]:
        """Return a block in which errors of rosbags become errors with a remedy."""
        remedy = f'copy it again, or mend it by ROS 1: rosbag reindex {self.name}'
        return readable(self.name, 'a whole ROS 1 bag with an index', remedy)


class _Reader(Reader):
    """The reader of rosbags, which knows where the last record of the index ends."""

    index_end: int | None = None

    def read_chunk_info(self) -> ChunkInfo:
        found = super().read_chunk_info()
        assert self.bio is not None
        self.index_end = self.bio.tell()
        return found
