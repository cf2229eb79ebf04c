"""
Recordings: MCAP, rosbag2 (sqlite3 and mcap) and ROS 1 bags as one ordered stream.

Message definitions are read from the recording, so ROS need not be installed.

"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
import shlex
from typing import Any, cast, NamedTuple, Protocol, runtime_checkable, Self

from boxreg_ros.errors import RecordingError, TransformUnavailable, UnsupportedMessage
from boxreg_ros.io.foxglove import encoded
from boxreg_ros.io.lidars import Lidars, SensorPlacement, SINGLE_LIDAR
from boxreg_ros.io.resync import Timeline
from boxreg_ros.io.storage.files import is_ros1, part_of
from boxreg_ros.io.storage.reader import is_message, Reader
from boxreg_ros.io.storage.record import Damage, one_line, Record
from boxreg_ros.io.transforms import to_fixed_frame, TransformTree
from boxreg_ros.structures import BoxArray, Floats, RefinedBoxes, Sweep
from msg_adapters import adapter_for, ADAPTERS, CLOUD_TYPES, clouds, pointcloud, poses, WITHOUT_IDS
from msg_adapters.concatenation import INFO_TYPE
from msg_adapters.convention import Convention, STANDARD
from rosbags.interfaces import Connection
from rosbags.typesys import get_types_from_msg, get_typestore, Stores
from rosbags.typesys.store import Typestore

TF_TYPES = ('tf2_msgs/msg/TFMessage', 'tf/msg/tfMessage')
ODOMETRY_TYPE = 'nav_msgs/msg/Odometry'
INFO_SUFFIX = '_info'
"""Autoware publishes the info on a topic of clouds under its name with this suffix."""
SEVERAL_LIDARS = ', or merge several LiDARs: repeat --points'

LOOKAHEAD_NS = 2 * 10**9
"""Transforms are read this far ahead of clouds and boxes [ns]: publishers of TF are late."""
TF_SEARCH_NS = 10 * 10**9
"""Odometry is used if TF does not connect the frames in this first part of a recording [ns]."""

# Definitions that recordings before ROS 2 Iron lack, and rosbags does not include.
VISION_DEFINITIONS = {
    'vision_msgs/msg/ObjectHypothesis': 'string class_id\nfloat64 score',
    'vision_msgs/msg/ObjectHypothesisWithPose': (
        'vision_msgs/ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose'
    ),
    'vision_msgs/msg/BoundingBox3D': 'geometry_msgs/Pose center\ngeometry_msgs/Vector3 size',
    'vision_msgs/msg/Detection3D': (
        'std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n'
        'vision_msgs/BoundingBox3D bbox\nstring id'
    ),
    'vision_msgs/msg/Detection3DArray': (
        'std_msgs/Header header\nvision_msgs/Detection3D[] detections'
    ),
}


class Item(NamedTuple):
    """
    A decoded cloud or box array of a recording.

    Attributes
    ----------
    received_ns : int
        When it was received [ns].
    content : Sweep or BoxArray
        In the frame of its message.
    intensities : array, shape (M,), or None
        Of the points of a cloud; None unless asked for and recorded.
    refined : RefinedBoxes or None
        Status and covariances of boxes that come from label files; else None.

    """

    received_ns: int
    content: Sweep | BoxArray
    intensities: Floats | None = None
    refined: RefinedBoxes | None = None


Stage = Callable[[str], AbstractContextManager[object]]
"""Measures the time of a ``with`` block under the name of a stage."""


def not_measured(stage: str) -> AbstractContextManager[object]:
    """Measure nothing."""
    return nullcontext()


@runtime_checkable
class ItemSource(Protocol):
    """
    A source of clouds and boxes: bags, MCAP files of Foxglove, clouds with label files.

    Attributes
    ----------
    points_topic, boxes_topic, odometry_topic
        Topics; `points_topic` is the first of several, `boxes_topic` is empty if the boxes are
        not from a topic.
    placement
        Topics of several LiDARs and the frames of their sensors; knows the info messages of
        concatenated clouds once these have been read.
    start_ns, end_ns
        Part that is read, in receive time [ns].
    unreadable, first_errors
        Number of messages of each topic that could not be decoded, and the first error.
    outside
        Boxes that do not belong to the part that is read.

    """

    points_topic: str
    boxes_topic: str
    odometry_topic: str | None
    placement: SensorPlacement
    start_ns: int
    end_ns: int
    unreadable: Counter[str]
    first_errors: dict[str, UnsupportedMessage]
    outside: int

    @property
    def apart(self) -> dict[str, float]:
        """Return the topics that were recorded apart from the clouds, and by how much [s]."""

    @property
    def damages(self) -> list[Damage]:
        """Return the parts of the files that could not be read so far."""

    def sensor_frame(self) -> str:
        """Return the frame of the first cloud."""

    def choose_fixed_frame(self, tree: TransformTree, fixed_frame: str | None = None) -> str:
        """Return the frame to refine in; see `Recording.choose_fixed_frame`."""

    def items(
        self,
        tree: TransformTree,
        *,
        with_clouds: bool = True,
        with_intensities: bool = False,
        stage: Stage = not_measured,
    ) -> Iterator[Item]:
        """Yield clouds and boxes in order while `tree` follows; see `Recording.items`."""

    def check_readable(self) -> None:
        """Raise UnsupportedMessage if none of the clouds, or of the boxes, was readable."""


class Recording:
    """
    One or several recordings of one drive, merged by receive time.

    Receive times only order the stream and select the part between `start` and `end`; stamps
    are those of the message headers. Topics that were recorded apart from the clouds are merged
    by stamp, see `Timeline`. Use as a context manager; a copy can be opened again.

    Parameters
    ----------
    paths : sequence of Path
        MCAP files, rosbag2 folders, .db3 files, or ROS 1 bags.
    lidars : Lidars
        Topics of the clouds, found by type if only one topic has it, and their LiDARs.
    boxes, odometry : str, optional
        Topics; found by type if only one topic has it.
    start, end : float, optional
        Part to read, from the beginning of the recording [s].
    convention : Convention
        Convention of the boxes, and whether ids will be assigned to them.

    Attributes
    ----------
    has_boxes : bool
        Whether a topic of boxes is required; without, `boxes_topic` is empty.
    points_topic, boxes_topic, odometry_topic, placement
        See `ItemSource`.
    start_ns, end_ns, unreadable, first_errors, outside
        See `ItemSource`.
    part_ns : tuple of int or None
        Begin and end of the part that was asked for, in receive time [ns]; None if it was not.
    files : list of Path
        Files that are read.

    Raises
    ------
    RecordingError
        On entering, if a file or topic cannot be read or found; the message lists the topics.

    """

    has_boxes = True

    def __init__(
        self,
        paths: Sequence[Path],
        lidars: Lidars = SINGLE_LIDAR,
        boxes: str | None = None,
        odometry: str | None = None,
        start: float | None = None,
        end: float | None = None,
        convention: Convention = STANDARD,
    ) -> None:
        self._convention = convention
        self._paths = [Path(path) for path in paths]
        self._lidars = lidars
        self._sensor_frame = ''
        self._asked = {'boxes': boxes, 'odometry': odometry}
        self._start, self._end = start, end
        self.odometry_topic: str | None = None
        self.unreadable: Counter[str] = Counter()
        self.first_errors: dict[str, UnsupportedMessage] = {}
        self.outside = 0
        self._decoded_topics: set[str] = set()

    def __enter__(self) -> Self:
        """Open all files and find the topics."""
        parts = [part_of(path) for path in self._paths]
        self.files = [file for part in parts for file in part.files]
        if len({is_ros1(file) for file in self.files}) > 1:
            raise RecordingError(
                'recordings of ROS 1 and ROS 2 cannot be merged; relabel them one by one'
            )
        self._reader = Reader(parts)
        try:
            self._find()
        except BaseException:
            self._reader.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        """Close all files."""
        self._reader.close()

    def __str__(self) -> str:
        """Return the paths."""
        return ', '.join(map(str, self._paths))

    def items(
        self,
        tree: TransformTree,
        *,
        with_clouds: bool = True,
        with_intensities: bool = False,
        stage: Stage = not_measured,
    ) -> Iterator[Item]:
        """
        Yield clouds and box arrays in the order they were received.

        Messages that cannot be decoded are counted in `unreadable` and left out.

        Parameters
        ----------
        tree : TransformTree
            At each item it holds the transforms received up to `LOOKAHEAD_NS` later. Older ones
            are forgotten, so that memory does not grow with the recording.
        with_clouds : bool
            False yields box arrays only, and saves decoding the clouds.
        with_intensities : bool
            Decode the intensities of the points, too.
        stage : callable, optional
            Measures the stages ``read`` and ``decode``.

        """
        self.unreadable.clear()
        self.first_errors.clear()
        self._decoded_topics.clear()
        topics = self.data_topics if with_clouds else {self.boxes_topic}
        records = self._records(tree, topics)
        while True:
            with stage('read'):
                record = next(records, None)
            if record is None:
                return
            with stage('decode'):
                item = self._item(record, with_intensities)
            if item is not None:
                yield item

    def check_readable(self) -> None:
        """
        Check after the last item that some of the clouds, and of the boxes, were readable.

        Raises
        ------
        UnsupportedMessage
            If all messages of either topic were unreadable.

        """
        for topic, first in self.first_errors.items():
            alike = self.points_topics if topic in self.points_topics else {topic}
            if topic in self.data_topics and self._decoded_topics.isdisjoint(alike):
                raise UnsupportedMessage(f'no message on {topic!r} can be read; first: {first}')

    def box_message(self, data: bytes) -> tuple[Any, BoxArray]:
        """
        Return a message of the boxes' topic from its bytes, and its boxes.

        Raises
        ------
        UnsupportedMessage
            If it is malformed.

        """
        connection = self._connections({self.boxes_topic})[0]
        message = self._message(Record(connection, 0, data))
        return message, cast(BoxArray, self._content(self.boxes_topic, message))

    def with_boxes(self, message: Any, boxes: BoxArray, covariances: Floats) -> bytes:
        """Return the bytes of a message of the boxes' topic with its boxes replaced."""
        replaced = self._adapter.to_msg(message, boxes, covariances)
        if not hasattr(message, '__msgtype__'):
            return encoded(replaced)
        store, kind = self._reader.typestore, self._topics[self.boxes_topic]
        encode = store.serialize_cdr if self._reader.is2 else store.serialize_ros1
        return bytes(encode(replaced, kind))

    def received_ns(self, topic: str, received_ns: int, data: bytes) -> int:
        """Return the receive time that a message on a topic of `apart` gets: its cloud's [ns]."""
        return self._timeline.received_ns(self._connections({topic})[0], received_ns, data)

    @property
    def apart(self) -> dict[str, float]:
        """Return the topics in use that were recorded apart, and how much later [s]."""
        used = self.data_topics | self._motion_topics()
        return {topic: late for topic, late in self._timeline.apart.items() if topic in used}

    @property
    def damages(self) -> list[Damage]:
        """Return the parts of the files that could not be read so far."""
        return self._reader.damages

    @property
    def is2(self) -> bool:
        """Return whether its messages are of ROS 2."""
        return self._reader.is2

    @property
    def typestore(self) -> Typestore:
        """Return the message definitions of the recording."""
        return self._reader.typestore

    @property
    def data_topics(self) -> set[str]:
        """Return the topics of clouds and boxes."""
        return {*self.points_topics, self.boxes_topic}

    @property
    def points_topics(self) -> tuple[str, ...]:
        """Return the topics of clouds."""
        return self.placement.lidars.topics

    @property
    def topics(self) -> dict[str, str]:
        """Return all topics with the types of their messages."""
        return dict(self._topics)

    def choose_fixed_frame(self, tree: TransformTree, fixed_frame: str | None = None) -> str:
        """
        Choose the source of the sensor's motion, and return the fixed frame.

        TF is used where it connects the frames, else odometry. The default is the topmost frame
        that the frame of the clouds moves in.

        Parameters
        ----------
        tree : TransformTree
            Empty; afterwards it holds the static and the first moving transforms.
        fixed_frame : str, optional
            Frame to use instead.

        Raises
        ------
        RecordingError
            If no motion is known, or no transforms connect `fixed_frame` with the clouds.

        """
        first_error: RecordingError | None = None
        for frame in self._sensor_frames():  # the others go on where TF does not know one
            try:
                found = self._choose_fixed_frame(tree, frame, fixed_frame)
            except RecordingError as error:
                first_error = first_error or error
                tree.clear()
            else:
                self._sensor_frame = frame
                return found
        assert first_error is not None  # there is a frame
        raise first_error

    def _choose_fixed_frame(self, tree: TransformTree, frame: str, fixed_frame: str | None) -> str:
        """Return the fixed frame that the LiDAR frame `frame` moves in."""
        for record in self._read(self._connections(self._static_topics())):
            self._add_motion(tree, record)
        if fixed_frame is not None and fixed_frame.lstrip('/') == frame:
            return frame
        found = self._scout(tree, frame, fixed_frame)
        odometry: list[str] = []
        if found is None or fixed_frame is None:
            # Odometry is needed if TF has no motion, or if odometry moves the root of TF.
            relevant = {}
            for topic in self._candidates((ODOMETRY_TYPE,)):
                message = self._first(topic)
                if message is None:
                    continue
                child = message.child_frame_id.lstrip('/')
                odometry.append(f'{topic} ({message.header.frame_id} -> {child})')
                if child == found or (found is None and tree.connects(child, frame)):
                    relevant[topic] = message
            if len(relevant) > 1:
                raise RecordingError(
                    f'{self}: TF alone does not lead to a fixed frame, and several topics have '
                    f'odometry: {", ".join(relevant)}; choose one with --odometry'
                )
            for topic, message in relevant.items():
                self.odometry_topic = topic
                tree.add_odometry(message)
            found = _fixed_frame(tree, frame, fixed_frame)
        if found is None and fixed_frame is not None:
            raise RecordingError(
                f'{self}: no transforms connect the fixed frame {fixed_frame!r} with the frame '
                f'of the clouds {frame!r}; TF: {tree}; odometry: {", ".join(odometry) or "none"}; '
                f'leave --fixed-frame out to have one chosen'
            )
        if found is None:
            raise RecordingError(
                f'{self}: neither /tf nor odometry has the motion of the frame of the clouds '
                f'{frame!r}; TF: {tree}; odometry: {", ".join(odometry) or "none"}; if it does '
                f'not move, set --fixed-frame {shlex.quote(frame)}'
            )
        return found

    def sensor_frame(self) -> str:
        """Return the frame of the first cloud, of the first LiDAR that TF or odometry moves."""
        return self._sensor_frame or self._sensor_frames()[0]

    def _sensor_frames(self) -> list[str]:
        """Return the frame of the first cloud of each topic that has any."""
        found = [self._first(topic) for topic in self.points_topics]
        headers = [clouds.header_of(cloud) for cloud in found if cloud is not None]
        frames = [str(header.frame_id).lstrip('/') for header in headers]
        if not frames:
            topics = ', '.join(map(repr, self.points_topics))
            raise RecordingError(f'{self}: no point clouds on {topics} in this part')
        return frames

    def _first(self, topic: str) -> Any:
        """Return the first readable message on a topic in the part that is read; None without."""
        first_error: UnsupportedMessage | None = None
        for record in self._read(self._connections({topic}), self.start_ns, self.end_ns):
            try:
                return self._message(record)
            except UnsupportedMessage as error:
                first_error = first_error or error
        if first_error is not None:
            raise first_error
        return None

    def _find(self) -> None:
        """Find topics and times, and complete the message definitions."""
        self._topics = {
            c.topic: c.msgtype for c in sorted(self._reader.connections, key=lambda c: c.topic)
        }
        self._filled = {c.topic for c in self._reader.connections if c.msgcount}
        self._find_clouds()
        self.boxes_topic = ''
        if self.has_boxes:
            types = self._box_types()
            self.boxes_topic = self._topic('boxes', 'boxes', types, self._asked['boxes'])
        if self._asked['odometry']:
            asked = self._asked['odometry']
            self.odometry_topic = self._topic('odometry', 'odometry', (ODOMETRY_TYPE,), asked)
        if self.has_boxes:
            self._adapter = adapter_for(self._topics[self.boxes_topic], self._convention)

        known = self._reader.typestore.fielddefs
        used = {kind for kind in self._topics.values() if '/msg/' in kind}
        if not known.keys() >= used:
            stock = stock_types().fielddefs
            self._reader.typestore.register({k: v for k, v in stock.items() if k not in known})

        self._timeline = Timeline(self._reader, self.points_topic, self._stamp_of)
        odometry = {t for t, kind in self._topics.items() if kind == ODOMETRY_TYPE}
        motion = (self._tf_topics() - self._static_topics()) | odometry
        begin_ns, last_ns = self._timeline.span_ns(self.data_topics | motion)
        self.start_ns = begin_ns + round((self._start or 0.0) * 1e9)
        self.end_ns = last_ns
        if self._end is not None:
            self.end_ns = min(last_ns, begin_ns + round(self._end * 1e9))
        self.part_ns = (
            self.start_ns if self._start else None,
            None if self._end is None else self.end_ns,
        )
        if self.start_ns >= self.end_ns:
            end = 'the end' if self._end is None else f'{self._end:g}'
            raise RecordingError(
                f'start and end: expected a part of the {(last_ns - begin_ns) * 1e-9:.1f} s of '
                f'{self}, got {self._start or 0:g} to {end}; '
                f'choose a smaller --start, or leave it out'
            )

    def _find_clouds(self) -> None:
        """Find the topics of the clouds, and that of info messages."""
        lidars = self._lidars
        asked: Sequence[str | None] = lidars.topics or (None,)
        topics = [self._topic('points', 'point clouds', CLOUD_TYPES, topic) for topic in asked]
        filled = [topic for topic in topics if topic in self._filled]
        self.points_topic = (filled or topics)[0]
        info = lidars.info
        if info:
            info = self._topic('points-info', 'info on concatenated clouds', (INFO_TYPE,), info)
        elif len(topics) == 1 and self._topics.get(topics[0] + INFO_SUFFIX) == INFO_TYPE:
            info = topics[0] + INFO_SUFFIX
        self.placement = SensorPlacement(replace(lidars, topics=tuple(topics), info=info))

    def _topic(self, role: str, what: str, types: tuple[str, ...], asked: str | None) -> str:
        """Return the topic asked for, or the only one of these types."""
        there = ', '.join(f'{t} ({kind})' for t, kind in self._topics.items()) or 'no topics'
        candidates = self._candidates(types)
        if asked is not None:
            if asked not in self._topics:
                fitting = ', '.join(candidates) or 'none'
                raise RecordingError(f'{self}: no topic {asked!r}; topics with {what}: {fitting}')
            if self._topics[asked] not in types:
                raise UnsupportedMessage(
                    f'topic {asked!r}: {what} expected as one of {", ".join(types)}, got '
                    f'{self._topics[asked]}'
                )
            return asked
        if empty := [t for t, kind in self._topics.items() if kind in types and not candidates]:
            raise RecordingError(f'{self}: no {what}: no messages on {", ".join(empty)}')
        if not candidates:
            raise RecordingError(
                f'{self}: no {what}, expected a topic of type {" or ".join(types)}; there: {there}'
            )
        if len(candidates) > 1:
            raise RecordingError(
                f'{self}: several topics have {what}: {", ".join(candidates)}; choose one with '
                f'--{role}{SEVERAL_LIDARS if role == "points" else ""}'
            )
        return candidates[0]

    def _box_types(self) -> tuple[str, ...]:
        """Return the types of boxes; those without ids only if there are no others."""
        with_ids = tuple(name for name in ADAPTERS if name not in WITHOUT_IDS)
        is_free = self._convention.associate or self._asked['boxes'] is not None
        return tuple(ADAPTERS) if is_free or not self._candidates(with_ids) else with_ids

    def _candidates(self, types: Collection[str]) -> list[str]:
        """Return the topics of these types that have messages, or the odometry asked for."""
        if types == (ODOMETRY_TYPE,) and self.odometry_topic:
            return [self.odometry_topic]
        return [t for t, kind in self._topics.items() if kind in types and t in self._filled]

    def _scout(self, tree: TransformTree, frame: str, wanted: str | None) -> str | None:
        """Read TF until it connects the fixed frame, and `LOOKAHEAD_NS` longer."""
        found = _fixed_frame(tree, frame, wanted)
        begin = self.start_ns - LOOKAHEAD_NS
        until = self.end_ns
        if self._candidates((ODOMETRY_TYPE,)):
            until = min(until, begin + TF_SEARCH_NS)
        for record in self._read(self._connections(self._tf_topics()), begin):
            if record.received_ns > until:
                break
            self._add_motion(tree, record)
            was_found, found = found, _fixed_frame(tree, frame, wanted)
            if was_found is None and found is not None:
                until = record.received_ns + LOOKAHEAD_NS
        return found

    def _tf_topics(self) -> set[str]:
        return {t for t, kind in self._topics.items() if kind in TF_TYPES}

    def _static_topics(self) -> set[str]:
        return {topic for topic in self._tf_topics() if topic.endswith('tf_static')}

    def _motion_topics(self) -> set[str]:
        """Return the topics that are read ahead of clouds and boxes."""
        others = {self.odometry_topic, self.placement.lidars.info}
        return self._tf_topics() | {topic for topic in others if topic}

    def _connections(self, topics: Collection[str]) -> list[Connection]:
        return [c for c in self._reader.connections if c.topic in topics]

    def _read(
        self,
        connections: list[Connection],
        start_ns: int | None = None,
        end_ns: int | None = None,
    ) -> Iterator[Record]:
        return self._timeline.messages(connections, start_ns, end_ns)

    def _records(self, tree: TransformTree, topics: set[str]) -> Iterator[Record]:
        """Yield the messages on `topics`, still encoded, while `tree` follows."""
        tree.rewind(0)  # motions that were read to choose a frame are read again
        motion_topics = self._motion_topics()
        connections = [*self._connections(topics), *self._connections(motion_topics)]
        begin, end = self.part_ns
        read_from = begin and begin - LOOKAHEAD_NS
        read_to = end and end + LOOKAHEAD_NS
        waiting: deque[Record] = deque()
        for record in self._read(connections, read_from, read_to):
            # Those complete first: after a pause, this record makes the tree forget.
            while waiting and waiting[0].received_ns <= record.received_ns - LOOKAHEAD_NS:
                yield waiting.popleft()
            if record.connection.topic in motion_topics:
                self._add_motion(tree, record)
            elif (begin or 0) <= record.received_ns and (not end or record.received_ns < end):
                waiting.append(record)
        yield from waiting

    def _item(self, record: Record, with_intensities: bool) -> Item | None:
        """Return a message decoded; None, and counted, if it cannot be."""
        topic = record.connection.topic
        try:
            message = self._message(record)
            content = self._content(topic, message)
        except UnsupportedMessage as error:
            self._count_unreadable(topic, error)
            return None
        self._decoded_topics.add(topic)
        intensities = None
        if with_intensities and isinstance(content, Sweep):
            try:
                intensities = pointcloud.intensities(clouds.plain(message))
            except UnsupportedMessage as error:
                self._count_unreadable(topic, error)
        return Item(record.received_ns, content, intensities)

    def _count_unreadable(self, topic: str, error: UnsupportedMessage) -> None:
        self.unreadable[topic] += 1
        self.first_errors.setdefault(topic, error)

    def _message(self, record: Record) -> Any:
        """Return a message decoded; UnsupportedMessage if its bytes are not of its type."""
        connection = record.connection
        kind = connection.msgtype
        origin = f'{self}: a message on {connection.topic!r} is not a {kind} as defined there'
        with _malformed(origin):
            return self._reader.deserialize(record.data, kind)

    def _content(self, topic: str, message: Any) -> Sweep | BoxArray:
        """Return the sweep or the boxes of a message; UnsupportedMessage if it has none."""
        with _malformed(f'topic {topic!r}'):
            if topic in self.points_topics:
                return self.placement.sweep_of(message, topic)
            boxes: BoxArray = self._adapter.from_msg(message)
        return boxes

    def _stamp_of(self, connection: Connection, data: bytes) -> int | None:
        """Return the stamp of clouds, boxes and motion [ns]; None if there is none."""
        if connection.topic in self._static_topics():
            return None
        try:
            message = self._message(Record(connection, 0, data))
            if connection.topic == self.boxes_topic:
                return self._content(connection.topic, message).stamp_ns or None
            stamped = getattr(message, 'transforms', [message])
            with _malformed(f'topic {connection.topic!r}'):
                header = clouds.header_of(stamped[0]) if len(stamped) else None
                return header and (poses.stamp_ns(header) or None)
        except UnsupportedMessage:
            return None

    def _add_motion(self, tree: TransformTree, record: Record) -> None:
        topic = record.connection.topic
        try:
            message = self._message(record)
            with _malformed(f'topic {topic!r}'):
                if record.connection.msgtype == ODOMETRY_TYPE:
                    tree.add_odometry(message)
                elif record.connection.msgtype == INFO_TYPE:
                    self.placement.add_info(message)
                else:
                    is_static = topic in self._static_topics()
                    tree.add_transforms(message.transforms, is_static)
        except UnsupportedMessage as error:
            self._count_unreadable(topic, error)


def _fixed_frame(tree: TransformTree, frame: str, wanted: str | None) -> str | None:
    """Return the fixed frame if `tree` connects `frame` with one."""
    if wanted is None:
        return tree.fixed_frame(frame)
    return wanted.lstrip('/') if tree.connects(wanted, frame) else None


def stock_types() -> Typestore:
    """Return the definitions used where a recording has none (before ROS 2 Iron)."""
    store = get_typestore(Stores.ROS2_JAZZY)
    types = {}
    for name, text in VISION_DEFINITIONS.items():
        types.update(get_types_from_msg(text, name))
    store.register(types)
    return store


@contextmanager
def _malformed(origin: str) -> Iterator[None]:
    """
    Turn errors that malformed messages cause into UnsupportedMessage; `origin` comes first.

    Decoders and adapters raise UnsupportedMessage for bytes, sizes and values that contradict
    each other. Beyond these, a message may lack a field because its definition in the recording
    is another one; that is an AttributeError of the message. Every other error, also an
    AttributeError of a module or of an object of ours, is a fault of boxreg_ros and goes on.

    """
    try:
        yield
    except UnsupportedMessage as error:
        raise UnsupportedMessage(f'{origin}: {one_line(error)}') from None
    except AttributeError as error:
        if not is_message(error.obj):
            raise
        raise UnsupportedMessage(
            f'{origin}: expected a field {error.name!r} in its {type(error.obj).__name__}, got '
            f'none; the definition in the recording is not the one that is known'
        ) from None


def left_out(source: ItemSource, missing_transforms: Sequence[str]) -> str:
    """
    Return how many messages of a source are not used, and why, in one line; empty if all are.

    Parameters
    ----------
    source : ItemSource
        After its last item.
    missing_transforms : sequence of str
        Errors of the messages without a transform.

    """
    parts = []
    if source.unreadable.total():
        first = next(iter(source.first_errors.values()))
        parts.append(f'{source.unreadable.total()} messages could not be read, first: {first}')
    if missing_transforms:
        parts.append(
            f'{len(missing_transforms)} messages had no transform, first: {missing_transforms[0]}'
        )
    return '; '.join(parts)


def input_boxes(
    source: AbstractContextManager[ItemSource], fixed_frame: str | None = None
) -> tuple[list[BoxArray], str]:
    """
    Return the input boxes of a recording in the fixed frame that `relabel` would choose.

    Parameters
    ----------
    source : context manager of ItemSource
        Recording that is not open yet.
    fixed_frame : str, optional
        Fixed frame to use instead.

    Returns
    -------
    arrays : list of BoxArray
        All that could be decoded and transformed.
    others : str
        Number of the others, and why; empty if there are none.

    """
    tree = TransformTree()
    arrays: list[BoxArray] = []
    missing_transforms: list[str] = []
    with source as recording:
        fixed_frame = recording.choose_fixed_frame(tree, fixed_frame)
        for item in recording.items(tree, with_clouds=False):
            try:
                moved = to_fixed_frame(item.content, tree, fixed_frame)
            except TransformUnavailable as error:
                missing_transforms.append(str(error))
                continue
            if isinstance(moved, BoxArray):
                arrays.append(moved)
        others = left_out(recording, missing_transforms)
    return arrays, others
