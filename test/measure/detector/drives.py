"""The drives of the experiment, each stored in a folder when it is first needed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
import pickle
from typing import TypeVar

from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.simulation.scene import FIXED_FRAME
from boxreg_ros.simulation.writer import write_recording
from measure.detector.frames import Frame, frames_of
from measure.detector.labels import with_points
from measure.detector.streets import random_street
from measure.drives import Drive
import numpy as np

Made = TypeVar('Made')


@dataclass(frozen=True, slots=True)
class StoredDrive:
    """A drive of the experiment: what is trained and tested on, and its recording."""

    name: str
    recording: Path
    frames: list[Frame]  # of all sweeps
    truth: BoxTable  # within reach
    published: BoxTable  # boxes with the errors of a published detector, none missing


def stored(path: Path, make: Callable[[], Made]) -> Made:
    """Return what a file holds; it is made, and written whole, if there is none."""
    if not path.is_file():
        path.parent.mkdir(parents=True, exist_ok=True)
        part = path.with_suffix('.part')
        part.write_bytes(pickle.dumps(make()))
        part.replace(path)
    return pickle.loads(path.read_bytes())


def street(folder: Path, seed: int, sweeps: int) -> StoredDrive:
    """Return the random street of a seed, in a folder with others."""
    name = f'street_{seed}'

    def make() -> StoredDrive:
        scene = random_street(seed, sweeps, miss_probability=0.0)
        recording = folder / f'{name}.mcap'
        folder.mkdir(parents=True, exist_ok=True)
        intensities = [np.zeros(len(sweep.points)) for sweep in scene.sweeps]
        write_recording(
            recording, scene.sweeps, intensities, scene.detections, scene.T_fixed_sensor,
            FIXED_FRAME, is_compressed=True,
        )  # fmt: skip
        return _stored_drive(name, recording, Drive.from_scene(scene))

    return stored(folder / f'{name}.pickle', make)


def recorded(folder: Path, data: Path) -> StoredDrive:
    """Return the drive in a folder with one recording and truth.csv."""
    (recording,) = sorted(data.glob('*.mcap'))
    return stored(
        folder / f'{data.name}.pickle',
        lambda: _stored_drive(data.name, recording.resolve(), Drive.read(data)),
    )


def _stored_drive(name: str, recording: Path, drive: Drive) -> StoredDrive:
    frames = frames_of(drive.sweeps)
    truth = with_points(drive.truth, frames)
    published = BoxTable.from_arrays(drive.boxes)
    return StoredDrive(name, recording, frames, truth, published)
