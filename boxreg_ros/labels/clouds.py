"""Point clouds as the files that labelling tools and data sets keep them in."""

from __future__ import annotations

from pathlib import Path

from boxreg_ros.errors import ConfigError
import numpy as np
from numpy.typing import NDArray

PCD = """\
# .PCD v0.7 - Point Cloud Data file format
VERSION 0.7
FIELDS {names}
SIZE {sizes}
TYPE {types}
COUNT {ones}
WIDTH {count}
HEIGHT 1
VIEWPOINT 0 0 0 1 0 0 0
POINTS {count}
DATA binary
"""
PLY = """\
ply
format binary_little_endian 1.0
element vertex {count}
{properties}
end_header
"""
COLUMNS = {'.bin': 4, '.pcd.bin': 5}
"""Numbers per point: KITTI has x y z intensity, nuScenes also the ring."""


def write_cloud(
    path: Path, points: NDArray[np.floating], intensities: NDArray[np.floating] | None = None
) -> None:
    """
    Write a cloud in the format that its file name asks for, as little-endian float32.

    Parameters
    ----------
    path : Path
        Ends in ``.pcd`` (binary), ``.ply`` (binary), ``.pcd.bin`` (nuScenes: x y z intensity
        ring) or ``.bin`` (KITTI: x y z intensity).
    points : array, shape (M, 3)
        In the sensor's frame [m]; M may be 0.
    intensities : array, shape (M,), optional
        As the sensor gives them. Without them PCD and PLY have no such field, and BIN files
        have zeros, as they have for the ring.

    Raises
    ------
    ConfigError
        If the name ends in something else.

    """
    names = ['x', 'y', 'z'] if intensities is None else ['x', 'y', 'z', 'intensity']
    ending = next((e for e in ('.pcd.bin', '.bin', '.pcd', '.ply') if path.name.endswith(e)), '')
    if not ending:
        raise ConfigError(f'cloud {path.name!r}: expected a name in .pcd, .ply, .bin or .pcd.bin')
    table = np.zeros((len(points), COLUMNS.get(ending, len(names))), '<f4')
    table[:, :3] = points
    if intensities is not None:
        table[:, 3] = intensities
    with path.open('wb') as file:
        if ending == '.pcd':
            n = len(names)
            fields = {'sizes': ['4'] * n, 'types': ['F'] * n, 'ones': ['1'] * n, 'names': names}
            texts = {key: ' '.join(values) for key, values in fields.items()}
            file.write(PCD.format(count=len(points), **texts).encode())
        elif ending == '.ply':
            properties = '\n'.join(f'property float {name}' for name in names)
            file.write(PLY.format(count=len(points), properties=properties).encode())
        file.write(table.tobytes())
