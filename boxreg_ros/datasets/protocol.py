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
    """
    A data set, as the documentation and ``boxreg formats`` show it.

    Attributes
    ----------
    name, title : str
        Prefix on the command line, and name in prose.
    folder : str
        Files and folders that are expected in the root folder.
    scene : str
        Example of the name of a scene, or a word for it.
    labels : str
        Label format of its results for ``--labels``; '' for none.
    remedy : str
        How to complete a folder with missing files.
    lidar : str
        Name of the main LiDAR; '' if the scene states it.
    packages : tuple of str
        Packages of pip that are needed beyond those of boxreg_ros itself.

    """

    name: str
    title: str
    folder: str
    scene: str
    labels: str
    remedy: str
    lidar: str = ''
    packages: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Cloud:
    """
    The points of a sweep, in the frame of the clouds of its scene.

    Attributes
    ----------
    points : array, shape (M, 3)
        Positions [m].
    intensities : array, shape (M,), or None
        In the unit of the data set.
    times : array, shape (M,), or None
        Time of measurement of each point relative to the stamp [s].
    origins : array, shape (K, 3)
        Position of each sensor [m].
    sensors : array, shape (M,), or None
        Row of `origins` of the sensor that measured each point; None if there is one sensor.

    """

    points: NDArray[np.floating]
    intensities: Floats | None = None
    times: Floats | None = None
    origins: Floats = field(default_factory=lambda: np.zeros((1, 3)))
    sensors: NDArray[np.uint8] | None = None


class SweepFile(NamedTuple):
    """
    A sweep that is not read yet.

    Attributes
    ----------
    stamp_ns : int
        Its stamp [ns].
    read : callable
        Returns its points; raises UnsupportedMessage if they cannot be read.

    """

    stamp_ns: int
    read: Callable[[], Cloud]


@dataclass(frozen=True, slots=True)
class Scene:
    """
    One drive of a data set.

    Attributes
    ----------
    frames : SceneFrames
        Names and stamps of its frames, and the names of the coordinate frames.
    points_topic : str
        Name of the LiDAR, or of several, separated by commas.
    sweep_stamps_ns : array, shape (S,)
        Stamps of the sweeps [ns], ascending.
    sweeps : callable
        Yields the sweeps in this order; one is in memory at a time.
    pose_stamps_ns : array, shape (P,)
        Stamps of the poses [ns], ascending.
    poses : array, shape (P, 7)
        Pose x y z qx qy qz qw of the frame of the clouds in the fixed frame.
    boxes : callable or None
        Yields the annotations of the data set; None if the scene has none.
    without_boxes : str
        File or folder that would have annotations.

    """

    frames: SceneFrames
    points_topic: str
    sweep_stamps_ns: Ints
    sweeps: Callable[[], Iterator[SweepFile]]
    pose_stamps_ns: Ints
    poses: Floats
    boxes: Callable[[], Iterator[LabelFrame]] | None
    without_boxes: str = ''


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

        Raises
        ------
        RecordingError
            If a table or another file of the scene is missing or does not follow the layout.

        """
