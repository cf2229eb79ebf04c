"""
MCAP files, read by the mcap package.

With a whole summary only the chunks that are asked for are read; else the file is gone through
once from its begin, as far as its records are whole. Each chunk is unpacked by itself: one that
fails is left out and noted, where the readers of the package would end.

"""

from __future__ import annotations

from bisect import bisect_left
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from dataclasses import replace
from io import BytesIO, SEEK_END
from itertools import takewhile
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple
import zlib

from boxreg_ros.errors import one_line, RecordingError, TransferError
from boxreg_ros.io.storage.byte_file import ByteFile
from boxreg_ros.io.storage.record import (
    Damage,
    Damages,
    Definition,
    Record,
    span_ns,
)
from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.exceptions import EndOfFile
from mcap.reader import FOOTER_SIZE, make_reader
from mcap.stream_reader import (
    CRCValidationError,
    get_chunk_data_stream,
    MAGIC_SIZE,
    StreamReader,
)
from mcap.summary import Summary
from rosbags.interfaces import (
    Connection,
    ConnectionExtRosbag2,
    MessageDefinition,
    MessageDefinitionFormat,
)
from rosbags.typesys.msg import normalize_msgtype
import zstandard

CHECKSUM_SIZE = 4
GROUP_BYTES = 2**22
"""Messages outside of chunks are grouped to parts of this size [bytes], as writers do."""
MAX_CHUNK_BYTES = 2**30
"""Chunks that claim to be larger are damaged [bytes]; writers make chunks of 1 to 16 MB."""
SKIPPED_BYTES = 64
"""
Fields of later versions and records of others that may be skipped without a word [bytes].

The package skips both, and with them what a damaged length or kind makes of a chunk: even one of a
single message is larger.

"""
LONG_READ = 2**20
"""Messages from this size on are parts of their chunk [bytes]; chosen: clouds and images alone."""
_end = RecordBuilder()
records.Footer(0, 0, 0).write(_end)
END = _end.end()
"""A footer, at which readers end."""
SCHEMA_FORMATS = {
    'ros2msg': MessageDefinitionFormat.MSG,
    'ros1msg': MessageDefinitionFormat.MSG,
    'ros2idl': MessageDefinitionFormat.IDL,
    'omgidl': MessageDefinitionFormat.IDL,
}
REMEDY = 'copy it again, or mend it: mcap recover'


class Chunk(NamedTuple):
    """A part of the file with messages: a chunk, or some messages outside of chunks."""

    first_byte: int
    end_byte: int
    """End of its byte range in the file."""
    start_ns: int
    last_ns: int
    """Receive time of its last message, as `start_ns` of the first [ns]."""
    counts: Mapping[int, int]
    """Number of messages by channel; 1 for each channel where only these are known."""


class McapFile:
    """
    An open MCAP file; see `StorageFile`. It `is_indexed` unless the whole file was gone through.

    Parameters
    ----------
    path
        A file of this machine, or behind a URL.
    origin
        The file that `path` was unpacked from, to name in messages.

    Raises
    ------
    RecordingError
        If there is no message in it, and it is not a whole MCAP file.
    TransferError
        If bytes of it cannot be read from their disk or server; while messages are read, too.

    """

    def __init__(self, path: Path, origin: Path | None = None) -> None:
        self.name = str(origin or path)
        self.damages: Damages = {}
        self.compression = ''
        self.is_indexed = True
        self._schemas: dict[int, records.Schema] = {}
        self._channels: dict[int, records.Channel] = {}
        self._chunks: list[Chunk] = []
        self._extras: list[int] = []
        self._file = ByteFile(path)
        try:
            counts = self._read_summary()
            if counts is None:
                self.is_indexed = False
                counts = self._scan()
        except BaseException:
            self.close()
            raise
        self.connections = [
            self._connection(channel, counts.get(number, 0))
            for number, channel in sorted(self._channels.items())
        ]
        self.start_time, self.end_time = span_ns(
            [(chunk.start_ns, chunk.last_ns + 1) for chunk in self._chunks]
        )

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def messages(
        self, connections: Collection[Connection], start: int | None, stop: int | None
    ) -> Iterator[Record]:
        """Yield the messages on `connections`, ordered by receive time; see `StorageFile`."""
        wanted = {connection.id: connection for connection in connections}
        waiting: list[tuple[int, int, Record]] = []
        chunks = [
            chunk
            for chunk in sorted(self._chunks, key=lambda chunk: chunk.start_ns)
            if not wanted.keys().isdisjoint(chunk.counts)
            and (start is None or start <= chunk.last_ns)
            and (stop is None or chunk.start_ns < stop)
        ]
        for chunk in chunks:
            due = bisect_left(waiting, chunk.start_ns, key=_time)
            for _, _, record in waiting[:due]:
                yield record
            del waiting[:due]
            for message in self._messages_of(chunk):
                time_ns = message.log_time
                is_within = (start is None or start <= time_ns) and (
                    stop is None or time_ns < stop
                )
                if is_within and message.channel_id in wanted:
                    record = Record(
                        wanted[message.channel_id], time_ns, message.data,
                        message.publish_time, message.sequence,
                    )  # fmt: skip
                    waiting.append((time_ns, chunk.first_byte, record))
            waiting.sort(key=_time_and_place)
        for _, _, record in waiting:
            yield record

    def spans(self) -> Iterator[tuple[int, int, int]]:
        """Yield connection id, first and last receive time [ns] of chunks with its messages."""
        for chunk in self._chunks:
            for number in chunk.counts:
                yield number, chunk.start_ns, chunk.last_ns

    def schema_of(self, connection: Connection) -> records.Schema | None:
        """Return the schema of a connection's channel; None without."""
        return self._schemas.get(self._channels[connection.id].schema_id)

    def definition_of(self, connection: Connection) -> Definition:
        """Return schema, encoding and metadata of a connection's channel."""
        channel = self._channels[connection.id]
        schema = self.schema_of(connection)
        return Definition(
            (schema.name, schema.encoding, schema.data) if schema else None,
            channel.message_encoding,
            tuple(channel.metadata.items()),
        )

    def extras(self) -> Iterator[records.Attachment | records.Metadata]:
        """Yield the attachments and the metadata; damaged ones are noted and left out."""
        for first_byte in self._extras:
            try:
                self._file.seek(first_byte)
                record: Any = next(self._records())
            except TransferError:
                raise
            except Exception as error:  # of the library, for any malformed content
                self._note(f'damaged attachment or metadata ({one_line(error)})', first_byte)
            else:
                yield record

    def _connection(self, channel: records.Channel, count: int) -> Connection:
        schema = self._schemas.get(channel.schema_id)
        kind = schema.name if schema else channel.message_encoding
        definition = MessageDefinition(MessageDefinitionFormat.NONE, '')
        if schema and schema.encoding in SCHEMA_FORMATS:
            kind = normalize_msgtype(kind)
            text = schema.data.decode(errors='replace')
            definition = MessageDefinition(SCHEMA_FORMATS[schema.encoding], text)
        return Connection(
            channel.id, channel.topic, kind, definition, '', count,
            ConnectionExtRosbag2(channel.message_encoding, []), self,
        )  # fmt: skip

    # Summary ----------------------------------------------------------------------------------

    def _read_summary(self) -> dict[int, int] | None:
        """
        Read the summary at the end of the file; return the number of messages by channel.

        None where it is missing, damaged, or does not list all chunks, channels and schemas.

        """
        try:
            summary = self._checked_summary()
            if summary is None or summary.statistics is None:
                return None
            counts = summary.statistics.channel_message_counts
            if not _lists_all_chunks(summary, self._file.size):
                return None
            self._schemas, self._channels = summary.schemas, summary.channels
            for index in summary.chunk_indexes:
                chunk = _indexed(index, counts)
                has_messages = index.message_index_offsets or index.message_end_time
                if has_messages or self._messages_of(chunk):
                    self._chunks.append(chunk)
            if not self._find_definitions(summary.statistics.channel_count):
                return None
        except TransferError:
            raise
        except Exception:  # of the library, for any malformed content; the scan reports it
            return None
        if summary.chunk_indexes:
            self.compression = summary.chunk_indexes[0].compression
        self._extras = [index.offset for index in summary.attachment_indexes]
        self._extras += [index.offset for index in summary.metadata_indexes]
        return counts

    def _checked_summary(self) -> Summary | None:
        """Return the summary; None if it has another checksum, which the library leaves out."""
        summary = make_reader(self._file).get_summary()  # type: ignore[arg-type]
        end = self._file.seek(-MAGIC_SIZE - CHECKSUM_SIZE, SEEK_END)
        self._file.seek(-MAGIC_SIZE - FOOTER_SIZE, SEEK_END)
        footer: Any = next(self._records())
        self._file.seek(footer.summary_start)
        checksum = zlib.crc32(self._file.read(end - footer.summary_start))
        return summary if footer.summary_crc in (0, checksum) else None

    def _find_definitions(self, channel_count: int) -> bool:
        """Search the chunks for channels and schemas that the summary does not repeat."""
        for chunk in self._chunks:
            if self._is_defined(channel_count):
                break
            self._messages_of(chunk)
        return self._is_defined(channel_count)

    def _is_defined(self, channel_count: int) -> bool:
        needed = {channel.schema_id for channel in self._channels.values()}
        return len(self._channels) == channel_count and needed <= {0, *self._schemas}

    # Scan -------------------------------------------------------------------------------------

    def _scan(self) -> dict[int, int]:
        """Go through all records; return the number of messages by channel."""
        self._schemas, self._channels, self._chunks = {}, {}, []
        self.damages.clear()
        end_byte = 0
        try:
            for first_byte, end_byte, found in self._parts():
                self._add_part(first_byte, end_byte, found)
                if isinstance(found[0], records.DataEnd):
                    break
        except TransferError:
            raise
        except CRCValidationError as error:
            if not self.damages:  # else it is that of a chunk
                self._note(f'damaged data ({one_line(error)})', 0, self._file.tell())
        except Exception as error:  # of the library, for any malformed content
            self._end_scan(error, end_byte)
        counts: Counter[int] = Counter()
        for chunk in self._chunks:
            counts.update(chunk.counts)
        return counts

    def _parts(self) -> Iterator[tuple[int, int, list[records.McapRecord]]]:
        """Yield begin, end and content of the records; messages outside of chunks together."""
        first_byte, end_byte = 0, 0
        group: list[records.McapRecord] = []
        self._file.seek(0)
        try:
            for record in self._records(skip_magic=False):
                are_loose = all(isinstance(one, records.Message) for one in (*group[:1], record))
                if group and not (are_loose and end_byte - first_byte < GROUP_BYTES):
                    yield first_byte, end_byte, group
                    first_byte, group = end_byte, []
                group.append(record)
                here = self._file.tell()
                skipped = here - end_byte - _size_of(record)
                if skipped > SKIPPED_BYTES:
                    self._note(f'{skipped} bytes of an unknown kind', end_byte, here)
                end_byte = here
        except Exception:  # what is whole before it is read
            if group:
                yield first_byte, end_byte, group
            raise
        yield first_byte, end_byte, group

    def _add_part(self, first_byte: int, end_byte: int, found: list[records.McapRecord]) -> None:
        """Add one record, or messages outside of chunks."""
        first = found[0]
        place = Chunk(first_byte, end_byte, 0, 0, {})
        if isinstance(first, records.Schema):
            self._schemas[first.id] = first
        elif isinstance(first, records.Channel):
            self._channels.setdefault(first.id, first)
        elif isinstance(first, records.Attachment | records.Metadata):
            self._extras.append(first_byte)
        elif isinstance(first, records.Chunk):
            self.compression = self.compression or first.compression
            times = first.message_start_time, first.message_end_time
            place = place._replace(start_ns=times[0], last_ns=times[1])
            self._add_chunk(place, self._unpacked(first, place))
        elif isinstance(first, records.Message):
            messages = [one for one in found if isinstance(one, records.Message)]
            self._note_unknown(messages, place)
            self._add_chunk(place, messages)

    def _add_chunk(self, place: Chunk, messages: list[records.Message]) -> None:
        """Add a part with messages, with their times and counts."""
        if messages:
            times = [message.log_time for message in messages]
            counts = Counter(message.channel_id for message in messages)
            self._chunks.append(
                place._replace(start_ns=min(times), last_ns=max(times), counts=counts)
            )

    def _end_scan(self, error: Exception, end_byte: int) -> None:
        """Note the bytes behind the last whole record, or raise if there is nothing before."""
        if not self._chunks:
            raise RecordingError(
                f'{self.name}: no message can be read; expected an MCAP file, got '
                f'{self._file.size} bytes without a whole chunk ({one_line(error)}); copy it '
                f'again, or leave it out'
            ) from None
        reason = 'interrupted or damaged: no whole record from here on'
        if not isinstance(error, EndOfFile):
            reason += f' ({one_line(error)})'
        last_ns = max(chunk.last_ns for chunk in self._chunks)
        self._note(f'{reason}; {REMEDY}', end_byte, self._file.size, last_ns, last_ns)

    # Content ----------------------------------------------------------------------------------

    def _records(self, skip_magic: bool = True) -> Iterator[records.McapRecord]:
        """Return the records from this place on; from the magic bytes on with their checksum."""
        stream: Any = self._file
        reader = StreamReader(
            stream, skip_magic=skip_magic, emit_chunks=True, validate_crcs=not skip_magic
        )
        return reader.records

    def _messages_of(self, place: Chunk) -> list[records.Message]:
        """Return the messages of a part; none, and a damage is noted, if it is damaged."""
        try:
            self._file.seek(place.first_byte)
            found = _records_in(self._file, place.end_byte - place.first_byte)
        except TransferError:
            raise
        except Exception as error:  # of the library, for any malformed content
            self._note_chunk(error, place)
            return []
        if isinstance(found[0], records.Chunk):
            return self._unpacked(found[0], place)
        return [record for record in found if isinstance(record, records.Message)]

    def _unpacked(self, chunk: records.Chunk, place: Chunk) -> list[records.Message]:
        """Return the messages of a chunk, or note it; add the channels and schemas in it."""
        try:
            times = chunk.message_start_time, chunk.message_end_time
            if self.is_indexed and times != (place.start_ns, place.last_ns):
                raise RecordingError('its times are not those of the index')
            _check_size(chunk)
            stream, size = get_chunk_data_stream(chunk, validate_crc=True)
            content = _records_in(_Parts(stream.read(size)), size)
        except Exception as error:  # of the library or of a decompressor
            self._note_chunk(error, place)
            return []
        messages = [record for record in content if isinstance(record, records.Message)]
        for record in content:
            if isinstance(record, records.Schema):
                self._schemas.setdefault(record.id, record)
            elif isinstance(record, records.Channel):
                self._channels.setdefault(record.id, record)
        self._note_unknown(messages, place)
        return messages

    def _note_unknown(self, messages: list[records.Message], place: Chunk) -> None:
        """Note messages whose channel is defined nowhere before them."""
        count = sum(message.channel_id not in self._channels for message in messages)
        if count:
            self._note(f'{count} messages of unknown channels', *place[:4])

    def _note_chunk(self, error: Exception, place: Chunk) -> None:
        self._file.check_unchanged()
        self._note(f'damaged chunk ({one_line(error)})', *place[:4])

    def _note(self, reason: str, *place: int | None) -> None:
        """Note a damage with begin and end of its bytes, and of its times [ns] if known."""
        self.damages[Damage(self.name, reason, *place)] = None


_time = itemgetter(0)
_time_and_place = itemgetter(0, 1)


def _indexed(index: records.ChunkIndex, ids: Collection[int]) -> Chunk:
    """Return the chunk of a chunk index; with all `ids` of channels, if it does not list them."""
    first_byte = index.chunk_start_offset
    listed = index.message_index_offsets
    return Chunk(
        first_byte, first_byte + index.chunk_length,
        index.message_start_time, index.message_end_time,
        dict.fromkeys(listed or ids, 1),
    )  # fmt: skip


def _check_size(chunk: records.Chunk) -> None:
    """Raise RecordingError if a chunk of a few bytes claims to hold any number."""
    size = chunk.uncompressed_size
    if chunk.compression == 'zstd':  # lz4 packs 255 bytes into one at most
        size = max(size, zstandard.frame_content_size(chunk.data))
    if size > MAX_CHUNK_BYTES:
        raise RecordingError(f'size of {size} bytes')


def _records_in(content: Any, size: int) -> list[records.McapRecord]:
    """Return the records in `size` bytes of a stream; EndOfFile if the last one is not whole."""
    stream: Any = _WholeReads(content, size)
    reader = StreamReader(stream, skip_magic=True, emit_chunks=True)
    return [*takewhile(lambda record: not isinstance(record, records.Footer), reader.records)]


class _Parts:
    """Bytes as a stream for the mcap package; long reads, of clouds and images, are no copies."""

    def __init__(self, content: bytes) -> None:
        self._rest = memoryview(content)

    def read(self, size: int) -> Any:
        """Return the next `size` bytes."""
        found, self._rest = self._rest[:size], self._rest[size:]
        return found if size >= LONG_READ else bytes(found)


class _WholeReads:
    """
    Bytes of a stream and a footer behind them, as a stream for the mcap package.

    A read beyond the end of the bytes raises EndOfFile: the package would take those that are left
    for the rest of a record. One that lacks all of its fields swallows the footer.

    """

    def __init__(self, content: Any, size: int) -> None:
        self._parts = [(BytesIO(END), len(END)), (content, size)]

    def read(self, size: int) -> bytes:
        """Return the next `size` bytes, first of the content, then of the footer."""
        if len(self._parts) > 1 and not self._parts[-1][1]:
            self._parts.pop()
        content, left = self._parts[-1]
        if size > left:
            raise EndOfFile
        self._parts[-1] = content, left - size
        found: bytes = content.read(size)
        return found


def _size_of(record: Any) -> int:
    """Return the bytes of a record with the fields that the package knows."""
    builder = RecordBuilder()
    if not hasattr(record, 'data'):
        record.write(builder)
        return builder.count
    replace(record, data=b'').write(builder)
    return builder.count + len(record.data)


def _lists_all_chunks(summary: Summary, size: int) -> bool:
    """Return whether the chunk indexes of a summary are whole, each of another place."""
    statistics = summary.statistics
    assert statistics is not None
    places = sorted((i.chunk_start_offset, i.chunk_length) for i in summary.chunk_indexes)
    ends = [first + length for first, length in places]
    are_apart = all(end <= first for end, (first, _) in zip(ends, places[1:], strict=False))
    return (
        len(places) == statistics.chunk_count
        and bool(places or not statistics.message_count)
        and are_apart
        and max(ends, default=0) <= size
    )
