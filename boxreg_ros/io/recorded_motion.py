"""The motion of the sensors in a recording: TF where it connects the frames, else odometry."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import combinations
import shlex
from typing import Any

from boxreg_ros.errors import RecordingError, UnsupportedMessage
from boxreg_ros.io.checks.jump_search import JumpSearch
from boxreg_ros.io.items import LOOKAHEAD_NS
from boxreg_ros.io.message_decoder import malformed, MessageDecoder
from boxreg_ros.io.storage.record import Record
from boxreg_ros.io.topics import (
    namespace_of,
    nearest_namespace,
    ODOMETRY_TYPE,
    TF_TYPES,
    Topics,
)
from boxreg_ros.io.transform_tree import TransformTree
from boxreg_ros.io.transforms import numbers_of

TF_SEARCH_NS = 10 * 10**9
"""Odometry is used if TF does not connect the frames in this first part of a recording [ns]."""

WHOLE_SECONDS = 60.0
"""A recording of this duration is searched for jumps of its fixed frame as a whole [s]; chosen."""
SEARCH_PARTS = 8
"""Parts of a longer one that are searched; chosen: as many as a minute of driving needs."""
SEARCH_SECONDS = 6.0
"""Their duration [s]; a localisation makes corrections every few seconds."""

ReadTopics = Callable[[Collection[str], int | None, int | None], Iterator[Record]]
"""Yields the messages on some topics, received from a time to another [ns], in order."""


@dataclass(eq=False, repr=False)
class RecordedMotion:
    """
    Transforms and odometry of a recording, in the part from begin to end of receive time [ns].

    `odometry_topic` is the one that was asked for, which comes before TF, then the one in use. Of
    TF the topics are used that were asked for, one or several; else those of all namespaces, but
    for others that state the same frames as the namespace of the clouds. `notes` say what was
    chosen.

    """

    _topics: Topics
    _decoder: MessageDecoder
    _read: ReadTopics
    _part_ns: tuple[int, int]
    odometry_topic: str | None
    _points_topics: Sequence[str]
    _asked_tf: Sequence[str]

    def __post_init__(self) -> None:
        """Begin without a choice."""
        self._is_odometry_asked = self.odometry_topic is not None
        self._start_ns, self._end_ns = self._part_ns
        self._transforms: set[str] | None = None
        self.notes: dict[str, str] = {}

    @property
    def transforms(self) -> set[str]:
        """
        Return the topics of TF in use.

        Raises RecordingError if `tf` names a topic that has none, or if two namespaces state
        different motions of one frame and the clouds are in neither.

        """
        if self._transforms is None:
            self._transforms = self._choose_transforms()
        return self._transforms

    @property
    def topics(self) -> set[str]:
        """Return the topics in use."""
        return self.transforms | ({self.odometry_topic} if self.odometry_topic else set())

    def _choose_transforms(self) -> set[str]:
        """Return the topics of TF to use."""
        known = self._topics.transforms
        for topic in self._asked_tf:
            self._topics.find('tf', 'transforms', TF_TYPES, topic)
        if self._asked_tf:
            spaces = set(map(namespace_of, self._asked_tf))
            static = {t for t in self._topics.static_transforms if namespace_of(t) in spaces}
            return static | set(self._asked_tf)
        spaces = {namespace_of(topic) for topic in self._topics.filled(TF_TYPES)}
        if len(spaces) < 2:
            return known
        stated = {space: self._stated(space) for space in sorted(spaces)}
        own = nearest_namespace(self._points_topics, spaces)
        if own is None:
            self._refuse_rivals(stated)
            return known
        rivals = [space for space in stated if space != own and stated[own].shares(stated[space])]
        if not rivals:
            return known
        others = {topic for topic in known if namespace_of(topic) in rivals}
        names = ', '.join(sorted(others))
        self.notes['tf'] = (
            f'several publishers state the same frames: transforms are those of '
            f'{own or ""}/tf, in the namespace of the clouds, without {names}; choose others with '
            f'--tf TOPIC'
        )
        return known - others

    def _refuse_rivals(self, stated: Mapping[str, _Stated]) -> None:
        """Raise RecordingError if two namespaces state different poses of one frame."""
        for (first, one), (second, other) in combinations(stated.items(), 2):
            frame = one.difference(other)
            if frame:
                raise RecordingError(
                    f'{self._decoder.origin}: expected one publisher of the frame {frame!r}, got '
                    f'different transforms on {first}/tf and {second}/tf, as of two robots; '
                    f'choose those of the clouds with --tf {first}/tf or --tf {second}/tf'
                )

    def _stated(self, space: str) -> _Stated:
        """Return the moving transforms of a namespace at the begin of the recording."""
        found = _Stated()
        moving = self._topics.transforms - self._topics.static_transforms
        topics = {topic for topic in moving if namespace_of(topic) == space}
        first_ns: int | None = None
        for record in self._read(topics, None, None):
            first_ns = record.received_ns if first_ns is None else first_ns
            if record.received_ns > first_ns + TF_SEARCH_NS:
                break
            with suppress(UnsupportedMessage):  # it is counted when it is read for good
                message = self._decoder.message(record)
                with malformed(f'topic {record.connection.topic!r}'):
                    found.add(message.transforms)
        return found

    def add(self, tree: TransformTree, record: Record, *, may_jump: bool = True) -> bool:
        """
        Add a message of `topics` to `tree`, or count it as unreadable.

        Return False where it was not added: by it time goes back, and it may not.

        """
        topic = record.connection.topic
        with self._decoder.counted(topic):
            message = self._decoder.message(record)
            with malformed(f'topic {topic!r}'):
                if not may_jump and tree.jumps_back(message):
                    return False
                if record.connection.msgtype == ODOMETRY_TYPE:
                    tree.add_odometry(message, record.received_ns)
                else:
                    is_static = topic in self._topics.static_transforms
                    tree.add_transforms(message.transforms, is_static, record.received_ns)
        return True

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

        Parameters
        ----------
        tree : TransformTree
            Empty before; then it holds the static and the first moving transforms.
        frame : str
            That of a LiDAR.
        wanted : str or None
            The fixed frame that was asked for. None: the topmost frame that `frame` moves smoothly
            in is chosen; frames that a localisation corrects in steps are left out, which `notes`
            say.

        Returns
        -------
        fixed_frame : str
            The frame to refine in.

        Raises
        ------
        RecordingError
            If `frame` is empty, no motion is known, or no transforms connect `wanted` with
            `frame`.

        """
        for record in self._read(self._static, None, None):
            self.add(tree, record)
        if not frame:
            self._search_transforms(tree, frame, wanted)
            raise RecordingError(
                f'{self._decoder.origin}: expected clouds with a frame, got an empty frame_id; '
                f'name that of the LiDAR with --sensor-frame FRAME, one of '
                f'{", ".join(tree.frames()) or "none in TF"}'
            )
        if wanted is not None and wanted.lstrip('/') == frame:
            return frame
        found = self._search_transforms(tree, frame, wanted)
        odometry: list[str] = []
        if found is None or wanted is None or self._is_odometry_asked:
            # Odometry is needed if TF has no motion, or if odometry moves the root of TF.
            odometry = self._add_odometry(tree, frame, None if self._is_odometry_asked else found)
            found = _fixed_frame(tree, frame, wanted)
        if found is not None:
            return found if wanted is not None else self._smooth_frame(tree, frame, found)
        origin = self._decoder.origin
        known = f'TF: {tree}; odometry: {", ".join(odometry) or "none"}'
        if wanted is not None:
            raise RecordingError(
                f'{origin}: no transforms connect the fixed frame {wanted!r} with the frame of '
                f'the clouds {frame!r}; {known}; leave --fixed-frame out to have one chosen'
            )
        alike = tree.alike(frame)
        if alike:
            roots = sorted({path[-1].parent for path in map(tree.path, alike) if path})
            raise RecordingError(
                f'{origin}: expected transforms of the frame of the clouds {frame!r}, got those '
                f'of {", ".join(alike)}, which differ by a prefix; choose one by its fixed frame: '
                f'--fixed-frame {roots[0]}{" or ".join(["", *roots[1:]])}; {known}'
            )
        is_alone = frame not in tree.frames() and bool(tree.edges())
        first = 'give the first file of the drive too, which may alone have its static transform; '
        raise RecordingError(
            f'{origin}: neither /tf nor odometry has the motion of the frame of the clouds '
            f'{frame!r}; {known}; {first if is_alone else ""}if it does not move, set '
            f'--fixed-frame {shlex.quote(tree.root(frame))}'
        )

    @property
    def _static(self) -> set[str]:
        """Return the topics of static transforms in use."""
        return self.transforms & self._topics.static_transforms

    def _smooth_frame(self, tree: TransformTree, frame: str, found: str) -> str:
        """Return the topmost frame, from `found` on, that does not jump."""
        self.notes.pop('frame', None)
        moving = [edge for edge in tree.route(found, frame) if not tree.is_constant(edge)]
        if len(moving) < 2:
            return found
        jumps = JumpSearch()
        for begin_ns, end_ns in self._searched_parts():
            part = TransformTree(buffer_duration=WHOLE_SECONDS + 2 * SEARCH_SECONDS)
            part.prefers_odometry = tree.prefers_odometry
            for record in self._read(self._static, None, None):
                self.add(part, record)
            for record in self._read(self.topics - self._static, begin_ns, end_ns):
                self.add(part, record)
            jumps.look(part, found, frame)
        smooth = jumps.smooth_frame(tree, found, frame)
        if smooth != found:
            steps = max(jumps.steps.values(), key=lambda one: one.largest)
            self.notes['frame'] = (
                f'fixed frame is {smooth!r}, not {found!r}, which jumps: {steps}; set '
                f'--fixed-frame {shlex.quote(found)} to refine in it all the same'
            )
        return smooth

    def _searched_parts(self) -> list[tuple[int, int]]:
        """Return begin and end of the parts that are searched for jumps [ns]."""
        length_ns = self._end_ns - self._start_ns
        if length_ns <= WHOLE_SECONDS * 1e9:
            return [(self._start_ns, self._end_ns)]
        duration_ns = round(SEARCH_SECONDS * 1e9)
        step_ns = (length_ns - duration_ns) // (SEARCH_PARTS - 1)
        begins = [self._start_ns + number * step_ns for number in range(SEARCH_PARTS)]
        return [(begin_ns, begin_ns + duration_ns) for begin_ns in begins]

    def _search_transforms(
        self, tree: TransformTree, frame: str, wanted: str | None
    ) -> str | None:
        """Read TF until it connects the fixed frame, and `LOOKAHEAD_NS` longer."""
        found = _fixed_frame(tree, frame, wanted)
        begin_ns = self._start_ns - LOOKAHEAD_NS
        until_ns = self._end_ns
        if self._odometry_topics():
            until_ns = min(until_ns, begin_ns + TF_SEARCH_NS)
        for record in self._read(self.transforms, begin_ns, None):
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
            if not child:
                self.notes['child'] = f'{topic}: {tree.name_odometry_child(frame)}'
                child = tree.odometry_child
            odometry.append(f'{topic} ({message.header.frame_id} -> {child})')
            if child == root or (root is None and tree.connects(child, frame)):
                relevant[topic] = message
        if self._is_odometry_asked and not relevant:
            raise RecordingError(
                f'{self._decoder.origin}: odometry: expected a topic whose child frame is '
                f'connected with that of the clouds, {frame!r}, got {"".join(odometry)}; '
                f'TF: {tree}; leave --odometry out to use TF'
            )
        own = nearest_namespace(self._points_topics, set(map(namespace_of, relevant)))
        near = [topic for topic in relevant if namespace_of(topic) == own]
        if len(relevant) > len(near) == 1:
            others = ', '.join(topic for topic in relevant if topic not in near)
            self.notes['odometry'] = (
                f'odometry is that of {near[0]}, in the namespace of the clouds, not of {others}; '
                f'choose another with --odometry'
            )
            relevant = {near[0]: relevant[near[0]]}
        if len(relevant) > 1:
            raise RecordingError(
                f'{self._decoder.origin}: TF alone does not lead to a fixed frame, and several '
                f'topics have odometry: {", ".join(relevant)}; choose one with --odometry'
            )
        for topic, message in relevant.items():
            self.odometry_topic = topic
            tree.add_odometry(message)
        return odometry


class _Stated:
    """Poses of frames that the publishers of a namespace state."""

    def __init__(self) -> None:
        self._poses: dict[str, set[tuple[str, int, tuple[float, ...]]]] = {}

    def add(self, transforms: Iterable[Any]) -> None:
        """Add the transforms of a TFMessage."""
        for item in transforms:
            values = numbers_of(item.transform.translation, item.transform.rotation)
            pose = tuple(round(float(value), 6) for value in values)
            stamp = item.header.stamp
            stated = item.header.frame_id, stamp.sec * 10**9 + stamp.nanosec, pose
            self._poses.setdefault(item.child_frame_id.lstrip('/'), set()).add(stated)

    def shares(self, other: _Stated) -> bool:
        """Return whether another namespace states the same frames, and is no copy of this one."""
        return any(self._poses[child] != other._poses[child] for child in self._common(other))

    def difference(self, other: _Stated) -> str:
        """Return a frame of which another namespace states other poses; empty if none."""
        for child in self._common(other):
            mine, theirs = (
                {(parent, pose) for parent, _, pose in stated._poses[child]}
                for stated in (self, other)
            )
            is_copy = bool(self._poses[child] & other._poses[child])
            if mine != theirs and not is_copy:
                return child
        return ''

    def _common(self, other: _Stated) -> list[str]:
        return sorted(self._poses.keys() & other._poses.keys())


def _fixed_frame(tree: TransformTree, frame: str, wanted: str | None) -> str | None:
    """Return the fixed frame if `tree` connects `frame` with one."""
    if wanted is None:
        return tree.fixed_frame(frame)
    return wanted.lstrip('/') if tree.connects(wanted, frame) else None
