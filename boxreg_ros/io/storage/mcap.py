"""
MCAP files: read by their index, or scanned record by record where the index is missing or damaged.

The mcap library parses the summary, definitions, attachments and metadata. Its readers stop at the
first error, and unpack what a chunk holds and not what it claims. Here a damaged chunk is left out
and noted, and after a damaged record the next plausible chunk is searched for.

"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from io import BytesIO
from itertools import pairwise
from pathlib import Path
import re
import struct
from typing import Any, NamedTuple
import zlib

from boxreg_ros.errors import RecordingError, TransferError
from boxreg_ros.io.storage import chunks
from boxreg_ros.io.storage.chunks import Chunk, RecordPlace, StoredMessage
from boxreg_ros.io.storage.record import Definition, one_line
from lz4.frame import LZ4FrameDecompressor
from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.stream_reader import StreamReader
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
STORED_BYTES = struct.Struct('<Q')
"""Number of compressed bytes, behind the name of the compression."""
MESSAGE_HEAD = struct.Struct('<HIQQ')
"""Channel, sequence, receive and publish time."""
COMPRESSIONS = ('', 'lz4', 'zstd')
CHUNK_BEGIN = re.compile(rb'\x06.{4}\0{4}.{28}(?:\0{4}|\x03\0{3}lz4|\x04\0{3}zstd)', re.DOTALL)
"""Begin of a chunk of less than 4 GB with one of these compressions."""
CHUNK_BEGIN_BYTES = HEAD_BYTES + CHUNK_HEAD.size + 4
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


class _ChunkHead(NamedTuple):
    """What a chunk claims about itself."""

    start_ns: int
    last_ns: int
    """Receive time of its last message, as `start_ns` of the first [ns]."""
    size: int
    checksum: int
    """Of its content, as `size`."""
    compression: str
    """One of `COMPRESSIONS`."""
    begin: int
    """Of the compressed bytes in the record."""
    stored: int
    """Number of the compressed bytes."""


class McapFile(chunks.ChunkedFile):
    """
    An open MCAP file; see `ChunkedFile`. It `is_indexed` unless the whole file had to be scanned.

    Raises RecordingError if there is no message in it, and it is not a whole MCAP file.

    """

    def __init__(self, path: Path, origin: Path | None = None) -> None:
        self._schemas: dict[int, records.Schema] = {}
        self.is_indexed = True
        self._channels: dict[int, records.Channel] = {}
        self._extras: list[RecordPlace] = []
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

    @property
    def compression(self) -> str:
        """Return the compression of the first chunk, one of `COMPRESSIONS`; '' without chunks."""
        if not self._chunks:
            return ''
        chunk = self._chunks[0]
        head = self._chunk_head_at(RecordPlace(Opcode.CHUNK, chunk.first_byte, chunk.end_byte))
        return '' if head is None else head.compression

    def extras(self) -> Iterator[records.Attachment | records.Metadata]:
        """Yield the attachments and the metadata; damaged ones are noted and left out."""
        for place in self._extras:
            kind = records.Attachment if place.kind == Opcode.ATTACHMENT else records.Metadata
            record = self._parsed(kind, place)
            if record is not None:
                yield record

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
        Read the summary at the end of the file; return the number of messages by channel.

        None where the summary is missing, damaged, or does not list all chunks and channels.

        """
        try:
            found = self._summary_records()
            statistics = next(r for r in found if isinstance(r, records.Statistics))
        except TransferError:
            raise
        except Exception:  # of the library, for any malformed content; the scan reports it
            return None
        for record in found:
            self._add_definition(record)
        listed = [_indexed_chunk(r) for r in found if isinstance(r, records.ChunkIndex)]
        is_complete = (
            len(self._channels) == statistics.channel_count
            and len(listed) == statistics.chunk_count
            and (listed or not statistics.message_count)
            and _are_apart(listed, self.size)
        )
        if not is_complete:
            return None
        counts: dict[int, int] = statistics.channel_message_counts
        any_channel = dict.fromkeys(counts, 1)  # of a chunk without an index of its messages
        self._chunks = [
            chunk if chunk.counts else chunk._replace(counts=any_channel)
            for chunk in listed
            if chunk.counts or chunk.last_ns
        ]
        self._extras = [
            RecordPlace(
                Opcode.ATTACHMENT if isinstance(r, records.AttachmentIndex) else Opcode.METADATA,
                r.offset,
                r.offset + r.length,
            )
            for r in found
            if isinstance(r, records.AttachmentIndex | records.MetadataIndex)
        ]
        return counts

    def _summary_records(self) -> list[records.McapRecord]:
        """Return the records of the summary; the library checks no checksum of theirs."""
        footer_byte = self.size - FOOTER_BYTES - len(MCAP_MAGIC)
        end = self._bytes(footer_byte, self.size)
        if self._bytes(0, len(MCAP_MAGIC)) != MCAP_MAGIC or end[FOOTER_BYTES:] != MCAP_MAGIC:
            raise RecordingError('expected the magic bytes of MCAP at begin and end')
        footer = _read(records.Footer.read, end[HEAD_BYTES:])
        summary = self._bytes(footer.summary_start, footer_byte)
        # The checksum covers the summary and the footer without the checksum itself.
        checksum = zlib.crc32(summary + end[: FOOTER_BYTES - 4])
        if footer.summary_crc not in (0, checksum):
            raise RecordingError('expected a summary of its checksum')
        reader = StreamReader(BytesIO(summary + end), skip_magic=True, emit_chunks=True)
        return list(reader.records)

    # Scan -------------------------------------------------------------------------------------

    def _scan(self) -> Counter[int]:
        """Find all chunks without the index; return the number of messages by channel."""
        self._channels.clear()
        self._schemas.clear()
        has_end = False
        group: list[RecordPlace] = []
        for place in self._places(len(MCAP_MAGIC)):
            if place.kind == Opcode.MESSAGE:
                group.append(place)
                if place.end_byte - group[0].first_byte < GROUP_BYTES:
                    continue
            self._add_chunk(group)
            group = []
            if place.kind == Opcode.CHUNK:
                self._add_chunk([place])
            elif place.kind in (Opcode.SCHEMA, Opcode.CHANNEL):
                self._add_definition(self._parsed(DEFINITIONS[place.kind], place))
            elif place.kind in (Opcode.ATTACHMENT, Opcode.METADATA):
                self._extras.append(place)
            elif place.kind == Opcode.DATA_END:
                has_end = True
                break
        self._add_chunk(group)
        if not has_end:
            if not self._chunks:
                raise self._no_chunk('an MCAP file')
            self._note('the recording was interrupted: no end of data', self.size, self.size)
        self._locate_damages()
        return self._count_messages()

    def _place_at(self, first_byte: int) -> RecordPlace | None:
        """Return the record at a position; None where there can be none."""
        head = self._bytes(first_byte, first_byte + HEAD_BYTES)
        if len(head) < HEAD_BYTES:
            return None
        opcode, length = RECORD_HEAD.unpack(head)
        end_byte = first_byte + HEAD_BYTES + length
        # Codes from 128 are for the extensions of others.
        is_known = Opcode.HEADER <= opcode <= Opcode.DATA_END or opcode >= 128
        return (
            RecordPlace(opcode, first_byte, end_byte)
            if is_known and end_byte <= self.size
            else None
        )

    def _next_chunk(self, position: int) -> int:
        """Return where the next whole chunk begins; the end of the file without."""
        while position < self.size:
            # Chunks that begin in this block, one behind the other or within a damaged one.
            block = self._bytes(position, position + SEARCH_BYTES + CHUNK_BEGIN_BYTES + 4)
            found = CHUNK_BEGIN.search(block)
            while found is not None and found.start() < SEARCH_BYTES:
                place = self._place_at(position + found.start())
                if place is not None and self._chunk_head_at(place) is not None:
                    return place.first_byte
                found = CHUNK_BEGIN.search(block, found.start() + 1)
            position += SEARCH_BYTES
        return self.size

    def _chunk_head_at(self, place: RecordPlace) -> _ChunkHead | None:
        """Return the head of a chunk; None if it is no chunk."""
        record = self._bytes(place.first_byte, place.first_byte + CHUNK_BEGIN_BYTES + 16)
        size = place.end_byte - place.first_byte
        try:
            head = _chunk_head(record, size)
        except (struct.error, RecordingError):
            return None
        is_whole = head.begin + head.stored == size and head.start_ns <= head.last_ns
        return head if is_whole else None

    def _add_chunk(self, places: list[RecordPlace]) -> None:
        """Add a chunk, or messages outside of chunks as one, and the definitions in it."""
        if not places:
            return
        is_chunk = places[0].kind == Opcode.CHUNK
        head = self._chunk_head_at(places[0]) if is_chunk else None
        times_ns = (head.start_ns, head.last_ns) if head else (0, 0)
        self._add(Chunk(places[0].first_byte, places[-1].end_byte, *times_ns, {}, is_chunk))

    # Content ----------------------------------------------------------------------------------

    def _parsed(self, kind: Any, place: RecordPlace) -> Any:
        """Return the record of a class of `records` at a place; None, and noted, if damaged."""
        content = self._bytes(place.first_byte + HEAD_BYTES, place.end_byte)
        try:
            return _read(kind.read, content)
        except Exception as error:  # of the library, for any malformed content
            reason = f'damaged {kind.__name__.lower()} ({one_line(error)})'
            self._note(reason, place.first_byte, place.end_byte)
            return None

    def _add_definition(self, record: object) -> None:
        if isinstance(record, records.Schema):
            self._schemas[record.id] = record
        elif isinstance(record, records.Channel):
            self._channels.setdefault(record.id, record)

    def _unpack(self, chunk: Chunk, stored: bytes) -> list[StoredMessage]:
        content = memoryview(_content(stored) if chunk.is_compressible else stored)
        found = []
        for opcode, begin, end in _places_in(content):
            if opcode == Opcode.MESSAGE:
                if begin + MESSAGE_HEAD.size > end:
                    raise RecordingError(f'a message of {end - begin} bytes')
                channel, sequence, received_ns, published_ns = MESSAGE_HEAD.unpack_from(
                    content, begin
                )
                data = content[begin + MESSAGE_HEAD.size : end]
                found.append(StoredMessage(channel, received_ns, data, published_ns, sequence))
            elif opcode in DEFINITIONS and not self.is_indexed:
                self._add_definition(_read(DEFINITIONS[opcode].read, content[begin:end]))
        return found


def _places_in(content: memoryview) -> list[tuple[int, int, int]]:
    """Return operation code, begin and end of the records in a chunk."""
    places: list[tuple[int, int, int]] = []
    begin = 0
    while begin < len(content):
        opcode, length = RECORD_HEAD.unpack_from(content, begin)
        begin += HEAD_BYTES
        end = begin + length
        if not opcode or end > len(content):
            raise RecordingError(f'no record: operation code {opcode}, {length} bytes')
        if len(places) == chunks.MAX_RECORDS:
            raise RecordingError(f'more than {chunks.MAX_RECORDS} records')
        places.append((opcode, begin, end))
        begin = end
    return places


def _read(read: Callable[[ReadDataStream], Any], content: bytes | memoryview) -> Any:
    """Return a record that the library parses."""
    return read(ReadDataStream(BytesIO(content)))


def _indexed_chunk(index: records.ChunkIndex) -> Chunk:
    """Return the chunk of a chunk index; without counts if its messages have no index."""
    first_byte = index.chunk_start_offset
    times_ns = index.message_start_time, index.message_end_time
    counts = dict.fromkeys(index.message_index_offsets, 1)
    return Chunk(first_byte, first_byte + index.chunk_length, *times_ns, counts)


def _chunk_head(record: bytes, size: int) -> _ChunkHead:
    """Return the head of a chunk record of `size` bytes; RecordingError if it is none."""
    if record[:1] != bytes([Opcode.CHUNK]):
        raise RecordingError('no chunk at the place that the index names')
    start_ns, last_ns, content_size, checksum, length = CHUNK_HEAD.unpack_from(record, HEAD_BYTES)
    name_begin = HEAD_BYTES + CHUNK_HEAD.size
    compression = record[name_begin : name_begin + min(length, 16)].decode('latin1')
    if compression not in COMPRESSIONS:
        names = ', '.join(map(repr, COMPRESSIONS))
        raise RecordingError(f'compression: expected one of {names}, got {compression!r}')
    (stored,) = STORED_BYTES.unpack_from(record, name_begin + length)
    begin = name_begin + length + STORED_BYTES.size
    if begin + stored > size:
        raise RecordingError(f'{size} bytes of a chunk of {begin + stored}')
    if content_size > chunks.MAX_CHUNK_BYTES:
        raise RecordingError(f'size of {content_size} bytes')
    return _ChunkHead(start_ns, last_ns, content_size, checksum, compression, begin, stored)


def _content(record: bytes) -> bytes | memoryview:
    """Return the content of a chunk; RecordingError if it is not what the chunk claims."""
    head = _chunk_head(record, len(record))
    content: bytes | memoryview = memoryview(record)[head.begin : head.begin + head.stored]
    # Not a byte more than claimed is unpacked: a few bytes may be compressed from any number.
    if head.compression == 'zstd':
        claimed = zstandard.frame_content_size(content)
        if claimed not in (-1, head.size):
            raise RecordingError(f'{claimed} bytes in a chunk of {head.size}')
        content = zstandard.decompress(content, head.size)
    elif head.compression == 'lz4':
        content = LZ4FrameDecompressor().decompress(content, head.size + 1)
    if len(content) != head.size:
        raise RecordingError(f'{len(content)} bytes in a chunk of {head.size}')
    if head.checksum and zlib.crc32(content) != head.checksum:
        raise RecordingError('its content is not that of its checksum')
    return content


def _are_apart(listed: list[Chunk], size: int) -> bool:
    """Return whether chunk indexes name places in a file of `size` [bytes], each another one."""
    places = sorted((chunk.first_byte, chunk.end_byte) for chunk in listed)
    are_within = all(first + HEAD_BYTES <= end <= size for first, end in places)
    return are_within and all(before[1] <= behind[0] for before, behind in pairwise(places))
