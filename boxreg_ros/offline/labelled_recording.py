"""Recordings with boxes from label files or without any, and the sensor frame of label files."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from boxreg_ros.errors import RecordingError
from boxreg_ros.io.items import EVERYTHING, Item, ItemSource, Wanted
from boxreg_ros.io.recording import Recording
from boxreg_ros.io.transforms import TransformTree
from boxreg_ros.labels import frames_of
from boxreg_ros.labels.merging import LabelMerger
from boxreg_ros.structures import BoxArray
import numpy as np


class LabelledRecording(Recording):
    """
    Clouds and motion of a recording, with the boxes of label files in place of a topic.

    `LabelMerger` states their order and their frame.

    """

    has_boxes = False

    def __init__(self, labels: tuple[str, Path], paths: Any, **options: Any) -> None:
        super().__init__(paths, **options)
        self._labels = labels
        self._is_part = any(options.get(name) is not None for name in ('start', 'end'))

    def items(self, tree: TransformTree, wanted: Wanted = EVERYTHING) -> Iterator[Item]:
        """
        Yield clouds and boxes; see `Recording.items`.

        Boxes have `Item.refined`: status and covariances as in the label files.

        """
        merger = LabelMerger(
            frames_of(*self._labels), tree, self.sensor_frame(), self.start_ns, self._is_part
        )
        for cloud in super().items(tree, wanted._replace(clouds=True)):
            if wanted.clouds:
                yield cloud
            yield from merger.after(cloud.received_ns, cloud.content.stamp_ns)
        yield from merger.rest()
        self.outside = merger.outside


class UnlabelledRecording(Recording):
    """Clouds and motion of a recording, with an empty array of boxes at each cloud."""

    has_boxes = False

    def items(self, tree: TransformTree, wanted: Wanted = EVERYTHING) -> Iterator[Item]:
        """Yield clouds and empty arrays; see `Recording.items`."""
        for cloud in super().items(tree, wanted._replace(clouds=True)):
            if wanted.clouds:
                yield cloud
            sweep = cloud.content
            none = BoxArray(sweep.stamp_ns, sweep.frame_id, (), (), np.zeros(0), np.zeros((0, 9)))
            yield Item(cloud.received_ns, none)


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
            f'{fixed_frame!r}; TF: {tree}; choose another with --label-frame'
        )
    return frame
