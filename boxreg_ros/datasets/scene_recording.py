"""A scene of a data set as a source of clouds and boxes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Self

from boxreg_ros.datasets.protocol import Scene, SweepFile
from boxreg_ros.datasets.registry import Address, module_of, open_scene, resolved, scene_files
from boxreg_ros.errors import RecordingError, UnsupportedMessage
from boxreg_ros.io.items import EVERYTHING, Item, LOOKAHEAD_NS, requested_part, Wanted
from boxreg_ros.io.lidars import Lidars, SensorPlacement
from boxreg_ros.io.storage.record import Damage
from boxreg_ros.io.transform_tree import TransformTree
from boxreg_ros.labels import frames_of, LabelFrame
from boxreg_ros.labels.camera import Camera
from boxreg_ros.labels.merging import LabelMerger
from boxreg_ros.structures import Sweep
from msg_adapters.convention import Convention, STANDARD
import numpy as np

ANNOTATIONS = 'annotations'
"""Name of the boxes of a data set, where recordings have a topic."""


@dataclass(eq=False, repr=False)
class SceneRecording:
    """
    Clouds, poses and boxes of a scene, as `Recording` has those of a bag: an `ItemSource`.

    One sweep is in memory at a time. Sweeps that cannot be read are counted and left out. The
    LiDARs are by default the main one of the data set; `start` and `end` are counted from the
    first sweep [s]; with `labels`, a format and a path, the boxes are those of label files and
    not the annotations; with `keyframes` boxes that no person made are left out, rejected ones are
    unless `with_rejected`. Entering raises RecordingError if the scene or a part of it is missing.

    """

    has_boxes = True
    odometry_topic: ClassVar[str | None] = None
    apart: ClassVar[dict[str, float]] = {}  # no topic was recorded apart
    damages: ClassVar[list[Damage]] = []  # sweeps that cannot be read are counted

    address: Address
    lidars: Sequence[str] = ()
    start: float | None = None
    end: float | None = None
    labels: tuple[str, Path] | None = None
    convention: Convention = STANDARD
    keyframes: bool = False
    with_rejected: bool = False

    def __post_init__(self) -> None:
        """Begin with nothing read."""
        self._dataset = module_of(self.address.dataset).DATASET
        self.boxes_topic = '' if self.labels else ANNOTATIONS
        self.unreadable: Counter[str] = Counter()
        self.first_errors: dict[str, UnsupportedMessage] = {}
        self.placement = SensorPlacement()
        self.outside = 0
        self.left_out: Counter[str] = Counter()
        self.label_notes: list[str] = []
        self._readable = 0

    def __enter__(self) -> Self:
        """Read stamps, poses and boxes of the scene, but no cloud."""
        self.address = resolved(self.address)
        self._scene: Scene = open_scene(self.address, self.lidars)
        self.points_topic = self._scene.points_topic
        self.placement = SensorPlacement(Lidars(self._scene.lidars))
        first_ns, last_ns = self._scene.sweep_stamps_ns[[0, -1]].tolist()
        part_ns = requested_part(str(self), first_ns, last_ns + 1, self.start, self.end)
        self.start_ns, self.end_ns = part_ns
        if self.has_boxes:
            self._frames()  # raises if there are no boxes
        return self

    def __exit__(self, *_: object) -> None:
        """Release nothing: files are open only while they are read."""

    def __str__(self) -> str:
        """Return the address."""
        return str(self.address)

    @property
    def topics(self) -> dict[str, int]:
        """Return the number of sweeps of the LiDAR, and of frames with boxes."""
        counts = {self.points_topic: len(self._scene.sweep_stamps_ns)}
        if self._scene.lidars:
            counts = dict(Counter(sweep.lidar for sweep in self._scene.sweeps()))
        if self.labels is None and self._scene.boxes is not None:
            counts[ANNOTATIONS] = len(self._scene.frames.stamps_ns)
        return counts

    @property
    def finding(self) -> str:
        """Return what was assumed of the scene; empty if its files state everything."""
        return self._scene.note

    @property
    def files(self) -> list[Path]:
        """Return the files that the scene is read from."""
        return scene_files(self.address)

    @property
    def camera(self) -> Camera | None:
        """Return the camera that the boxes of the scene refer to; None if it states none."""
        return self._scene.frames.camera

    def sensor_frame(self) -> str:
        """Return the frame of the clouds."""
        return self._scene.frames.sensor_frame

    def choose_fixed_frame(self, tree: TransformTree, fixed_frame: str | None = None) -> str:
        """
        Return the fixed frame of the scene, and add its first pose to a tree.

        Parameters
        ----------
        tree : TransformTree
            Is given the pose of the frame of the clouds at the first stamp.
        fixed_frame : str, optional
            That is asked for, with or without a leading slash: that of the scene, or of the
            clouds.

        Returns
        -------
        frame : str
            Without a leading slash; by default that of the scene.

        Raises
        ------
        RecordingError
            If `fixed_frame` is another one.

        """
        frames = self._scene.frames
        known = (frames.fixed_frame, frames.sensor_frame)
        if fixed_frame is not None and fixed_frame.lstrip('/') not in known:
            raise RecordingError(
                f'{self}: expected the fixed frame {" or ".join(map(repr, known))}, got '
                f'{fixed_frame!r}; leave --fixed-frame out'
            )
        self._add_poses(tree, 0, int(self._scene.pose_stamps_ns[0]))
        return (fixed_frame or frames.fixed_frame).lstrip('/')

    def items(self, tree: TransformTree, wanted: Wanted = EVERYTHING) -> Iterator[Item]:
        """Yield clouds and boxes in order while `tree` follows; see `Recording.items`."""
        self.unreadable.clear()
        self.first_errors.clear()
        self._readable = 0
        tree.rewind(0)  # the pose that was read to choose a frame is read again
        frames = self._frames() if self.has_boxes else iter(())
        is_part = self.start is not None or self.end is not None
        sensor_frame = self.sensor_frame()
        merger = LabelMerger(
            frames, tree, sensor_frame, self.start_ns, is_part, self.keyframes, self.with_rejected
        )
        num_poses = 0
        for sweep in self._scene.sweeps():
            stamp_ns = sweep.stamp_ns
            if not self.start_ns <= stamp_ns < self.end_ns:
                continue
            num_poses = self._add_poses(tree, num_poses, stamp_ns + LOOKAHEAD_NS)
            if wanted.clouds:
                with wanted.stage('read'):
                    item = self._item(sweep, sensor_frame, wanted.intensities)
                if item is not None:
                    yield item
            yield from merger.after(stamp_ns, stamp_ns)
        self._add_poses(tree, num_poses, int(self._scene.pose_stamps_ns[-1]))
        yield from merger.rest()
        self.outside = merger.outside
        self.left_out = merger.left_out
        self.label_notes = merger.notes

    def check_readable(self) -> None:
        """Raise UnsupportedMessage if sweeps were missing and none was readable."""
        for topic, first in self.first_errors.items():
            if not self._readable:
                raise UnsupportedMessage(
                    f'{self}: none of {self.unreadable[topic]} sweeps of {topic!r} can be read; '
                    f'first: {first}; {self._dataset.remedy}'
                )

    def _frames(self) -> Iterator[LabelFrame]:
        """Return the boxes to refine, by stamp."""
        scene = self._scene
        if self.labels is not None:
            return frames_of(*self.labels, scene.frames, self.convention)
        if scene.boxes is not None:
            return scene.boxes()
        remedy = 'give label files with --labels'
        if self._dataset.labels:
            remedy = f'give detections or tracks with --labels {self._dataset.labels}:PATH'
        raise RecordingError(
            f'{self}: no boxes: expected {scene.without_boxes}, got none (a test split has none); '
            f'{remedy}'
        )

    def _item(self, sweep: SweepFile, frame_id: str, with_intensities: bool) -> Item | None:
        """Return a sweep; None, and counted, if it cannot be read."""
        try:
            cloud = sweep.read()
        except UnsupportedMessage as error:
            topic = sweep.lidar or self.points_topic
            self.unreadable[topic] += 1
            self.first_errors.setdefault(topic, error)
            return None
        self._readable += 1
        origins = None if cloud.sensors is None else cloud.origins
        content = Sweep(
            sweep.stamp_ns, frame_id, cloud.points, cloud.times, cloud.origins.mean(axis=0),
            topic=sweep.lidar, origins=origins, sensors=cloud.sensors,
        )  # fmt: skip
        return Item(sweep.stamp_ns, content, cloud.intensities if with_intensities else None)

    def _add_poses(self, tree: TransformTree, first: int, until_ns: int) -> int:
        """Add the poses from number `first` up to a stamp [ns]; return the number of the next."""
        scene = self._scene
        end = int(np.searchsorted(scene.pose_stamps_ns, until_ns, side='right'))
        for stamp_ns, pose in zip(
            scene.pose_stamps_ns[first:end].tolist(), scene.poses[first:end], strict=True
        ):
            tree.add_pose(scene.frames.fixed_frame, scene.frames.sensor_frame, stamp_ns, pose)
        return end
