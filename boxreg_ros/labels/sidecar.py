"""
Stamps and poses beside labels whose format only counts frames.

Three files: ``timestamps.txt`` with one stamp per frame [ns]; ``poses.txt`` with
``T_fixed_sensor`` per frame, its upper three rows as twelve numbers, NaN if unknown; and
``boxreg.json`` with the provenance and the names of frames and tracks.

"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
import re

from boxreg_ros.errors import RecordingError, unreadable
from boxreg_ros.labels.files import following, frame_names
from boxreg_ros.labels.protocol import LabelFrame, SceneFrames
from boxreg_ros.labels.records import FrameBoxes, NO_FRAME_BOXES, ReadBox, refined_of
from boxreg_ros.labels.stamps import stamps_ns, stamps_of_names
from boxreg_ros.structures import Floats
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

    def frame(
        self, index: int, boxes: Sequence[ReadBox], left_out: Mapping[str, int]
    ) -> LabelFrame:
        """
        Return a frame of boxes in the sensor frame.

        Parameters
        ----------
        index : int
            Of the stamp and the pose, from 0.
        boxes : sequence of ReadBox
            In the sensor frame [m, rad].
        left_out : mapping of str to int
            Number of boxes of the file that `boxes` lacks, by `Reason`.

        Returns
        -------
        frame : LabelFrame
            With the pose of the sensor, if it is known.

        Raises
        ------
        ValueError, TypeError
            If a box or its evidence does not have the numbers that it should.

        """
        refined = refined_of(self.stamps_ns[index], self.sensor_frame, boxes)
        pose = self.poses[index]
        return LabelFrame(
            refined, self.fixed_frame, self.sensor_frame, pose, left_out=dict(left_out)
        )


def read_sidecar(
    folder: Path, count: int, stamps: Path | None = None, names: Sequence[str] = ()
) -> Sidecar:
    """
    Return stamps and poses of frames.

    Parameters
    ----------
    folder : Path
        Of the sidecar files.
    count : int
        Least number of frames.
    stamps : Path, optional
        File of the stamps, instead of that of the folder.
    names : sequence of str
        Of the frames in order. Without a file of stamps these are used, if they state one each.

    Raises
    ------
    RecordingError
        If a file is missing, does not follow its format, or has too few frames.

    """
    path = stamps or folder / STAMPS_FILE
    stamps_of_frames = None if path.exists() else stamps_of_names(names)
    stamps_ns = whole_stamps(path, count, names) if stamps_of_frames is None else stamps_of_frames
    if len(stamps_ns) < count:
        raise RecordingError(f'{path}: expected a stamp for {count} frames, got {len(stamps_ns)}')
    fixed_frame, sensor_frame = frame_names(folder)
    return Sidecar(
        stamps_ns,
        read_poses(folder / POSES_FILE, len(stamps_ns)),
        fixed_frame,
        sensor_frame,
    )


def numbered_frames(
    folder: Path,
    frames: Mapping[int, FrameBoxes],
    stamps: Path | None = None,
    names: Sequence[str] = (),
) -> Iterator[LabelFrame]:
    """
    Yield the frames of a folder whose labels have the number of their frame.

    Parameters
    ----------
    folder : Path
        Of the sidecar files.
    frames : mapping of int to FrameBoxes
        By the number of the frame, from 0; boxes in the sensor frame [m, rad].
    stamps : Path, optional
        File of the stamps, instead of that of the folder.
    names : sequence of str
        Of the frames in order; without a file of stamps these are used, if they state one each.

    Yields
    ------
    frame : LabelFrame
        One per stamp, in the order of the numbers, with or without boxes.

    Raises
    ------
    RecordingError
        If the sidecar files are missing, do not follow their format, or have too few frames.

    """
    sidecar = read_sidecar(folder, 1 + max(frames, default=-1), stamps, names)
    for index in range(len(sidecar.stamps_ns)):
        yield sidecar.frame(index, *frames.get(index, NO_FRAME_BOXES))


def numbered_scene(
    path: Path, frames: Mapping[int, FrameBoxes], scene: SceneFrames
) -> Iterator[LabelFrame]:
    """
    Yield the frames of a scene of a data set whose labels have the number of their frame.

    Parameters
    ----------
    path : Path
        The label file, for the error.
    frames : mapping of int to FrameBoxes
        By the number of the frame; boxes in the sensor frame of the scene [m, rad].
    scene : SceneFrames
        Its `stamps_ns` are by the number of the frame, as text.

    Yields
    ------
    frame : LabelFrame
        One per stamp of the scene, in its order, with or without boxes.

    Raises
    ------
    RecordingError
        If there are boxes of a frame that the scene does not have.

    """
    known = scene.stamps_ns
    unknown = [number for number in frames if str(number) not in known and frames[number][0]]
    if unknown:
        raise RecordingError(
            f'{path}: expected frames 0 to {len(known) - 1} of {scene.name}, got frame '
            f'{max(unknown)}; name the labels of this drive'
        )
    for number, stamp_ns in known.items():
        boxes, left_out = frames.get(int(number), NO_FRAME_BOXES)
        refined = refined_of(stamp_ns, scene.sensor_frame, boxes)
        yield LabelFrame(refined, scene.fixed_frame, scene.sensor_frame, left_out=dict(left_out))


def whole_stamps(path: Path, count: int = 0, names: Sequence[str] = ()) -> list[int]:
    """
    Return a stamp for each frame of a file.

    A frame whose line is blank keeps its number. Its stamp is interpolated between those of its
    neighbours, and extrapolated at an end.

    Parameters
    ----------
    path : Path
        In the format of `read_stamps`.
    count : int
        Blank lines at the end are frames up to this number.
    names : sequence of str
        Of frames, which state no stamps; for the error.

    Returns
    -------
    stamps_ns : list of int
        Of each frame [ns]; they may be fewer than `count`.

    Raises
    ------
    RecordingError
        If the file cannot be read, or a line is no stamp.

    """
    return filled_stamps(read_stamps(path, names), count)


def named_frames(folder: Path, names: Iterable[str]) -> list[str]:
    """
    Return the names of the frames of a folder in the order of the lines of ``timestamps.txt``.

    Names are counted, as 2, 10, where the stamps ascend. Others were written as a program lists
    the files: 10, 2.

    """
    counted = sorted(names, key=lambda name: (_by_number(name), name))
    path = folder / STAMPS_FILE
    stamps_ns = read_stamps(path) if path.exists() else []
    known = [stamp_ns for stamp_ns in stamps_ns if stamp_ns is not None]
    return counted if known == sorted(known) else sorted(counted)


def _by_number(name: str) -> tuple[str | int, ...]:
    """Return the parts of a name, whose digits are numbers; every second part has digits."""
    parts = re.split('([0-9]+)', name)
    return tuple(int(part) if index % 2 else part for index, part in enumerate(parts))


def filled_stamps(stamps_ns: Sequence[int | None], count: int = 0) -> list[int]:
    """
    Return stamps with those of blank lines, as `whole_stamps` has them.

    Parameters
    ----------
    stamps_ns : sequence of int or None
        One per line [ns]; None for a blank one.
    count : int
        Blank lines at the end are frames up to this number.

    Returns
    -------
    stamps_ns : list of int
        Of each frame [ns]. Of less than two stamps there is no period: that of the first frame
        alone is returned, or none.

    Raises
    ------
    RecordingError
        If the only stamp is that of a later frame.

    """
    known = [number for number, stamp_ns in enumerate(stamps_ns) if stamp_ns is not None]
    given_ns = [stamp_ns for stamp_ns in stamps_ns if stamp_ns is not None]
    if known and known[0] and len(known) < 2:
        raise RecordingError(
            f'stamps: expected two or more, whose period blank lines have, got one, in line '
            f'{known[0] + 1}; write the stamp of each frame'
        )
    if len(known) < 2:
        return given_ns
    end = max(1 + known[-1], min(count, len(stamps_ns)))
    if len(known) == end:
        return given_ns
    numbers = np.arange(end)
    after_first_ns = np.array(given_ns) - given_ns[0]
    filled_ns = np.interp(numbers, known, after_first_ns)
    period_ns = np.median(np.diff(after_first_ns) / np.diff(known))
    beyond = np.minimum(numbers - known[0], 0) + np.maximum(numbers - known[-1], 0)
    return [given_ns[0] + round(offset) for offset in (filled_ns + period_ns * beyond).tolist()]


def read_stamps(path: Path, names: Sequence[str] = ()) -> list[int | None]:
    """
    Return the stamps of a file [ns].

    Parameters
    ----------
    path : Path
        A stamp per line, or a blank one: whole nanoseconds; a unit in which all are between 2001
        and 2100; seconds with decimals; or moments, as in KITTI raw.
    names : sequence of str
        Of frames, which state no stamps; for the error.

    Returns
    -------
    stamps_ns : list of int or None
        One per line; None for a blank one.

    Raises
    ------
    RecordingError
        If the file cannot be read, or a line is no stamp.

    """
    try:
        lines = [line.strip() for line in path.read_text(encoding='utf-8').splitlines()]
    except FileNotFoundError:
        got = f' (names such as {names[0]!r} are none)' if names else ''
        raise RecordingError(
            f'{path}: not found, and these labels have no stamps of their own{got}; create it '
            f'with one stamp per frame, as whole nanoseconds'
        ) from None
    except OSError as error:
        raise RecordingError(unreadable(path, error)) from None
    for number, line in enumerate(lines, 1):
        try:
            stamps_ns([line] if line else [])
        except ValueError:
            raise RecordingError(
                f'{path}:{number}: expected whole nanoseconds, got {line!r}'
            ) from None
    with following(path, 'stamps'):
        known = iter(stamps_ns([line for line in lines if line], are_nanoseconds=True))
    return [next(known) if line else None for line in lines]


def read_poses(path: Path, count: int) -> list[Floats | None]:
    """
    Return the poses of the sensor in the fixed frame.

    Parameters
    ----------
    path : Path
        The upper three rows of a matrix (4, 4) per line, row by row; NaN where it is unknown.
    count : int
        Number of frames.

    Returns
    -------
    poses : list of array, shape (4, 4), or None
        ``T_fixed_sensor`` of each frame [m]; None where the pose is unknown, and for all frames
        without the file.

    Raises
    ------
    RecordingError
        If the file exists but is not `count` lines of twelve numbers.

    """
    if not path.exists() or not count:
        return [None] * count
    with following(path, 'twelve numbers a line'):
        rows = np.loadtxt(path, ndmin=2).reshape(-1, 3, 4)  # (frame, row, column)
    if len(rows) != count:
        raise RecordingError(f'{path}: expected {count} poses, one per stamp, got {len(rows)}')
    last_row = np.array([[0.0, 0.0, 0.0, 1.0]])
    return [np.vstack([row, last_row]) if np.isfinite(row).all() else None for row in rows]
