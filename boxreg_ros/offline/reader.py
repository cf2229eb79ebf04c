"""
Items of a recording on their way to the registrar: read, decoded, in the fixed frame.

This runs in a process of its own, a few items ahead of the registrar, or in that of a run on one
core; see `reader`.

"""

from __future__ import annotations

from collections import Counter
from collections.abc import Generator, Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from functools import partial
from typing import cast, NamedTuple

from boxreg_ros.config import Config
from boxreg_ros.io.items import Item, ItemSource
from boxreg_ros.io.lidars import MergedSweep
from boxreg_ros.io.session import Admitted, is_placeholder, JumpConfirmation, Session
from boxreg_ros.io.storage.record import Damage
from boxreg_ros.io.transforms import inverse, sweep_to_frame
from boxreg_ros.offline.labelled_recording import label_frame_of, pose_of
from boxreg_ros.offline.request import Request
from boxreg_ros.offline.stopwatch import Stopwatch
from boxreg_ros.offline.worker_process import Receive, run_in_worker, Send
from boxreg_ros.structures import BoxArray, Floats, Sweep
import numpy as np


class ReadItem(NamedTuple):
    """
    A cloud or boxes for the registrar, with the poses that label files need.

    Attributes
    ----------
    seconds : float
        Time since the start of the part that is read [s].
    restarts : bool
        True if time went back before this item.
    given, moved : Sweep or BoxArray, or None
        In its own and in the fixed frame. `given` is None for a cloud that is not written;
        `moved` is None where no transform is known.
    T_fixed_given, T_fixed_sensor : array, shape (4, 4), or None
        Poses of its own frame and of the sensor frame of label files. None where unknown, and
        for a cloud that is not written.
    intensities : array, shape (M,), or None
        Of a cloud that is written.

    """

    seconds: float
    restarts: bool
    given: Sweep | BoxArray | None
    moved: Sweep | BoxArray | None
    T_fixed_given: Floats | None
    T_fixed_sensor: Floats | None
    intensities: Floats | None


class Source(NamedTuple):
    """
    Properties of a recording that are known before the first item.

    Attributes
    ----------
    topics : dict
        Topics of points, boxes and odometry; None where there is none.
    fixed_frame, sensor_frame : str
        Frame to refine in, and sensor frame of label files.
    seconds : float
        Duration of the part that is read [s].

    """

    topics: dict[str, str | None]
    fixed_frame: str
    sensor_frame: str
    seconds: float


class Findings(NamedTuple):
    """
    Properties of a recording that are known after the last item.

    Attributes
    ----------
    counts : Counter
        Sweeps, box arrays, time jumps, clouds without a transform or whose LiDARs are not all
        known, and clouds and box arrays without a stamp.
    first_missing_transform : str
        Error of the first item without a transform; empty if there is none.
    first_unplaced : str
        Error of the first cloud whose LiDARs are not all known; empty if there is none.
    lidars : dict of str and Counter
        Of each of several topics of clouds: clouds that were merged, late and missing.
    point_layouts : dict of str
        Layout of the clouds of each topic, and how the times of their points are read.
    unreadable, first_unreadable : int and str
        Number of unreadable messages, and the first error of each topic.
    apart : dict
        Topics that were recorded apart from the clouds, and by how much [s].
    damages : list of Damage
        Parts of the files that could not be read.
    outside : int
        Boxes of label files outside of the part that is read.
    warning, facts : str and dict
        Finding of the pose check, and origin of the ids.
    seconds : dict
        Time spent in each stage [s].

    """

    counts: Counter[str]
    first_missing_transform: str
    first_unplaced: str
    lidars: dict[str, Counter[str]]
    point_layouts: dict[str, str]
    unreadable: int
    first_unreadable: str
    apart: dict[str, float]
    damages: list[Damage]
    outside: int
    warning: str
    facts: dict[str, object]
    seconds: dict[str, float]


class RecordingReader:
    """
    Read a recording and bring its items into the fixed frame.

    Parameters
    ----------
    recording : ItemSource
        Open.
    request : Request
        Frames, convention and settings.
    clock : Stopwatch
        Measures the stages ``read``, ``decode`` and ``transform``.

    Attributes
    ----------
    source : Source
        Known before the first item.

    """

    def __init__(self, recording: ItemSource, request: Request, clock: Stopwatch) -> None:
        self._recording = recording
        self._clock = clock
        self._with_points = request.options.with_points
        self._with_times = request.config.sampling.deskew
        self._session = Session(request.convention, request.config, placement=recording.placement)
        self._is_merging = len(recording.placement.lidars.topics) > 1
        self._jumps = JumpConfirmation[Item]()
        tree = self._session.tree
        with clock('read'):
            fixed_frame = recording.choose_fixed_frame(tree, request.fixed_frame)
            sensor_frame = label_frame_of(recording, tree, fixed_frame, request.label_frame)
        self._session.fixed_frame = fixed_frame
        topics = {
            'points': ', '.join(recording.placement.lidars.topics) or recording.points_topic,
            'boxes': recording.boxes_topic or None,
            'odometry': recording.odometry_topic,
        }
        seconds = (recording.end_ns - recording.start_ns) * 1e-9
        self.source = Source(topics, fixed_frame, sensor_frame, seconds)
        self._counts: Counter[str] = Counter()
        self._first_missing_transform = ''
        self._first_unplaced = ''
        self._restarts = False

    def __iter__(self) -> Iterator[ReadItem]:
        """
        Yield clouds and boxes in the order they were received.

        Raises
        ------
        UnsupportedMessage
            At the end, if no cloud, or no message of boxes, was readable.

        """
        items = self._recording.items(
            self._session.tree, with_intensities=self._with_points, stage=self._clock
        )
        for item in items:
            confirmed, restarts = [item], False
            if not is_placeholder(item.content):
                confirmed, restarts = self._jumps.add(item, item.content)
            if restarts:
                yield from map(self._merged_item, self._session.unmerged())
                # The tree, which is ahead of the items, has detected the jump itself.
                self._session.restart()
                self._counts['time_jump'] += 1
                self._restarts = True
            for ready in confirmed:
                yield from self._read_items(ready)
        for late in self._jumps.release():
            yield from self._read_items(late)
        yield from map(self._merged_item, self._session.unmerged())
        self._recording.check_readable()

    def findings(self) -> Findings:
        """Return the properties that are known after the last item."""
        recording = self._recording
        return Findings(
            self._counts,
            self._first_missing_transform,
            self._first_unplaced,
            self._session.lidar_counts,
            recording.placement.layouts,
            recording.unreadable.total(),
            '; '.join(map(str, recording.first_errors.values())),
            recording.apart,
            recording.damages,
            recording.outside,
            self._session.finding,
            self._session.facts,
            self._clock.stages(),
        )

    def _count(self, given: Sweep | BoxArray, admitted: Admitted) -> None:
        kind = 'sweeps' if isinstance(given, Sweep) else 'box_arrays'
        if not (self._is_merging and isinstance(given, Sweep)):  # those are counted merged
            self._counts[kind] += 1
        if given.stamp_ns <= 0 and not is_placeholder(given):
            self._counts[f'{kind}_without_stamp'] += 1
        if not admitted.reason:
            return
        if isinstance(given, Sweep):
            self._counts[admitted.reason] += 1
        if admitted.moved is None:
            self._first_missing_transform = self._first_missing_transform or admitted.detail
        else:
            self._first_unplaced = self._first_unplaced or admitted.detail

    def _read_items(self, item: Item) -> Iterator[ReadItem]:
        """Yield an item in the fixed frame, or the sweeps that are complete with its cloud."""
        with self._clock('transform'):
            admitted = self._session.admit(item.content)
            self._count(item.content, admitted)
            if not self._is_merging or not isinstance(item.content, Sweep):
                yield self._trimmed(item, admitted)
                return
            if not isinstance(admitted.moved, Sweep):
                return  # the other LiDARs go on
            complete = self._session.merged(admitted.moved, item)
        yield from map(self._merged_item, complete)

    def _merged_item(self, merged: MergedSweep) -> ReadItem:
        """Return a sweep of several LiDARs; files get it in their sensor frame."""
        items = cast(tuple[Item, ...], merged.extras)
        self._counts['sweeps'] += 1
        with self._clock('transform'):
            sweep = merged.sweep
            sensor_frame = self.source.sensor_frame
            T_fixed_sensor = pose_of(
                self._session.tree, sweep.frame_id, sensor_frame, sweep.stamp_ns
            )
            given = sweep
            if T_fixed_sensor is not None:
                given = sweep_to_frame(sweep, inverse(T_fixed_sensor), sensor_frame)
            intensities = [item.intensities for item in items]
            known = [values for values in intensities if values is not None]
            whole = Item(
                items[-1].received_ns,
                given,
                np.concatenate(known) if len(known) == len(items) else None,
            )
            return self._trimmed(whole, Admitted(sweep, T_fixed_sensor))

    def _trimmed(self, item: Item, admitted: Admitted) -> ReadItem:
        """Return an item without the parts that are not read: it is copied to a process."""
        restarts = self._restarts
        self._restarts = False
        given = item.content
        moved = admitted.moved
        if isinstance(moved, Sweep) and not self._with_times:
            moved = replace(moved, times=None)
        seconds = (item.received_ns - self._recording.start_ns) * 1e-9
        if isinstance(given, Sweep) and not self._with_points:
            return ReadItem(seconds, restarts, None, moved, None, None, None)
        fixed_frame = self.source.fixed_frame
        T_fixed_sensor = pose_of(
            self._session.tree, fixed_frame, self.source.sensor_frame, given.stamp_ns
        )
        return ReadItem(
            seconds, restarts, given, moved, admitted.T_fixed_item, T_fixed_sensor,
            item.intensities,
        )  # fmt: skip


@contextmanager
def reader(request: Request) -> Iterator[Receive]:
    """
    Yield, for a block, a function that returns the next message for `ReadAhead`.

    The recording is read in a process of its own, or in this one where it may use one core only.

    """
    if uses_one_core(request.config):
        with closing(_messages(request)) as messages:
            yield messages.__next__
        return
    with run_in_worker(partial(_read, request), 'reads the recording') as process:
        yield process.receive


def uses_one_core(config: Config) -> bool:
    """Return whether a run is one process: more would use more cores, and copy every sweep."""
    return config.solver.threads == 1


class ReadAhead:
    """
    Iterate over the items that a `RecordingReader` yields, in another process a few ahead.

    Parameters
    ----------
    receive : callable
        From `reader`.

    Attributes
    ----------
    source : Source
        Known before the first item.
    findings : Findings
        Known after the last item; not set before.

    """

    def __init__(self, receive: Receive) -> None:
        self._receive = receive
        self.source: Source = receive()
        self.findings: Findings

    def __iter__(self) -> Iterator[ReadItem]:
        """Yield clouds and boxes; an error of the process is raised at its place."""
        while True:
            received = self._receive()
            if isinstance(received, Findings):
                self.findings = received
                return
            yield received


def _read(request: Request, _: Receive, send: Send) -> None:
    for message in _messages(request):
        send(message)


def _messages(request: Request) -> Generator[Source | ReadItem | Findings]:
    """Yield the source of a recording, all its items, and the findings."""
    with request.recording() as recording:
        reading = RecordingReader(recording, request, Stopwatch())
        yield reading.source
        yield from reading
        yield reading.findings()
