"""
Recordings: MCAP, rosbag2 (sqlite3 and mcap) and ROS 1 bags as one ordered stream.

Message definitions are read from the recording, so ROS need not be installed.

"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast, Self

from boxreg_ros.errors import RecordingError, UnsupportedMessage
from boxreg_ros.io.definitions import known_store
from boxreg_ros.io.foxglove import encoded
from boxreg_ros.io.images import RecordedImages
from boxreg_ros.io.items import EVERYTHING, Item, LOOKAHEAD_NS, requested_part, Wanted
from boxreg_ros.io.lidars import Lidars, SensorPlacement, SINGLE_LIDAR
from boxreg_ros.io.message_contents import MessageContents
from boxreg_ros.io.message_decoder import malformed, MessageDecoder
from boxreg_ros.io.recorded_motion import RecordedMotion
from boxreg_ros.io.resync import MessageOrder
from boxreg_ros.io.storage.files import part_of
from boxreg_ros.io.storage.reader import Reader
from boxreg_ros.io.storage.record import Damage, Record
from boxreg_ros.io.topics import ODOMETRY_TYPE, Topics
from boxreg_ros.io.transform_tree import TransformTree
from boxreg_ros.structures import BoxArray, Floats
from msg_adapters import adapter_for, clouds, poses
from msg_adapters.convention import Convention, STANDARD
from rosbags.interfaces import Connection
from rosbags.typesys.store import Typestore


@dataclass(eq=False, repr=False)
class Recording:
    """
    One or several recordings of one drive, merged by receive time.

    MCAP files, rosbag2 folders, ``.db3`` files, or ROS 1 bags. Receive times only order the stream
    and select the part from `start` to `end` [s]; stamps are those of the message headers. Topics
    that were recorded apart from the clouds are merged by stamp, see `MessageOrder`. Topics that
    are not named are found by type, if only one has it. Use as a context manager; a copy can be
    opened again.

    Attributes are those of `ItemSource`; also the `files`, all `topics` with their types,
    `points_topics`, `data_topics` of clouds and boxes, whether messages are encoded as by ROS 2
    (`is2`), and `part_ns`: begin and end that were asked for, in receive time [ns], None where
    not; and the `decoder` and the order (`timeline`) of its messages.

    Raises RecordingError on entering, if a file or topic cannot be read or found; the message
    lists the topics.

    """

    has_boxes = True

    paths: Sequence[Path]
    lidars: Lidars = SINGLE_LIDAR
    boxes: str | None = None
    odometry: str | None = None
    start: float | None = None
    """Of the part that is read, from the beginning [s]; so is `end`."""
    end: float | None = None
    convention: Convention = STANDARD
    tf: Sequence[str] = ()
    clock_offset: float = 0.0
    """Added to the stamps of motion [s]."""

    def __post_init__(self) -> None:
        """Begin without files."""
        self.paths = [Path(path) for path in self.paths]
        self._sensor_frame = ''  # once it is chosen
        self.outside = 0
        self.left_out: Counter[str] = Counter()
        self.label_notes: list[str] = []

    def __enter__(self) -> Self:
        """Open all files and find the topics."""
        parts = [part_of(path) for path in self.paths]
        self.files = [file for part in parts for file in part.files]
        self._reader = Reader(parts)
        try:
            self._open()
        except BaseException:
            self._reader.close()
            raise
        return self

    def _open(self) -> None:
        """Find the topics, the definitions of their messages, the part to read, and its motion."""
        self._topics = topics = Topics(self._reader.connections, str(self))
        self.topics, self.is2 = topics.kinds, self._reader.is2
        lidars, self.points_topic = topics.find_lidars(self.lidars)
        self.placement = SensorPlacement(lidars)
        self.points_topics = lidars.topics
        self.boxes_topic = ''
        adapter = None
        if self.has_boxes:
            self.boxes_topic = topics.find_boxes(self.boxes, self.convention.associate)
            adapter = adapter_for(topics.kinds[self.boxes_topic], self.convention)
        if self.odometry:
            topics.find('odometry', 'odometry', (ODOMETRY_TYPE,), self.odometry)
        self.data_topics = {*self.points_topics, self.boxes_topic}
        self.decoder = MessageDecoder(str(self))
        self.unreadable, self.first_errors = self.decoder.unreadable, self.decoder.first_errors
        self._contents = MessageContents(
            self.decoder, self.placement, self.boxes_topic, adapter, self.convention
        )
        motion = topics.transforms | topics.of((ODOMETRY_TYPE,))
        chosen = map(self.choose_definition, topics.connections(self.data_topics | motion))
        self._chosen = list(filter(None, chosen))
        self.timeline = MessageOrder(self._reader, self.points_topic, self._stamp_of)
        span_ns = self.timeline.span_ns(self.data_topics | motion - topics.static_transforms)
        part_ns = requested_part(str(self), *span_ns, self.start, self.end)
        self.start_ns, self.end_ns = part_ns
        self._motion = RecordedMotion(
            topics, self.decoder, self._read, part_ns, self.odometry, self.points_topics,
            self.tf,
        )  # fmt: skip

    @property
    def part_ns(self) -> tuple[int | None, int | None]:
        """Return begin and end that were asked for, in receive time [ns]; None where not."""
        begin = self.start_ns if self.start else None
        return begin, None if self.end is None else self.end_ns

    def __exit__(self, *_: object) -> None:
        """Close all files."""
        self._reader.close()

    def __str__(self) -> str:
        """Return the paths."""
        return ', '.join(map(str, self.paths))

    def items(self, tree: TransformTree, wanted: Wanted = EVERYTHING) -> Iterator[Item]:
        """
        Yield clouds and box arrays in the order they were received.

        Messages that cannot be decoded are counted in `unreadable` and left out.

        Parameters
        ----------
        tree : TransformTree
            As `choose_fixed_frame` has left it. At each item it holds the transforms received up
            to `LOOKAHEAD_NS` later; older ones are forgotten, so that memory does not grow with
            the recording.
        wanted : Wanted
            What is decoded, and how the time it takes is measured.

        Yields
        ------
        item : Item
            A sweep or a box array in the frame of its message [m, rad].

        Raises
        ------
        RecordingError
            If a file is damaged so that the rest of it cannot be read.

        """
        self.decoder.reset()
        self._contents.reset()
        topics = self.data_topics if wanted.clouds else {self.boxes_topic}
        waiting = deque[Record]()
        records = self._records(tree, topics, waiting)
        while True:
            with wanted.stage('read'):
                record = next(records, None)
            if record is None:
                return
            with wanted.stage('decode'):
                item = self._contents.item(record, waiting, wanted.intensities)
            if item is not None:
                yield item

    def choose_definition(self, connection: Connection) -> str:
        """Choose the definition of a connection, see `MessageDecoder.choose_definition`."""
        records = self._reader.messages([connection], None, None)
        return self.decoder.choose_definition(connection, records)

    def check_readable(self) -> None:
        """Raise UnsupportedMessage, after the last item, if no cloud or no boxes were readable."""
        for topic, first in self.first_errors.items():
            alike = self.points_topics if topic in self.points_topics else {topic}
            if topic in self.data_topics and self._contents.decoded_topics.isdisjoint(alike):
                raise UnsupportedMessage(f'no message on {topic!r} can be read; first: {first}')

    def box_message(self, connection: Connection, data: bytes) -> tuple[Any, BoxArray]:
        """Return a message of the boxes' topic, and its boxes; UnsupportedMessage if malformed."""
        message = self.decoder.decoded(connection, data)
        return message, cast(BoxArray, self._contents.of(self.boxes_topic, message))

    def with_boxes(
        self, connection: Connection, message: Any, boxes: BoxArray, covariances: Floats
    ) -> bytes:
        """
        Return the bytes of a message of the boxes' topic with its boxes replaced.

        Parameters
        ----------
        connection : Connection
            Of the topic of the boxes.
        message : message
            As `box_message` returns it; it is not modified.
        boxes : BoxArray
            As many boxes, in the order and the frame of the message [m, rad].
        covariances : array, shape (n, 6, 6)
            Of x y z roll pitch yaw [m, rad]; where one is NaN, that of the message remains.

        Returns
        -------
        bytes
            In the encoding of the connection.

        """
        replaced = self._contents.with_boxes(message, boxes, covariances)
        store = self.decoder.store_of(connection)
        if store is None:
            return encoded(replaced)
        return self._encoded(replaced, connection.msgtype, store)

    def encoded_cloud(self, message: Any) -> bytes:
        """Return the bytes of a PointCloud2 as the recording encodes its messages."""
        store = known_store((clouds.POINTS_TYPE,), not self.is2)
        return self._encoded(message, clouds.POINTS_TYPE, store)

    def _encoded(self, message: Any, kind: str, store: Typestore) -> bytes:
        return bytes((store.serialize_cdr if self.is2 else store.serialize_ros1)(message, kind))

    def store_of_type(self, kind: str) -> Typestore | None:
        """Return the definition of a type in the recording; None if no topic has it."""
        same = (c for c in self._reader.connections if c.msgtype == kind)
        return next(filter(None, map(self.decoder.store_of, same)), None)

    def images(self) -> RecordedImages:
        """Return the camera images."""
        return RecordedImages(self._topics, self._reader, self.decoder)

    @property
    def odometry_topic(self) -> str | None:
        """Return the topic of the odometry in use."""
        return self._motion.odometry_topic

    @property
    def apart(self) -> dict[str, float]:
        """Return the topics in use that were recorded apart, and how much later [s]."""
        used = self.data_topics | self._ahead_topics()
        return {topic: late for topic, late in self.timeline.apart.items() if topic in used}

    @property
    def finding(self) -> str:
        """Return what is unusual about the recordings as a whole; empty if nothing is."""
        own = (
            *self._chosen, self._contents.finding, *self._pauses(), *self._slow(),
            self.timeline.finding,
        )  # fmt: skip
        return '; '.join(filter(None, (*own, *self._motion.notes.values())))

    def _slow(self) -> Iterator[str]:
        """Yield that the boxes are taken for those of a slow detector."""
        late = self.timeline.as_slow.get(self.boxes_topic)
        if late is not None:
            total = late + self.convention.boxes_offset
            yield (
                f'{self.boxes_topic}: boxes have stamps of clouds that were received {late:.2f} s '
                f'before them: they are taken for those of a slow detector and used at their '
                f'stamps; if its clock is behind, correct them with --boxes-offset={total:.2f}'
            )

    def _pauses(self) -> Iterator[str]:
        """Yield that the recordings are not of one drive, if they are not."""
        parts = self.timeline.parts_ns
        if len(parts) == 1:
            return
        spans = ' and '.join(f'{begin * 1e-9:.3f} to {end * 1e-9:.3f} s' for begin, end in parts)
        yield (
            f'recordings: expected those of one drive, without pauses between them, got clouds '
            f'received at {spans}; tracks of the same id are one track: relabel drives one by one'
        )

    @property
    def damages(self) -> list[Damage]:
        """Return the parts of the files that could not be read so far."""
        return self._reader.damages

    def choose_fixed_frame(self, tree: TransformTree, fixed_frame: str | None = None) -> str:
        """
        Choose the source of the sensor's motion, and return the fixed frame.

        TF is used where it connects the frames, else odometry; odometry that was asked for comes
        before TF.

        Parameters
        ----------
        tree : TransformTree
            Empty before; then it holds the static and the first moving transforms.
        fixed_frame : str, optional
            Frame to refine in; default: the topmost frame that the frame of the clouds moves in.

        Returns
        -------
        fixed_frame : str
            The frame to refine in.

        Raises
        ------
        RecordingError
            If no motion is known, or no transforms connect `fixed_frame` with the clouds.

        """
        tree.clock_offset = self.clock_offset
        tree.prefers_odometry = self.odometry is not None
        first_error: RecordingError | None = None
        for frame in self._sensor_frames():  # the others go on where TF does not know one
            try:
                found = self._motion.choose_fixed_frame(tree, frame, fixed_frame)
            except RecordingError as error:
                first_error = first_error or error
                tree.clear()
            else:
                self._sensor_frame = frame
                return found
        assert first_error is not None  # there is a frame
        raise first_error

    def sensor_frame(self) -> str:
        """Return the frame of the first cloud, of the first LiDAR that TF or odometry moves."""
        return self._sensor_frame or self._sensor_frames()[0]

    def _sensor_frames(self) -> list[str]:
        """Return the frame of the first cloud of each topic that has any."""
        first = {topic: self._motion.first(topic) for topic in self.points_topics}
        frames = [
            self.placement.frame_of(cloud, topic)
            for topic, cloud in first.items()
            if cloud is not None
        ]
        if not frames:
            topics = ', '.join(map(repr, self.points_topics))
            raise RecordingError(
                f'{self}: expected point clouds on {topics} in this part, got none; choose '
                f'another with --start and --end'
            )
        return frames

    def _read(
        self, topics: Collection[str], start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[Record]:
        """Yield the messages on some topics in order."""
        return self.timeline.messages(self._topics.connections(topics), start_ns, end_ns)

    def _records(
        self, tree: TransformTree, topics: set[str], waiting: deque[Record]
    ) -> Iterator[Record]:
        """Yield the messages on `topics`, still encoded, while `tree` and `waiting` are ahead."""
        tree.rewind(0)  # motions that were read to choose a frame are read again
        ahead_topics = self._ahead_topics()
        begin, end = self.part_ns
        read_from = begin and begin - LOOKAHEAD_NS
        read_to = end and end + LOOKAHEAD_NS
        for record in self._read(topics | ahead_topics, read_from, read_to):
            # Those complete first: after a pause, this record resets the tree.
            while waiting and waiting[0].received_ns <= record.received_ns - LOOKAHEAD_NS:
                yield waiting.popleft()
            if record.connection.topic in ahead_topics:
                if not self._follow(tree, record, may_jump=not waiting):
                    while waiting:  # before their transforms are forgotten
                        yield waiting.popleft()
                    self._follow(tree, record)
            elif (begin or 0) <= record.received_ns and (not end or record.received_ns < end):
                waiting.append(record)
        while waiting:
            yield waiting.popleft()

    def _ahead_topics(self) -> set[str]:
        """Return the topics that are read ahead of clouds and boxes."""
        info = self.placement.lidars.info
        return self._motion.topics | ({info} if info else set())

    def _stamp_of(self, connection: Connection, data: bytes) -> int | None:
        """Return the stamp of clouds, boxes and motion [ns]; None if there is none."""
        if connection.topic in self._topics.static_transforms:
            return None
        try:
            if connection.topic == self.boxes_topic:
                return self._contents.boxes(connection, data).stamp_ns or None
            message = self.decoder.decoded(connection, data)
            stamped = getattr(message, 'transforms', [message])
            with malformed(f'topic {connection.topic!r}'):
                header = clouds.header_of(stamped[0]) if len(stamped) else None
            stamp_ns = 0 if header is None else poses.stamp_ns(header)
            if stamp_ns and connection.topic not in self.data_topics:
                stamp_ns += round(self.clock_offset * 1e9)
            return stamp_ns or None
        except UnsupportedMessage:
            return None

    def _follow(self, tree: TransformTree, record: Record, *, may_jump: bool = True) -> bool:
        """
        Add a message that is read ahead to `tree`, or to the placement of the sensors.

        Return False where it was not added, see `RecordedMotion.add`.

        """
        topic = record.connection.topic
        if topic != self.placement.lidars.info:
            return self._motion.add(tree, record, may_jump=may_jump)
        with self.decoder.counted(topic):
            message = self.decoder.message(record)
            with malformed(f'topic {topic!r}'):
                self.placement.add_info(message)
        return True
