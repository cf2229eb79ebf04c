"""
nuScenes, its tables as they are downloaded; T4 and our own exports have the same tables.

The tables are read row by row and only the rows of the scene are held. Sweeps between the key
frames are read too: 20 Hz, where annotations have 2 Hz. Clouds are read in the format of their
file names. Those of several LiDARs are in the frame of the ego vehicle, each at its own stamp.

"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from boxreg_ros.datasets.files import at_stamp, pose_rows, read_cloud, require, require_lidars
from boxreg_ros.datasets.protocol import Cloud, Dataset, Scene, SweepFile
from boxreg_ros.errors import RecordingError, UnsupportedMessage
from boxreg_ros.labels import frames_of, SceneFrames
from boxreg_ros.labels.clouds import BIN_COLUMNS
from boxreg_ros.labels.files import frame_names, from_json, json_items, visible
from boxreg_ros.labels.nuscenes import lidar_mounts, own_values, pose_matrix
from boxreg_ros.structures import Floats, Ints
import numpy as np

DATASET = Dataset(
    name='nuscenes',
    title='nuScenes',
    folder='v1.0-*/scene.json, samples/, sweeps/',
    scene='scene-0061',
    labels='nuscenes',
    remedy='unpack its metadata and LiDAR archives into one folder',
    packages=('ijson',),
    reads='the LiDARs of a scene, `.pcd.bin`, `.bin` and `.pcd`, key frames and sweeps',
    leaves_out='cameras, radar, maps, lidarseg',
    read_back='nuscenes-devkit 1.2.0',
)
MERGED_FRAME = 'ego'
"""Frame of the clouds of several LiDARs."""
POSE_MARGIN_NS = 10**9
"""Poses are read so long before the first and after the last sweep [ns]; chosen."""


def scene_names(root: Path) -> list[str]:
    """Return the names of the scenes of all splits in a folder."""
    names = {row['name'] for tables in _table_folders(root) for row in _rows(tables, 'scene')}
    return sorted(names)


def inputs(root: Path, name: str) -> tuple[Path, ...]:
    """Return the folder of the tables of a scene."""
    return (tables_of(root, name)[0],)


def open_scene(root: Path, name: str, lidars: Sequence[str]) -> Scene:
    """Return a scene; see `protocol.DatasetModule`."""
    return scene_of(root, name, lidars)


def scene_of(root: Path, name: str, lidars: Sequence[str], has_all_poses: bool = False) -> Scene:
    """
    Return a scene of tables as those of nuScenes.

    Parameters
    ----------
    root : Path
        The folder of the data set.
    name : str
        Of the scene.
    lidars : sequence of str
        Channels of the LiDARs, the first gives the stamps; by default the only one.
    has_all_poses : bool
        Whether ``ego_pose`` has the motion of the vehicle, and not one pose per sweep. Then the
        default is all LiDARs, poses are at their own stamps, and the motion during a sweep is
        compensated where its points have times.

    Raises
    ------
    RecordingError
        If a table or row is missing, or there is no such LiDAR.

    """
    tables, scene = tables_of(root, name)
    try:
        sensors = _lidars(tables, lidars, has_all_poses)
        return _scene(root, tables, scene, sensors, has_all_poses)
    except (KeyError, TypeError, ValueError) as error:
        raise RecordingError(
            f'{tables}: expected the tables of nuScenes: {type(error).__name__} {error}'
        ) from None


class _Lidars(NamedTuple):
    """The LiDARs of a scene."""

    channels: tuple[str, ...]
    mounts: dict[str, tuple[str, Floats]]
    """Channel and pose (4, 4) in the vehicle by the token of the calibration."""


class _Motion(NamedTuple):
    """Poses of the vehicle, or of the LiDAR, in the global frame."""

    stamps_ns: Ints  # (P,) ascending
    T_global: Floats  # (P, 4, 4)


def _scene(
    root: Path, tables: Path, scene: dict[str, Any], lidars: _Lidars, has_all_poses: bool
) -> Scene:
    """Return a scene of a row of the table ``scene``."""
    samples = {
        row['token']: row['timestamp'] * 1000
        for row in _rows(tables, 'sample')
        if row['scene_token'] == scene['token']
    }
    sweeps = _sweeps_of_scene(tables, samples, lidars)
    names = ', '.join(lidars.channels)
    if not sweeps:
        raise RecordingError(
            f'{tables / "sample_data.json"}: expected sweeps of {names} in {scene["name"]}, got '
            f'none; {DATASET.remedy}'
        )
    is_single = len(lidars.channels) == 1
    is_in_ego = has_all_poses or not is_single
    stamps_ns = dict(samples)
    if not is_in_ego:
        # The stamp of a sample is that of its sweep, which our own exports have in nanoseconds.
        stamps_ns |= {row['sample_token']: _stamp_ns(row) for row in sweeps if row['is_key_frame']}
    by_time = dict(sorted(stamps_ns.items(), key=lambda item: item[1]))
    sensor_frame = MERGED_FRAME if is_in_ego else names
    frames = SceneFrames(scene['name'], by_time, *frame_names(root, 'map', sensor_frame))
    if has_all_poses:
        motion = _motion(tables, sweeps)
    else:
        motion = _motion_at_sweeps(tables, sweeps, None if is_in_ego else lidars)
    annotations = tables / 'sample_annotation.json'
    has_annotations = annotations.is_file() and next(json_items(annotations), None) is not None
    return Scene(
        frames,
        names,
        np.array([_stamp_ns(row) for row in sweeps], np.int64),
        partial(
            _sweep_files,
            root,
            sweeps,
            lidars if is_in_ego else None,
            motion if has_all_poses else None,
        ),
        motion.stamps_ns,
        pose_rows(motion.T_global),
        partial(frames_of, 'nuscenes', tables, frames) if has_annotations else None,
        without_boxes=str(annotations),
        lidars=() if is_single else lidars.channels,
    )


def _lidars(tables: Path, asked: Sequence[str], takes_all: bool) -> _Lidars:
    """Return the LiDARs that are asked for, else the only one, or all if it `takes_all`."""
    mounts = lidar_mounts(tables)
    names = sorted({channel for channel, _ in mounts.values()})
    chosen = require_lidars(asked or (names if takes_all else ()), names)
    return _Lidars(chosen, {token: one for token, one in mounts.items() if one[0] in chosen})


def _sweeps_of_scene(
    tables: Path, samples: Mapping[str, int], lidars: _Lidars
) -> list[dict[str, Any]]:
    """
    Return the rows of ``sample_data`` with the clouds of a scene, in the order of time.

    Sweeps between the key frames of T4 name no sample. They are of the scene if a sweep that names
    one of its samples is linked with them, or if there is no other scene.

    """
    found: dict[str, dict[str, Any]] = {}
    own = own_values(tables.parent)
    without_sample: dict[str, dict[str, Any]] = {}
    is_only_scene = len(list(_rows(tables, 'scene'))) == 1
    for row in _rows(tables, 'sample_data'):
        if row['calibrated_sensor_token'] not in lidars.mounts:
            continue
        row |= own.get(row['token'], {})
        if row['sample_token'] in samples or (is_only_scene and not row['sample_token']):
            found[row['token']] = row
        elif not row['sample_token']:
            without_sample[row['token']] = row
    reached = list(found.values()) if without_sample else []
    while reached:
        row = reached.pop()
        for token in (row['prev'], row['next']):
            linked = without_sample.pop(token, None)
            if linked is not None:
                found[token] = linked
                reached.append(linked)
    return sorted(found.values(), key=_stamp_ns)


def _sweep_files(
    root: Path, sweeps: list[dict[str, Any]], lidars: _Lidars | None, motion: _Motion | None
) -> Iterator[SweepFile]:
    """Yield the sweeps; with `lidars` in the frame of the vehicle, compensated by `motion`."""
    for row in sweeps:
        read = partial(_cloud, root, row)
        if lidars is None:
            yield SweepFile(_stamp_ns(row), read)
            continue
        channel, T_ego_lidar = lidars.mounts[row['calibrated_sensor_token']]
        yield SweepFile(
            _stamp_ns(row), partial(_cloud_in_ego, read, T_ego_lidar, motion, _stamp_ns(row)),
            channel if len(lidars.channels) > 1 else '',
        )  # fmt: skip


def _cloud(root: Path, row: dict[str, Any]) -> Cloud:
    """Return the cloud of a row of ``sample_data`` in the frame of its LiDAR."""
    if row.get('is_valid') is False:
        raise UnsupportedMessage(
            f'{root / row["filename"]}: expected a sweep that can be used, got one that is_valid '
            f'of T4 excludes; it is left out'
        )
    columns = BIN_COLUMNS['.pcd.bin']
    about = row.get('info_filename')
    if about and (root / about).is_file():
        columns = int(from_json(root / about).get('num_pts_feats', columns))  # of T4
    return read_cloud(root / row['filename'], _stamp_ns(row), row['fileformat'], columns)


def _cloud_in_ego(
    read: Callable[[], Cloud], T_ego_lidar: Floats, motion: _Motion | None, stamp_ns: int
) -> Cloud:
    """Return a cloud in the frame of the vehicle at its stamp [ns]."""
    cloud = read()
    points = cloud.points.astype(np.float64) @ T_ego_lidar[:3, :3].T + T_ego_lidar[:3, 3]
    if motion is not None and cloud.times is not None and len(points):
        points = at_stamp(points, cloud.times, stamp_ns, *motion)
    return replace(cloud, points=points.astype(np.float32), origins=T_ego_lidar[None, :3, 3])


def _motion(tables: Path, sweeps: list[dict[str, Any]]) -> _Motion:
    """Return all poses of the vehicle of the time of the sweeps, at their own stamps."""
    first_ns = _stamp_ns(sweeps[0]) - POSE_MARGIN_NS
    last_ns = _stamp_ns(sweeps[-1]) + POSE_MARGIN_NS
    poses = {
        row['timestamp'] * 1000: pose_matrix(row)
        for row in _rows(tables, 'ego_pose')
        if first_ns <= row['timestamp'] * 1000 <= last_ns
    }
    if not poses:
        raise RecordingError(
            f'{tables / "ego_pose.json"}: expected poses of the time of the sweeps, from '
            f'{_stamp_ns(sweeps[0])} to {_stamp_ns(sweeps[-1])} ns, got none; {DATASET.remedy}'
        )
    return _ordered(poses)


def _motion_at_sweeps(
    tables: Path, sweeps: list[dict[str, Any]], lidars: _Lidars | None
) -> _Motion:
    """Return the poses that sweeps name, at their stamps: of the vehicle, or of `lidars`."""
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
    poses = {}
    for row in sweeps:
        T = T_global_ego[row['ego_pose_token']]
        if lidars is not None:
            T = T @ lidars.mounts[row['calibrated_sensor_token']][1]
        poses[_stamp_ns(row)] = T
    return _ordered(poses)


def _ordered(poses: Mapping[int, Floats]) -> _Motion:
    """Return poses (4, 4) by their stamps [ns] in the order of time."""
    stamps_ns = sorted(poses)
    return _Motion(
        np.array(stamps_ns, np.int64), np.array([poses[stamp_ns] for stamp_ns in stamps_ns])
    )


def _stamp_ns(row: dict[str, Any]) -> int:
    """Return the stamp of a sweep [ns]; only our own exports have it in nanoseconds."""
    return int(row.get('stamp_ns', row['timestamp'] * 1000))


def _table_folders(root: Path) -> list[Path]:
    """Return the folders of the tables of all splits."""
    return [path.parent for path in visible(root, '*/scene.json')]


def tables_of(root: Path, name: str) -> tuple[Path, dict[str, Any]]:
    """
    Return the tables of a scene, and its row; the mini split comes before the others.

    Parameters
    ----------
    root : Path
        Folder of the data set.
    name : str
        Of the scene, as in ``scene.json``.

    Returns
    -------
    tables : Path
        Folder of the JSON tables.
    row : dict
        Of the table ``scene``.

    Raises
    ------
    RecordingError
        If there is no such scene, or a table cannot be read.

    """
    for tables in _table_folders(root):
        for row in _rows(tables, 'scene'):
            if row['name'] == name:
                return tables, row
    raise RecordingError(f'{root}: expected the scene {name!r}, got none; {DATASET.remedy}')


def _rows(tables: Path, name: str) -> Iterator[dict[str, Any]]:
    """Yield the rows of a table."""
    path = require(tables / f'{name}.json', f'the table {name!r} of nuScenes', DATASET.remedy)
    yield from json_items(path)
