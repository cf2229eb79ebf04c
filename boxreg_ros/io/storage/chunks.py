"""
Files that consist of chunks: MCAP and ROS 1 bags.

A chunk is read when the stream reaches its first message, and dropped after its last one. Chunks
may overlap in time, or lie in any order. At most `BUFFER_BYTES` of them are buffered.

"""

from __future__ import annotations

from abc import ABC, abstractmethod
from bisect import bisect_left, bisect_right
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from heapq import heapify, heappop, heappush
from itertools import accumulate
from pathlib import Path
from typing import NamedTuple

from boxreg_ros.errors import RecordingError
from boxreg_ros.io.storage.record import Damage, Damages, one_line, Record, shown, span_ns
from boxreg_ros.io.storage.urls import byte_source_of, ByteSource
from rosbags.interfaces import Connection

BUFFER_BYTES = 256 * 2**20
"""
Messages of chunks that are held at a time [bytes].

Two seconds of a recording of 100 MB/s. Recordings whose chunks all cover the whole time exceed
it; their chunks are then dropped and read again.

"""
AHEAD_BYTES = 16 * 2**20
AHEAD_CHUNKS = 16
"""
Chunks that are requested ahead of a stream of a remote file, the first limit that is reached.

Chosen: at 50 MB/s they last for the latency of an object store, 0.1 s, three times.

"""
MAX_CHUNK_BYTES = 2**30
"""Chunks that claim to be larger are damaged [bytes]; writers make chunks of 1 to 16 MB."""
MAX_RECORDS = 2**20
"""Chunks with more records are damaged; those of 16 MB with the smallest of messages have half."""
RECORD_BYTES = 256
"""What a message takes in memory beside its content [bytes]."""


class Chunk(NamedTuple):
    """A part of a file with messages."""

    first_byte: int
    end_byte: int
    """End of its byte range in the file."""
    start_ns: int
    last_ns: int
    """Receive time of its last message, as `start_ns` of the first [ns]."""
    counts: Mapping[int, int]
    """Number of messages by the id of their connection."""
    is_compressible: bool = True
    """False for messages outside of chunks, which are grouped to chunks here."""


class StoredMessage(NamedTuple):
    """Connection id, receive time [ns] and bytes of a message, and what MCAP has beside them."""

    connection_id: int
    received_ns: int
    data: bytes | memoryview
    published_ns: int
    sequence: int


class RecordPlace(NamedTuple):
    """A record in the file, without its content; `kind` is its operation code."""

    kind: int
    first_byte: int
    end_byte: int


class ChunkedFile(ABC):
    """An open file of chunks, unpacked from `origin` where that is given; see `StorageFile`."""

    def __init__(self, path: Path, origin: Path | None = None) -> None:
        self.name = shown(path, origin)
        self._path = path
        self._file = byte_source_of(path)
        self.size = self._file.size
        self.connections: list[Connection] = []
        self.damages: Damages = {}
        self._chunks: list[Chunk] = []
        try:
            self._open()
        except BaseException:
            self.close()
            raise
        spans = [(chunk.start_ns, chunk.last_ns + 1) for chunk in self._chunks if chunk.counts]
        self.start_time, self.end_time = span_ns(spans)

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def messages(
        self, connections: Collection[Connection], start: int | None, stop: int | None
    ) -> Iterator[Record]:
        """Yield the messages on `connections`, ordered by receive time; see `StorageFile`."""
        wanted = {connection.id: connection for connection in connections}

        def load(chunk: Chunk) -> list[Record]:
            read_ahead(chunk)
            return [
                Record(
                    wanted[message.connection_id], message.received_ns, bytes(message.data),
                    message.published_ns, message.sequence,
                )
                for message in self._messages_of(chunk)
                if message.connection_id in wanted and _is_within(message.received_ns, start, stop)
            ]  # fmt: skip

        chunks = [
            chunk
            for chunk in self._chunks
            if not wanted.keys().isdisjoint(chunk.counts)
            and (start is None or start <= chunk.last_ns)
            and (stop is None or chunk.start_ns < stop)
        ]
        read_ahead = _ReadAhead(chunks, self._file)
        return _merged(chunks, load, BUFFER_BYTES)

    def spans(self) -> Iterator[tuple[int, int, int]]:
        """Yield connection id, first and last receive time [ns] of chunks with its messages."""
        for chunk in self._chunks:
            for number in chunk.counts:
                yield number, chunk.start_ns, chunk.last_ns

    @abstractmethod
    def _open(self) -> None:
        """Set `connections` and `_chunks`, from the index of the file or by a scan."""

    @abstractmethod
    def _unpack(self, chunk: Chunk, stored: bytes) -> list[StoredMessage]:
        """Return the messages of a chunk from its bytes; any error means that it is damaged."""

    @abstractmethod
    def _place_at(self, first_byte: int) -> RecordPlace | None:
        """Return the record at a position; None where there can be none."""

    @abstractmethod
    def _next_chunk(self, position: int) -> int:
        """Return where the next whole chunk begins; the end of the file without."""

    def _places(self, first_byte: int) -> Iterator[RecordPlace]:
        """Yield the records from a position on; skip and note what is no record."""
        while first_byte < self.size:
            place = self._place_at(first_byte)
            if place is None:
                following = self._next_chunk(first_byte + 1)
                self._note('no record', first_byte, following)
                first_byte = following
            else:
                yield place
                first_byte = place.end_byte

    def _add(self, chunk: Chunk) -> None:
        """Add a chunk that has messages, with their times and counts."""
        messages = self._messages_of(chunk)
        if messages:
            times = [message.received_ns for message in messages]
            counts = Counter(message.connection_id for message in messages)
            self._chunks.append(
                chunk._replace(start_ns=min(times), last_ns=max(times), counts=counts)
            )

    def _no_chunk(self, what: str) -> RecordingError:
        """Return the error of a file in which no chunk was found."""
        return RecordingError(
            f'{self.name}: no message can be read; expected {what}, got {self.size} bytes without '
            f'a whole chunk; copy or record it again'
        )

    def _messages_of(self, chunk: Chunk) -> list[StoredMessage]:
        """Return the messages of a chunk; none, and a damage is noted, if it is damaged."""
        stored = self._bytes(chunk.first_byte, chunk.end_byte)  # a failure here is no damage
        try:
            return self._unpack(chunk, stored)
        except Exception as error:  # of the format's library or of a decompressor
            self._file.check_unchanged()
            reason = f'damaged chunk ({one_line(error)})'
            self._note(reason, chunk.first_byte, chunk.end_byte, chunk.start_ns, chunk.last_ns)
            return []

    def _note(
        self,
        reason: str,
        first_byte: int,
        end_byte: int,
        start_ns: int | None = None,
        end_ns: int | None = None,
    ) -> None:
        damage = Damage(self.name, reason, first_byte, end_byte, start_ns, end_ns)
        self.damages[damage] = None

    def _bytes(self, first_byte: int, end_byte: int) -> bytes:
        """Return a part of the file; fewer bytes at its end."""
        return self._file.read(first_byte, end_byte)

    def _count_messages(self) -> Counter[int]:
        """Return the number of messages in all chunks by connection id."""
        counts: Counter[int] = Counter()
        for chunk in self._chunks:
            counts.update(chunk.counts)
        return counts

    def _locate_damages(self) -> None:
        """Give damages found by a scan the times of the chunks before and behind them."""
        begins = [chunk.first_byte for chunk in self._chunks]  # ascending: the order of the scan
        ends = [chunk.end_byte for chunk in self._chunks]
        latest = list(accumulate((chunk.last_ns for chunk in self._chunks), max))
        earliest = list(accumulate((chunk.start_ns for chunk in reversed(self._chunks)), min))

        def located(damage: Damage) -> Damage:
            if damage.start_ns is not None or damage.first_byte is None:
                return damage
            before = bisect_right(ends, damage.first_byte)
            behind = bisect_left(begins, damage.end_byte or damage.first_byte)
            # Behind the last chunk the end is unknown: the recording was interrupted there.
            start_ns = latest[before - 1] if before else None
            end_ns = earliest[-1 - behind] if behind < len(begins) else start_ns
            return damage._replace(start_ns=start_ns, end_ns=end_ns)

        self.damages = {located(damage): None for damage in self.damages}


class _ReadAhead:
    """
    Ask for the chunks that are needed next, once a stream has come to its third chunk.

    Streams that are begun for one message end before.

    """

    def __init__(self, chunks: Sequence[Chunk], file: ByteSource) -> None:
        self._following = sorted(chunks, key=lambda chunk: chunk.start_ns)
        self._place = {chunk.first_byte: i for i, chunk in enumerate(self._following)}
        self._file = file

    def __call__(self, chunk: Chunk) -> None:
        """Ask for the chunks behind one, up to `AHEAD_BYTES`."""
        begin = self._place[chunk.first_byte]
        if begin < 2:
            return
        ranges = []
        size = 0
        for later in self._following[begin : begin + AHEAD_CHUNKS]:
            size += later.end_byte - later.first_byte
            ranges.append((later.first_byte, later.end_byte))
            if size > AHEAD_BYTES:
                break
        self._file.prefetch(ranges)


def _merged(
    chunks: Sequence[Chunk],
    load: Callable[[Chunk], list[Record]],
    buffer_bytes: int,
) -> Iterator[Record]:
    """
    Yield the messages of chunks in the order of their receive times.

    If more than `buffer_bytes` would be held, the chunk that is needed last is dropped and read
    again when its next message is due.

    """
    waiting = [(chunk.start_ns, i) for i, chunk in enumerate(chunks)]
    heapify(waiting)
    positions = [0] * len(chunks)
    held: dict[int, list[Record]] = {}
    sizes: dict[int, int] = {}
    while waiting:
        _, i = heappop(waiting)
        if i in held:
            yield held[i][positions[i]]
            positions[i] += 1
        else:
            held[i] = sorted(load(chunks[i]), key=lambda record: record.received_ns)
            sizes[i] = sum(RECORD_BYTES + len(record.data) for record in held[i])
            while len(held) > 1 and sum(sizes.values()) > buffer_bytes:
                others = {k: held[k][positions[k]].received_ns for k in held if k != i}
                last = max(others, key=others.__getitem__)
                del held[last], sizes[last]
        if positions[i] < len(held[i]):
            heappush(waiting, (held[i][positions[i]].received_ns, i))
        else:
            del held[i], sizes[i]


def _is_within(time_ns: int, start: int | None, stop: int | None) -> bool:
    return (start is None or start <= time_ns) and (stop is None or time_ns < stop)
