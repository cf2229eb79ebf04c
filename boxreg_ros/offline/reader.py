"""
Items of a recording on their way to the registrar: read, decoded, in the fixed frame.

This runs in a process of its own, a few items ahead of the registrar, or in that of a run on one
core; see `reader`.

"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Generator, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from mmap import mmap
from typing import Any, NamedTuple

from boxreg_ros.config import Config
from boxreg_ros.errors import ConfigError, RecordingError
from boxreg_ros.io.fixed_frame import FixedFrameItems
from boxreg_ros.io.items import Item, ItemSource
from boxreg_ros.io.recording import Recording
from boxreg_ros.offline.progress import Stopwatch
from boxreg_ros.offline.request import NO_TOPIC, Request
from boxreg_ros.offline.shared_arrays import Receiver, Sender, shared_memory
from boxreg_ros.offline.sources import label_frame_of, scene_address, source_of
from boxreg_ros.offline.stored_sweeps import StoredPlace, StoredSweeps
from boxreg_ros.offline.workers import Receive, run_in_worker, Send
from boxreg_ros.structures import BoxArray, Floats, RefinedBoxes, Sweep
from msg_adapters.clouds import POINTS_TYPE
import numpy as np

IDS_SECONDS = 20.0
"""Boxes are checked for jumping ids this long, or to the end, before a run is begun again [s];
chosen: 200 box arrays at 10 Hz, in which a tracker may switch now and then."""


class JumpingIds(RecordingError):
    """The ids of a topic of boxes do not identify objects over time."""


@dataclass(eq=False, slots=True)
class ArrayPlace:
    """What label files need of a box array beside its result: its ticket at the registrar."""

    boxes: BoxArray | None = None
    """Of the input, in time, in the fixed frame where a transform to it is known."""
    T_fixed_sensor: Floats | None = None
    T_fixed_boxes: Floats | None = None
    """Pose of the frame of the input message; None where unknown, as that of the sensor."""
    early: RefinedBoxes | None = None
    is_written: bool = False


class Source(NamedTuple):
    """Properties of a recording that are known before the first item."""

    topics: dict[str, str | None]  # of points, boxes and odometry; None where there is none
    fixed_frame: str  # to refine in
    sensor_frame: str  # of label files
    start_ns: int  # of the part that is read, in receive time [ns]
    seconds: float  # its duration


class Findings(NamedTuple):
    """Properties of a recording that are known after the last item."""

    counts: Counter[str]  # as of `FixedFrameItems`
    lidars: dict[str, Counter[str]]  # clouds of each that were merged, late and missing
    unreadable: int  # messages
    outside: int  # boxes of label files outside of the part that is read
    left_out: Counter[str]  # boxes of label files that are not used, by reason
    warning: str  # finding of the pose check
    facts: dict[str, Any]  # fields of the summary that follow from the recording alone
    places: list[StoredPlace]  # of the stored sweeps; empty where none are stored
    seconds: dict[str, float]  # spent in each stage


class RecordingReader:
    """
    Read an open recording and bring its items into the fixed frame.

    The stages ``read``, ``decode`` and ``transform`` are measured by the clock. All sweeps are
    stored in `sweeps`. `source` is known before the first item. Where `jumping_ids` of the
    request says that the ids of the input do not identify objects, boxes are associated.

    """

    def __init__(
        self,
        recording: ItemSource,
        request: Request,
        clock: Stopwatch,
        sweeps: StoredSweeps | None = None,
    ) -> None:
        self._recording = recording
        self._jumping_ids = request.jumping_ids
        self._checks_ids = _may_associate(request)
        self._clock = clock
        self._sweeps = sweeps
        self._with_points = request.options.with_points
        self._with_times = request.config.sampling.deskew
        convention = request.convention
        if request.jumping_ids:
            convention = replace(convention, associate=True)
        self._items = FixedFrameItems(
            recording, request.config, convention, request.fixed_frame, clock, ArrayPlace
        )
        self._items.session.trusts_ids = request.keyframes
        with clock('read'):
            sensor_frame = label_frame_of(
                recording, self._items.tree, self._items.fixed_frame, request.label_frame
            )
        topics = {
            'points': ', '.join(recording.placement.lidars.topics) or recording.points_topic,
            'boxes': recording.boxes_topic or None,
            'odometry': recording.odometry_topic,
        }
        seconds = (recording.end_ns - recording.start_ns) * 1e-9
        self.source = Source(
            topics, self._items.fixed_frame, sensor_frame, recording.start_ns, seconds
        )

    def __iter__(self) -> Iterator[Item]:
        """
        Yield clouds and boxes in the order they were received.

        Raises UnsupportedMessage at the end, if no cloud, or no message of boxes, was readable,
        and JumpingIds if boxes are to be associated, of which nobody has said whether they are.

        """
        yield from self._read()
        self._check_ids()
        self._recording.check_readable()

    def _read(self) -> Iterator[Item]:
        """Yield clouds and boxes, as they are."""
        sweeps = self._sweeps
        checked_ns = self._recording.start_ns + round(IDS_SECONDS * 1e9)
        are_written = self._with_points or (sweeps is not None and sweeps.with_clouds)
        for item in self._items.read(with_intensities=are_written):
            if sweeps is not None and isinstance(item.content, Sweep):
                with self._clock('points'):
                    sweeps.add(item, self._items, self.source.sensor_frame)
            with self._clock('transform'):
                trimmed = self._trimmed(item)
            yield trimmed
            if isinstance(item.content, BoxArray) and item.received_ns >= checked_ns:
                self._check_ids()

    def _check_ids(self) -> None:
        """Raise JumpingIds if the ids of the boxes so far do not identify objects."""
        found = self._items.session.jumping_ids
        if self._checks_ids and found:
            raise JumpingIds(
                f'{found}; boxes are associated over time instead, as with --associate; set '
                f'--keep-ids to take the ids as they are'
            )

    def findings(self) -> Findings:
        """Return the properties that are known after the last item."""
        recording = self._recording
        items = self._items
        facts = {
            **items.session.facts,  # origin of the ids
            'recorded_apart': {topic: round(late, 3) for topic, late in recording.apart.items()},
            'damage': [damage._asdict() for damage in recording.damages],
            'point_layouts': recording.placement.layouts,
            'first_missing_transform': items.first_missing_transform,
            'first_unplaced': items.first_unplaced,
            'first_unreadable': '; '.join(map(str, recording.first_errors.values())),
        }
        warnings = (
            *(*recording.label_notes, recording.finding, self._jumping_ids),
            *(items.session.finding, items.ahead),
        )
        return Findings(
            items.counts,
            items.session.lidar_counts,
            recording.unreadable.total(),
            recording.outside,
            +recording.left_out,
            '; '.join(filter(None, warnings)),
            facts,
            [] if self._sweeps is None else self._sweeps.complete(),
            self._clock.stages(),
        )

    def _trimmed(self, item: Item) -> Item:
        """Return an item without what nobody reads: it is copied to a process."""
        pose, frame = item.T_fixed_item, self.source.sensor_frame
        if pose is None or item.content.frame_id != frame:
            pose = self._items.pose_of(frame, item.content.stamp_ns)
        trimmed = item._replace(refined=None, parts=(), T_fixed_sensor=pose)
        moved = item.moved
        if isinstance(item.content, BoxArray):
            return trimmed._replace(content=moved or item.content)
        if isinstance(moved, Sweep) and not (self._with_times and np.any(moved.times)):
            moved = replace(moved, times=None)  # times of 0 say no more
        if not self._with_points:
            content = moved or Sweep(item.content.stamp_ns, '', np.zeros((0, 3)))
            return trimmed._replace(
                content=content, moved=moved, T_fixed_item=None, intensities=None
            )
        cloud = self._items.stored_cloud(item, self.source.sensor_frame)
        return trimmed._replace(
            content=cloud.sweep,
            moved=moved,
            T_fixed_item=cloud.T_fixed_sweep,
            intensities=cloud.intensities,
        )


def _may_associate(request: Request) -> bool:
    """
    Return whether boxes are associated where their ids do not identify objects.

    Ids of label files and scenes are a person's, and are kept.

    """
    is_topic = request.labels is None and request.boxes != NO_TOPIC
    is_asked = request.keep_ids or request.keyframes or request.convention.associate
    is_known = is_asked or bool(request.jumping_ids)
    return is_topic and not is_known and scene_address(request.recordings) is None


@contextmanager
def reader(request: Request, sweeps: StoredSweeps | None = None) -> Iterator[Receive]:
    """
    Yield, for a block, a function that returns the next message for `ReadAhead`.

    The recording is read in a process of its own, or in this one where it may use one core only.
    All sweeps are added to `sweeps`.

    """
    messages = partial(_messages, request, sweeps)
    if uses_one_core(request.config):
        with closing(messages()) as received:
            yield received.__next__
        return
    memory = shared_memory()
    with run_in_worker(partial(_read, messages, memory), 'reads the recording') as process:
        yield Receiver(memory, process)


def uses_one_core(config: Config) -> bool:
    """Return whether a run is one process: more would use more cores, and copy every sweep."""
    return config.solver.threads == 1


class ReadAhead:
    """Items that a `RecordingReader` yields in another process; `findings` follow the last one."""

    def __init__(self, receive: Receive) -> None:
        self._receive = receive
        self.source: Source = receive()
        self.findings: Findings

    def __iter__(self) -> Iterator[Item]:
        """Yield clouds and boxes; an error of the process is raised at its place."""
        while True:
            received = self._receive()
            if isinstance(received, Findings):
                self.findings = received
                del self._receive
                return
            yield received


def _read(
    messages: Callable[[], Iterator[Source | Item | Findings]],
    memory: list[mmap],
    receive: Receive,
    send: Send,
) -> None:
    """Send the messages."""
    send_shared = Sender(memory, receive, send)
    for message in messages():
        send_shared(message)


def _messages(
    request: Request, sweeps: StoredSweeps | None
) -> Generator[Source | Item | Findings]:
    """Yield the source of a recording, all its items, and the findings."""
    with source_of(request) as recording:
        _check_copies(request, recording)
        reading = RecordingReader(recording, request, Stopwatch(), sweeps)
        yield reading.source
        yield from reading
        yield reading.findings()


def _check_copies(request: Request, recording: ItemSource) -> None:
    """Refuse, before the work begins, a source whose clouds cannot be copied and edited."""
    kinds = {POINTS_TYPE}
    if isinstance(recording, Recording):
        kinds = {recording.topics[topic] for topic in recording.points_topics}
    if not request.cloud_copies or (isinstance(recording, Recording) and kinds == {POINTS_TYPE}):
        return
    raise ConfigError(
        f'clouds: expected a recording with {POINTS_TYPE}, which is copied with edited clouds, '
        f'got {", ".join(sorted(kinds - {POINTS_TYPE})) or recording}; ask for --label-points or '
        f'--clouds object alone'
    )
