"""What several formats share: streamed JSON lists, whole numbers for tracks, stamps and poses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from datetime import datetime, UTC
from itertools import count
import json
from pathlib import Path
from typing import Any, NamedTuple

from boxreg_ros.errors import RecordingError
from boxreg_ros.labels import INPUT, LabelFrame, Provenance
from boxreg_ros.rotations import rpy_from_quaternion
from boxreg_ros.structures import BoxArray, Floats, RefinedBoxes
import numpy as np
from numpy.typing import ArrayLike
import orjson

STAMPS, POSES, ORIGIN = 'timestamps.txt', 'poses.txt', 'boxreg.json'
FIRST_GIVEN_NUMBER = 10**6
JSON = orjson.OPT_NON_STR_KEYS | orjson.OPT_SERIALIZE_NUMPY


def the_one(found: Sequence[Path], path: Path, what: str) -> Path:
    """
    Return what was found in `path`.

    Raises
    ------
    RecordingError
        If that is none, or several.

    """
    if len(found) != 1:
        names = ', '.join(item.name for item in found) or 'none'
        raise RecordingError(f'{path}: expected one {what}, got {names}; name the path of one')
    return found[0]


def refined_boxes(
    stamp_ns: int,
    frame_id: str,
    track_ids: Sequence[str],
    class_names: Sequence[str],
    boxes: ArrayLike,
    scores: Sequence[float | None] | Floats | None = None,
    status: Sequence[str | None] | None = None,
    num_points: ArrayLike | None = None,
    covariances: Sequence[ArrayLike | None] | None = None,
    reasons: Sequence[str | None] | None = None,
) -> RefinedBoxes:
    """
    Return boxes as read from a file.

    Where the file says nothing, or None, the score is NaN, the status `INPUT`, the number of
    points 0 and the covariance the unit matrix.

    """
    n = len(track_ids)
    unknown = [None] * n
    covariance = [np.eye(6) if c is None else c for c in covariances or unknown]
    return RefinedBoxes(
        BoxArray(
            stamp_ns,
            frame_id,
            tuple(track_ids),
            tuple(class_names),
            np.array(unknown if scores is None else scores, np.float64),
            np.asarray(boxes, np.float64).reshape(n, 9),
        ),
        tuple(item or INPUT for item in status or unknown),
        tuple(item or '' for item in reasons or unknown),
        np.zeros(n, np.int64) if num_points is None else np.asarray(num_points, np.int64),
        np.array([np.asarray(c, np.float64).reshape(6, 6) for c in covariance]).reshape(n, 6, 6),
    )


def boxes_from(centres: ArrayLike, extents: ArrayLike, quaternions_xyzw: ArrayLike) -> Floats:
    """Return boxes (n, 9); the angles of quaternions that are none are NaN."""
    parts = [np.asarray(part, np.float64) for part in (centres, extents, quaternions_xyzw)]
    centre, extent, quaternion = (part.reshape(-1, part.shape[-1]) for part in parts)
    angles = np.full((len(centre), 3), np.nan)
    turned = np.linalg.norm(quaternion, axis=1) > 1e-6  # False for NaN
    if turned.any():
        angles[turned] = rpy_from_quaternion(quaternion[turned])
    return np.hstack([centre, extent, angles])


def to_json(value: Any) -> str:
    """Return `value` as JSON that every parser reads: null for NaN, text as it is."""
    return orjson.dumps(value, option=JSON).decode()


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

    def names(self) -> dict[str, str]:
        """Return the names behind the numbers that were given, the numbers as text."""
        return {str(number): name for name, number in self._numbers.items()}

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

    def close(self, tracks: Mapping[str, str] | None = None) -> None:
        """Complete the files; `tracks` are names that the labels have numbers for."""
        self._stamps.close()
        self._poses.close()
        write_origin(self._folder, self._origin | ({'tracks': tracks} if tracks else {}))


def write_origin(folder: Path, origin: Mapping[str, Any]) -> None:
    """Write ``boxreg.json``: `Provenance` as a dict, and what else is known."""
    (folder / ORIGIN).write_text(to_json(origin) + '\n', encoding='utf-8')


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
    if not path.exists() or not count:
        return [None] * count
    try:
        rows = np.loadtxt(path, ndmin=2).reshape(-1, 3, 4)
    except ValueError as error:
        raise RecordingError(f'{path}: expected twelve numbers a line: {error}') from None
    if len(rows) != count:
        raise RecordingError(f'{path}: expected {count} poses, one per stamp, got {len(rows)}')
    last = np.array([[0.0, 0.0, 0.0, 1.0]])
    return [np.vstack([row, last]) if np.isfinite(row).all() else None for row in rows]


class ReadTimeline(NamedTuple):
    """What a `Timeline` left: stamps [ns], poses, and the names of frames and tracks."""

    stamps_ns: list[int]
    poses: list[Floats | None]
    fixed_frame: str
    sensor_frame: str
    tracks: dict[str, str]

    def frame(self, index: int, refined: RefinedBoxes) -> LabelFrame:
        """Return a frame with boxes in the sensor's frame."""
        return LabelFrame(refined, self.fixed_frame, self.sensor_frame, self.poses[index])


def read_timeline(folder: Path, count: int, stamps: Path | None = None) -> ReadTimeline:
    """
    Return the timeline beside labels of at least `count` frames.

    Raises
    ------
    RecordingError
        If there are no stamps in `stamps` (default: ``timestamps.txt``), or fewer than frames.

    """
    path = stamps or folder / STAMPS
    stamps_ns = read_stamps(path)
    if len(stamps_ns) < count:
        raise RecordingError(f'{path}: expected a stamp for {count} frames, got {len(stamps_ns)}')
    origin = from_json(folder / ORIGIN) if (folder / ORIGIN).exists() else {}
    poses = read_poses(folder / POSES, len(stamps_ns))
    return ReadTimeline(stamps_ns, poses, *frame_names(folder), origin.get('tracks', {}))
