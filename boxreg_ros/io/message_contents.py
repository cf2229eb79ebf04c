"""Clouds and boxes of the messages of a recording."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, cast

from boxreg_ros.errors import UnsupportedMessage
from boxreg_ros.io.definitions import fields_of, known_store
from boxreg_ros.io.items import Item
from boxreg_ros.io.joining import are_parts, JOIN_NS, joined, Repeats
from boxreg_ros.io.lidars import SensorPlacement
from boxreg_ros.io.message_decoder import malformed, MessageDecoder
from boxreg_ros.io.storage.files import encoding_of
from boxreg_ros.io.storage.reader import decompressed
from boxreg_ros.io.storage.record import Record
from boxreg_ros.structures import BoxArray, Floats, Sweep
from msg_adapters import Adapter, clouds, pointcloud
from msg_adapters.convention import Convention
from msg_adapters.serialized import BOX_FIELDS, BoxReader
from rosbags.interfaces import Connection
from rosbags.typesys.store import Typestore


@dataclass(eq=False, repr=False)
class MessageContents:
    """
    Read clouds and boxes of messages; box arrays of one stamp, received at once, are one array.

    A message that is equal to one received at the same time is read once. The adapter reads the
    messages on the topic of the boxes; there are none without it. `decoded_topics` are those with
    messages that could be read since `reset`.

    """

    _decoder: MessageDecoder
    _placement: SensorPlacement
    _boxes_topic: str
    _adapter: Adapter | None
    _convention: Convention

    def __post_init__(self) -> None:
        """Begin with no message."""
        self.decoded_topics: set[str] = set()
        self._joined: set[int] = set()  # records whose boxes are in an array before them, by id
        self._joins = 0
        self._repeats = Repeats()
        self._repeated: Counter[str] = Counter()  # by topic
        self._readers: dict[Typestore, BoxReader | None] = {}
        self._is_standard = self._convention.is_standard

    def reset(self) -> None:
        """Forget which topics could be read: the recording is read again."""
        self.decoded_topics.clear()
        self._repeats = Repeats()
        self._repeated.clear()

    @property
    def finding(self) -> str:
        """Return that messages were joined, or read once; empty if none were."""
        found = []
        if self._repeated:
            counts = ', '.join(f'{topic} {count}' for topic, count in self._repeated.items())
            found.append(
                f'messages that are in the recording twice, as where its files overlap in time, '
                f'are read once: {counts}'
            )
        if self._joins:
            found.append(
                f'{self._boxes_topic}: {self._joins} messages have the stamp of the one before '
                f'them and other boxes: they are read as one message per stamp'
            )
        return '; '.join(found)

    def item(self, record: Record, later: Iterable[Record], with_intensities: bool) -> Item | None:
        """
        Return the item of a message.

        Parameters
        ----------
        record : Record
            The message. Boxes are joined with those of the same stamp among the later ones.
        later : iterable of Record
            Those behind it, as far as they are known; those that were joined have no item of their
            own.
        with_intensities : bool
            Whether those of the points of a cloud are read.

        Returns
        -------
        item : Item or None
            Its sweep or boxes are in the frame of the message. None, and counted, if it cannot be
            decoded, is repeated, or was joined with one before.

        """
        topic = record.connection.topic
        if self._repeats.has(record.received_ns, topic, record.data):
            self._repeated[topic] += 1
            return None
        if id(record) in self._joined:
            self._joined.remove(id(record))
            return None
        intensities = None
        content: Sweep | BoxArray | None = None
        with self._decoder.counted(topic):
            if topic == self._boxes_topic:
                content = self._whole(self.boxes(record.connection, record.data), record, later)
            else:
                message = self._decoder.message(record)
                content = self.of(topic, message)
                intensities = self._intensities(topic, message) if with_intensities else None
        if content is None:
            return None
        self.decoded_topics.add(topic)
        return Item(record.received_ns, content, intensities)

    def boxes(self, connection: Connection, data: bytes) -> BoxArray:
        """Return the boxes of a message; UnsupportedMessage if it is malformed."""
        reader = self._reader_of(connection)
        with malformed(f'topic {connection.topic!r}'):
            fields = None if reader is None else reader.ordinary(bytes(decompressed(data)))
            if reader is not None and fields is not None:
                boxes = reader.boxes_of(fields)
                return boxes if self._is_standard else self._convention.to_centers(boxes)
        return cast(BoxArray, self.of(connection.topic, self._decoder.decoded(connection, data)))

    def of(self, topic: str, message: Any) -> Sweep | BoxArray:
        """Return the sweep or the boxes of a message; UnsupportedMessage if it has none."""
        with malformed(f'topic {topic!r}'):
            if topic in self._placement.lidars.topics:
                return self._placement.sweep_of(message, topic)
            assert self._adapter is not None  # there is no other topic
            boxes: BoxArray = self._adapter.from_msg(message)
        return boxes

    def with_boxes(self, message: Any, boxes: BoxArray, covariances: Floats) -> Any:
        """Return a copy of a message of the boxes' topic with its boxes replaced."""
        assert self._adapter is not None  # it has read the message
        return self._adapter.to_msg(message, boxes, covariances)

    def _reader_of(self, connection: Connection) -> BoxReader | None:
        """Return what reads the boxes of serialised messages; None if only objects can be read."""
        store = self._decoder.store_of(connection)
        is_plain = encoding_of(connection) != 'ros1' and connection.msgtype in BOX_FIELDS
        if store is None or not is_plain:
            return None
        if store not in self._readers:
            found = None
            known = known_store([connection.msgtype])
            with suppress(UnsupportedMessage):  # an older definition, which the adapter reads
                found = BoxReader(connection.msgtype, fields_of(store))
            # Other types of its fields, as float32 for float64, would be read as wrong numbers.
            is_usual = found and found.reads_as(BoxReader(connection.msgtype, fields_of(known)))
            self._readers[store] = found if is_usual else None
        return self._readers[store]

    def _intensities(self, topic: str, message: Any) -> Floats | None:
        """Return the intensities of a cloud; None, and counted, where they cannot be read."""
        with self._decoder.counted(topic):
            return pointcloud.intensities(clouds.plain(message))
        return None

    def _whole(self, boxes: BoxArray, record: Record, later: Iterable[Record]) -> BoxArray:
        """Return the boxes of a message, and of those behind it that have others of its stamp."""
        read = [record.data]
        for other in later:
            if other.received_ns - record.received_ns > JOIN_NS:
                break
            if other.connection.topic != self._boxes_topic or other.data in read:
                continue
            try:
                more = self.boxes(other.connection, other.data)
            except UnsupportedMessage:
                continue  # counted in its turn
            if not are_parts(boxes, more):
                break
            boxes = joined(boxes, more)
            read.append(other.data)
            self._joined.add(id(other))
            self._joins += 1
        return boxes
