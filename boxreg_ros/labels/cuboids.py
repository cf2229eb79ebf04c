"""
Cuboids of the browser-based labelling tools, which have one file or record per frame.

Their rotation is three angles x y z [rad] with R = Rx(x) Ry(y) Rz(z), the order 'XYZ' of
three.js. They equal roll, pitch and yaw for upright boxes only. The position is the centre in the
sensor frame; the extents are along x (forward), y (left) and z of the box.

"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from boxreg_ros.errors import RecordingError
from boxreg_ros.labels.clouds import write_cloud
from boxreg_ros.labels.files import require_single
from boxreg_ros.labels.protocol import absolute, Format, INPUT_STATUS, LabelFrame
from boxreg_ros.labels.records import finite_or_none, refined_boxes
from boxreg_ros.labels.sidecar import read_sidecar, Sidecar, STAMPS_FILE
from boxreg_ros.rotations import matrix_from_rpy, rpy_from_matrix
from boxreg_ros.structures import Floats, HEIGHT, LENGTH, RefinedBoxes, ROLL, X, Z
import numpy as np
from numpy.typing import ArrayLike

EVIDENCE_KEY = 'boxreg'
"""Key of the evidence that is written beside a box; the tools ignore it."""
UNKNOWN_CLASS = 'unknown'
"""Class name of boxes without one, for tools that require a name."""
UPPER_TRIANGLE = np.triu_indices(6)


def cuboid_format(name: str, title: str, files: str) -> Format:
    """Return the format of a tool with these conventions."""
    return Format(
        name=name,
        title=title,
        frame='sensor',
        reference='centre',
        sizes='length width height (x y z)',
        rotation='angles x y z, R = Rx Ry Rz',
        files=files,
        options=('with_points',),
    )


def xyz_angles(boxes: Floats) -> Floats:
    """Return angles x y z (n, 3) of boxes (n, 9), with R = Rx(x) Ry(y) Rz(z) [rad]."""
    # The transpose of Rx(x) Ry(y) Rz(z) is Rz(-z) Ry(-y) Rx(-x).
    return -rpy_from_matrix(matrix_from_rpy(boxes[:, ROLL:]).swapaxes(-1, -2))


def box_from_cuboid(position: ArrayLike, angles: ArrayLike, extent: ArrayLike) -> Floats:
    """Return a box (9,) from its centre, angles x y z and extents."""
    rpy = rpy_from_matrix(matrix_from_rpy(-np.asarray(angles, float)).T)
    return np.concatenate([np.asarray(position, float), np.asarray(extent, float), rpy])


def xyz(values: Iterable[float]) -> dict[str, float]:
    """Return three numbers by the names of their axes."""
    return dict(zip('xyz', map(float, values), strict=True))


def from_xyz(vector: Mapping[str, float]) -> list[float]:
    """Return the numbers of a vector that is written by axis."""
    return [float(vector[axis]) for axis in 'xyz']


@dataclass(frozen=True, slots=True)
class Cuboid:
    """
    A box in the conventions of the tools.

    Attributes
    ----------
    row : int
        Row index into the boxes of the frame.
    track_id, class_name : str
        Track, '' if it has none; class, `UNKNOWN_CLASS` if it has none.
    position, angles, extent : dict
        By axis: centre in the sensor frame [m], R = Rx Ry Rz [rad], full extents [m].
    evidence : dict
        Status, reason, num_points, score, and the upper triangle of the covariance of x y z
        roll pitch yaw in the fixed frame, row by row; the covariance of length width height.

    """

    row: int
    track_id: str
    class_name: str
    position: dict[str, float]
    angles: dict[str, float]
    extent: dict[str, float]
    evidence: dict[str, Any]


class ReadCuboid(NamedTuple):
    """A box as read from a file of a tool; `box` (9,) is in the sensor frame."""

    track_id: str
    class_name: str
    box: Floats
    evidence: Mapping[str, Any]


def cuboids_of(frame: LabelFrame, dropped: Counter[str]) -> Iterator[Cuboid]:
    """Yield the valid boxes of a frame in the sensor frame; the others are counted."""
    rows, boxes = frame.boxes_in('sensor', dropped)
    for row, box, angles in zip(rows.tolist(), boxes, xyz_angles(boxes), strict=True):
        yield Cuboid(
            row,
            frame.refined.boxes.track_ids[row],
            frame.refined.boxes.class_names[row] or UNKNOWN_CLASS,
            xyz(box[X : Z + 1]),
            xyz(angles),
            xyz(box[LENGTH : HEIGHT + 1]),
            _evidence(frame.refined, row),
        )


def _evidence(refined: RefinedBoxes, row: int) -> dict[str, Any]:
    return {
        'status': refined.status[row],
        'reason': refined.reasons[row],
        'num_points': int(refined.num_points[row]),
        'score': finite_or_none(refined.boxes.scores[row]),
        'covariance': refined.covariances[row][UPPER_TRIANGLE].tolist(),
        'extent_covariance': refined.extent_covariances[row].ravel().tolist(),
    }


class FrameNames:
    """Names of frames that sort by time: the stamp [ns]; a repeated stamp gets ``_1``."""

    def __init__(self) -> None:
        self._used: Counter[int] = Counter()

    def of(self, stamp_ns: int) -> str:
        """Return the name of the next frame of this stamp."""
        number = self._used[stamp_ns]
        self._used[stamp_ns] += 1
        name = f'{stamp_ns:019d}'
        return f'{name}_{number}' if number else name


def write_points(frame: LabelFrame, path: Path) -> None:
    """Write the cloud of a frame; an empty one if it has none, because the tools need a file."""
    points = np.zeros((0, 3)) if frame.sweep is None else frame.sweep.points
    write_cloud(path, points, frame.intensities)


def single_part(path: Path, what: str, members: Collection[str]) -> tuple[Path, Path]:
    """
    Return the folder of the only scene or episode of a project, and that of its sidecar files.

    The sidecar files are in the part itself, or beside it.

    Parameters
    ----------
    path : Path
        The project, or the part itself.
    what : str
        Name of a part in messages: scene, episode.
    members : collection of str
        Files or folders; every part contains one of them.

    Raises
    ------
    RecordingError
        If there is no part, or several.

    """
    folders = [path]
    if path.is_dir():
        folders += sorted(path.iterdir())
    found = [folder for folder in folders if any((folder / name).exists() for name in members)]
    part = require_single(found, path, f'{what}, a folder with {" or ".join(members)}')
    has_sidecar = (part / STAMPS_FILE).exists()
    return part, part if has_sidecar else absolute(part).parent


def read_frames(
    folder: Path, names: list[str], cuboids_by_name: Callable[[str], list[ReadCuboid]]
) -> Iterator[LabelFrame]:
    """
    Yield the frames of a folder with sidecar files, in the fixed frame where it is known.

    Parameters
    ----------
    folder : Path
        Folder of the sidecar files.
    names : list of str
        Names of all frames that have labels or points, in order.
    cuboids_by_name : callable
        Returns the boxes of the frame of this name.

    Raises
    ------
    RecordingError
        If the sidecar files are missing or belong to other frames.

    """
    sidecar = read_sidecar(folder, len(names))
    namer = FrameNames()
    order = [namer.of(stamp_ns) for stamp_ns in sidecar.stamps_ns]
    if not set(names) <= set(order):  # frames named by another program: one stamp for each
        if len(names) != len(order):
            raise RecordingError(
                f'{folder / STAMPS_FILE}: expected one stamp for each of {len(names)} frames, got '
                f'{len(order)}'
            )
        order = names
    for index, name in enumerate(order):
        try:
            refined = _refined(cuboids_by_name(name), sidecar, index)
        except (AttributeError, TypeError, ValueError) as error:
            raise RecordingError(
                f'{folder}: frame {name!r}: expected attributes as boxreg writes them, got '
                f'others: {error}; remove the attributes that were changed'
            ) from None
        yield sidecar.frame(index, refined).moved('fixed')


def _refined(cuboids: Sequence[ReadCuboid], sidecar: Sidecar, index: int) -> RefinedBoxes:
    """Return the boxes of one frame with the evidence in their attributes."""
    evidence = [cuboid.evidence for cuboid in cuboids]
    return refined_boxes(
        sidecar.stamps_ns[index],
        sidecar.sensor_frame,
        [cuboid.track_id for cuboid in cuboids],
        [cuboid.class_name for cuboid in cuboids],
        [cuboid.box for cuboid in cuboids],
        [item.get('score', 1.0) for item in evidence],
        [str(item.get('status', INPUT_STATUS)) for item in evidence],
        [int(item.get('num_points', 0)) for item in evidence],
        [_covariance(item.get('covariance')) for item in evidence],
        [str(item.get('reason', '')) for item in evidence],
        [item.get('extent_covariance') for item in evidence],
    )


def _covariance(upper: ArrayLike | None) -> Floats | None:
    """Return the symmetric matrix (6, 6) of an upper triangle."""
    if upper is None:
        return None
    matrix = np.zeros((6, 6))
    matrix[UPPER_TRIANGLE] = upper
    return matrix + np.triu(matrix, 1).T
