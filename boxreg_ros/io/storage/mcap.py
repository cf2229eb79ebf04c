"""
MCAP files: read by their index, or scanned record by record where the index is missing or damaged.

The records are parsed by the mcap library. Its readers stop at the first error; here a damaged
chunk is left out and noted, and after a damaged record the next plausible chunk is searched for.
They also copy the bytes of a message three times; here messages are views of their chunk.

"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from io import BytesIO
from pathlib import Path
import struct
from typing import Any, cast, IO, NamedTuple, TypeVar
import zlib

from boxreg_ros.errors import RecordingError
from boxreg_ros.io.storage.chunks import Chunk, ChunkedFile, MAX_CHUNK_BYTES, StoredMessage
from boxreg_ros.io.storage.record import Bytes, Definition, one_line
from lz4.frame import decompress as decompress_lz4
from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from rosbags.interfaces import (
    Connection,
    ConnectionExtRosbag2,
    MessageDefinition,
    MessageDefinitionFormat,
)
from rosbags.typesys.msg import normalize_msgtype
import zstandard

MCAP_MAGIC = b'\x89MCAP0\r\n'
RECORD_HEAD = struct.Struct('<BQ')
"""Operation code and length in front of each record."""
HEAD_BYTES = RECORD_HEAD.size
FOOTER_BYTES = HEAD_BYTES + 20
CHUNK_HEAD = struct.Struct('<QQQII')
"""First and last receive time, size, checksum, and length of the name of the compression."""
COMPRESSIONS = ('', 'lz4', 'zstd')
INDEX_HEAD = struct.Struct('<QQQQI')
"""
Of a chunk: first and last receive time, first byte, length, and length of its message offsets.

Parsed here: the library takes 40 us for a chunk, 0.25 s for a recording of 10 GB.

"""
MESSAGE_OFFSET = struct.Struct('<HQ')
"""Id of a channel, and where the index of its messages in a chunk is."""
SUMMARY_RECORDS: dict[int, Callable[[ReadDataStream], records.McapRecord]] = {
    Opcode.SCHEMA: records.Schema.read,
    Opcode.CHANNEL: records.Channel.read,
    Opcode.STATISTICS: records.Statistics.read,
    Opcode.ATTACHMENT_INDEX: records.AttachmentIndex.read,
    Opcode.METADATA_INDEX: records.MetadataIndex.read,
}
"""How the records of the summary are parsed that are used, beside the chunk indexes."""
DEFINITIONS: dict[int, Any] = {Opcode.SCHEMA: records.Schema, Opcode.CHANNEL: records.Channel}
GROUP_BYTES = 2**22
"""Messages outside of chunks are grouped to chunks of this size [bytes], as writers do."""
SEARCH_BYTES = 2**20
SCHEMA_FORMATS = {
    'ros2msg': MessageDefinitionFormat.MSG,
    'ros1msg': MessageDefinitionFormat.MSG,
    'ros2idl': MessageDefinitionFormat.IDL,
    'omgidl': MessageDefinitionFormat.IDL,
}

_T = TypeVar('_T')


class _Place(NamedTuple):
    """A record in the file, without its content."""

    opcode: int
    first_byte: int
    end_byte: int


class McapFile(ChunkedFile):
    """
    An open MCAP file; see `ChunkedFile`.

    Attributes
    ----------
    is_indexed : bool
        False if the whole file had to be scanned.

    Raises
    ------
    RecordingError
        If there is no message in it, and it is not a whole MCAP file.

    """

    def __init__(self, path: Path, origin: Path | None = None) -> None:
        self._schemas: dict[int, records.Schema] = {}
        self.is_indexed = True
        self._channels: dict[int, records.Channel] = {}
        self._extras: list[_Place] = []
        super().__init__(path, origin)

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
        for place in self._extras:
            try:
                kind = (
                    records.Attachment if place.opcode == Opcode.ATTACHMENT else records.Metadata
                )
                yield self._parsed(kind.read, place)
            except Exception as error:  # of the library, for any malformed content
                reason = f'damaged attachment or metadata ({one_line(error)})'
                self._note(reason, place.first_byte, place.end_byte)

    def _open(self) -> None:
        counts = self._read_index()
        if counts is None:
            self.is_indexed = False
            counts = self._scan()
        for number, channel in sorted(self._channels.items()):
            self.connections.append(self._connection(channel, counts.get(number, 0)))

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

    # Index ------------------------------------------------------------------------------------

    def _read_index(self) -> dict[int, int] | None:
        """
        Read the summary at the end of the file.

        Returns
        -------
        counts : dict of int, or None
            Number of messages by channel; None where the summary is missing, damaged, or does
            not list all chunks and channels.

        """
        try:
            found, chunks = self._summary_records()
            statistics = next(r for r in found if isinstance(r, records.Statistics))
        except Exception:  # of the library, for any malformed content; the scan reports it
            return None
        for record in found:
            self._add_definition(record)
        is_complete = (
            len(self._channels) == statistics.channel_count
            and len(chunks) == statistics.chunk_count
            and (chunks or not statistics.message_count)
            and all(_is_within(chunk, self.size) for chunk in chunks)
        )
        if not is_complete:
            return None
        counts: dict[int, int] = statistics.channel_message_counts
        any_channel = dict.fromkeys(counts, 1)  # of a chunk without an index of its messages
        self._chunks = [
            chunk if chunk.counts else chunk._replace(counts=any_channel)
            for chunk in chunks
            if chunk.counts or chunk.last_ns
        ]
        self._extras = [
            _Place(
                Opcode.ATTACHMENT if isinstance(r, records.AttachmentIndex) else Opcode.METADATA,
                r.offset,
                r.offset + r.length,
            )
            for r in found
            if isinstance(r, records.AttachmentIndex | records.MetadataIndex)
        ]
        return counts

    def _summary_records(self) -> tuple[list[records.McapRecord], list[Chunk]]:
        """Return the records of the summary that are used, and the chunks that it lists."""
        footer_byte = self.size - FOOTER_BYTES - len(MCAP_MAGIC)
        end = self._bytes(footer_byte, self.size)
        if self._bytes(0, len(MCAP_MAGIC)) != MCAP_MAGIC or end[FOOTER_BYTES:] != MCAP_MAGIC:
            raise RecordingError('expected the magic bytes of MCAP at begin and end')
        footer = records.Footer.read(ReadDataStream(BytesIO(end[HEAD_BYTES:])))
        summary = self._bytes(footer.summary_start, footer_byte)
        # The checksum covers the summary and the footer without the checksum itself.
        checksum = zlib.crc32(summary + end[: FOOTER_BYTES - 4])
        if footer.summary_crc not in (0, checksum):
            raise RecordingError('expected a summary of its checksum')
        found = []
        chunks = []
        for opcode, content in _split(summary):
            if opcode == Opcode.CHUNK_INDEX:
                chunks.append(_indexed_chunk(content))
            elif opcode in SUMMARY_RECORDS:
                found.append(SUMMARY_RECORDS[opcode](ReadDataStream(BytesIO(content))))
        return found, chunks

    # Scan -------------------------------------------------------------------------------------

    def _scan(self) -> Counter[int]:
        """Find all chunks without the index; return the number of messages by channel."""
        self._channels.clear()
        self._schemas.clear()
        has_end = False
        group: list[_Place] = []
        for place in self._places():
            if place.opcode == Opcode.MESSAGE:
                group.append(place)
                if place.end_byte - group[0].first_byte < GROUP_BYTES:
                    continue
            self._add_chunk(group)
            group = []
            if place.opcode == Opcode.CHUNK:
                self._add_chunk([place])
            elif place.opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                kind = records.Schema if place.opcode == Opcode.SCHEMA else records.Channel
                self._add_definition(self._parsed_or_noted(kind.read, place))
            elif place.opcode in (Opcode.ATTACHMENT, Opcode.METADATA):
                self._extras.append(place)
            has_end = has_end or place.opcode == Opcode.DATA_END
        self._add_chunk(group)
        if not has_end:
            if not self._chunks:
                raise RecordingError(
                    f'{self.name}: no message can be read; expected an MCAP file, got '
                    f'{self.size} bytes without a whole chunk; copy or record it again'
                )
            self._note('the recording was interrupted: no end of data', self.size, self.size)
        self._locate_damages()
        return self._count_messages()

    def _places(self) -> Iterator[_Place]:
        """Yield the records up to the end of the data; skip and note what is no record."""
        first_byte = len(MCAP_MAGIC)
        while first_byte < self.size:
            place = self._place_at(first_byte)
            if place is None:
                following = self._next_chunk(first_byte + 1)
                self._note('no record', first_byte, following)
                first_byte = following
                continue
            yield place
            if place.opcode == Opcode.DATA_END:
                return
            first_byte = place.end_byte

    def _place_at(self, first_byte: int) -> _Place | None:
        """Return the record at a position; None where there can be none."""
        head = self._bytes(first_byte, first_byte + HEAD_BYTES)
        if len(head) < HEAD_BYTES:
            return None
        opcode, length = RECORD_HEAD.unpack(head)
        end_byte = first_byte + HEAD_BYTES + length
        # Codes from 128 are for the extensions of others.
        is_known = Opcode.HEADER <= opcode <= Opcode.DATA_END or opcode >= 128
        return _Place(opcode, first_byte, end_byte) if is_known and end_byte <= self.size else None

    def _next_chunk(self, position: int) -> int:
        """Return where the next whole chunk begins; the end of the file without."""
        while position < self.size:
            block = self._bytes(position, position + SEARCH_BYTES)
            found = block.find(Opcode.CHUNK)
            while found >= 0:
                place = self._place_at(position + found)
                if place is not None and self._chunk_times(place) is not None:
                    return position + found
                found = block.find(Opcode.CHUNK, found + 1)
            position += len(block)
        return self.size

    def _chunk_times(self, place: _Place) -> tuple[int, int] | None:
        """Return first and last receive time of a chunk [ns]; None if it is no chunk."""
        first_byte = place.first_byte + HEAD_BYTES
        head = self._bytes(first_byte, first_byte + CHUNK_HEAD.size + 16)
        if len(head) < CHUNK_HEAD.size + 8:
            return None
        start_ns, last_ns, size, _, length = CHUNK_HEAD.unpack_from(head)
        name_end = CHUNK_HEAD.size + length
        if length > 4 or head[CHUNK_HEAD.size : name_end].decode('latin1') not in COMPRESSIONS:
            return None
        (stored,) = struct.unpack_from('<Q', head, name_end)
        is_whole = first_byte + name_end + 8 + stored == place.end_byte
        if not is_whole or start_ns > last_ns or size > MAX_CHUNK_BYTES:
            return None
        return start_ns, last_ns

    def _add_chunk(self, places: list[_Place]) -> None:
        """Add a chunk, or messages outside of chunks as one, and the definitions in it."""
        if not places:
            return
        is_chunk = places[0].opcode == Opcode.CHUNK
        start_ns, last_ns = (is_chunk and self._chunk_times(places[0])) or (0, 0)
        chunk = Chunk(places[0].first_byte, places[-1].end_byte, start_ns, last_ns, {}, is_chunk)
        messages = self._messages_of(chunk)
        if messages:
            times = [message.received_ns for message in messages]
            counts = Counter(message.connection_id for message in messages)
            self._chunks.append(
                chunk._replace(start_ns=min(times), last_ns=max(times), counts=counts)
            )

    def _parsed_or_noted(self, read: Callable[[ReadDataStream], _T], place: _Place) -> _T | None:
        try:
            return self._parsed(read, place)
        except Exception as error:  # of the library, for any malformed content
            reason = f'damaged record ({one_line(error)})'
            self._note(reason, place.first_byte, place.end_byte)
            return None

    # Content ----------------------------------------------------------------------------------

    def _parsed(self, read: Callable[[ReadDataStream], _T], place: _Place) -> _T:
        """Return the record at a place."""
        content = self._bytes(place.first_byte + HEAD_BYTES, place.end_byte)
        return read(ReadDataStream(BytesIO(content)))

    def _add_definition(self, record: object) -> None:
        if isinstance(record, records.Schema):
            self._schemas[record.id] = record
        elif isinstance(record, records.Channel):
            self._channels.setdefault(record.id, record)

    def _unpack(self, chunk: Chunk) -> list[StoredMessage]:
        content = memoryview(_content(self._chunk_record(chunk)))
        stream = _stream_of(content)
        found = []
        while stream.count < len(content):
            opcode, length = stream.read1(), stream.read8()
            if opcode == Opcode.MESSAGE:
                record = records.Message.read(stream, length)
                found.append(
                    StoredMessage(
                        record.channel_id, record.log_time, record.data,
                        record.publish_time, record.sequence,
                    )
                )  # fmt: skip
                continue
            body = stream.read(length)
            if opcode in DEFINITIONS and not self.is_indexed:
                self._add_definition(DEFINITIONS[opcode].read(ReadDataStream(BytesIO(body))))
        return found

    def _chunk_record(self, chunk: Chunk) -> records.Chunk:
        """Return a chunk as it is stored; RecordingError if its sizes are wrong."""
        data = self._bytes(chunk.first_byte, chunk.end_byte)
        size = chunk.end_byte - chunk.first_byte
        if not chunk.is_compressible:
            return records.Chunk('', data, chunk.last_ns, chunk.start_ns, 0, size)
        if data[:1] != bytes([Opcode.CHUNK]):
            raise RecordingError('no chunk at the place that the index names')
        view = memoryview(data)[HEAD_BYTES:]
        record: records.Chunk = records.Chunk.read(_stream_of(view))
        if record.compression == 'zstd':
            size = zstandard.frame_content_size(record.data)
            if size not in (-1, record.uncompressed_size):
                raise RecordingError(f'{size} bytes in a chunk of {record.uncompressed_size}')
        if record.uncompressed_size > MAX_CHUNK_BYTES:
            raise RecordingError(f'size of {record.uncompressed_size} bytes')
        return record


def _split(summary: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield operation code and content of the records in a summary."""
    first_byte = 0
    while first_byte < len(summary):
        opcode, length = RECORD_HEAD.unpack_from(summary, first_byte)
        first_byte += HEAD_BYTES
        yield opcode, summary[first_byte : first_byte + length]
        first_byte += length


def _indexed_chunk(content: bytes) -> Chunk:
    """Return the chunk of a chunk index; without counts if its messages have no index."""
    start_ns, last_ns, first_byte, length, offsets_size = INDEX_HEAD.unpack_from(content)
    offsets = content[INDEX_HEAD.size : INDEX_HEAD.size + offsets_size]
    counts = {channel: 1 for channel, _ in MESSAGE_OFFSET.iter_unpack(offsets)}
    return Chunk(first_byte, first_byte + length, start_ns, last_ns, counts)


class _Views:
    """A file in memory whose parts are read as views, not as copies."""

    def __init__(self, content: memoryview) -> None:
        self._content = content
        self._position = 0

    def read(self, length: int) -> memoryview:
        """Return the next bytes; fewer at the end."""
        begin = self._position
        self._position = begin + length
        return self._content[begin : self._position]


def _stream_of(content: memoryview) -> ReadDataStream:
    """Return the stream that the records of the library are read from."""
    return ReadDataStream(cast(IO[bytes], _Views(content)))


def _content(chunk: records.Chunk) -> Bytes:
    """Return the content of a chunk; RecordingError if it is damaged or cannot be unpacked."""
    content: Bytes = chunk.data
    if chunk.compression == 'zstd':
        content = zstandard.decompress(content, chunk.uncompressed_size)
    elif chunk.compression == 'lz4':
        content = decompress_lz4(content)
    elif chunk.compression:
        names = ', '.join(map(repr, COMPRESSIONS))
        raise RecordingError(f'compression: expected one of {names}, got {chunk.compression!r}')
    if chunk.uncompressed_crc and zlib.crc32(content) != chunk.uncompressed_crc:
        raise RecordingError('its content is not that of its checksum')
    return content


def _is_within(chunk: Chunk, size: int) -> bool:
    """Return whether a chunk index names a place inside of a file of `size` [bytes]."""
    return chunk.first_byte + HEAD_BYTES <= chunk.end_byte <= size
