"""Recordings whose boxes come from label files, and the frames that labels are written in."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from boxreg_ros.errors import RecordingError, TransformUnavailable
from boxreg_ros.io.recording import Record, Recording
from boxreg_ros.io.transforms import TransformTree
from boxreg_ros.labels import frames_of, LabelFrame
from boxreg_ros.structures import BoxArray, Floats, Sweep


class LabelledRecording(Recording):
    """
    Clouds and motion of a recording, and the boxes of label files as if they were in it.

    Boxes come after the sweep of their stamp, or the next. They are taken in the frame of the
    sensor where the labels tell how they are placed in it, and move with the recording; else in
    the frame they name.

    Parameters
    ----------
    labels : tuple of str and Path
        Format and files.
    paths, options
        As those of `Recording`.

    Attributes
    ----------
    label : LabelFrame
        What the boxes last decoded are of.
    outside : int
        Boxes of the label files outside of the part that is read.

    """

    has_boxes = False
    label: LabelFrame

    def __init__(self, labels: tuple[str, Path], paths: Any, **options: Any) -> None:
        super().__init__(paths, **options)
        self._labels = labels
        self._is_part = any(options.get(name) is not None for name in ('start', 'end'))
        self._newest_ns: int | None = None
        self.outside = 0

    def records(self, tree: TransformTree) -> Iterator[Record]:
        """Yield clouds and stand-ins for labels; each wants to be decoded before the next."""
        frames = frames_of(*self._labels)
        sensor_frame = self.sensor_frame()
        waiting = next(frames, None)
        begin_ns: int | None = None
        for record in super().records(tree):
            yield record
            begin_ns = self._newest_ns if begin_ns is None else begin_ns
            while waiting is not None and _stamp(waiting) <= (self._newest_ns or 0):
                if self._is_part and _stamp(waiting) < (begin_ns or 0):
                    self.outside += len(waiting.refined.status)
                else:
                    yield self._stand_in(record, waiting, tree, sensor_frame)
                waiting = next(frames, None)
        while waiting is not None:
            if self._is_part:
                self.outside += len(waiting.refined.status)
            else:
                yield self._stand_in(record, waiting, tree, sensor_frame)
            waiting = next(frames, None)

    def decode(self, record: Record) -> Sweep | BoxArray:
        """Return the sweep of a record, or the boxes it stands for."""
        if record.connection.topic != self.points_topic:
            return self.label.refined.boxes
        item = super().decode(record)
        self._newest_ns = max(self._newest_ns or item.stamp_ns, item.stamp_ns)
        return item

    def _stand_in(
        self, record: Record, frame: LabelFrame, tree: TransformTree, sensor_frame: str
    ) -> Record:
        """Return a record that stands for boxes, and remember those."""
        placed = frame.moved('sensor')
        boxes = placed.refined.boxes
        is_sensor = frame.sensor_frame != '' and boxes.frame_id == frame.sensor_frame
        if is_sensor and not tree.connects(boxes.frame_id, sensor_frame):
            boxes = replace(boxes, frame_id=sensor_frame)
        self.label = replace(placed, refined=replace(placed.refined, boxes=boxes))
        return record._replace(connection=record.connection._replace(topic=''), data=b'')


def _stamp(frame: LabelFrame) -> int:
    return frame.refined.boxes.stamp_ns


def pose_of(tree: TransformTree, fixed_frame: str, frame: str, stamp_ns: int) -> Floats | None:
    """Return the pose of `frame` in the fixed frame; None if unknown."""
    try:
        return tree.lookup(fixed_frame, frame, stamp_ns)
    except TransformUnavailable:
        return None


def label_frame_of(
    recording: Recording, tree: TransformTree, fixed_frame: str, wish: str | None
) -> str:
    """
    Return the frame that stands for the sensor's in label files: that of the clouds, or `wish`.

    Raises
    ------
    RecordingError
        If nothing connects it with the fixed frame.

    """
    frame = (wish or recording.sensor_frame()).lstrip('/')
    if not tree.connects(fixed_frame, frame):
        raise RecordingError(
            f'{recording}: label frame {frame!r}: expected one that is connected with '
            f'{fixed_frame!r}; TF: {tree}'
        )
    return frame
