"""Point clouds in the file formats of labelling tools and data sets."""

from __future__ import annotations

from pathlib import Path

from boxreg_ros.errors import ConfigError
import numpy as np
from numpy.typing import NDArray

PCD_HEADER = """\
# .PCD v0.7 - Point Cloud Data file format
VERSION 0.7
FIELDS {names}
SIZE {sizes}
TYPE {types}
COUNT {counts}
WIDTH {points}
HEIGHT 1
VIEWPOINT 0 0 0 1 0 0 0
POINTS {points}
DATA binary
"""
PLY_HEADER = """\
ply
format binary_little_endian 1.0
element vertex {points}
{properties}
end_header
"""
SUFFIXES = ('.pcd.bin', '.bin', '.pcd', '.ply')
"""Longest first: ``.pcd.bin`` also ends in ``.bin``."""
BIN_COLUMNS = {'.bin': 4, '.pcd.bin': 5}
"""Numbers per point: KITTI has x y z intensity, nuScenes also the ring."""


def write_cloud(
    path: Path, points: NDArray[np.floating], intensities: NDArray[np.floating] | None = None
) -> None:
    """
    Write a cloud in the format of its file name, as little-endian float32.

    The name ends in ``.pcd`` (binary), ``.ply`` (binary), ``.pcd.bin`` (nuScenes: x y z intensity
    ring) or ``.bin`` (KITTI: x y z intensity). Points (M, 3) are in the sensor frame [m],
    intensities (M,) in the unit of the sensor. Without these, PCD and PLY files have no such
    field, and BIN files have zeros. The ring is always zero. Raises ConfigError if the name has
    another suffix.

    """
    suffix = next((s for s in SUFFIXES if path.name.endswith(s)), '')
    if not suffix:
        raise ConfigError(f'cloud {path.name!r}: expected a name in .pcd, .ply, .bin or .pcd.bin')
    names = ['x', 'y', 'z']
    if intensities is not None:
        names.append('intensity')
    table = np.zeros((len(points), BIN_COLUMNS.get(suffix, len(names))), '<f4')
    table[:, :3] = points
    if intensities is not None:
        table[:, 3] = intensities
    with path.open('wb') as file:
        file.write(_header(suffix, names, len(points)).encode())
        file.write(table.data)


def _header(suffix: str, names: list[str], points: int) -> str:
    """Return the header of a cloud of `points` points; BIN files have none."""
    if suffix == '.pcd':
        n = len(names)
        return PCD_HEADER.format(
            names=' '.join(names),
            sizes=' '.join(['4'] * n),
            types=' '.join(['F'] * n),
            counts=' '.join(['1'] * n),
            points=points,
        )
    if suffix == '.ply':
        properties = '\n'.join(f'property float {name}' for name in names)
        return PLY_HEADER.format(points=points, properties=properties)
    return ''
