"""The source of clouds and boxes that paths on the command line name."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from boxreg_ros.config import Config
from boxreg_ros.datasets.registry import Address, address_of
from boxreg_ros.datasets.scene_recording import SceneRecording
from boxreg_ros.errors import ConfigError, RecordingError
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.io.fixed_frame import FixedFrameItems
from boxreg_ros.io.items import EVERYTHING, Item, ItemSource, Wanted
from boxreg_ros.io.recording import Recording
from boxreg_ros.io.transform_tree import TransformTree
from boxreg_ros.io.transforms import inverse, moved_boxes
from boxreg_ros.labels import frames_of, module_of, Options
from boxreg_ros.labels.merging import LabelMerger
from boxreg_ros.offline.request import NO_TOPIC, Request
from boxreg_ros.structures import BoxArray
from msg_adapters.convention import Convention
import numpy as np
from numpy.typing import NDArray


class LabelledRecording(Recording):
    """Clouds and motion of a recording, and boxes of label files as `LabelMerger` orders them."""

    has_boxes = False

    def __init__(
        self,
        labels: tuple[str, Path],
        paths: Any,
        convention: Convention,
        keyframes: bool = False,
        with_rejected: bool = False,
        **options: Any,
    ) -> None:
        super().__init__(paths, **options)
        self._labels = labels
        self._label_convention = convention
        self._keyframes = keyframes
        self._with_rejected = with_rejected
        self._is_part = any(options.get(name) is not None for name in ('start', 'end'))

    def items(self, tree: TransformTree, wanted: Wanted = EVERYTHING) -> Iterator[Item]:
        """Yield clouds and boxes; see `Recording.items`. Boxes have `Item.refined`."""
        frames = frames_of(*self._labels, convention=self._label_convention)
        sensor_frame, is_part = self.sensor_frame(), self._is_part
        choice = self._keyframes, self._with_rejected
        merger = LabelMerger(frames, tree, sensor_frame, self.start_ns, is_part, *choice)
        for cloud in super().items(tree, wanted._replace(clouds=True)):
            if wanted.clouds:
                yield cloud
            yield from merger.after(cloud.received_ns, cloud.content.stamp_ns)
        yield from merger.rest()
        self.outside = merger.outside
        self.left_out = merger.left_out
        self.label_notes = merger.notes


class UnlabelledRecording(Recording):
    """Clouds and motion of a recording, with an empty array of boxes at each cloud."""

    has_boxes = False

    def items(self, tree: TransformTree, wanted: Wanted = EVERYTHING) -> Iterator[Item]:
        """Yield clouds and empty arrays; see `Recording.items`."""
        for cloud in super().items(tree, wanted._replace(clouds=True)):
            if wanted.clouds:
                yield cloud
            none = BoxArray.empty(cloud.content.stamp_ns, cloud.content.frame_id)
            yield Item(cloud.received_ns, none)


def label_frame_of(
    recording: ItemSource, tree: TransformTree, fixed_frame: str, wish: str | None
) -> str:
    """
    Return the sensor frame of label files.

    Parameters
    ----------
    recording : ItemSource
        Its clouds state the frame.
    tree : TransformTree
        With the transforms read so far.
    fixed_frame : str
        The frame has to be connected with it.
    wish : str or None
        Another frame; None for that of the clouds.

    Returns
    -------
    frame : str
        Without a leading slash.

    Raises
    ------
    RecordingError
        If the frame is not connected with the fixed one.

    """
    frame = (wish or recording.sensor_frame()).lstrip('/')
    if not tree.connects(fixed_frame, frame):
        raise RecordingError(
            f'{recording}: label frame {frame!r}: expected one that is connected with '
            f'{fixed_frame!r}; TF: {tree}; choose another with --label-frame'
        )
    return frame


def writer_options(request: Request) -> Options:
    """Return the options of the label writers, with the source as far as they use it."""
    if not request.recordings:
        return request.options
    recording = source_of(request)
    if isinstance(recording, Recording):
        return replace(request.options, recording=recording)
    if not any('camera' in module_of(name).FORMAT.options for name in request.formats):
        return request.options
    with recording:
        return replace(request.options, scene_camera=recording.camera)


def source_of(request: Request, with_rejected: bool = False) -> Recording | SceneRecording:
    """
    Return the recording or the scene of a data set that a request names, not yet open.

    Rejected labels are left out unless `with_rejected`.

    """
    address = scene_address(request.recordings)
    if address is not None:
        _check_scene(address, request)
        return SceneRecording(
            address,
            request.lidars.topics,
            request.start,
            request.end,
            request.labels,
            request.convention,
            request.keyframes,
            with_rejected,
        )
    names = ('lidars', 'odometry', 'start', 'end', 'tf', 'clock_offset')
    options = {name: getattr(request, name) for name in names}
    if request.labels is not None:
        choice = request.convention, request.keyframes, with_rejected
        return LabelledRecording(request.labels, request.recordings, *choice, **options)
    if request.boxes == NO_TOPIC:
        return UnlabelledRecording(request.recordings, **options)
    options |= {'boxes': request.boxes, 'convention': request.convention}
    return Recording(request.recordings, **options)


def scene_address(paths: Sequence[Path]) -> Address | None:
    """Return the address of a scene, which is alone, among paths; None if all are recordings."""
    addresses = [address for address in map(address_of, paths) if address is not None]
    if not addresses:
        return None
    if len(paths) > 1:
        raise ConfigError(
            f'recordings: expected one scene of a data set, got {", ".join(map(str, paths))}; '
            f'relabel them one by one, or with boxreg batch'
        )
    return addresses[0]


def _check_scene(address: Address, request: Request) -> None:
    """Refuse options of topics."""
    lidars, convention = request.lidars, request.convention
    if lidars.frames or lidars.info:
        raise ConfigError(
            f'sensor_frames, points_info: expected for recordings with topics only, got {lidars} '
            f'with {address}; leave them out: a data set has the positions of its LiDARs'
        )
    named = (
        ('boxes', request.boxes),
        ('odometry', request.odometry),
        ('tf', ', '.join(request.tf) or None),
        ('clock_offset', request.clock_offset or None),
    )
    for name, topic in named:
        if topic is not None:
            raise ConfigError(
                f'{name}: expected for recordings with topics only, got {topic!r} with {address}; '
                f'leave --{name.replace("_", "-")} out'
            )
    if not convention.is_standard and request.labels is None:
        raise ConfigError(
            f'{convention}: expected for boxes of a topic or of label files, got {address}; leave '
            f'it out: a data set has its own convention'
        )


def true_boxes(path: Path) -> BoxTable:
    """Return true boxes: those of a table that are not rejected, or the annotations of a scene."""
    address = address_of(path)
    if address is None:
        return BoxTable.read(path).without_rejected()
    arrays: list[BoxArray] = []
    num_points = [np.zeros(0, np.int64)]
    with SceneRecording(address) as scene:
        for item in FixedFrameItems(scene, Config()).read(with_clouds=False):
            if not isinstance(item.moved, BoxArray):
                continue  # without a pose
            annotations = item.refined
            assert annotations is not None
            arrays.append(item.moved)
            num_points.append(annotations.num_points)
    return replace(BoxTable.from_arrays(arrays), num_points=np.concatenate(num_points))


def in_labelled_view(path: Path, predicted: BoxTable) -> NDArray[np.bool_]:
    """
    Return which boxes the annotations of a data set could contain.

    Annotations that refer to a camera are of objects in its image, others of all around.

    Parameters
    ----------
    path : Path
        Of the true boxes: an address of a scene, or a file, which could contain all boxes.
    predicted : BoxTable
        n boxes, in the fixed frame of the true ones.

    Returns
    -------
    is_seen : array of bool, shape (n,)
        Whether a box is in the image, at least in part; True for all without a camera.

    Raises
    ------
    RecordingError
        If the scene cannot be read.

    """
    is_seen = np.ones(len(predicted.boxes), dtype=bool)
    address = address_of(path)
    if address is None:
        return is_seen
    with SceneRecording(address) as scene:
        if scene.camera is None:
            return is_seen
        for item in FixedFrameItems(scene, Config()).read(with_clouds=False):
            if item.moved is None or item.T_fixed_item is None:
                continue
            rows = np.flatnonzero(predicted.stamps_ns == item.moved.stamp_ns)
            # The camera is calibrated to the LiDAR, whose frame annotations are in.
            boxes = moved_boxes(predicted.boxes[rows], inverse(item.T_fixed_item))
            rectangles, _ = scene.camera.project(boxes)
            is_seen[rows] = np.isfinite(rectangles[:, 0])
    return is_seen
