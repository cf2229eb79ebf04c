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
from typing import Any, ClassVar

from boxreg_ros.errors import RecordingError
from boxreg_ros.io.covariance_table import POSE_TRIANGLE
from boxreg_ros.labels.files import following, require_single
from boxreg_ros.labels.folder import FolderWriter, frame_name
from boxreg_ros.labels.protocol import absolute, Format, LabelFrame
from boxreg_ros.labels.records import evidence_of, FrameBoxes, NO_FRAME_BOXES
from boxreg_ros.labels.sidecar import read_sidecar, STAMPS_FILE
from boxreg_ros.rotations import matrix_from_rpy, rpy_from_matrix
from boxreg_ros.structures import BOX_CENTER, BOX_EXTENT, Floats, ROLL
import numpy as np
from numpy.typing import ArrayLike

EVIDENCE_KEY = 'boxreg'
"""Key of the evidence that is written beside a box; the tools ignore it."""
UNKNOWN_CLASS = 'unknown'
"""Class name of boxes without one, for tools that require a name."""
CUBOID_FORMAT = Format(
    name='',
    title='',
    frame='sensor',
    sizes='length width height (x y z)',
    rotation='angles x y z, R = Rx Ry Rz',
    files='',
    options=('with_points', 'with_images'),
)
"""The conventions that the tools share."""


def xyz_angles(boxes: Floats) -> Floats:
    """Return angles x y z (n, 3) of boxes (n, 9), with R = Rx(x) Ry(y) Rz(z) [rad]."""
    # The transpose of Rx(x) Ry(y) Rz(z) is Rz(-z) Ry(-y) Rx(-x).
    return -rpy_from_matrix(matrix_from_rpy(boxes[:, ROLL:]).swapaxes(-1, -2))


def box_from_cuboid(position: ArrayLike, angles: ArrayLike, extent: ArrayLike) -> Floats:
    """
    Return a box from the cuboid of a labelling tool.

    Parameters
    ----------
    position : array_like, 3 numbers
        Geometric centre [m].
    angles : array_like, 3 numbers
        About x, y and z, with R = Rx(x) Ry(y) Rz(z) [rad].
    extent : array_like, 3 numbers
        Length, width and height [m].

    Returns
    -------
    box : array, shape (9,)
        In the same frame [m, rad].

    Raises
    ------
    ValueError
        If one of them has not three numbers.

    """
    centre, turn, size = (
        np.reshape(np.asarray(part, float), 3) for part in (position, angles, extent)
    )
    return np.concatenate([centre, size, rpy_from_matrix(matrix_from_rpy(-turn).T)])


def xyz(values: Iterable[float]) -> dict[str, float]:
    """Return three numbers by the names of their axes."""
    return dict(zip('xyz', map(float, values), strict=True))


def box_from_xyz(*vectors: Mapping[str, float]) -> Floats:
    """
    Return a box (9,) from its centre, angles and extents that are written by axis.

    Raises KeyError for an axis that is missing, TypeError or ValueError for one that is no number.

    """
    return box_from_cuboid(*([float(vector[axis]) for axis in 'xyz'] for vector in vectors))


@dataclass(frozen=True, slots=True)
class Cuboid:
    """A box in the conventions of the tools."""

    row: int
    """Into the boxes of the frame."""
    track_id: str
    class_name: str
    """`UNKNOWN_CLASS` if it has none."""
    position: dict[str, float]
    """Centre by axis in the sensor frame [m]."""
    angles: dict[str, float]
    """By axis, R = Rx Ry Rz [rad]."""
    extent: dict[str, float]
    """By axis, in full [m]."""
    evidence: dict[str, Any]
    """As of `evidence_of`, with num_points; of the covariance the upper triangle by rows. Where
    the object has attributes, they are in it too."""


class CuboidWriter(FolderWriter):
    """Write the labels and the cloud of each frame, as the tools share them."""

    needs_clouds: ClassVar[bool] = True
    has_sidecar: ClassVar[bool] = True

    def cuboids(self, frame: LabelFrame) -> Iterator[Cuboid]:
        """Yield the valid boxes of a frame in the sensor frame; the others are counted."""
        rows, boxes = frame.boxes_in('sensor', self.dropped)
        array = frame.refined.boxes
        for row, box, angles in zip(rows.tolist(), boxes, xyz_angles(boxes), strict=True):
            evidence = evidence_of(frame.refined, row)
            attributes = array.attributes_of(row)
            yield Cuboid(
                row,
                array.track_ids[row],
                array.class_names[row] or UNKNOWN_CLASS,
                xyz(box[BOX_CENTER]),
                xyz(angles),
                xyz(box[BOX_EXTENT]),
                {
                    'status': evidence['status'],
                    'reason': evidence['reason'],
                    'num_points': int(frame.refined.num_points[row]),
                    'score': evidence['score'],
                    'covariance': frame.refined.covariances[row][POSE_TRIANGLE].tolist(),
                    'extent_covariance': evidence['extent_covariance'],
                    **({'attributes': dict(attributes)} if attributes else {}),
                },
            )


def single_part(path: Path, what: str, members: Collection[str]) -> tuple[Path, Path]:
    """
    Return the only scene or episode of a project.

    Parameters
    ----------
    path : Path
        Folder of the project, or of the part itself.
    what : str
        Name of such a part, for the error.
    members : collection of str
        Files or folders of which every part contains one.

    Returns
    -------
    part : Path
        The folder of the part.
    sidecar : Path
        The folder of its sidecar files: the part itself, or the one that contains it.

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
    folder: Path,
    names: Sequence[str],
    cuboids_by_name: Callable[[str], FrameBoxes],
    numbers: Mapping[str, int] | None = None,
) -> Iterator[LabelFrame]:
    """
    Yield the frames of a folder with sidecar files, in the fixed frame where it is known.

    Parameters
    ----------
    folder : Path
        Of the sidecar files. Without ``timestamps.txt`` the names state the stamps.
    names : sequence of str
        Of all frames that have labels or points, in order.
    cuboids_by_name : callable
        Returns the boxes of a frame.
    numbers : mapping of str to int, optional
        Number of each frame, where the labels state it: the line of its stamp in a file with more.

    Yields
    ------
    frame : LabelFrame
        One for each stamp, in their order.

    Raises
    ------
    RecordingError
        If there are neither sidecar files nor stamps in the names, or those of other frames.

    """
    sidecar = read_sidecar(folder, len(names), names=names)
    names_in_order = in_order(folder, names, sidecar.stamps_ns, numbers or {})
    for index in np.argsort(sidecar.stamps_ns, kind='stable').tolist():
        name = names_in_order.get(index)
        boxes, left_out = NO_FRAME_BOXES if name is None else cuboids_by_name(name)
        with following(folder, f'attributes as boxreg writes them in frame {name!r}'):
            frame = sidecar.frame(index, boxes, left_out)
        yield frame.moved('fixed')


def in_order(
    folder: Path, names: Sequence[str], stamps_ns: Sequence[int], numbers: Mapping[str, int]
) -> dict[int, str]:
    """Return the frame of each stamp by its index; other parameters are as of `read_frames`."""
    if len(names) == len(stamps_ns):
        used: Counter[int] = Counter()
        by_stamp = [frame_name(stamp_ns, used) for stamp_ns in stamps_ns]
        # Frames named by another program are in the order of the stamps.
        return dict(enumerate(by_stamp if set(names) == set(by_stamp) else names))
    used = Counter()
    index_of = {frame_name(stamp_ns, used): index for index, stamp_ns in enumerate(stamps_ns)}
    if not set(names) <= index_of.keys() and len({*numbers.values()}) == len(names):
        index_of = {name: numbers[name] for name in names}
    if not set(names) <= index_of.keys() or max(index_of.values(), default=0) >= len(stamps_ns):
        raise RecordingError(
            f'{folder / STAMPS_FILE}: expected one stamp for each of {len(names)} frames, got '
            f'{len(stamps_ns)}; leave out the lines of frames without files'
        )
    return {index_of[name]: name for name in names}
