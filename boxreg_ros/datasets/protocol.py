"""The protocol of the modules of data sets: description and reader of a data set."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple, Protocol

from boxreg_ros.labels import LabelFrame, SceneFrames
from boxreg_ros.structures import Floats, Ints
import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Dataset:
    """A data set, as the documentation and ``boxreg formats`` show it."""

    name: str
    """Prefix on the command line."""
    title: str
    """Name in prose."""
    folder: str
    """Files and folders that are expected in the root folder."""
    scene: str
    """Example of the name of a scene, or a word for it."""
    labels: str
    """Label format of its results for ``--labels``; empty for none."""
    remedy: str
    """How to complete a folder with missing files."""
    lidars: tuple[str, ...] = ()
    """Names of the LiDARs, the main one first; empty if the scene states them."""
    packages: tuple[str, ...] = ()
    """Of pip, beyond those of boxreg_ros itself."""
    reads: str = ''
    """What is read, in a few words."""
    leaves_out: str = ''
    """What the data set has beside it."""
    read_back: str = ''
    """Library and version that has the same clouds or poses, in the tests."""

    @property
    def lidar(self) -> str:
        """Return the main one of `lidars`."""
        return self.lidars[0]


@dataclass(frozen=True, slots=True)
class Cloud:
    """The points of a sweep, in the frame of the clouds of its scene."""

    points: NDArray[np.floating]
    """(M, 3) [m]."""
    intensities: Floats | None = None
    """(M,) in the unit of the data set."""
    times: Floats | None = None
    """(M,) of measurement relative to the stamp [s]."""
    origins: Floats = field(default_factory=lambda: np.zeros((1, 3)))
    """(K, 3) positions of the sensors [m]."""
    sensors: NDArray[np.uint8] | None = None
    """(M,) row of `origins`; None for one sensor."""

    def finite(self) -> Cloud:
        """Return it without the points that are not finite; itself if all are."""
        is_finite = np.isfinite(self.points).all(axis=1)
        if is_finite.all():
            return self
        names = ('points', 'intensities', 'times', 'sensors')
        known = [name for name in names if getattr(self, name) is not None]
        return replace(self, **{name: getattr(self, name)[is_finite] for name in known})


class SweepFile(NamedTuple):
    """A sweep that is not read yet."""

    stamp_ns: int
    """Of the cloud, to which its times are relative [ns]."""
    read: Callable[[], Cloud]
    """Reads the points; raises UnsupportedMessage if they cannot be read."""
    lidar: str = ''
    """Of `Scene.lidars` that measured it."""


@dataclass(frozen=True, slots=True)
class Scene:
    """One drive of a data set."""

    frames: SceneFrames
    """Names and stamps of its frames, and the coordinate frames."""
    points_topic: str
    """Name of the LiDAR, or of several, separated by commas."""
    sweep_stamps_ns: Ints
    """(S,) ascending [ns]."""
    sweeps: Callable[[], Iterator[SweepFile]]
    """Yields the S sweeps in this order; one is in memory at a time."""
    pose_stamps_ns: Ints
    """(P,) ascending [ns]."""
    poses: Floats
    """(P, 7) x y z qx qy qz qw of the frame of the clouds in the fixed frame [m]."""
    boxes: Callable[[], Iterator[LabelFrame]] | None
    """Yields the annotations in the order of their stamps; None if there are none."""
    without_boxes: str = ''
    """File or folder that would have annotations."""
    lidars: tuple[str, ...] = ()
    """LiDARs whose sweeps have stamps of their own, merged by time; the first gives the stamp."""
    note: str = ''
    """What was assumed, since the files do not state it."""


class DatasetModule(Protocol):
    """A module of `registry.DATASETS`."""

    @property
    def DATASET(self) -> Dataset:
        """Return the description of the data set."""

    def scene_names(self, root: Path) -> list[str]:
        """
        Return the names of all scenes in a folder.

        Parameters
        ----------
        root : Path
            Folder that the archives were unpacked in.

        Returns
        -------
        names : list of str
            In the order in which they are listed; empty if the folder is not of this data set.

        Raises
        ------
        RecordingError
            If a table of scenes cannot be read.

        """

    def inputs(self, root: Path, name: str) -> tuple[Path, ...]:
        """
        Return the files and folders that a scene is read from, for its fingerprint.

        Parameters
        ----------
        root : Path
            As of `scene_names`.
        name : str
            One of these names.

        Returns
        -------
        paths : tuple of Path
            Folders stand for all files below them; those that do not exist are left out later.

        """

    def open_scene(self, root: Path, name: str, lidars: Sequence[str]) -> Scene:
        """
        Return a scene, without reading its clouds.

        Parameters
        ----------
        root, name
            As of `inputs`.
        lidars : sequence of str
            Some of `Dataset.lidars` to read; where these are empty, those that the user names.

        Returns
        -------
        scene : Scene
            Clouds are in the frame of the LiDAR, or of the vehicle for several [m], poses in the
            fixed frame, stamps as integers [ns].

        Raises
        ------
        RecordingError
            If a file is missing or does not follow the layout, or there is no such LiDAR; with
            the file, and the archive that has it.

        """
