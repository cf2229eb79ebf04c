"""Point clouds in the file formats of labelling tools and data sets."""

from __future__ import annotations

from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from boxreg_ros.errors import ConfigError, one_line, UnsupportedMessage
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
SUFFIXES = ('.pcd.bin', '.bin', '.npy', '.pcd', '.ply')
"""Longest first: ``.pcd.bin`` also ends in ``.bin``."""
PCD_LINE_BYTES = 1 << 16
"""Longest line of the header of a PCD file that is read [bytes]; chosen."""
BIN_COLUMNS = {'.bin': 4, '.npy': 4, '.pcd.bin': 5}
"""Numbers per point: KITTI and OpenPCDet have x y z intensity, nuScenes also the ring."""


def write_cloud(
    path: Path, points: NDArray[np.floating], intensities: NDArray[np.floating] | None = None
) -> None:
    """
    Write a cloud in the format of its file name, as little-endian float32.

    Parameters
    ----------
    path : Path
        Its name ends in ``.pcd`` (binary), ``.ply`` (binary), ``.pcd.bin`` (nuScenes: x y z
        intensity ring), ``.bin`` (KITTI: x y z intensity) or ``.npy`` (OpenPCDet: likewise).
    points : array, shape (M, 3)
        In the sensor frame [m].
    intensities : array, shape (M,), or None
        In the unit of the sensor. Without them PCD and PLY files have no such field, and the
        others have zeros. The ring is always zero.

    Raises
    ------
    ConfigError
        If the name has another suffix.
    OSError
        If the file cannot be written.

    """
    suffix = next((s for s in SUFFIXES if path.name.endswith(s)), '')
    if not suffix:
        raise ConfigError(
            f'cloud {path.name!r}: expected a name in .pcd, .ply, .bin, .npy or .pcd.bin'
        )
    names = ['x', 'y', 'z']
    if intensities is not None:
        names.append('intensity')
    table = np.zeros((len(points), BIN_COLUMNS.get(suffix, len(names))), '<f4')
    table[:, :3] = points
    if intensities is not None:
        table[:, 3] = intensities
    if suffix == '.npy':
        np.save(path, table)
        return
    with path.open('wb') as file:
        file.write(_header(suffix, names, len(points)).encode())
        file.write(table.data)


def _header(suffix: str, names: list[str], points: int) -> str:
    """Return the header of a cloud of `points` points; BIN files have none."""
    if suffix == '.pcd':
        sizes, types, counts = (' '.join(word * len(names)) for word in '4F1')
        return PCD_HEADER.format(
            names=' '.join(names), sizes=sizes, types=types, counts=counts, points=points
        )
    if suffix == '.ply':
        properties = '\n'.join(f'property float {name}' for name in names)
        return PLY_HEADER.format(points=points, properties=properties)
    return ''


class _PcdHeader(NamedTuple):
    """What a PCD file states before its points."""

    layout: np.dtype[Any]  # of one point; a field of several numbers is a subarray
    num_points: int
    encoding: str


def read_pcd(path: Path) -> NDArray[Any]:
    """
    Return the points of a PCD file as they are stored.

    Parameters
    ----------
    path : Path
        A file of version 0.5 to 0.7, with ``DATA`` ascii, binary or binary_compressed.

    Returns
    -------
    points : structured array, shape (M,)
        One row per point, with the fields of the file in its types; padding fields are left out.

    Raises
    ------
    UnsupportedMessage
        If the file does not follow the format or ends early.
    ConfigError
        If it is compressed and the package that unpacks LZF is not installed.
    OSError
        If it cannot be read.

    """
    with path.open('rb') as file:
        try:
            header = _read_pcd_header(file)
            table = _read_pcd_points(file, header)
        except (KeyError, TypeError, ValueError) as error:
            raise UnsupportedMessage(
                f'{path}: expected a PCD file: {type(error).__name__} {one_line(error)}; download '
                f'it again'
            ) from None
    names = [name for name in header.layout.names or () if not name.startswith('_')]
    return table[names]


def _read_pcd_header(file: BinaryIO) -> _PcdHeader:
    """Return the header of a PCD file, and leave `file` at its first point."""
    entries: dict[str, list[str]] = {}
    while 'DATA' not in entries:
        line = file.readline(PCD_LINE_BYTES)
        if not line:
            raise ValueError('no line DATA')
        words = line.decode('ascii').split()
        if words and not words[0].startswith('#'):
            entries[words[0].upper()] = words[1:]
    names = entries['FIELDS']
    counts = entries.get('COUNT', ['1'] * len(names))
    fields = []
    for number, (name, kind, size, count) in enumerate(
        zip(names, entries['TYPE'], entries['SIZE'], counts, strict=True)
    ):
        shape = () if count == '1' else (int(count),)
        fields.append(
            (f'_{number}' if name == '_' else name, f'<{kind.lower()}{int(size)}', shape)
        )
    width, height = int(entries['WIDTH'][0]), int(entries.get('HEIGHT', ['1'])[0])
    num_points = int(entries.get('POINTS', [str(width * height)])[0])
    return _PcdHeader(np.dtype(fields), num_points, entries['DATA'][0].lower())


def _read_pcd_points(file: BinaryIO, header: _PcdHeader) -> NDArray[Any]:
    """Return the points behind a header; raises ValueError if there are fewer or more."""
    layout, n, encoding = header
    if encoding == 'ascii':
        table = _read_pcd_text(file, layout) if n else np.zeros(0, layout)
    elif encoding == 'binary':
        table = np.frombuffer(file.read(n * layout.itemsize), layout)
    elif encoding == 'binary_compressed':
        table = _read_pcd_compressed(file, layout, n)
    else:
        raise ValueError(f'DATA {encoding}')
    if len(table) != n:
        raise ValueError(f'{len(table)} of {n} points')
    return table


def _read_pcd_text(file: BinaryIO, layout: np.dtype[Any]) -> NDArray[Any]:
    """Return the points that are written one a line."""
    numbers = []
    for name in layout.names or ():
        base, shape = layout[name].base, layout[name].shape
        numbers += [base] * int(np.prod(shape, initial=1))
    flat = np.dtype([(f'f{i}', base) for i, base in enumerate(numbers)])
    table: NDArray[Any] = np.loadtxt(file, flat, ndmin=1)
    return table.view(layout)


def _read_pcd_compressed(file: BinaryIO, layout: np.dtype[Any], n: int) -> NDArray[Any]:
    """Return the points that are stored field by field, compressed as a whole by LZF."""
    try:
        import lzf
    except ImportError as error:
        raise ConfigError(
            f'compressed PCD files need LZF: pip install python-neo-lzf ({error})'
        ) from None
    sizes = np.frombuffer(file.read(8), '<u4')
    if len(sizes) < 2:
        raise ValueError(f'0 of {n} points')
    packed = file.read(int(sizes[0]))
    whole = n * layout.itemsize
    unpacked = lzf.decompress(packed, whole) if whole else b''
    if unpacked is None or len(unpacked) != whole:
        raise ValueError(f'{len(unpacked or b"")} of {whole} bytes of points')
    table = np.zeros(n, layout)
    offset = 0
    for name in layout.names or ():
        kind = layout[name]
        count = n * int(np.prod(kind.shape, initial=1))
        column = np.frombuffer(unpacked, kind.base, count, offset)
        table[name] = column.reshape(n, *kind.shape)
        offset += count * kind.base.itemsize
    return table
