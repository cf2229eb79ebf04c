"""What several formats share: streamed JSON lists, whole numbers for tracks, stamps and poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from datetime import datetime, UTC
from itertools import count
import json
from pathlib import Path
from typing import Any

from boxreg_ros.errors import RecordingError
from boxreg_ros.labels import INPUT, LabelFrame, Provenance
from boxreg_ros.structures import BoxArray, Floats, RefinedBoxes
import numpy as np
from numpy.typing import ArrayLike

STAMPS, POSES, ORIGIN = 'timestamps.txt', 'poses.txt', 'boxreg.json'
FIRST_GIVEN_NUMBER = 10**6


def refined_boxes(
    stamp_ns: int,
    frame_id: str,
    track_ids: Sequence[str],
    class_names: Sequence[str],
    boxes: ArrayLike,
    scores: ArrayLike | None = None,
    status: Sequence[str] | None = None,
    num_points: ArrayLike | None = None,
    covariances: ArrayLike | None = None,
    reasons: Sequence[str] | None = None,
) -> RefinedBoxes:
    """Return boxes as read from a file, filled up where the file says nothing."""
    n = len(track_ids)
    return RefinedBoxes(
        BoxArray(
            stamp_ns,
            frame_id,
            tuple(track_ids),
            tuple(class_names),
            np.ones(n) if scores is None else np.asarray(scores, np.float64),
            np.asarray(boxes, np.float64).reshape(n, 9),
        ),
        (INPUT,) * n if status is None else tuple(status),
        ('',) * n if reasons is None else tuple(reasons),
        np.zeros(n, np.int64) if num_points is None else np.asarray(num_points, np.int64),
        np.broadcast_to(np.eye(6), (n, 6, 6))
        if covariances is None
        else np.asarray(covariances, np.float64).reshape(n, 6, 6),
    )


def to_json(value: Any) -> str:
    """Return `value` as JSON that every parser reads: no NaN, text as it is."""
    return json.dumps(value, allow_nan=False, ensure_ascii=False)


def from_json(path: Path) -> Any:
    """
    Return the content of a JSON file.

    Raises
    ------
    RecordingError
        If there is none, or it is broken.

    """
    try:
        return json.loads(path.read_text(encoding='utf-8'))
    except OSError as error:
        raise RecordingError(f'{path}: cannot be read: {error.strerror}') from None
    except ValueError as error:
        raise RecordingError(f'{path}: not JSON: {error}') from None


class JsonList:
    """A JSON file that is one list, written item by item."""

    def __init__(self, path: Path) -> None:
        self._file = path.open('w', encoding='utf-8')
        self._lead = '[\n'

    def append(self, item: Any) -> None:
        """Add an item, on a line of its own."""
        self._file.write(self._lead + to_json(item))
        self._lead = ',\n'

    def close(self) -> None:
        """Close the list and the file."""
        self._file.write('[]\n' if self._lead == '[\n' else '\n]\n')
        self._file.close()


class TrackNumbers:
    """
    Whole numbers for tracks, where a format does not take names.

    A name that is a number below `FIRST_GIVEN_NUMBER` stays what it is; others get numbers from
    there on. A box without a name gets a number of its own.

    """

    def __init__(self) -> None:
        self._numbers: dict[str, int] = {}
        self._next = count(FIRST_GIVEN_NUMBER)

    def of(self, track_id: str) -> int:
        """Return the number of a track."""
        if track_id.isascii() and track_id.isdigit() and len(track_id) <= 6:
            number = int(track_id)
            if str(number) == track_id:
                return number
        if not track_id:
            return next(self._next)
        if track_id not in self._numbers:
            self._numbers[track_id] = next(self._next)
        return self._numbers[track_id]


class Timeline:
    """
    Stamps and poses of frames that their format only counts, in three files beside the labels.

    ``timestamps.txt``: a stamp per frame [ns]; ``poses.txt``: ``T_fixed_sensor`` per frame, its
    upper three rows as twelve numbers, NaN if unknown; ``boxreg.json``: `Provenance`, and the
    names of the two frames.

    """

    def __init__(self, folder: Path, provenance: Provenance) -> None:
        self._folder = folder
        self._stamps = (folder / STAMPS).open('w', encoding='utf-8')
        self._poses = (folder / POSES).open('w', encoding='utf-8')
        self._origin = asdict(provenance)

    def add(self, frame: LabelFrame) -> None:
        """Add the next frame."""
        T = frame.T_fixed_sensor
        rows = np.full((3, 4), np.nan) if T is None else T[:3]
        self._stamps.write(f'{frame.refined.boxes.stamp_ns}\n')
        self._poses.write(' '.join(map(repr, rows.ravel().tolist())) + '\n')
        self._origin |= {'fixed_frame': frame.fixed_frame, 'sensor_frame': frame.sensor_frame}

    def close(self) -> None:
        """Complete the files."""
        self._stamps.close()
        self._poses.close()
        (self._folder / ORIGIN).write_text(to_json(self._origin) + '\n', encoding='utf-8')


def frame_names(folder: Path, fixed: str = 'map', sensor: str = 'lidar') -> tuple[str, str]:
    """Return the names of the fixed and the sensor's frame in ``boxreg.json``, or the defaults."""
    if not (folder / ORIGIN).exists():
        return fixed, sensor
    origin = from_json(folder / ORIGIN)
    return str(origin.get('fixed_frame', fixed)), str(origin.get('sensor_frame', sensor))


def read_stamps(path: Path) -> list[int]:
    """
    Return the stamps of a file [ns]: whole numbers, or date and time (UTC) as KITTI writes them.

    Raises
    ------
    RecordingError
        If there is no such file, or a line is neither.

    """
    try:
        lines = path.read_text(encoding='utf-8').split('\n')
    except OSError:
        raise RecordingError(
            f'{path}: not there, and the labels only count their frames; write one stamp per '
            f'frame into it, as whole nanoseconds'
        ) from None
    stamps = []
    for number, line in enumerate(filter(str.strip, lines), 1):
        try:
            if line.strip().isdigit():
                stamps.append(int(line))
                continue
            moment, _, part = line.strip().partition('.')
            seconds = datetime.fromisoformat(moment).replace(tzinfo=UTC).timestamp()
            stamps.append(int(seconds) * 10**9 + int(part.ljust(9, '0')[:9] or 0))
        except ValueError:
            raise RecordingError(
                f'{path}:{number}: expected whole nanoseconds, got {line.strip()!r}'
            ) from None
    return stamps


def read_poses(path: Path, count: int) -> list[Floats | None]:
    """
    Return ``T_fixed_sensor`` (4, 4) of `count` frames; None for those that are not known.

    Raises
    ------
    RecordingError
        If the file is there, but not `count` lines of twelve numbers.

    """
    if not path.exists():
        return [None] * count
    try:
        rows = np.loadtxt(path, ndmin=2).reshape(-1, 3, 4)
    except ValueError as error:
        raise RecordingError(f'{path}: expected twelve numbers a line: {error}') from None
    if len(rows) != count:
        raise RecordingError(f'{path}: expected {count} poses, one per stamp, got {len(rows)}')
    last = np.array([[0.0, 0.0, 0.0, 1.0]])
    return [np.vstack([row, last]) if np.isfinite(row).all() else None for row in rows]
