"""
nuScenes, its tables as they are downloaded; T4 and our own exports have the same tables.

The tables are read row by row and only the rows of the scene are held. Sweeps between the key
frames are read too: 20 Hz, where annotations have 2 Hz.

"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from boxreg_ros.datasets.files import pose_rows, read_bin, require, require_lidar
from boxreg_ros.datasets.protocol import Dataset, Scene, SweepFile
from boxreg_ros.errors import RecordingError
from boxreg_ros.labels import frames_of, SceneFrames
from boxreg_ros.labels.files import frame_names, from_json, json_items
from boxreg_ros.labels.nuscenes import pose_matrix
from boxreg_ros.structures import Floats
import numpy as np

DATASET = Dataset(
    name='nuscenes',
    title='nuScenes',
    folder='v1.0-*/scene.json, samples/, sweeps/',
    scene='scene-0061',
    labels='nuscenes',
    remedy='unpack its metadata and LiDAR archives into one folder',
    packages=('ijson',),
)
CLOUD_SUFFIX = '.pcd.bin'


def scene_names(root: Path) -> list[str]:
    """Return the names of the scenes of all splits in a folder."""
    names = {row['name'] for tables in _table_folders(root) for row in _rows(tables, 'scene')}
    return sorted(names)


def inputs(root: Path, name: str) -> tuple[Path, ...]:
    """Return the folder of the tables of a scene."""
    return (_tables_of(root, name)[0],)


def open_scene(root: Path, name: str, lidars: Sequence[str]) -> Scene:
    """Return a scene; see `protocol.DatasetModule`."""
    tables, scene = _tables_of(root, name)
    try:
        return _scene(root, tables, scene, lidars)
    except (KeyError, TypeError, ValueError) as error:
        raise RecordingError(
            f'{tables}: expected the tables of nuScenes: {type(error).__name__} {error}'
        ) from None


def _scene(root: Path, tables: Path, scene: dict[str, Any], lidars: Sequence[str]) -> Scene:
    """Return a scene of a row of the table ``scene``."""
    samples = {
        row['token']: row['timestamp'] * 1000
        for row in _rows(tables, 'sample')
        if row['scene_token'] == scene['token']
    }
    channel, calibrations = _lidar(tables, lidars)
    sweeps = [
        row
        for row in _rows(tables, 'sample_data')
        if row['sample_token'] in samples and row['calibrated_sensor_token'] in calibrations
    ]
    if not sweeps:
        raise RecordingError(
            f'{tables / "sample_data.json"}: expected sweeps of {channel} in {scene["name"]}, got '
            f'none; {DATASET.remedy}'
        )
    sweeps.sort(key=_stamp_ns)
    # The stamp of a sample is that of its sweep, which our own exports have in nanoseconds.
    stamps_ns = samples | {
        row['sample_token']: _stamp_ns(row) for row in sweeps if row['is_key_frame']
    }
    by_time = dict(sorted(stamps_ns.items(), key=lambda item: item[1]))
    frames = SceneFrames(scene['name'], by_time, *frame_names(root, 'map', channel))
    sweep_stamps_ns = np.array([_stamp_ns(row) for row in sweeps], np.int64)
    annotations = tables / 'sample_annotation.json'
    has_annotations = annotations.is_file() and next(json_items(annotations), None) is not None
    return Scene(
        frames,
        channel,
        sweep_stamps_ns,
        partial(_sweep_files, root, sweeps),
        sweep_stamps_ns,
        _poses(tables, sweeps, calibrations),
        partial(frames_of, 'nuscenes', tables, frames) if has_annotations else None,
        without_boxes=str(annotations),
    )


def _lidar(tables: Path, lidars: Sequence[str]) -> tuple[str, dict[str, Floats]]:
    """Return the channel of the LiDAR, and its poses (4, 4) in the vehicle by their tokens."""
    channels = {
        row['token']: row['channel']
        for row in from_json(tables / 'sensor.json')
        if row['modality'] == 'lidar'
    }
    channel = require_lidar(lidars, sorted(set(channels.values())))
    calibrations = {
        row['token']: pose_matrix(row)
        for row in from_json(tables / 'calibrated_sensor.json')
        if channels.get(row['sensor_token']) == channel
    }
    return channel, calibrations


def _sweep_files(root: Path, sweeps: list[dict[str, Any]]) -> Iterator[SweepFile]:
    for row in sweeps:
        yield SweepFile(_stamp_ns(row), partial(read_bin, root / row['filename'], CLOUD_SUFFIX))


def _poses(tables: Path, sweeps: list[dict[str, Any]], calibrations: dict[str, Floats]) -> Floats:
    """Return the poses (P, 7) of the LiDAR in the global frame, one per sweep."""
    wanted = {row['ego_pose_token'] for row in sweeps}
    T_global_ego = {
        row['token']: pose_matrix(row)
        for row in _rows(tables, 'ego_pose')
        if row['token'] in wanted
    }
    missing = wanted - T_global_ego.keys()
    if missing:
        raise RecordingError(
            f'{tables / "ego_pose.json"}: expected the poses of {len(wanted)} sweeps, got '
            f'{len(T_global_ego)}, the first without is {min(missing)}; {DATASET.remedy}'
        )
    return pose_rows(
        [
            T_global_ego[row['ego_pose_token']] @ calibrations[row['calibrated_sensor_token']]
            for row in sweeps
        ]
    )


def _stamp_ns(row: dict[str, Any]) -> int:
    """Return the stamp of a sweep [ns]; only our own exports have it in nanoseconds."""
    return int(row.get('stamp_ns', row['timestamp'] * 1000))


def _table_folders(root: Path) -> list[Path]:
    """Return the folders of the tables of all splits."""
    return sorted(path.parent for path in root.glob('*/scene.json'))


def _tables_of(root: Path, name: str) -> tuple[Path, dict[str, Any]]:
    """Return the tables of a scene, and its row; the mini split comes before the others."""
    for tables in _table_folders(root):
        for row in _rows(tables, 'scene'):
            if row['name'] == name:
                return tables, row
    raise RecordingError(f'{root}: expected the scene {name!r}, got none; {DATASET.remedy}')


def _rows(tables: Path, name: str) -> Iterator[dict[str, Any]]:
    """Yield the rows of a table."""
    path = require(tables / f'{name}.json', f'the table {name!r} of nuScenes', DATASET.remedy)
    yield from json_items(path)
