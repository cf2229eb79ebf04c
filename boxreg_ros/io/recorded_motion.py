"""The motion of the sensors in a recording: TF where it connects the frames, else odometry."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
import shlex
from typing import Any

from boxreg_ros.errors import RecordingError, UnsupportedMessage
from boxreg_ros.io.items import LOOKAHEAD_NS
from boxreg_ros.io.message_decoder import malformed, MessageDecoder
from boxreg_ros.io.storage.record import Record
from boxreg_ros.io.topics import ODOMETRY_TYPE, Topics
from boxreg_ros.io.transforms import TransformTree

TF_SEARCH_NS = 10 * 10**9
"""Odometry is used if TF does not connect the frames in this first part of a recording [ns]."""

ReadTopics = Callable[[Collection[str], int | None, int | None], Iterator[Record]]
"""Yields the messages on some topics, received from a time to another [ns], in order."""


class RecordedMotion:
    """
    Transforms and odometry of a recording, in the part from begin to end of receive time [ns].

    `odometry_topic` is the one that was asked for, then the one in use.

    """

    def __init__(
        self,
        topics: Topics,
        decoder: MessageDecoder,
        read: ReadTopics,
        part_ns: tuple[int, int],
        odometry_topic: str | None,
    ) -> None:
        self._topics = topics
        self._decoder = decoder
        self._read = read
        self._start_ns, self._end_ns = part_ns
        self.odometry_topic = odometry_topic

    @property
    def topics(self) -> set[str]:
        """Return the topics in use."""
        return self._topics.transforms | ({self.odometry_topic} if self.odometry_topic else set())

    def add(self, tree: TransformTree, record: Record) -> None:
        """Add a message of `topics` to `tree`, or count it as unreadable."""
        topic = record.connection.topic
        try:
            message = self._decoder.message(record)
            with malformed(f'topic {topic!r}'):
                if record.connection.msgtype == ODOMETRY_TYPE:
                    tree.add_odometry(message)
                else:
                    is_static = topic in self._topics.static_transforms
                    tree.add_transforms(message.transforms, is_static)
        except UnsupportedMessage as error:
            self._decoder.count_unreadable(topic, error)

    def first(self, topic: str) -> Any:
        """Return the first readable message on a topic; UnsupportedMessage if none of them is."""
        first_error: UnsupportedMessage | None = None
        for record in self._read({topic}, self._start_ns, self._end_ns):
            try:
                return self._decoder.message(record)
            except UnsupportedMessage as error:
                first_error = first_error or error
        if first_error is not None:
            raise first_error
        return None

    def choose_fixed_frame(self, tree: TransformTree, frame: str, wanted: str | None) -> str:
        """
        Choose between TF and odometry, and return the fixed frame.

        It is `wanted`, or the topmost frame that the `frame` of a LiDAR moves in. The empty `tree`
        then holds the static and the first moving transforms.

        Raises RecordingError if no motion is known, or no transforms connect `wanted` with
        `frame`.

        """
        if not frame:
            raise RecordingError(
                f'{self._decoder.origin}: expected clouds with a frame, got an empty frame_id; '
                f'set it in the driver of the LiDAR'
            )
        for record in self._read(self._topics.static_transforms, None, None):
            self.add(tree, record)
        if wanted is not None and wanted.lstrip('/') == frame:
            return frame
        found = self._search_transforms(tree, frame, wanted)
        odometry: list[str] = []
        if found is None or wanted is None:
            # Odometry is needed if TF has no motion, or if odometry moves the root of TF.
            odometry = self._add_odometry(tree, frame, found)
            found = _fixed_frame(tree, frame, wanted)
        if found is not None:
            return found
        origin = self._decoder.origin
        known = f'TF: {tree}; odometry: {", ".join(odometry) or "none"}'
        if wanted is not None:
            raise RecordingError(
                f'{origin}: no transforms connect the fixed frame {wanted!r} with the frame of '
                f'the clouds {frame!r}; {known}; leave --fixed-frame out to have one chosen'
            )
        raise RecordingError(
            f'{origin}: neither /tf nor odometry has the motion of the frame of the clouds '
            f'{frame!r}; {known}; if it does not move, set --fixed-frame {shlex.quote(frame)}'
        )

    def _search_transforms(
        self, tree: TransformTree, frame: str, wanted: str | None
    ) -> str | None:
        """Read TF until it connects the fixed frame, and `LOOKAHEAD_NS` longer."""
        found = _fixed_frame(tree, frame, wanted)
        begin_ns = self._start_ns - LOOKAHEAD_NS
        until_ns = self._end_ns
        if self._odometry_topics():
            until_ns = min(until_ns, begin_ns + TF_SEARCH_NS)
        for record in self._read(self._topics.transforms, begin_ns, None):
            if record.received_ns > until_ns:
                break
            self.add(tree, record)
            was_found = found is not None
            found = _fixed_frame(tree, frame, wanted)
            if found is not None and not was_found:
                until_ns = record.received_ns + LOOKAHEAD_NS
        return found

    def _odometry_topics(self) -> Sequence[str]:
        """Return the topics of odometry with messages, or the one that was asked for."""
        if self.odometry_topic:
            return [self.odometry_topic]
        return self._topics.filled((ODOMETRY_TYPE,))

    def _add_odometry(self, tree: TransformTree, frame: str, root: str | None) -> list[str]:
        """Use odometry that moves `root`, or any above `frame`; return topics and frames."""
        odometry = []
        relevant = {}
        for topic in self._odometry_topics():
            message = self.first(topic)
            if message is None:
                continue
            child = message.child_frame_id.lstrip('/')
            odometry.append(f'{topic} ({message.header.frame_id} -> {child})')
            if child == root or (root is None and tree.connects(child, frame)):
                relevant[topic] = message
        if len(relevant) > 1:
            raise RecordingError(
                f'{self._decoder.origin}: TF alone does not lead to a fixed frame, and several '
                f'topics have odometry: {", ".join(relevant)}; choose one with --odometry'
            )
        for topic, message in relevant.items():
            self.odometry_topic = topic
            tree.add_odometry(message)
        return odometry


def _fixed_frame(tree: TransformTree, frame: str, wanted: str | None) -> str | None:
    """Return the fixed frame if `tree` connects `frame` with one."""
    if wanted is None:
        return tree.fixed_frame(frame)
    return wanted.lstrip('/') if tree.connects(wanted, frame) else None
