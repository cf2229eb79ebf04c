"""
OpenPCDet's template of custom data: ``points/NAME.npy`` or ``.bin``, with ``labels/NAME.txt``.

The folder is one drive. Stamps are those of ``timestamps.txt``, one per cloud, or the names of the
clouds. The poses of the LiDAR are those of ``poses.txt``, which has no place in the template:
without it the LiDAR is taken to stand still.

"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

from boxreg_ros.datasets.files import missing_sweep, pose_rows, read_bin
from boxreg_ros.datasets.protocol import Cloud, Dataset, Scene, SweepFile
from boxreg_ros.errors import RecordingError, UnsupportedMessage
from boxreg_ros.labels import frames_of, SceneFrames
from boxreg_ros.labels.cuboids import in_order
from boxreg_ros.labels.files import visible
from boxreg_ros.labels.openpcdet import CLOUD_SUFFIXES
from boxreg_ros.labels.sidecar import named_frames, POSES_FILE, read_sidecar
import numpy as np

DATASET = Dataset(
    name='openpcdet',
    title='OpenPCDet custom data',
    folder='points/NAME.npy or .bin, labels/NAME.txt, timestamps.txt and poses.txt',
    scene='drive',
    labels='openpcdet',
    remedy='write the clouds again',
    lidars=('points',),
    reads='clouds of one drive, stamps, labels; poses in `poses.txt`',
    leaves_out='ImageSets',
)
BIN_NUMBERS = 4
"""Numbers per point of ``.bin``: x y z intensity, as OpenPCDet reads it."""


def scene_names(root: Path) -> list[str]:
    """Return the name of the folder, if it has clouds."""
    return [root.absolute().name] if _clouds(root) else []


def inputs(root: Path, name: str) -> tuple[Path, ...]:
    """Return the files and folders of the drive."""
    known = ('points', 'labels', 'boxreg', 'timestamps.txt', POSES_FILE)
    return tuple(root / part for part in known)


def open_scene(root: Path, name: str, lidars: Sequence[str]) -> Scene:
    """Return the drive; see `protocol.DatasetModule`."""
    paths = {path.stem: path for path in _clouds(root)}
    # As of `labels.openpcdet`: frames with labels or clouds have a stamp each.
    labels = {path.stem for path in visible(root, 'labels/*.txt')}
    names = named_frames(root, paths.keys() | labels)
    sidecar = read_sidecar(root, len(names), names=names)
    stamps_ns = sidecar.stamps_ns
    name_of = in_order(root, names, stamps_ns, {})
    with_clouds = [i for i, stem in name_of.items() if stem in paths]
    order = sorted(with_clouds, key=stamps_ns.__getitem__)
    poses = [sidecar.poses[i] for i in order]
    known = [i for i, pose in enumerate(poses) if pose is not None]
    note = ''
    if not known:
        note = (
            f'{root / POSES_FILE}: expected the poses of the LiDAR, 12 numbers a line, got no '
            f'file: it is taken to stand still; if it drives, parked objects move in its frame, '
            f'and are refined as moving ones'
        )
        known = list(range(len(order)))
        poses = [np.eye(4)] * len(order)
    ascending = np.array([stamps_ns[i] for i in order], np.int64)
    frames = SceneFrames(
        name,
        {stem: stamps_ns[i] for i, stem in name_of.items()},
        sidecar.fixed_frame,
        sidecar.sensor_frame,
    )
    has_labels = (root / 'labels').is_dir()
    return Scene(
        frames,
        DATASET.lidar,
        ascending,
        lambda: (SweepFile(stamps_ns[i], partial(_cloud, paths[name_of[i]])) for i in order),
        ascending[known],
        pose_rows([pose for pose in poses if pose is not None]),
        partial(frames_of, 'openpcdet', root) if has_labels else None,
        without_boxes=str(root / 'labels'),
        note=note,
    )


def _clouds(root: Path) -> list[Path]:
    """Return the files of the clouds, by name; RecordingError if two have one name."""
    paths = [path for path in visible(root, 'points/*') if path.suffix in CLOUD_SUFFIXES]
    names = [path.stem for path in paths]
    for name in names:
        if names.count(name) > 1:
            raise RecordingError(
                f'{root}: expected one cloud of each name, got points/{name}.npy and .bin; '
                f'remove one of them'
            )
    return paths


def _cloud(path: Path) -> Cloud:
    """Return the cloud of a file; UnsupportedMessage if it cannot be read."""
    if path.suffix == '.bin':
        return read_bin(path, BIN_NUMBERS)
    try:
        rows = np.load(path, allow_pickle=False)
    except OSError as error:
        raise missing_sweep(path, error) from None
    except ValueError as error:
        raise UnsupportedMessage(f'{path}: expected an array of numbers: {error}') from None
    if rows.ndim != 2 or rows.shape[1] < 3 or rows.dtype.kind not in 'fiu':
        raise UnsupportedMessage(
            f'{path}: expected rows of x y z and more, got {rows.dtype} of shape {rows.shape}; '
            f'write it again'
        )
    has_intensity = rows.shape[1] > 3
    return Cloud(rows[:, :3], rows[:, 3].astype(np.float64) if has_intensity else None).finite()
