"""
What the browser-based tools share: cuboids as three.js has them, a file per frame.

Their rotation is three angles x y z [rad] with R = Rx(x) Ry(y) Rz(z), in three.js the order
'XYZ': not our roll, pitch and yaw, but for upright boxes. Position is the centre in the sensor's
frame; the extents are along the box's own x (forward), y (left) and z.

"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from boxreg_ros.errors import RecordingError
from boxreg_ros.labels import absolute, INPUT, LabelFrame
from boxreg_ros.labels.clouds import write_cloud
from boxreg_ros.labels.files import read_timeline, refined_boxes, STAMPS, the_one
from boxreg_ros.rotations import matrix_from_rpy, rpy_from_matrix
from boxreg_ros.structures import Floats, HEIGHT, LENGTH, RefinedBoxes, ROLL, X, Z
import numpy as np
from numpy.typing import ArrayLike

OURS = 'boxreg'
"""Key of what only we write and read beside a box; the tools pass over it."""
NAMELESS = 'unknown'
"""Class of boxes that have none, where a tool wants a name."""
UPPER = np.triu_indices(6)


def angles_of(boxes: Floats) -> Floats:
    """Return angles x y z (n, 3) of boxes (n, 9), with R = Rx(x) Ry(y) Rz(z) [rad]."""
    # The transpose of Rx(x) Ry(y) Rz(z) is Rz(-z) Ry(-y) Rx(-x).
    return -rpy_from_matrix(matrix_from_rpy(boxes[:, ROLL:]).swapaxes(-1, -2))


def box_of(position: ArrayLike, angles: ArrayLike, extent: ArrayLike) -> Floats:
    """Return a box (9,) from its centre, angles x y z and extent."""
    rpy = rpy_from_matrix(matrix_from_rpy(-np.asarray(angles, float)).T)
    return np.concatenate([np.asarray(position, float), np.asarray(extent, float), rpy])


def xyz(values: Iterable[float]) -> dict[str, float]:
    """Return three numbers by the names of their axes."""
    return dict(zip('xyz', map(float, values), strict=True))


def numbers(vector: Mapping[str, float]) -> list[float]:
    """Return what `xyz` was given."""
    return [float(vector[axis]) for axis in 'xyz']


@dataclass(frozen=True, slots=True)
class Cuboid:
    """
    A box as the tools want it.

    Attributes
    ----------
    row : int
        Its place in the frame's boxes.
    track_id, class_name : str
        Identity, '' if there is none; category, `NAMELESS` if there is none.
    position, angles, extent : dict
        By axis: centre in the sensor's frame [m], R = Rx Ry Rz [rad], full extents [m].
    evidence : dict
        Where the box comes from: status, reason, num_points, score, and the upper triangle of
        the covariance of x y z roll pitch yaw in the fixed frame, row by row.

    """

    row: int
    track_id: str
    class_name: str
    position: dict[str, float]
    angles: dict[str, float]
    extent: dict[str, float]
    evidence: dict[str, Any]


def cuboids_of(frame: LabelFrame, dropped: Counter[str]) -> Iterator[Cuboid]:
    """Yield the boxes of a frame that have a place in the sensor's frame; count the others."""
    rows, boxes = frame.placed('sensor', dropped)
    for row, box, angles in zip(rows.tolist(), boxes, angles_of(boxes), strict=True):
        yield Cuboid(
            row,
            frame.refined.boxes.track_ids[row],
            frame.refined.boxes.class_names[row] or NAMELESS,
            xyz(box[X : Z + 1]),
            xyz(angles),
            xyz(box[LENGTH : HEIGHT + 1]),
            _evidence(frame.refined, row),
        )


def _evidence(refined: RefinedBoxes, row: int) -> dict[str, Any]:
    score = float(refined.boxes.scores[row])
    return {
        'status': refined.status[row],
        'reason': refined.reasons[row],
        'num_points': int(refined.num_points[row]),
        'score': score if np.isfinite(score) else None,
        'covariance': refined.covariances[row][UPPER].tolist(),
    }


class FrameNames:
    """Names of frames that sort by time: the stamp [ns]; the second of a stamp gets ``_1``."""

    def __init__(self) -> None:
        self._taken: Counter[int] = Counter()

    def of(self, stamp_ns: int) -> str:
        """Return the name of the next frame of this stamp."""
        number = self._taken[stamp_ns]
        self._taken[stamp_ns] += 1
        return f'{stamp_ns:019d}' + (f'_{number}' if number else '')


def write_points(frame: LabelFrame, path: Path) -> None:
    """Write the frame's cloud, an empty one if none belongs to it: the tools need a file."""
    points = np.zeros((0, 3)) if frame.sweep is None else frame.sweep.points
    write_cloud(path, points, frame.intensities)


def part_of(path: Path, what: str, marks: Collection[str]) -> tuple[Path, Path]:
    """
    Return the folder of the only part of a project, its scene or episode, and of its `Timeline`.

    The timeline is in the part, or else beside it.

    Parameters
    ----------
    path : Path
        The project, or the part itself.
    what : str
        What a part is called.
    marks : collection of str
        Files or folders, one of which every part holds.

    Raises
    ------
    RecordingError
        If there is no part, or several.

    """
    folders = [path, *(sorted(path.iterdir()) if path.is_dir() else ())]
    found = [folder for folder in folders if any((folder / mark).exists() for mark in marks)]
    part = the_one(found, path, f'{what}, a folder with {" or ".join(marks)}')
    return part, part if (part / STAMPS).exists() else absolute(part).parent


def frames_in(
    folder: Path,
    names: list[str],
    items_of: Callable[[str], list[tuple[str, str, Floats, Mapping[str, Any]]]],
) -> Iterator[LabelFrame]:
    """
    Yield the frames of a folder with a `Timeline`, boxes in the fixed frame where that is known.

    Parameters
    ----------
    folder : Path
        Where the timeline is.
    names : list of str
        Names of all frames that have labels or points, in their order.
    items_of : callable
        Returns the boxes of a name: track id, class, box (9,) and evidence.

    Raises
    ------
    RecordingError
        If the timeline is missing or is that of other frames.

    """
    timeline = read_timeline(folder, len(names))
    maker = FrameNames()
    order = [maker.of(stamp_ns) for stamp_ns in timeline.stamps_ns]
    if not set(names) <= set(order):  # not our names: a stamp for each
        if len(names) != len(order):
            raise RecordingError(
                f'{folder / STAMPS}: expected one stamp for each of {len(names)} frames, got '
                f'{len(order)}'
            )
        order = names
    for index, name in enumerate(order):
        items = items_of(name)
        notes = [note for *_, note in items]
        refined = refined_boxes(
            timeline.stamps_ns[index],
            timeline.sensor_frame,
            [track_id for track_id, *_ in items],
            [class_name for _, class_name, *_ in items],
            [box for _, _, box, _ in items],
            [np.nan if (s := note.get('score', 1.0)) is None else s for note in notes],
            [str(note.get('status', INPUT)) for note in notes],
            [int(note.get('num_points', 0)) for note in notes],
            [_covariance(note.get('covariance')) for note in notes],
            [str(note.get('reason', '')) for note in notes],
        )
        yield timeline.frame(index, refined).moved('fixed')


def _covariance(upper: ArrayLike | None) -> Floats:
    if upper is None:
        return np.eye(6)
    half = np.zeros((6, 6))
    half[UPPER] = upper
    return half + np.triu(half, 1).T
