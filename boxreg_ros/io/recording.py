"""
Recordings: MCAP, rosbag2 (sqlite3 and mcap) and ROS 1 bags as one ordered stream.

Message definitions come from the recording, so nothing of ROS need be installed.

"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
import shlex
from typing import Any, cast, NamedTuple, Self

from boxreg_ros.errors import (
    BoxregError,
    RecordingError,
    TransformUnavailable,
    UnsupportedMessage,
)
from boxreg_ros.io.foxglove_mcap import encoded, Reader
from boxreg_ros.io.resync import Timeline
from boxreg_ros.io.transforms import to_fixed_frame, TransformTree
from boxreg_ros.structures import BoxArray, Floats, Sweep
from msg_adapters import adapter_for, ADAPTERS, pointcloud, POINTS_TYPE, poses, WITHOUT_IDS
from msg_adapters.convention import Convention, STANDARD
from rosbags.interfaces import Connection
from rosbags.typesys import get_types_from_msg, get_typestore, Stores
from rosbags.typesys.store import Typestore

TF_TYPES = ('tf2_msgs/msg/TFMessage', 'tf/msg/tfMessage')
ODOMETRY_TYPE = 'nav_msgs/msg/Odometry'

LOOKAHEAD_NS = 2 * 10**9
"""Transforms are read this far ahead of the clouds and boxes that need them."""
PATIENCE_NS = 10 * 10**9
"""So long is TF given to connect the frames before odometry is taken."""

# What recordings before ROS 2 Iron leave out, and rosbags does not know.
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


class Record(NamedTuple):
    """One message as it was recorded, still encoded."""

    connection: Connection
    received_ns: int
    data: bytes


class Recording:
    """
    One or several recordings of one drive, merged by receive time.

    Receive time only orders the stream and cuts out the part between `start` and `end`; stamps
    are those of the messages' headers. What was recorded apart from the clouds is merged by
    stamp, see `Timeline`. Use as a context manager; a copy can be opened once more.

    Parameters
    ----------
    paths : sequence of Path
        MCAP files, rosbag2 folders, .db3 files, or ROS 1 bags.
    points, boxes, odometry : str, optional
        Topics; found by type where only one fits.
    start, end : float, optional
        Part to read, from the beginning of the recording [s].
    convention : Convention
        How the boxes are to be read.

    Attributes
    ----------
    has_boxes : bool
        Whether there have to be boxes; without them `boxes_topic` is ''.
    part_ns : tuple of int or None
        Begin and end of the part that was asked for, in receive time [ns].
    unreadable, first_errors : Counter and dict
        How many messages of each topic were passed over, and the error of the first.

    Raises
    ------
    RecordingError
        On entering, if something cannot be read or found; the message lists what there is.

    """

    has_boxes = True

    def __init__(
        self,
        paths: Sequence[Path],
        points: str | None = None,
        boxes: str | None = None,
        odometry: str | None = None,
        start: float | None = None,
        end: float | None = None,
        convention: Convention = STANDARD,
    ) -> None:
        self._convention = convention
        self._paths = [Path(path) for path in paths]
        self._asked = {'points': points, 'boxes': boxes, 'odometry': odometry}
        self._start, self._end = start, end
        self.odometry_topic: str | None = None
        self.unreadable: Counter[str] = Counter()
        self.first_errors: dict[str, UnsupportedMessage] = {}

    def __enter__(self) -> Self:
        """Open all files and find the topics."""
        with _readable(self):
            self.files = _files(self._paths)
            self._reader = _opened(self.files)
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

    def records(self, tree: TransformTree) -> Iterator[Record]:
        """
        Yield clouds and box arrays in the order they were received.

        `tree` then holds the transforms received up to `LOOKAHEAD_NS` after each: a window
        that moves along, so that memory does not grow with the recording.

        """
        tree.rewind(0)  # motions that were read to choose a frame come again
        self.unreadable.clear()
        data = self._connections(self.data_topics)
        motion_topics = self._motion_topics()
        motion = self._connections(motion_topics)
        held: deque[Record] = deque()
        begin, end = self.part_ns
        wide = begin and begin - LOOKAHEAD_NS, end and end + LOOKAHEAD_NS
        for record in self._read([*data, *motion], *wide):
            # First what needs no more transforms: those after a pause make the tree forget.
            while held and held[0].received_ns <= record.received_ns - LOOKAHEAD_NS:
                yield held.popleft()
            if record.connection.topic in motion_topics:
                self._add_motion(tree, record)
            elif (begin or 0) <= record.received_ns and (not end or record.received_ns < end):
                held.append(record)
        yield from held

    def decode(self, record: Record) -> Sweep | BoxArray:
        """
        Return the sweep or the boxes of a record, in the frame they were recorded in.

        Raises
        ------
        UnsupportedMessage
            If this message cannot be read: its bytes do not follow the definition in the
            recording, or it contradicts itself, or its layout is none that is known.
        RecordingError
            If no message of its kind can be read here.

        """
        return self._content(record.connection.topic, self._message(record))

    def pass_over(self, record: Record, error: UnsupportedMessage) -> None:
        """Note a record that cannot be read."""
        self.unreadable[record.connection.topic] += 1
        self.first_errors.setdefault(record.connection.topic, error)

    def left_out(self, unmoved: Sequence[str]) -> str:
        """Return how many messages are not used, and why; `unmoved`: why some had no transform."""
        unread = [str(error) for error in self.first_errors.values()]
        return '; '.join(
            f'{count} messages {what}, first: {reasons[0]}'
            for count, what, reasons in (
                (self.unreadable.total(), 'could not be read', unread),
                (len(unmoved), 'had no transform', unmoved),
            )
            if count
        )

    def intensities(self, record: Record) -> Floats | None:
        """Return the intensities of a sweep's points; None if it has none that can be read."""
        try:
            return pointcloud.intensities(self._message(record))
        except UnsupportedMessage as error:
            self.pass_over(record, error)
            return None

    def box_message(self, data: bytes) -> tuple[Any, BoxArray]:
        """Return a message of the boxes' topic from its bytes, and its boxes; see `decode`."""
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
        """Return when a message on a topic of `apart` counts as received: with its clouds [ns]."""
        return self._timeline.received_ns(self._connections({topic})[0], received_ns, data)

    @property
    def apart(self) -> dict[str, float]:
        """Return the topics in use that were recorded apart, and how much later [s]."""
        used = self.data_topics | self._motion_topics()
        return {topic: late for topic, late in self._timeline.apart.items() if topic in used}

    @property
    def typestore(self) -> Typestore:
        """Return the definitions of the messages in the recording."""
        return self._reader.typestore

    @property
    def data_topics(self) -> set[str]:
        """Return the topics of clouds and boxes."""
        return {self.points_topic, self.boxes_topic}

    @property
    def topics(self) -> dict[str, str]:
        """Return all topics with the types of their messages."""
        return dict(self._topics)

    def choose_fixed_frame(self, tree: TransformTree, fixed_frame: str | None = None) -> str:
        """
        Find out where the motion of the sensor comes from, and return the fixed frame.

        TF where it connects the frames, else odometry. Without a wish it is the topmost frame
        the cloud's frame moves in.

        Parameters
        ----------
        tree : TransformTree
            Empty; afterwards it holds the static transforms, and the first ones over time.
        fixed_frame : str, optional
            The frame wished for.

        Raises
        ------
        RecordingError
            If no motion is known, or the frame wished for is not connected to the cloud's.

        """
        frame = self.sensor_frame()
        for record in self._read(self._connections(self._static_topics())):
            self._add_motion(tree, record)
        if fixed_frame is not None and fixed_frame.lstrip('/') == frame:
            return frame
        found = self._scout(tree, frame, fixed_frame)
        odometry: list[str] = []
        if found is None or fixed_frame is None:
            # Odometry is needed where TF does not lead to a fixed frame, or where the root of
            # TF is the very frame that odometry moves.
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
                f'{self}: neither /tf nor odometry tells how the frame of the clouds {frame!r} '
                f'moves; TF: {tree}; odometry: {", ".join(odometry) or "none"}; if it does not '
                f'move, say so with --fixed-frame {shlex.quote(frame)}'
            )
        return found

    def sensor_frame(self) -> str:
        """Return the frame of the first point cloud."""
        cloud = self._first(self.points_topic)
        if cloud is None:
            raise RecordingError(f'{self}: no point clouds on {self.points_topic!r} in this part')
        return str(cloud.header.frame_id).lstrip('/')

    def _first(self, topic: str) -> Any:
        """Return the first message on a topic, in the part that is read, that can be; or None."""
        trouble: UnsupportedMessage | None = None
        for record in self._read(self._connections({topic}), self.start_ns, self.end_ns):
            try:
                return self._message(record)
            except UnsupportedMessage as error:
                trouble = trouble or error
        if trouble is not None:
            raise trouble
        return None

    def _find(self) -> None:
        """Settle topics and times, and complete the message definitions."""
        self._topics = {
            c.topic: c.msgtype for c in sorted(self._reader.connections, key=lambda c: c.topic)
        }
        self._filled = {c.topic for c in self._reader.connections if c.msgcount}
        self.points_topic = self._topic('points', 'point clouds', (POINTS_TYPE,))
        self.boxes_topic = ''
        if self.has_boxes:
            self.boxes_topic = self._topic('boxes', 'boxes', self._box_types())
        if self._asked['odometry']:
            self.odometry_topic = self._topic('odometry', 'odometry', (ODOMETRY_TYPE,))
        if self.has_boxes:
            self._adapter = adapter_for(self._topics[self.boxes_topic], self._convention)

        known = self._reader.typestore.fielddefs
        if not known.keys() >= set(self._topics.values()):
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

    def _topic(self, role: str, what: str, types: tuple[str, ...]) -> str:
        """Return the topic asked for, or the only one of these types."""
        asked = self._asked[role]
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
                f'--{role}'
            )
        return candidates[0]

    def _box_types(self) -> tuple[str, ...]:
        """Return the types of boxes; not those without ids where there are others to choose."""
        with_ids = tuple(name for name in ADAPTERS if name not in WITHOUT_IDS)
        is_free = self._convention.associate or self._asked['boxes'] is not None
        return tuple(ADAPTERS) if is_free or not self._candidates(with_ids) else with_ids

    def _candidates(self, types: Collection[str]) -> list[str]:
        """Return the topics of these types that have messages, or the odometry asked for."""
        if types == (ODOMETRY_TYPE,) and self.odometry_topic:
            return [self.odometry_topic]
        return [t for t, kind in self._topics.items() if kind in types and t in self._filled]

    def _scout(self, tree: TransformTree, frame: str, wish: str | None) -> str | None:
        """Feed `tree` from TF until that leads to the fixed frame, and a little longer."""
        found = _fixed_frame(tree, frame, wish)
        begin = self.start_ns - LOOKAHEAD_NS
        until = self.end_ns
        if self._candidates((ODOMETRY_TYPE,)):
            until = min(until, begin + PATIENCE_NS)
        for record in self._read(self._connections(self._tf_topics()), begin):
            if record.received_ns > until:
                break
            self._add_motion(tree, record)
            was_found, found = found, _fixed_frame(tree, frame, wish)
            if was_found is None and found is not None:
                until = record.received_ns + LOOKAHEAD_NS
        return found

    def _tf_topics(self) -> set[str]:
        return {t for t, kind in self._topics.items() if kind in TF_TYPES}

    def _static_topics(self) -> set[str]:
        return {topic for topic in self._tf_topics() if topic.endswith('tf_static')}

    def _motion_topics(self) -> set[str]:
        return self._tf_topics() | ({self.odometry_topic} if self.odometry_topic else set())

    def _connections(self, topics: Collection[str]) -> list[Connection]:
        return [c for c in self._reader.connections if c.topic in topics]

    def _read(
        self,
        connections: list[Connection],
        start_ns: int | None = None,
        end_ns: int | None = None,
    ) -> Iterator[Record]:
        with _readable(self):
            for item in self._timeline.messages(connections, start_ns, end_ns):
                yield Record(*item)

    def _message(self, record: Record) -> Any:
        connection = record.connection
        try:
            return self._reader.deserialize(record.data, connection.msgtype)
        except BoxregError:
            raise
        except Exception as error:  # the bytes are foreign, and so are the errors they cause
            raise UnsupportedMessage(
                f'{self}: a message on {connection.topic!r} is not a {connection.msgtype} as '
                f'defined there: {_text(error)}'
            ) from None

    def _stamp_of(self, connection: Connection, data: bytes) -> int | None:
        """Return the stamp of clouds, boxes and motion [ns]; None if there is none."""
        if connection.topic in self._static_topics():
            return None
        try:
            message = self._message(Record(connection, 0, data))
            if connection.topic == self.boxes_topic:
                return self._content(connection.topic, message).stamp_ns or None
        except UnsupportedMessage:
            return None
        stamped = message.transforms if hasattr(message, 'transforms') else [message]
        return poses.stamp_ns(stamped[0].header) or None if len(stamped) else None

    def _content(self, topic: str, message: Any) -> Sweep | BoxArray:
        """Return the sweep or the boxes in a message."""
        reader: Any = pointcloud if topic == self.points_topic else self._adapter
        try:
            content: Sweep | BoxArray = reader.from_msg(message)
            return content
        except Exception as error:  # whatever a malformed message leads to
            raise UnsupportedMessage(f'topic {topic!r}: {_text(error)}') from None

    def _add_motion(self, tree: TransformTree, record: Record) -> None:
        try:
            message = self._message(record)
        except UnsupportedMessage as error:
            return self.pass_over(record, error)
        if record.connection.msgtype == ODOMETRY_TYPE:
            tree.add_odometry(message)
        else:
            is_static = record.connection.topic in self._static_topics()
            tree.add_transforms(message.transforms, is_static)


def _fixed_frame(tree: TransformTree, frame: str, wish: str | None) -> str | None:
    """Return the fixed frame if `tree` connects `frame` with one."""
    if wish is None:
        return tree.fixed_frame(frame)
    return wish.lstrip('/') if tree.connects(wish, frame) else None


def _files(paths: Sequence[Path]) -> list[Path]:
    """Return what the reader can open; folders without metadata stand for the files in them."""
    files = []
    for path in paths:
        if not path.exists():
            raise RecordingError(f'no such recording: {str(path)!r}')
        if path.is_dir() and not (path / 'metadata.yaml').exists():
            inner = sorted(f for f in path.iterdir() if f.suffix in ('.mcap', '.db3', '.bag'))
            if not inner:
                raise RecordingError(
                    f'{str(path)!r} is no recording: expected metadata.yaml, .mcap, .db3 or .bag '
                    f'files in it'
                )
            files += inner
        else:
            files.append(path)
    if len({path.suffix == '.bag' for path in files}) > 1:
        raise RecordingError(
            'recordings of ROS 1 and ROS 2 cannot be merged; relabel them one by one'
        )
    return files


def _opened(files: Sequence[Path]) -> Reader:
    """Return a reader of all files; an error names the one that cannot be read."""
    try:
        return Reader(files, stock_types)
    except Exception:
        for path in files:
            with _readable(path):
                Reader([path], stock_types).close()
        raise


def stock_types() -> Typestore:
    """Return the definitions used where a recording has none (before ROS 2 Iron)."""
    store = get_typestore(Stores.ROS2_JAZZY)
    types = {}
    for name, text in VISION_DEFINITIONS.items():
        types.update(get_types_from_msg(text, name))
    store.register(types)
    return store


@contextmanager
def _readable(what: object) -> Iterator[None]:
    """Turn whatever a reader throws at foreign or broken bytes into a RecordingError."""
    try:
        yield
    except BoxregError:
        raise
    except Exception as error:
        raise RecordingError(
            f'{what}: {_text(error)}; expected a whole MCAP file, rosbag2 folder, .db3 file or '
            f'ROS 1 bag; mcap recover, ros2 bag reindex and rosbag reindex mend those cut short'
        ) from None


def _text(error: Exception) -> str:
    """Return an error in one line."""
    return ' '.join(str(error).split()).rstrip('.') or type(error).__name__


def input_boxes(
    path: Path, fixed_frame: str | None = None, **options: Any
) -> tuple[list[BoxArray], str]:
    """
    Return the boxes of a recording as they are, in the fixed frame `relabel` would choose.

    Box arrays without a transform to that frame are left out, and what cannot be read: how many
    comes beside, and why. `options` are those of `Recording`.

    """
    tree, unmoved = TransformTree(), []
    arrays = []
    with Recording([path], **options) as recording:
        fixed_frame = recording.choose_fixed_frame(tree, fixed_frame)
        for record in recording.records(tree):
            if record.connection.topic != recording.boxes_topic:
                continue
            try:
                arrays.append(to_fixed_frame(recording.decode(record), tree, fixed_frame))
            except UnsupportedMessage as error:
                recording.pass_over(record, error)
            except TransformUnavailable as error:
                unmoved.append(str(error))
        left_out = recording.left_out(unmoved)
    return [array for array in arrays if isinstance(array, BoxArray)], left_out
