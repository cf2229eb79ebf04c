"""
Cuboids of the browser-based labelling tools, which have one file or record per frame.

Their rotation is three angles x y z [rad] with R = Rx(x) Ry(y) Rz(z), the order 'XYZ' of
three.js. They equal roll, pitch and yaw for upright boxes only. The position is the centre in the
sensor frame; the extents are along x (forward), y (left) and z of the box.

"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from boxreg_ros.errors import RecordingError
from boxreg_ros.labels.files import following, from_json, require_single
from boxreg_ros.labels.folder import FolderWriter, frame_name
from boxreg_ros.labels.protocol import absolute, Format, LabelFrame
from boxreg_ros.labels.records import evidence_of, ReadBox, refined_of, UPPER_TRIANGLE
from boxreg_ros.labels.sidecar import read_sidecar, STAMPS_FILE
from boxreg_ros.rotations import matrix_from_rpy, rpy_from_matrix
from boxreg_ros.structures import BOX_CENTER, BOX_EXTENT, Floats, ROLL
import numpy as np
from numpy.typing import ArrayLike

EVIDENCE_KEY = 'boxreg'
"""Key of the evidence that is written beside a box; the tools ignore it."""
UNKNOWN_CLASS = 'unknown'
"""Class name of boxes without one, for tools that require a name."""


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


def box_from_xyz(*vectors: Mapping[str, float]) -> Floats:
    """Return a box (9,) from its centre, angles and extents that are written by axis."""
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
    """As of `evidence_of`, with num_points; of the covariance the upper triangle, row by row."""


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
                    'covariance': frame.refined.covariances[row][UPPER_TRIANGLE].tolist(),
                    'extent_covariance': evidence['extent_covariance'],
                },
            )


def single_part(path: Path, what: str, members: Collection[str]) -> tuple[Path, Path]:
    """
    Return the folder of the only scene or episode of a project, and that of its sidecar files.

    The sidecar files are in the part itself, or beside it; `path` may be the part, too. Every part
    contains one of `members`; `what` names it in messages. Raises RecordingError if there is no
    part, or several.

    """
    folders = [path]
    if path.is_dir():
        folders += sorted(path.iterdir())
    found = [folder for folder in folders if any((folder / name).exists() for name in members)]
    part = require_single(found, path, f'{what}, a folder with {" or ".join(members)}')
    has_sidecar = (part / STAMPS_FILE).exists()
    return part, part if has_sidecar else absolute(part).parent


def read_files(
    folder: Path,
    labels: Path,
    names: Iterable[str],
    what: str,
    cuboids_of: Callable[[Any], list[ReadBox]],
    has_all: bool = True,
) -> Iterator[LabelFrame]:
    """
    Yield the frames of a folder with sidecar files and a file of labels per frame.

    `labels` has the files, whose content `cuboids_of` reads; frames without boxes may lack theirs
    unless the tool `has_all`. `names` and errors are as of `read_frames`; `what` the file has.

    """

    def cuboids_by_name(name: str) -> list[ReadBox]:
        file = labels / f'{name}.json'
        if not has_all and not file.exists():
            return []
        content = from_json(file)
        with following(file, what):
            return cuboids_of(content)

    yield from read_frames(folder, sorted(names), cuboids_by_name)


def read_frames(
    folder: Path, names: list[str], cuboids_by_name: Callable[[str], list[ReadBox]]
) -> Iterator[LabelFrame]:
    """
    Yield the frames of a folder with sidecar files, in the fixed frame where it is known.

    `names`, in order, are those of all frames that have labels or points. Raises RecordingError if
    the sidecar files are missing or belong to other frames.

    """
    sidecar = read_sidecar(folder, len(names))
    used: Counter[int] = Counter()
    order = [frame_name(stamp_ns, used) for stamp_ns in sidecar.stamps_ns]
    if not set(names) <= set(order):  # frames named by another program: one stamp for each
        if len(names) != len(order):
            raise RecordingError(
                f'{folder / STAMPS_FILE}: expected one stamp for each of {len(names)} frames, got '
                f'{len(order)}'
            )
        order = names
    for index, name in enumerate(order):
        cuboids = cuboids_by_name(name)
        with following(folder, f'attributes as boxreg writes them in frame {name!r}'):
            refined = refined_of(sidecar.stamps_ns[index], sidecar.sensor_frame, cuboids)
        yield sidecar.frame(index, refined).moved('fixed')
