"""The protocol of the modules of data sets: description and reader of a data set."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple, Protocol

from boxreg_ros.labels import LabelFrame, SceneFrames
from boxreg_ros.structures import Floats, Ints
import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Dataset:
    """A data set, as the documentation and ``boxreg formats`` show it."""

    name: str  # prefix on the command line
    title: str  # name in prose
    folder: str  # files and folders that are expected in the root folder
    scene: str  # example of the name of a scene, or a word for it
    labels: str  # label format of its results for ``--labels``; '' for none
    remedy: str  # how to complete a folder with missing files
    lidar: str = ''  # name of the main one; '' if the scene states it
    packages: tuple[str, ...] = ()  # of pip, beyond those of boxreg_ros itself
    reads: str = ''  # what is read, in a few words
    leaves_out: str = ''  # what the data set has beside it
    read_back: str = ''  # library and version that has the same clouds or poses, in the tests


@dataclass(frozen=True, slots=True)
class Cloud:
    """The points of a sweep, in the frame of the clouds of its scene."""

    points: NDArray[np.floating]  # (M, 3) [m]
    intensities: Floats | None = None  # (M,) in the unit of the data set
    times: Floats | None = None  # (M,) of measurement relative to the stamp [s]
    # (K, 3) positions of the sensors [m]
    origins: Floats = field(default_factory=lambda: np.zeros((1, 3)))
    sensors: NDArray[np.uint8] | None = None  # (M,) row of `origins`; None for one sensor


class SweepFile(NamedTuple):
    """A sweep that is not read yet."""

    stamp_ns: int
    read: Callable[[], Cloud]  # raises UnsupportedMessage if the points cannot be read
    lidar: str = ''  # of `Scene.lidars` that measured it


@dataclass(frozen=True, slots=True)
class Scene:
    """One drive of a data set."""

    frames: SceneFrames  # names and stamps of its frames, and the coordinate frames
    points_topic: str  # name of the LiDAR, or of several, separated by commas
    sweep_stamps_ns: Ints  # (S,) ascending
    sweeps: Callable[[], Iterator[SweepFile]]  # in this order; one is in memory at a time
    pose_stamps_ns: Ints  # (P,) ascending
    poses: Floats  # (P, 7) x y z qx qy qz qw of the frame of the clouds in the fixed frame
    boxes: Callable[[], Iterator[LabelFrame]] | None  # the annotations, if it has any
    without_boxes: str = ''  # file or folder that would have annotations
    # LiDARs whose sweeps have stamps of their own, to be merged by time; the first gives the stamp
    lidars: tuple[str, ...] = ()


class DatasetModule(Protocol):
    """A module of `registry.DATASETS`."""

    @property
    def DATASET(self) -> Dataset:
        """Return the description of the data set."""

    def scene_names(self, root: Path) -> list[str]:
        """Return the names of all scenes in a folder; empty if it is not of this data set."""

    def inputs(self, root: Path, name: str) -> tuple[Path, ...]:
        """Return the files and folders that a scene is read from, for its fingerprint."""

    def open_scene(self, root: Path, name: str, lidars: Sequence[str]) -> Scene:
        """
        Return a scene with these LiDARs, by their names; none for the main one.

        Raises RecordingError if a file is missing or does not follow the layout.

        """
