"""The protocol of the modules of label formats: description, reader and writer."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
import os
from pathlib import Path
from typing import Protocol, TYPE_CHECKING

from boxreg_ros import __version__
from boxreg_ros.config import Config
from boxreg_ros.io.transforms import boxes_to_frame, inverse
from boxreg_ros.options import option
from boxreg_ros.reasons import Reason
from boxreg_ros.structures import (
    ADDED,
    Floats,
    Ints,
    is_valid_box,
    RefinedBoxes,
    REJECTED,
    Sweep,
)
import numpy as np

if TYPE_CHECKING:
    from boxreg_ros.core.point_labels import PointLabels
    from boxreg_ros.io.recording import Recording
    from boxreg_ros.labels.camera import Camera

INPUT_STATUS = 'input'
"""Status of boxes whose label file states none."""
AUTOMATIC_STATUS = 'automatic'
"""Status of boxes that a model, a tracker or another tool made, and no person has touched."""
NOT_OF_A_PERSON = (*ADDED, AUTOMATIC_STATUS)
"""Status of boxes that are no keyframes; labelling tools interpolate, as we do."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Format:
    """The conventions of a format, as ``boxreg formats`` prints them."""

    name: str
    """On the command line."""
    title: str
    """In prose."""
    frame: str
    """Of the boxes."""
    reference: str = 'centre'
    """Point of the box at its position."""
    sizes: str = 'length width height'
    """Order of the extents."""
    rotation: str
    """Parameters of the orientation, and the angles that are lost."""
    files: str
    """That the writer creates, and folders, with commas; ``STAMP`` stands for one per frame."""
    packages: tuple[str, ...] = ()
    """Of pip, needed beyond those of boxreg_ros itself."""
    options: tuple[str, ...] = ()
    """Fields of `Options` that the writer uses."""
    has_points: bool = False
    """Whether it labels points; then ``boxreg relabel`` alone writes it."""
    reads: str = ''
    """What is read of files of others, in a few words."""
    leaves_out: str = ''
    """What these files may have beside it, and is not read."""
    read_back: str = ''
    """Library and version that our files were read by, in the tests."""


@dataclass(frozen=True, slots=True)
class LabelFrame:
    """The boxes of one stamp, with the poses by which formats write them in their own frame."""

    refined: RefinedBoxes
    """In the fixed frame, but for boxes without a transform to it; covariances use its axes."""
    fixed_frame: str
    """Name of the frame; so is `sensor_frame`."""
    sensor_frame: str
    T_fixed_sensor: Floats | None = None
    """Pose (4, 4) of the sensor at the stamp of the boxes; None if unknown."""
    sweep: Sweep | None = None
    """Point cloud of that stamp in the sensor frame, if clouds are written."""
    intensities: Floats | None = None
    """(M,), of its points in the unit of the sensor; None if it has none."""
    T_fixed_given: Floats | None = None
    """Pose (4, 4) of the frame of the input boxes; None if unknown."""
    points: PointLabels | None = None
    """Labels of the points of `sweep`, for formats of points."""
    left_out: Mapping[str, int] = field(default_factory=dict)
    """Boxes of the file at this stamp that `refined` lacks, by `Reason`."""
    note: str = ''
    """What the reader assumed of the files, where they do not state it; on the first frame."""

    def boxes_in(self, frame: str, dropped: Counter[str]) -> tuple[Ints, Floats]:
        """
        Return the boxes that a format can write in a frame.

        Parameters
        ----------
        frame : str
            'fixed' or 'sensor'.
        dropped : Counter
            Boxes left out are added to it: ``invalid_box`` (of `is_valid_box`) and
            ``no_transform`` (no transform to `frame`).

        Returns
        -------
        rows : array, shape (k,)
            Rows of `refined`, ascending.
        boxes : array, shape (k, 9)
            x y z length width height roll pitch yaw in this frame [m, rad].

        """
        boxes = self.moved(frame).refined.boxes
        rows = np.flatnonzero(is_valid_box(self.refined.boxes.boxes))
        dropped[Reason.INVALID_BOX] += len(boxes.boxes) - len(rows)
        if boxes.frame_id != (self.fixed_frame if frame == 'fixed' else self.sensor_frame):
            dropped[Reason.NO_TRANSFORM] += len(rows)
            rows = rows[:0]
        return rows, boxes.boxes[rows]

    def moved(self, frame: str) -> LabelFrame:
        """
        Return it with its boxes in another frame, if a transform is known.

        Parameters
        ----------
        frame : str
            'fixed' or 'sensor'.

        Returns
        -------
        frame : LabelFrame
            Itself if its boxes are there, or no transform leads there. Covariances remain in the
            axes of the fixed frame.

        """
        boxes = self.refined.boxes
        if frame == 'fixed':
            source, target = self.sensor_frame, self.fixed_frame
        else:
            source, target = self.fixed_frame, self.sensor_frame
        is_movable = boxes.frame_id == source and boxes.frame_id != target
        if self.T_fixed_sensor is None or not is_movable:
            return self
        T = self.T_fixed_sensor if frame == 'fixed' else inverse(self.T_fixed_sensor)
        boxes = boxes_to_frame(boxes, T, target)
        return replace(self, refined=replace(self.refined, boxes=boxes))

    def labels(self) -> LabelFrame:
        """Return it without rejected boxes, which are in `left_out`."""
        return self._without((REJECTED,), Reason.REJECTED_LABEL)

    def keyframes(self) -> LabelFrame:
        """Return it with the boxes of a person alone; the others are in `left_out`."""
        return self._without(NOT_OF_A_PERSON, Reason.NOT_A_KEYFRAME)

    def _without(self, words: Sequence[str], reason: Reason) -> LabelFrame:
        """Return it without the boxes of some status, which are in `left_out` for a reason."""
        refined = self.refined.without(*words)
        left_out = Counter(self.left_out)
        left_out[reason] += len(self.refined.status) - len(refined.status)
        return replace(self, refined=refined, left_out=+left_out)


@dataclass(frozen=True, slots=True)
class SceneFrames:
    """The frames of one scene of a data set, for label files that leave these facts to it."""

    name: str
    """As in file names and ids of its data set."""
    stamps_ns: Mapping[str, int]
    """By the name in label files: token of a sample of nuScenes, number of a frame of KITTI."""
    fixed_frame: str
    sensor_frame: str
    """Of the clouds."""
    camera: Camera | None = None
    """That the boxes of KITTI refer to."""


@dataclass(frozen=True, slots=True)
class Provenance:
    """Origin of labels, for the formats with a field for it."""

    recordings: tuple[str, ...] = ()
    """Their file names."""
    config_hash: str = ''
    """`Config.digest` of the configuration; empty if none was used."""
    tool: str = 'boxreg_ros'
    """That made the labels."""
    version: str = __version__

    @classmethod
    def of(cls, recordings: tuple[Path, ...], config: Config | None = None) -> Provenance:
        """Return the provenance of labels of `recordings`, made with `config`."""
        digest = '' if config is None else config.digest
        names = (absolute(path).name for path in recordings)
        # File names may contain bytes that are not UTF-8; label files may not.
        return cls(tuple(n.encode('utf-8', 'backslashreplace').decode() for n in names), digest)


@dataclass(frozen=True, slots=True)
class Options:
    """Settings of the label writers."""

    with_points: bool = option(
        False, 'also write the point clouds that a label format stores beside its labels'
    )
    camera: Path | None = option(
        None,
        'camera calibration, for formats with image coordinates (default: the CameraInfo of the '
        'only camera, else one is assumed); a topic of images chooses one of several',
        metavar='FILE|TOPIC',
        parse=Path,
    )
    swap_axes: bool = option(
        False, 'write the extents in the order that Datumaro and CVAT display them'
    )
    with_images: bool = option(
        False, 'also write the camera images that a label format stores beside its labels'
    )
    class_map: Path | None = option(
        None,
        'class names to write, a YAML file of lines CLASS: NAME; beside those of the evaluation',
        metavar='FILE',
        parse=Path,
    )
    recording: Recording | None = None
    """Source, open or closed, for formats that copy it."""
    scene_camera: Camera | None = None
    """Of the scene of a data set that is the source, where it has one."""


class LabelWriter(Protocol):
    """
    Writes the frames of one drive; memory must not grow with their number.

    A writer may also have ``notes``, a list of str: sentences about what it assumed, and about
    boxes that programs which read the files leave out. They are printed and in ``summary.json``.

    Attributes
    ----------
    dropped : Counter of str
        Boxes that the format cannot represent, by `Reason`; `LabelFrame.boxes_in` counts them.

    """

    dropped: Counter[str]

    def write(self, frame: LabelFrame) -> None:
        """
        Add the boxes of one stamp.

        Parameters
        ----------
        frame : LabelFrame
            In the fixed frame where a transform is known [m, rad]. Stamps [ns] ascend, except for
            boxes that arrived late; two frames may have the same stamp.

        Raises
        ------
        OSError
            If a file cannot be written; the folder of results is then removed as a whole.

        """

    def close(self) -> None:
        """
        Complete the files; nothing is written after it.

        Raises
        ------
        OSError
            If a file cannot be written.

        """


WriterFactory = Callable[[Path, Provenance, Options], LabelWriter]
"""
Opens a writer; ``Writer`` of a format module.

The folder exists, is empty and belongs to this writer, except for the formats of
`registry.IN_RESULT_FOLDER`, which share the folder of results.

"""


class FormatModule(Protocol):
    """
    A module of `registry.FORMATS`.

    A module may have three functions more, each with a path of a file or folder.

    ``read(path)``, if files can be read back, yields a `LabelFrame` per stamp, in the order of
    time: boxes (n, 9) in the fixed or the sensor frame [m, rad], stamps [ns] as integers. What the
    files have and a box cannot be made of is counted in `LabelFrame.left_out`, what they do not
    state and was assumed is in `LabelFrame.note`. It raises `RecordingError` for files that do not
    exist or do not follow the format, with the file and the place in it.

    ``read_scene(path, scene)``, of a data set, yields the frames of a `SceneFrames`, whose stamps
    and calibration hold: it reads results of detectors and trackers, too. It raises the same.

    ``files_of(path)``, if paths may name a part of the files as ``PATH#PART``, returns the path
    without the part.

    """

    @property
    def FORMAT(self) -> Format:
        """Return the conventions of the format."""

    @property
    def Writer(self) -> WriterFactory:
        """Return the class of the writer."""


def absolute(path: Path) -> Path:
    """Return `path` with a name and parents, which ``.`` lacks; links are not resolved."""
    return Path(os.path.abspath(path))
