"""
Label files: one module per format, all behind one protocol.

A module states its conventions once, as `FORMAT`; its ``Writer(folder, provenance, options)``
takes one `LabelFrame` after the other and never holds more than the tracks' names; and where
files can be read back, ``read(path)`` yields the same frames.

"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
import hashlib
from importlib import import_module
import json
import os
from pathlib import Path
from types import ModuleType
from typing import Protocol, TYPE_CHECKING

from boxreg_ros import __version__
from boxreg_ros.config import Config
from boxreg_ros.errors import ConfigError, RecordingError
from boxreg_ros.io.transforms import boxes_to_frame, inverse
from boxreg_ros.structures import Floats, Ints, is_valid_box, RefinedBoxes, Sweep
import numpy as np

if TYPE_CHECKING:
    from boxreg_ros.io.recording import Recording

FORMATS = {
    'csv': 'boxreg_ros.labels.csv',
    'parquet': 'boxreg_ros.labels.parquet',
    'openlabel': 'boxreg_ros.labels.openlabel',
    'kitti': 'boxreg_ros.labels.kitti',
    'tracklets': 'boxreg_ros.labels.tracklets',
    'nuscenes': 'boxreg_ros.labels.nuscenes',
    't4': 'boxreg_ros.labels.t4',
    'argoverse2': 'boxreg_ros.labels.argoverse2',
    'waymo': 'boxreg_ros.labels.waymo',
    'sustechpoints': 'boxreg_ros.labels.sustechpoints',
    'datumaro': 'boxreg_ros.labels.datumaro',
    'supervisely': 'boxreg_ros.labels.supervisely',
    'xtreme1': 'boxreg_ros.labels.xtreme1',
    'mcap': 'boxreg_ros.labels.mcap',
}
BESIDE_RESULTS = ('csv', 'mcap')
"""Formats whose one file is in the folder of results itself."""
INPUT = 'input'
"""Status of boxes whose file does not say where they come from."""


@dataclass(frozen=True, slots=True)
class Format:
    """
    The conventions of a format, as ``boxreg formats`` and the README state them.

    Attributes
    ----------
    name, title : str
        What ``--formats`` calls it, and what people do.
    frame : str
        Frame of the boxes.
    reference : str
        Point of the box that its position is of.
    sizes : str
        Order of the extents.
    rotation : str
        What is kept of the orientation, and how it is written.
    files : str
        What the writer leaves in its folder.
    packages : tuple of str
        Packages of pip that are needed beyond those of boxreg_ros itself.
    options : tuple of str
        Those of `Options` that its writer acts on.

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


@dataclass(frozen=True, slots=True)
class LabelFrame:
    """
    The boxes of one stamp, and what a format needs to write them in a frame of its own.

    Attributes
    ----------
    refined : RefinedBoxes
        Boxes with their evidence; in the fixed frame, but for those nothing connects with it.
        Covariances are in the same axes.
    fixed_frame, sensor_frame : str
        Names of the frames below.
    T_fixed_sensor : array, shape (4, 4), or None
        Pose of the sensor at the boxes' stamp; None if unknown.
    sweep : Sweep or None
        The cloud of that stamp in the sensor's frame, where points are asked for.
    intensities : array, shape (M,), or None
        Of its points, in the units of the sensor; None if it has none.
    T_fixed_given : array, shape (4, 4), or None
        Pose of the frame that the boxes came in; None if unknown.

    """

    refined: RefinedBoxes
    fixed_frame: str
    sensor_frame: str
    T_fixed_sensor: Floats | None = None
    sweep: Sweep | None = None
    intensities: Floats | None = None
    T_fixed_given: Floats | None = None

    def placed(self, frame: str, dropped: Counter[str]) -> tuple[Ints, Floats]:
        """
        Return rows of `refined` and their boxes in the 'fixed' or the 'sensor' frame.

        Parameters
        ----------
        frame : str
            Which of the two.
        dropped : Counter
            Boxes left out, by reason, are added: ``invalid_box`` (NaN, or an extent that is not
            positive) and ``no_transform`` (nothing leads to `frame`).

        Returns
        -------
        rows : array, shape (k,)
            Rows of `refined` that have a place.
        boxes : array, shape (k, 9)
            Those boxes.

        """
        boxes = self.refined.boxes
        rows = np.flatnonzero(is_valid_box(boxes.boxes))
        dropped['invalid_box'] += len(boxes.boxes) - len(rows)
        target = self.fixed_frame if frame == 'fixed' else self.sensor_frame
        if boxes.frame_id == target:
            return rows, boxes.boxes[rows]
        T = self.T_fixed_sensor
        if T is None or boxes.frame_id not in (self.fixed_frame, self.sensor_frame):
            dropped['no_transform'] += len(rows)
            return rows[:0], boxes.boxes[:0]
        moved = boxes_to_frame(boxes, T if frame == 'fixed' else inverse(T), target)
        return rows, moved.boxes[rows]

    def moved(self, frame: str) -> LabelFrame:
        """Return the frame with all its boxes in the 'fixed' or the 'sensor' frame, if known."""
        boxes, T = self.refined.boxes, self.T_fixed_sensor
        source, target = self.sensor_frame, self.fixed_frame
        if frame == 'sensor':
            source, target = target, source
        if boxes.frame_id == target or boxes.frame_id != source or T is None:
            return self
        there = boxes_to_frame(boxes, T if frame == 'fixed' else inverse(T), target)
        return replace(self, refined=replace(self.refined, boxes=there))


@dataclass(frozen=True, slots=True)
class Provenance:
    """
    Where labels come from, for the formats that have room to say so.

    Attributes
    ----------
    recordings : tuple of str
        Names of the files the boxes are of.
    config_hash : str
        First 16 digits of the SHA-256 of the settings as JSON; '' if none were used.
    tool, version : str
        What made them.

    """

    recordings: tuple[str, ...] = ()
    config_hash: str = ''
    tool: str = 'boxreg_ros'
    version: str = __version__

    @classmethod
    def of(cls, recordings: tuple[Path, ...], config: Config | None = None) -> Provenance:
        """Return the provenance of labels of `recordings`, made with `config`."""
        text = '' if config is None else json.dumps(asdict(config), sort_keys=True)
        digest = hashlib.sha256(text.encode()).hexdigest()[:16] if text else ''
        names = (absolute(path).name for path in recordings)
        # Names of files need not be UTF-8, label files are.
        return cls(tuple(n.encode('utf-8', 'backslashreplace').decode() for n in names), digest)


@dataclass(frozen=True, slots=True)
class Options:
    """
    What a user may say about label files.

    Attributes
    ----------
    with_points : bool
        Also write the clouds that a tool needs beside its labels.
    camera : Path or None
        Calibration file, for the formats that look through a camera.
    swap_axes : bool
        Write extents where Datumaro and CVAT look for them, not where the format says.
    recording : Recording or None
        What the boxes are of, open or not, for the formats that write it again.

    """

    with_points: bool = False
    camera: Path | None = None
    swap_axes: bool = False
    recording: Recording | None = None


class LabelWriter(Protocol):
    """
    What ``Writer(folder, provenance, options)`` of every module in `FORMATS` offers.

    `folder` exists, is empty and the writer's own (that of `BESIDE_RESULTS` is the folder of
    results).

    Attributes
    ----------
    dropped : Counter
        Boxes the format has no place for, by reason.

    """

    dropped: Counter[str]

    def write(self, frame: LabelFrame) -> None:
        """Add the boxes of one stamp; stamps ascend, but for what came late."""

    def close(self) -> None:
        """Complete the files."""


def absolute(path: Path) -> Path:
    """Return a path that has a name and parents, as ``.`` has not; links stay what they are."""
    return Path(os.path.abspath(path))


def module_of(name: str) -> ModuleType:
    """
    Return the module of a format.

    Raises
    ------
    ConfigError
        For a format that does not exist, or one that needs a package that is not installed.

    """
    if name not in FORMATS:
        raise ConfigError(f'format {name!r}: expected one of {", ".join(FORMATS)}')
    module = import_module(FORMATS[name])
    for package in module.FORMAT.packages:
        try:
            import_module(package.replace('-', '_'))
        except ImportError as error:
            raise ConfigError(
                f'format {name!r} needs {package}: pip install {package} ({error})'
            ) from None
    return module


def check_options(names: Sequence[str], options: Options) -> None:
    """
    Refuse options that none of the formats `names` acts on.

    Raises
    ------
    ConfigError
        Which names the formats that do, or as in `module_of`.

    """
    used = {option for name in names for option in module_of(name).FORMAT.options}
    for option in ('camera', 'with_points', 'swap_axes'):
        if getattr(options, option) and option not in used:
            able = [
                n for n, path in FORMATS.items() if option in import_module(path).FORMAT.options
            ]
            raise ConfigError(
                f'--{option.replace("_", "-")}: expected a format that uses it '
                f'({", ".join(able)}), got {", ".join(names)}; add one, or leave it out'
            )


def writer_for(
    name: str, out: Path, provenance: Provenance, options: Options | None = None
) -> LabelWriter:
    """
    Return a writer of this format for the results in the folder `out`.

    Raises
    ------
    ConfigError
        As in `module_of`, or if the format needs an option that is not given.

    """
    module = module_of(name)
    folder = out if name in BESIDE_RESULTS else out / name
    folder.mkdir(exist_ok=True)
    writer: LabelWriter = module.Writer(folder, provenance, options or Options())
    return writer


def is_written(name: str, out: Path) -> bool:
    """Return whether what a format's writer leaves first, a file or a folder of some, is there."""
    first = (
        out / ('' if name in BESIDE_RESULTS else name) / module_of(name).FORMAT.files.split(',')[0]
    )
    if 'STAMP' in first.name:  # a file per frame
        first = first.parent
    return first.is_file() or (first.is_dir() and any(first.iterdir()))


def frames_of(name: str, path: Path) -> Iterator[LabelFrame]:
    """
    Yield the frames of a label file or folder.

    Boxes whose file does not say otherwise have the status ``input`` and unit covariances.

    Raises
    ------
    ConfigError
        As in `module_of`, or if the format cannot be read.
    RecordingError
        If the files are not what the format says.

    """
    module = module_of(name)
    if not hasattr(module, 'read'):
        able = [other for other in FORMATS if hasattr(import_module(FORMATS[other]), 'read')]
        raise ConfigError(f'format {name!r} can only be written; readable: {", ".join(able)}')
    if not path.exists():
        raise RecordingError(f'labels {str(path)!r}: no such file or folder')
    frames: Iterator[LabelFrame] = module.read(path)
    return frames
