"""
Stamps and poses beside labels whose format only counts frames.

Three files: ``timestamps.txt`` with one stamp per frame [ns]; ``poses.txt`` with
``T_fixed_sensor`` per frame, its upper three rows as twelve numbers, NaN if unknown; and
``boxreg.json`` with the provenance and the names of frames and tracks.

"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime, UTC
from pathlib import Path

from boxreg_ros.errors import RecordingError
from boxreg_ros.labels.files import frame_names, read_provenance
from boxreg_ros.labels.protocol import LabelFrame
from boxreg_ros.structures import Floats, RefinedBoxes
import numpy as np

STAMPS_FILE = 'timestamps.txt'
POSES_FILE = 'poses.txt'


@dataclass(frozen=True, slots=True)
class Sidecar:
    """The content of the three files; `poses` are ``T_fixed_sensor`` (4, 4), None if unknown."""

    stamps_ns: list[int]
    poses: list[Floats | None]
    fixed_frame: str
    sensor_frame: str
    tracks: dict[str, str]
    """Track ids by the numbers in the labels."""

    def frame(self, index: int, refined: RefinedBoxes) -> LabelFrame:
        """Return a frame with boxes in the sensor frame."""
        return LabelFrame(refined, self.fixed_frame, self.sensor_frame, self.poses[index])


def read_sidecar(folder: Path, count: int, stamps: Path | None = None) -> Sidecar:
    """
    Return the stamps and poses of at least `count` frames.

    Raises RecordingError if `stamps` (default: ``timestamps.txt``) is missing or has too few.

    """
    path = stamps or folder / STAMPS_FILE
    stamps_ns = read_stamps(path)
    if len(stamps_ns) < count:
        raise RecordingError(f'{path}: expected a stamp for {count} frames, got {len(stamps_ns)}')
    fixed_frame, sensor_frame = frame_names(folder)
    return Sidecar(
        stamps_ns,
        read_poses(folder / POSES_FILE, len(stamps_ns)),
        fixed_frame,
        sensor_frame,
        read_provenance(folder).get('tracks', {}),
    )


def read_stamps(path: Path) -> list[int]:
    """
    Return the stamps of a file [ns]: integers, or date and time (UTC) as in KITTI raw.

    Raises RecordingError if there is no such file, or a line is neither.

    """
    try:
        lines = path.read_text(encoding='utf-8').split('\n')
    except OSError:
        raise RecordingError(
            f'{path}: not found, and these labels have no stamps of their own; create it with '
            f'one stamp per frame, as whole nanoseconds'
        ) from None
    stamps = []
    for number, line in enumerate(filter(str.strip, lines), 1):
        try:
            stamps.append(_stamp_ns(line.strip()))
        except ValueError:
            raise RecordingError(
                f'{path}:{number}: expected whole nanoseconds, got {line.strip()!r}'
            ) from None
    return stamps


def read_poses(path: Path, count: int) -> list[Floats | None]:
    """
    Return ``T_fixed_sensor`` (4, 4) of `count` frames; None where the pose is unknown.

    Raises RecordingError if the file exists but is not `count` lines of twelve numbers.

    """
    if not path.exists() or not count:
        return [None] * count
    try:
        rows = np.loadtxt(path, ndmin=2).reshape(-1, 3, 4)  # (frame, row, column)
    except ValueError as error:
        raise RecordingError(f'{path}: expected twelve numbers a line: {error}') from None
    if len(rows) != count:
        raise RecordingError(f'{path}: expected {count} poses, one per stamp, got {len(rows)}')
    last_row = np.array([[0.0, 0.0, 0.0, 1.0]])
    return [np.vstack([row, last_row]) if np.isfinite(row).all() else None for row in rows]


def _stamp_ns(text: str) -> int:
    if text.isdigit():
        return int(text)
    moment, _, fraction = text.partition('.')
    seconds = int(datetime.fromisoformat(moment).replace(tzinfo=UTC).timestamp())
    return seconds * 10**9 + int(fraction.ljust(9, '0')[:9] or 0)
