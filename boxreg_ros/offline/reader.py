"""
Messages of a recording on their way to the registrar: read, decoded, in the fixed frame.

That happens in a process beside the one that uses them, as `Coming` says.

"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

from boxreg_ros.errors import TransformUnavailable, UnsupportedMessage
from boxreg_ros.io.recording import Recording
from boxreg_ros.io.session import Intake
from boxreg_ros.io.transforms import to_fixed_frame, TransformTree
from boxreg_ros.offline.labelled_recording import label_frame_of, LabelledRecording, pose_of
from boxreg_ros.offline.request import Request
from boxreg_ros.offline.stopwatch import Stopwatch
from boxreg_ros.offline.worker_process import run_in_worker, WorkerProcess
from boxreg_ros.structures import BoxArray, Floats, Sweep


class Arrival(NamedTuple):
    """
    A cloud or boxes on the way to the registrar, and what files need to know with them.

    Attributes
    ----------
    seconds : float
        Part of the recording that lies behind [s].
    begins_anew : bool
        Stamps start again with it.
    given, moved : Sweep or BoxArray, or None
        In its own and in the fixed frame: `given` is None for a cloud that is not written,
        `moved` where nothing connects the frames.
    T_fixed_given, T_fixed_sensor : array, shape (4, 4), or None
        Poses of its own frame, and of that which stands for the sensor's in label files; None
        where unknown, and for a cloud that is not written.
    intensities : array, shape (M,), or None
        Those of a cloud, if they are written.

    """

    seconds: float
    begins_anew: bool
    given: Sweep | BoxArray | None
    moved: Sweep | BoxArray | None
    T_fixed_given: Floats | None
    T_fixed_sensor: Floats | None
    intensities: Floats | None


class Source(NamedTuple):
    """
    What a recording turned out to be.

    Attributes
    ----------
    topics : dict
        Topics of points, boxes and odometry; None where there is none.
    fixed_frame, sensor_frame : str
        That to refine in, and that which stands for the sensor's in label files.
    seconds : float
        How long it lasts [s].

    """

    topics: dict[str, str | None]
    fixed_frame: str
    sensor_frame: str
    seconds: float


class Findings(NamedTuple):
    """
    What was found while a recording was read.

    Attributes
    ----------
    counts : Counter
        Sweeps, box arrays and time jumps, and what was not used by reason.
    first_missing_transform : str
        What is not known of the first item without a transform; else empty.
    unreadable, first_unreadable : int and str
        How many messages could not be read, and why the first of each topic could not.
    apart : dict
        By how much topics were recorded apart from the clouds [s].
    outside : int
        Boxes of label files outside the part that was asked for.
    warning, facts : str and dict
        What `Intake` says of the boxes and of their ids.
    seconds : dict
        What each stage took [s].

    """

    counts: Counter[str]
    first_missing_transform: str
    unreadable: int
    first_unreadable: str
    apart: dict[str, float]
    outside: int
    warning: str
    facts: dict[str, object]
    seconds: dict[str, float]


class Arrivals:
    """
    All that happens to messages before the registrar: reading, decoding, the fixed frame.

    Attributes
    ----------
    source : Source
        What is known before the first item.

    """

    def __init__(self, recording: Recording, request: Request, clock: Stopwatch) -> None:
        self._recording = recording
        self._clock = clock
        self._tree = TransformTree()
        self._with_points = request.options.with_points
        self._with_times = request.config.sampling.deskew
        with clock('read'):
            fixed = recording.choose_fixed_frame(self._tree, request.fixed_frame)
            sensor = label_frame_of(recording, self._tree, fixed, request.label_frame)
        topics = {
            'points': recording.points_topic,
            'boxes': recording.boxes_topic or None,
            'odometry': recording.odometry_topic,
        }
        seconds = (recording.end_ns - recording.start_ns) * 1e-9
        self.source = Source(topics, fixed, sensor, seconds)
        self._intake = Intake(request.convention, request.config)
        self._counts: Counter[str] = Counter()
        self._first_missing_transform = ''

    def __iter__(self) -> Iterator[Arrival]:
        """
        Yield clouds and boxes in the order they were received, but for those unreadable.

        Raises
        ------
        UnsupportedMessage
            At the end, if no cloud, or no message of boxes, was readable.

        """
        read: set[str] = set()
        for record in self._clock.each('read', self._recording.records(self._tree)):
            topic = record.connection.topic
            with self._clock('decode'):
                try:
                    given = self._recording.decode(record)
                except UnsupportedMessage as error:
                    self._recording.pass_over(record, error)
                    continue
                is_cloud = isinstance(given, Sweep)
                is_written = is_cloud and self._with_points
                intensities = self._recording.intensities(record) if is_written else None
            read.add(topic)
            self._counts['sweeps' if is_cloud else 'box_arrays'] += 1
            begins_anew = self._intake.begins_anew(given)
            self._counts['time_jump'] += begins_anew
            is_kept = is_written or not is_cloud
            with self._clock('transform'):
                arrival = Arrival(
                    (record.received_ns - self._recording.start_ns) * 1e-9,
                    begins_anew,
                    given if is_kept else None,
                    self._moved(given),
                    self._pose_of(given.frame_id, given.stamp_ns) if is_kept else None,
                    self._pose_of(self.source.sensor_frame, given.stamp_ns) if is_kept else None,
                    intensities,
                )
            yield arrival
        for topic, first in self._recording.first_errors.items():
            if topic not in read and topic in self._recording.data_topics:
                raise UnsupportedMessage(f'no message on {topic!r} can be read; first: {first}')

    def findings(self) -> Findings:
        """Return what is known after the last item."""
        recording = self._recording
        return Findings(
            self._counts,
            self._first_missing_transform,
            recording.unreadable.total(),
            '; '.join(map(str, recording.first_errors.values())),
            recording.apart,
            recording.outside if isinstance(recording, LabelledRecording) else 0,
            self._intake.finding,
            self._intake.facts,
            self._clock.stages(),
        )

    def _moved(self, given: Sweep | BoxArray) -> Sweep | BoxArray | None:
        """Return a cloud or boxes in the fixed frame; None, and counted, where it is unknown."""
        if isinstance(given, Sweep) and not self._with_times:
            given = replace(given, times=None)
        try:
            return self._intake.take(to_fixed_frame(given, self._tree, self.source.fixed_frame))
        except TransformUnavailable as error:
            self._counts['sweep_without_transform'] += isinstance(given, Sweep)
            self._first_missing_transform = self._first_missing_transform or str(error)
            return None

    def _pose_of(self, frame: str, stamp_ns: int) -> Floats | None:
        return pose_of(self._tree, self.source.fixed_frame, frame, stamp_ns)


def reader(request: Request) -> AbstractContextManager[WorkerProcess]:
    """Return, for a block, the process that reads a recording for `Coming`."""
    return run_in_worker(partial(_read, request), 'reads the recording')


class Coming:
    """
    `Arrivals` as another process makes them, at most a few ahead; that process opens them, too.

    Parameters
    ----------
    peer : WorkerProcess
        The process, from `reader`.

    Attributes
    ----------
    source : Source
        What is known before the first item.
    findings : Findings
        What is known after the last one; not before.

    """

    def __init__(self, peer: WorkerProcess) -> None:
        self._peer = peer
        self.source: Source = peer.receive()
        self.findings: Findings

    def __iter__(self) -> Iterator[Arrival]:
        """Yield clouds and boxes; errors are raised where they came."""
        while not isinstance(item := self._peer.receive(), Findings):
            yield item
        self.findings = item


def _read(request: Request, _: Callable[[], Any], send: Callable[[Any], None]) -> None:
    with request.recording() as recording:
        arrivals = Arrivals(recording, request, Stopwatch())
        send(arrivals.source)
        for arrival in arrivals:
            send(arrival)
        send(arrivals.findings())
