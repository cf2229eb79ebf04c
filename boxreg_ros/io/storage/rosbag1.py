"""ROS 1 bags: read by their index, or scanned where the index is missing or damaged."""

from __future__ import annotations

from bz2 import BZ2Decompressor
from collections.abc import Iterator
from io import BytesIO
from itertools import pairwise
import struct

from boxreg_ros.errors import RecordingError, TransferError
from boxreg_ros.io.storage import chunks
from boxreg_ros.io.storage.chunks import Chunk, RecordPlace, StoredMessage
from boxreg_ros.io.storage.record import one_line
from lz4.frame import LZ4FrameDecompressor
from rosbags.interfaces import (
    Connection,
    ConnectionExtRosbag1,
    MessageDefinition,
    MessageDefinitionFormat,
)
from rosbags.rosbag1 import Reader
from rosbags.rosbag1.reader import Header, normalize, RecordType
from rosbags.typesys.msg import normalize_msgtype

BAG_MAGIC = b'#ROSBAG V2.0\n'
CHUNK_MARK = b'op=\x05'
"""The field of a record's header that marks a chunk."""
MAX_HEAD_BYTES = 128
"""The header of a chunk has three short fields; a mark is this far behind its begin at most."""
MAX_HEADER_BYTES = 2**20
"""Headers of connections have a topic, those of other records a few numbers."""
SEARCH_BYTES = 2**20


class Rosbag1File(chunks.ChunkedFile):
    """An open ROS 1 bag; see `ChunkedFile`. Raises RecordingError if it has no whole chunk."""

    def _open(self) -> None:
        if self._bytes(0, len(BAG_MAGIC)) != BAG_MAGIC:
            raise RecordingError(
                f'{self.name}: expected a ROS 1 bag of version 2.0, got another file; correct the '
                f'suffix of its name, or give a bag'
            )
        if not self._read_index():
            self._scan()

    def _read_index(self) -> bool:
        """Read the index; return False if it is missing or damaged."""
        reader = Reader(self._path)
        try:
            reader.open()
        except Exception:  # of the library, for any malformed content; the scan reports it
            return False
        places = sorted(info.pos for info in reader.chunk_infos)
        ends = dict(pairwise([*places, self.size]))
        if len(ends) < len(places):  # entries of the index name the same chunk
            reader.close()
            return False
        self._chunks = [
            Chunk(i.pos, ends[i.pos], i.start_time, i.end_time - 1, i.connection_counts)
            for i in reader.chunk_infos
        ]
        self.connections = [c._replace(owner=self) for c in reader.connections]
        reader.close()
        return True

    def _scan(self) -> None:
        """Find all chunks and connections without the index."""
        self._found: dict[int, Connection] = {}
        for place in self._places(len(BAG_MAGIC)):
            if place.kind == RecordType.CHUNK:
                self._add(Chunk(place.first_byte, place.end_byte, 0, 0, {}))
        if not self._chunks:
            raise self._no_chunk('a ROS 1 bag')
        self._locate_damages()
        counts = self._count_messages()
        self.connections = [
            connection._replace(msgcount=counts[number])
            for number, connection in sorted(self._found.items())
        ]

    def _place_at(self, first_byte: int) -> RecordPlace | None:
        """Return the record at a position; None where there can be none."""
        try:
            (length,) = struct.unpack('<I', self._bytes(first_byte, first_byte + 4))
            data_byte = first_byte + 4 + length
            if data_byte > self.size or length > MAX_HEADER_BYTES:
                return None
            header = Header.read(BytesIO(self._bytes(first_byte, data_byte)))
            kind = header.get_uint8('op')
            (size,) = struct.unpack('<I', self._bytes(data_byte, data_byte + 4))
        except TransferError:
            raise
        except Exception:  # of the library, for any malformed content
            return None
        end_byte = data_byte + 4 + size
        return RecordPlace(kind, first_byte, end_byte) if end_byte <= self.size else None

    def _next_chunk(self, position: int) -> int:
        """Return where the next whole chunk begins; the end of the file without."""
        while position < self.size:
            block = self._bytes(position, position + SEARCH_BYTES)
            found = block.find(CHUNK_MARK)
            while found >= 0:
                for begin in range(max(0, found - MAX_HEAD_BYTES), found):
                    # The length of the header, which ends behind the mark.
                    (length,) = struct.unpack_from('<I', block, begin)
                    if found - begin <= length <= MAX_HEAD_BYTES:
                        place = self._place_at(position + begin)
                        if place is not None and place.kind == RecordType.CHUNK:
                            return position + begin
                found = block.find(CHUNK_MARK, found + 1)
            # A mark may lie across the blocks, and its header before it.
            position += max(len(block) - MAX_HEAD_BYTES, 1)
        return self.size

    def _unpack(self, chunk: Chunk, stored: bytes) -> list[StoredMessage]:
        stream = BytesIO(stored)
        head = Header.read(stream, RecordType.CHUNK)
        data = _sized(stream)
        size = head.get_uint32('size')
        if size > chunks.MAX_CHUNK_BYTES:
            raise RecordingError(f'size of {size} bytes')
        content = _decompressed(data, head.get_string('compression'), size)
        if len(content) != size:
            raise RecordingError(f'expected {size} bytes, got {len(content)}')
        return list(self._stored_messages(BytesIO(content), size))

    def _stored_messages(self, stream: BytesIO, size: int) -> Iterator[StoredMessage]:
        for _ in range(chunks.MAX_RECORDS):
            if stream.tell() >= size:
                return
            header = Header.read(stream)
            data = _sized(stream)
            operation = header.get_uint8('op')
            if operation == RecordType.MSGDATA:
                time_ns = header.get_time('time')
                yield StoredMessage(header.get_uint32('conn'), time_ns, data, time_ns, 0)
            elif operation == RecordType.CONNECTION and not self.connections:
                connection = self._connection(header, Header.read(_with_length(data)))
                self._found.setdefault(connection.id, connection)
        raise RecordingError(f'more than {chunks.MAX_RECORDS} records')

    def _connection(self, header: Header, about: Header) -> Connection:
        latching = about.get_string('latching') if 'latching' in about else ''
        return Connection(
            header.get_uint32('conn'),
            normalize(header.get_string('topic')),
            normalize_msgtype(about.get_string('type')),
            MessageDefinition(MessageDefinitionFormat.MSG, about.get_string('message_definition')),
            about.get_string('md5sum'),
            0,
            ConnectionExtRosbag1(
                about.get_string('callerid') if 'callerid' in about else None,
                int(latching) if latching else None,
            ),
            self,
        )


def _sized(stream: BytesIO) -> bytes:
    """Return bytes that follow their number."""
    (size,) = struct.unpack('<I', stream.read(4))
    data = stream.read(size)
    if len(data) != size:
        raise RecordingError(f'expected {size} bytes, got {len(data)}')
    return data


def _with_length(data: bytes) -> BytesIO:
    """Return the header that the data of a connection record consists of, as one to read."""
    return BytesIO(struct.pack('<I', len(data)) + data)


def _decompressed(data: bytes, compression: str, size: int) -> bytes:
    """Return the content of a chunk, at most `size` bytes."""
    if compression == 'none':
        return data
    if compression == 'bz2':
        return BZ2Decompressor().decompress(data, size)
    if compression == 'lz4':
        return bytes(LZ4FrameDecompressor().decompress(data, size))
    raise RecordingError(f'compression {one_line(ValueError(compression))!r} is not known')
