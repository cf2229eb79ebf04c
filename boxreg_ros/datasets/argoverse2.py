"""
Argoverse 2 (sensor data set), as it is downloaded: one folder per log.

Clouds are those of both LiDARs on the roof, one above the other, in the frame of the ego vehicle
at the stamp of the sweep; the motion of the ego vehicle is compensated, that of other objects is
not.

"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

from boxreg_ros.datasets.files import missing_sweep, require
from boxreg_ros.datasets.protocol import Cloud, Dataset, Scene, SweepFile
from boxreg_ros.errors import RecordingError, UnsupportedMessage
from boxreg_ros.labels import frames_of, SceneFrames
from boxreg_ros.labels.argoverse2 import (
    CITY_FRAME,
    EGO_FRAME,
    EGO_POSES_FILE,
    FEATHER_FILE,
    xyz_xyzw,
)
from boxreg_ros.labels.arrow import read_rows, read_table
from boxreg_ros.labels.files import frame_names, visible
from boxreg_ros.structures import Floats
import numpy as np

DATASET = Dataset(
    name='argoverse2',
    title='Argoverse 2 sensor',
    folder=f'LOG/{EGO_POSES_FILE}, LOG/sensors/lidar/ (in the folder of a split or above it)',
    scene='LOG',
    labels='argoverse2',
    remedy='download the whole log',
    lidars=('lidar',),
    packages=('pyarrow',),
    reads='sweeps, poses, annotations',
    leaves_out='cameras, maps',
    read_back='av2 0.3.6',
)
SENSOR_POSES_FILE = 'calibration/egovehicle_SE3_sensor.feather'
LIDAR_NAMES = ('up_lidar', 'down_lidar')
"""Names in the calibration; `laser_number` counts the lasers of the first one, then the second."""
LASERS_EACH = 32


def scene_names(root: Path) -> list[str]:
    """Return the names of all logs in a folder of one or several splits."""
    return sorted(_logs(root))


def inputs(root: Path, name: str) -> tuple[Path, ...]:
    """Return the files and folders of a log."""
    log = _logs(root)[name]
    files = (FEATHER_FILE, EGO_POSES_FILE, SENSOR_POSES_FILE)
    return (log / 'sensors' / DATASET.lidar, *(log / name for name in files))


def open_scene(root: Path, name: str, lidars: Sequence[str]) -> Scene:
    """Return a log; see `protocol.DatasetModule`."""
    log = _logs(root)[name]
    clouds = require(log / 'sensors' / DATASET.lidar, 'the sweeps', DATASET.remedy)
    stamps_ns = sorted(int(path.stem) for path in visible(clouds, '*.feather'))
    if not stamps_ns:
        raise RecordingError(
            f'{clouds}: expected sweeps STAMP.feather, got none; {DATASET.remedy}'
        )
    origins = _origins(require(log / SENSOR_POSES_FILE, 'the calibration', DATASET.remedy))
    rows = sorted(read_rows(log / EGO_POSES_FILE), key=lambda row: row['timestamp_ns'])
    frames = SceneFrames(
        name,
        {str(stamp_ns): stamp_ns for stamp_ns in stamps_ns},
        *frame_names(log, CITY_FRAME, EGO_FRAME),
    )
    annotations = log / FEATHER_FILE
    return Scene(
        frames,
        DATASET.lidar,
        np.array(stamps_ns, np.int64),
        partial(_sweep_files, clouds, stamps_ns, origins),
        np.array([row['timestamp_ns'] for row in rows], np.int64),
        np.array([xyz_xyzw(row) for row in rows]),
        partial(frames_of, 'argoverse2', annotations, frames) if annotations.is_file() else None,
        without_boxes=str(annotations),
    )


def _sweep_files(folder: Path, stamps_ns: list[int], origins: Floats) -> Iterator[SweepFile]:
    for stamp_ns in stamps_ns:
        path = folder / f'{stamp_ns}.feather'
        yield SweepFile(stamp_ns, partial(_cloud, path, origins))


def _cloud(path: Path, origins: Floats) -> Cloud:
    """Return the cloud of a table with x y z, intensity, laser and the time since the stamp."""
    if not path.is_file():
        raise missing_sweep(path, FileNotFoundError(2, 'No such file or directory'))
    try:
        table = read_table(path)
        columns = {name: table.column(name).to_numpy() for name in ('x', 'y', 'z', 'intensity')}
        delays_ns = table.column('offset_ns').to_numpy()
        lasers = table.column('laser_number').to_numpy()
    except (RecordingError, KeyError) as error:
        raise UnsupportedMessage(f'{error}; download it again') from None
    points = np.stack([columns[axis] for axis in 'xyz'], axis=1).astype(np.float32)
    times = delays_ns * 1e-9 if delays_ns.any() else None  # exports without times have zeros
    sensors = None
    if len(origins) > 1:
        sensors = (lasers >= LASERS_EACH).astype(np.uint8)
    intensities = columns['intensity'].astype(np.float64)
    return Cloud(points, intensities, times, origins, sensors).finite()


def _origins(path: Path) -> Floats:
    """Return the positions of both LiDARs in the ego frame (2, 3); of our exports one (1, 3)."""
    positions = {row['sensor_name']: xyz_xyzw(row)[:3] for row in read_rows(path)}
    found = [positions[name] for name in LIDAR_NAMES if name in positions]
    if not found:
        raise RecordingError(
            f'{path}: expected the poses of {" and ".join(LIDAR_NAMES)}, got none; '
            f'{DATASET.remedy}'
        )
    return np.array(found)


def _logs(root: Path) -> dict[str, Path]:
    """Return the folders of all logs by name: the root itself, in it, or in its splits."""
    found = [*root.glob(EGO_POSES_FILE), *visible(root, f'*/{EGO_POSES_FILE}')]
    found += visible(root, f'*/*/{EGO_POSES_FILE}')
    return {path.parent.absolute().name: path.parent for path in found}
