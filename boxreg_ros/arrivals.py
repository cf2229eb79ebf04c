"""Messages of a recording on their way to the registrar: read, decoded, in the fixed frame."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import NamedTuple

from boxreg_ros.errors import TransformUnavailable, UnsupportedMessage
from boxreg_ros.intake import Intake
from boxreg_ros.labelled import label_frame_of, pose_of
from boxreg_ros.recording import Recording
from boxreg_ros.request import Request
from boxreg_ros.stopwatch import Stopwatch
from boxreg_ros.structures import BoxArray, Floats, Sweep
from boxreg_ros.transforms import to_fixed_frame, TransformTree


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


class Arrivals:
    """
    All that happens to messages before the registrar: reading, decoding, the fixed frame.

    Iterating may happen in another thread: nothing here is used by others until that is over,
    but for the frames and `seconds`, which stay what they are.

    Attributes
    ----------
    counts : Counter
        Sweeps, box arrays and time jumps, and what was not used by reason.
    first_missing_transform : str
        What is not known of the first item without a transform; else empty.

    """

    def __init__(self, recording: Recording, request: Request, clock: Stopwatch) -> None:
        self._recording = recording
        self._clock = clock
        self._tree = TransformTree()
        self._with_points = request.options.with_points
        self.fixed_frame = recording.choose_fixed_frame(self._tree, request.fixed_frame)
        self.sensor_frame = label_frame_of(
            recording, self._tree, self.fixed_frame, request.label_frame
        )
        self.seconds = (recording.end_ns - recording.start_ns) * 1e-9
        self.intake = Intake(request.convention, request.config)
        self.counts: Counter[str] = Counter()
        self.first_missing_transform = ''

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
            self.counts['sweeps' if is_cloud else 'box_arrays'] += 1
            begins_anew = self.intake.begins_anew(given)
            self.counts['time_jump'] += begins_anew
            is_kept = is_written or not is_cloud
            with self._clock('transform'):
                arrival = Arrival(
                    (record.received_ns - self._recording.start_ns) * 1e-9,
                    begins_anew,
                    given if is_kept else None,
                    self._moved(given),
                    self._pose_of(given.frame_id, given.stamp_ns) if is_kept else None,
                    self._pose_of(self.sensor_frame, given.stamp_ns) if is_kept else None,
                    intensities,
                )
            yield arrival
        for topic, first in self._recording.first_errors.items():
            if topic not in read and topic in self._recording.data_topics:
                raise UnsupportedMessage(f'no message on {topic!r} can be read; first: {first}')

    def _moved(self, given: Sweep | BoxArray) -> Sweep | BoxArray | None:
        """Return a cloud or boxes in the fixed frame; None, and counted, where it is unknown."""
        try:
            return self.intake.take(to_fixed_frame(given, self._tree, self.fixed_frame))
        except TransformUnavailable as error:
            self.counts['sweep_without_transform'] += isinstance(given, Sweep)
            self.first_missing_transform = self.first_missing_transform or str(error)
            return None

    def _pose_of(self, frame: str, stamp_ns: int) -> Floats | None:
        return pose_of(self._tree, self.fixed_frame, frame, stamp_ns)
