"""The table of data sets, and access to their scenes by address."""

from __future__ import annotations

from collections.abc import Sequence
from difflib import get_close_matches
from importlib import import_module
from pathlib import Path
from typing import cast, NamedTuple

from boxreg_ros.datasets.files import require_lidars
from boxreg_ros.datasets.protocol import DatasetModule, Scene
from boxreg_ros.errors import RecordingError, require_packages

DATASETS = {
    'nuscenes': 'boxreg_ros.datasets.nuscenes',
    'truckscenes': 'boxreg_ros.datasets.truckscenes',
    'kitti-tracking': 'boxreg_ros.datasets.kitti_tracking',
    'kitti-raw': 'boxreg_ros.datasets.kitti_raw',
    'argoverse2': 'boxreg_ros.datasets.argoverse2',
    'waymo': 'boxreg_ros.datasets.waymo',
    'pandaset': 'boxreg_ros.datasets.pandaset',
    'openpcdet': 'boxreg_ros.datasets.openpcdet',
}
"""Prefix on the command line -> module that implements `protocol.DatasetModule`."""
MAX_NAMED = 5
"""Most scenes that an error names; chosen."""


class Address(NamedTuple):
    """A scene of a data set, on the command line ``PREFIX:FOLDER#SCENE``."""

    dataset: str  # a name of `DATASETS`
    root: Path
    scene: str  # '' for the only one

    def __str__(self) -> str:
        """Return the address as on the command line."""
        scene = f'#{self.scene}' if self.scene else ''
        return f'{self.dataset}:{self.root}{scene}'


def address_of(path: Path) -> Address | None:
    """
    Return the address that the text of a path states; None for a file or folder.

    Raises RecordingError if it has the form of an address, but no data set has its prefix.

    """
    prefix, colon, rest = str(path).partition(':')
    if not colon:
        return None
    if prefix in DATASETS:
        root, mark, scene = rest.rpartition('#')
        if not mark or Path(rest).expanduser().is_dir():
            root, scene = rest, ''
        return Address(prefix, Path(root).expanduser(), scene)
    if '#' not in rest or path.exists():
        return None
    similar = get_close_matches(prefix, DATASETS, 1)
    meant = f'; did you mean {similar[0]}:{rest}?' if similar else ''
    raise RecordingError(
        f'recording {str(path)!r}: expected a data set among {", ".join(DATASETS)}, got '
        f'{prefix!r}{meant}'
    )


def module_of(name: str) -> DatasetModule:
    """Return the module of a data set, whether or not the packages it needs are installed."""
    return cast(DatasetModule, import_module(DATASETS[name]))


def scene_names(address: Address) -> list[str]:
    """
    Return the names of all scenes in the folder of a data set.

    Raises RecordingError if there are none, with the files that are expected, and ConfigError if
    the data set needs a package that is not installed.

    """
    module = module_of(address.dataset)
    require_packages(f'data set {address.dataset!r}', module.DATASET.packages)
    root = address.root
    if not root.is_dir():
        raise RecordingError(f'{address}: no such folder: {str(root)!r}')
    names = module.scene_names(root)
    if not names:
        there = sorted(path.name for path in root.iterdir())
        raise RecordingError(
            f'{address}: expected {module.DATASET.folder} in {str(root)!r}, got '
            f'{_listed(there)}; name the folder that the archives were unpacked in'
        )
    return names


def resolved(address: Address) -> Address:
    """
    Return the address with the name of its scene.

    Raises RecordingError if there is no such scene, or several and none is named; also as
    `scene_names`.

    """
    names = scene_names(address)
    if not address.scene and len(names) == 1:
        return address._replace(scene=names[0])
    if address.scene in names:
        return address
    title = module_of(address.dataset).DATASET.title
    if not address.scene:
        raise RecordingError(
            f'{address}: expected the name of a scene of {title}, as in '
            f'{address._replace(scene=names[0])}, got none; there: {_listed(names)}'
        )
    similar = get_close_matches(address.scene, names, 1)
    meant = f'; did you mean {similar[0]}?' if similar else ''
    raise RecordingError(
        f'{address}: no scene {address.scene!r} of {title} in {str(address.root)!r}{meant} '
        f'there: {_listed(names)}; is its split downloaded?'
    )


def scene_inputs(address: Address) -> tuple[Path, ...]:
    """Return the files and folders that a scene is read from; raises as `resolved`."""
    address = resolved(address)
    paths = module_of(address.dataset).inputs(address.root, address.scene)
    return tuple(path for path in paths if path.exists())


def scene_files(address: Address) -> list[Path]:
    """Return the files that a scene is read from; raises as `resolved`."""
    found: list[Path] = []
    for path in scene_inputs(address):
        found += sorted(path.rglob('*')) if path.is_dir() else [path]
    return [path for path in found if path.is_file()]


def all_scenes(address: Address) -> list[Address]:
    """Return the address of each scene of a folder, or the one that is named."""
    if address.scene:
        return [address]
    return [address._replace(scene=name) for name in scene_names(address)]


def open_scene(address: Address, lidars: Sequence[str] = ()) -> Scene:
    """
    Return a scene, without reading its clouds.

    Parameters
    ----------
    address : Address
        Its scene may be empty if the folder has one only.
    lidars : sequence of str
        Names of the LiDARs to read; none for the main one.

    Returns
    -------
    scene : Scene
        See `protocol.DatasetModule.open_scene`.

    Raises
    ------
    RecordingError
        If there is no such scene or LiDAR, several scenes and none is named, or a file is missing
        or does not follow the layout.
    ConfigError
        If the data set needs a package that is not installed.

    """
    address = resolved(address)
    module = module_of(address.dataset)
    names = module.DATASET.lidars
    chosen = require_lidars(lidars or names[:1], names) if names else lidars
    return module.open_scene(address.root, address.scene, chosen)


def _listed(names: list[str]) -> str:
    """Return the first of some names, and how many there are."""
    if not names:
        return 'nothing'
    shown = ', '.join(names[:MAX_NAMED])
    return shown if len(names) <= MAX_NAMED else f'{shown}, ... ({len(names)})'
