"""The protocol of the modules of label formats: description, reader and writer."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace
import hashlib
import json
import os
from pathlib import Path
from typing import Protocol, TYPE_CHECKING

from boxreg_ros import __version__
from boxreg_ros.config import Config
from boxreg_ros.io.transforms import boxes_to_frame, inverse
from boxreg_ros.options import option
from boxreg_ros.reasons import Reason
from boxreg_ros.structures import BoxArray, Floats, Ints, is_valid_box, RefinedBoxes, Sweep
import numpy as np

if TYPE_CHECKING:
    from boxreg_ros.core.point_labels import PointLabels
    from boxreg_ros.io.recording import Recording
    from boxreg_ros.labels.camera import Camera

INPUT_STATUS = 'input'
"""Status of boxes whose label file states none."""


@dataclass(frozen=True, slots=True)
class Format:
    """
    The conventions of a format, as ``boxreg formats`` prints them.

    Attributes
    ----------
    name, title : str
        Name on the command line, and name in prose.
    frame : str
        Frame of the boxes.
    reference : str
        Point of the box at its position, for example its centre.
    sizes : str
        Order of the extents.
    rotation : str
        Parameters of the orientation, and the angles that are lost.
    files : str
        Files and folders that the writer creates, separated by commas. ``STAMP`` in the first
        stands for one file per frame.
    packages : tuple of str
        Packages of pip that are needed beyond those of boxreg_ros itself.
    options : tuple of str
        Fields of `Options` that the writer uses.
    has_points : bool
        Whether it labels points; such a format is written by ``boxreg relabel`` alone.

    """

    name: str
    title: str
    frame: str
    reference: str
    sizes: str
    rotation: str
    files: str
    packages: tuple[str, ...] = ()
    options: tuple[str, ...] = ()
    has_points: bool = False


@dataclass(frozen=True, slots=True)
class LabelFrame:
    """
    The boxes of one stamp, with the poses that formats need to write them in their own frame.

    Attributes
    ----------
    refined : RefinedBoxes
        Boxes with status and covariance. They are in the fixed frame, except those without a
        transform to it. Covariances use the same axes.
    fixed_frame, sensor_frame : str
        Names of the frames below.
    T_fixed_sensor : array, shape (4, 4), or None
        Pose of the sensor at the stamp of the boxes; None if unknown.
    sweep : Sweep or None
        Point cloud of that stamp in the sensor frame, if clouds are written.
    intensities : array, shape (M,), or None
        Intensities of its points in the unit of the sensor; None if it has none.
    T_fixed_given : array, shape (4, 4), or None
        Pose of the frame of the input boxes; None if unknown.
    points : PointLabels or None
        Labels of the points of `sweep`, for formats of points.

    """

    refined: RefinedBoxes
    fixed_frame: str
    sensor_frame: str
    T_fixed_sensor: Floats | None = None
    sweep: Sweep | None = None
    intensities: Floats | None = None
    T_fixed_given: Floats | None = None
    points: PointLabels | None = None

    def boxes_in(self, frame: str, dropped: Counter[str]) -> tuple[Ints, Floats]:
        """
        Return the valid boxes in the 'fixed' or the 'sensor' frame, with their row indices.

        Parameters
        ----------
        frame : str
            'fixed' or 'sensor'.
        dropped : Counter
            Counts of boxes left out are added by reason: ``invalid_box`` (not finite, or an
            extent that is not positive) and ``no_transform`` (no transform to `frame`).

        Returns
        -------
        rows : array, shape (k,)
            Row indices into `refined`.
        boxes : array, shape (k, 9)
            The boxes of these rows.

        """
        boxes = self.refined.boxes
        rows = np.flatnonzero(is_valid_box(boxes.boxes))
        dropped[Reason.INVALID_BOX] += len(boxes.boxes) - len(rows)
        target = self.fixed_frame if frame == 'fixed' else self.sensor_frame
        if boxes.frame_id == target:
            return rows, boxes.boxes[rows]
        is_known = boxes.frame_id in (self.fixed_frame, self.sensor_frame)
        if self.T_fixed_sensor is None or not is_known:
            dropped[Reason.NO_TRANSFORM] += len(rows)
            return rows[:0], boxes.boxes[:0]
        return rows, _boxes_moved(boxes, self.T_fixed_sensor, frame, target).boxes[rows]

    def moved(self, frame: str) -> LabelFrame:
        """
        Return the frame with its boxes in the 'fixed' or the 'sensor' frame.

        Boxes without a known transform stay in their frame.

        """
        boxes = self.refined.boxes
        if frame == 'fixed':
            source, target = self.sensor_frame, self.fixed_frame
        else:
            source, target = self.fixed_frame, self.sensor_frame
        is_movable = boxes.frame_id == source and boxes.frame_id != target
        if self.T_fixed_sensor is None or not is_movable:
            return self
        boxes = _boxes_moved(boxes, self.T_fixed_sensor, frame, target)
        return replace(self, refined=replace(self.refined, boxes=boxes))


@dataclass(frozen=True, slots=True)
class SceneFrames:
    """
    The frames of one scene of a data set, for label files that leave these facts to it.

    Attributes
    ----------
    name : str
        Of the scene, as in file names and ids of its data set.
    stamps_ns : mapping of str to int
        Stamp of each frame [ns], by the name that label files give it: the token of a sample of
        nuScenes, the number of a frame of KITTI. Stamps ascend.
    fixed_frame, sensor_frame : str
        Names of the fixed frame, and of the frame of the clouds.
    camera : Camera or None
        Camera that the boxes of KITTI refer to.

    """

    name: str
    stamps_ns: Mapping[str, int]
    fixed_frame: str
    sensor_frame: str
    camera: Camera | None = None


@dataclass(frozen=True, slots=True)
class Provenance:
    """
    Origin of labels, for the formats with a field for it.

    Attributes
    ----------
    recordings : tuple of str
        File names of the recordings.
    config_hash : str
        First 16 digits of the SHA-256 of the configuration as JSON; '' if none was used.
    tool, version : str
        Program that made the labels.

    """

    recordings: tuple[str, ...] = ()
    config_hash: str = ''
    tool: str = 'boxreg_ros'
    version: str = __version__

    @classmethod
    def of(cls, recordings: tuple[Path, ...], config: Config | None = None) -> Provenance:
        """Return the provenance of labels of `recordings`, made with `config`."""
        digest = ''
        if config is not None:
            text = json.dumps(asdict(config), sort_keys=True)
            digest = hashlib.sha256(text.encode()).hexdigest()[:16]
        names = (absolute(path).name for path in recordings)
        # File names may contain bytes that are not UTF-8; label files may not.
        return cls(tuple(n.encode('utf-8', 'backslashreplace').decode() for n in names), digest)


@dataclass(frozen=True, slots=True)
class Options:
    """
    Settings of the label writers.

    Attributes
    ----------
    with_points, camera, swap_axes : bool, Path or None, bool
        As their help says.
    recording : Recording or None
        Source recording, open or closed, for formats that copy it.

    """

    with_points: bool = option(
        False, 'also write the point clouds that a label format stores beside its labels'
    )
    camera: Path | None = option(
        None,
        'camera calibration, for formats with image coordinates',
        metavar='FILE',
        parse=Path,
    )
    swap_axes: bool = option(
        False, 'write the extents in the order that Datumaro and CVAT display them'
    )
    recording: Recording | None = None


class LabelWriter(Protocol):
    """
    Writes the frames of one drive.

    Memory must not grow with the number of frames.

    Attributes
    ----------
    dropped : Counter
        Number of boxes that the format cannot represent, by reason.

    """

    dropped: Counter[str]

    def write(self, frame: LabelFrame) -> None:
        """Add the boxes of one stamp; stamps ascend, except for boxes that arrived late."""

    def close(self) -> None:
        """Complete the files."""


class WriterFactory(Protocol):
    """Opens a writer; ``Writer`` of a format module."""

    def __call__(self, folder: Path, provenance: Provenance, options: Options) -> LabelWriter:
        """
        Return a writer.

        `folder` exists, is empty and belongs to this writer, except for the formats of
        `registry.IN_RESULT_FOLDER`, which share the folder of results.

        """


class FormatModule(Protocol):
    """
    A module of `registry.FORMATS`.

    A module whose files can be read back also has ``read(path)``, which yields a `LabelFrame`
    per stamp and raises `RecordingError` for files that do not follow the format. A module of a
    data set may have ``read_scene(path, scene)``: it reads files, results of detectors and
    trackers among them, whose stamps or calibration are those of a `SceneFrames`.

    """

    @property
    def FORMAT(self) -> Format:
        """Return the conventions of the format."""

    @property
    def Writer(self) -> WriterFactory:
        """Return the class of the writer."""


class ReadableModule(FormatModule, Protocol):
    """A format module whose files can be read back; only those of data sets have `read_scene`."""

    def read(self, path: Path) -> Iterator[LabelFrame]:
        """Yield the frames of a label file or folder."""

    def read_scene(self, path: Path, scene: SceneFrames) -> Iterator[LabelFrame]:
        """Yield the frames of one scene in a label file or folder."""


def absolute(path: Path) -> Path:
    """Return `path` with a name and parents, which ``.`` lacks; links are not resolved."""
    return Path(os.path.abspath(path))


def _boxes_moved(boxes: BoxArray, T_fixed_sensor: Floats, frame: str, target: str) -> BoxArray:
    """Return boxes of the other frame in the 'fixed' or the 'sensor' frame, named `target`."""
    T = T_fixed_sensor if frame == 'fixed' else inverse(T_fixed_sensor)
    return boxes_to_frame(boxes, T, target)
