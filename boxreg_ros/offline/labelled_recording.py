"""Recordings with boxes from label files, and the sensor frame of label files."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from boxreg_ros.errors import RecordingError, TransformUnavailable
from boxreg_ros.io.recording import Item, ItemSource, not_measured, Recording, Stage
from boxreg_ros.io.transforms import TransformTree
from boxreg_ros.labels import frames_of, LabelFrame
from boxreg_ros.structures import Floats


class LabelledRecording(Recording):
    """
    Clouds and motion of a recording, with the boxes of label files in place of a topic.

    The boxes of a stamp follow the sweep of that stamp, or the next one. Boxes whose labels have
    poses in the sensor frame are taken in the frame of the clouds and move with the recording;
    the others are taken in the frame that the labels name.

    Parameters
    ----------
    labels : tuple of str and Path
        Format and files.
    paths, options
        As those of `Recording`.

    """

    has_boxes = False

    def __init__(self, labels: tuple[str, Path], paths: Any, **options: Any) -> None:
        super().__init__(paths, **options)
        self._labels = labels
        self._is_part = any(options.get(name) is not None for name in ('start', 'end'))

    def items(
        self,
        tree: TransformTree,
        *,
        with_clouds: bool = True,
        with_intensities: bool = False,
        stage: Stage = not_measured,
    ) -> Iterator[Item]:
        """
        Yield clouds and boxes; see `Recording.items`.

        Boxes have `Item.refined`: status and covariances as in the label files.

        """
        self.outside = 0
        frames = frames_of(*self._labels)
        frame = next(frames, None)
        sensor_frame = self.sensor_frame()
        received_ns = self.start_ns
        first_ns: int | None = None
        newest_ns = 0
        clouds = super().items(tree, with_intensities=with_intensities, stage=stage)
        for cloud in clouds:
            received_ns = cloud.received_ns
            newest_ns = max(newest_ns, cloud.content.stamp_ns)
            if first_ns is None:
                first_ns = newest_ns
            if with_clouds:
                yield cloud
            while frame is not None and _stamp(frame) <= newest_ns:
                if self._is_part and _stamp(frame) < first_ns:
                    self.outside += len(frame.refined.status)
                else:
                    yield _item(frame, received_ns, tree, sensor_frame)
                frame = next(frames, None)
        while frame is not None:  # later than the last cloud
            if self._is_part:
                self.outside += len(frame.refined.status)
            else:
                yield _item(frame, received_ns, tree, sensor_frame)
            frame = next(frames, None)


def _item(frame: LabelFrame, received_ns: int, tree: TransformTree, sensor_frame: str) -> Item:
    """Return the boxes of a label frame, in a frame that the transforms know if possible."""
    placed = frame.moved('sensor')
    boxes = placed.refined.boxes
    is_sensor = frame.sensor_frame != '' and boxes.frame_id == frame.sensor_frame
    if is_sensor and not tree.connects(boxes.frame_id, sensor_frame):
        boxes = replace(boxes, frame_id=sensor_frame)
    return Item(received_ns, boxes, refined=replace(placed.refined, boxes=boxes))


def _stamp(frame: LabelFrame) -> int:
    return frame.refined.boxes.stamp_ns


def pose_of(tree: TransformTree, fixed_frame: str, frame: str, stamp_ns: int) -> Floats | None:
    """Return the pose of `frame` in the fixed frame; None if unknown."""
    try:
        return tree.lookup(fixed_frame, frame, stamp_ns)
    except TransformUnavailable:
        return None


def label_frame_of(
    recording: ItemSource, tree: TransformTree, fixed_frame: str, wish: str | None
) -> str:
    """
    Return the sensor frame of label files: the frame of the clouds, or `wish`.

    Raises
    ------
    RecordingError
        If no transforms connect it with the fixed frame.

    """
    frame = (wish or recording.sensor_frame()).lstrip('/')
    if not tree.connects(fixed_frame, frame):
        raise RecordingError(
            f'{recording}: label frame {frame!r}: expected one that is connected with '
            f'{fixed_frame!r}; TF: {tree}'
        )
    return frame
