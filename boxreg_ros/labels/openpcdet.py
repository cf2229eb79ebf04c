"""
OpenPCDet's template of custom data: ``labels/NAME.txt`` with ``points/NAME.npy``.

A line has x y z of the centre, the extents along x, y and z of the box, its heading and its class.
MMDetection3D and others take the same lines. They have neither tracks nor scores, see `per_frame`.

"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from boxreg_ros.errors import RecordingError
from boxreg_ros.labels.cuboids import UNKNOWN_CLASS
from boxreg_ros.labels.files import visible
from boxreg_ros.labels.per_frame import EVIDENCE_FOLDER, numbers_of, PerFrameWriter, read_lines
from boxreg_ros.labels.protocol import Format, LabelFrame
from boxreg_ros.labels.records import ReadBox, require_radians
from boxreg_ros.rotations import matrix_from_rpy
from boxreg_ros.structures import BoxArray, Floats, Ints, ROLL
import numpy as np

FORMAT = Format(
    name='openpcdet',
    title='OpenPCDet custom data',
    frame='sensor',
    sizes='length width height (dx dy dz)',
    rotation='heading about z; roll and pitch are lost',
    files='labels/STAMP.txt, points/STAMP.npy, ImageSets/',
    options=('with_points', 'class_map'),
    reads='lines of 8 columns, or 9 with a score; clouds state frames without boxes',
    leaves_out='the points, which `openpcdet:FOLDER` reads',
)
COLUMN_COUNTS = (8, 9)
"""x y z dx dy dz heading class, and a score in files of some detectors."""
CLOUD_SUFFIXES = ('.npy', '.bin')


class Writer(PerFrameWriter):
    """
    Write one file of labels per frame, and one of points if they are requested.

    All frames are in the split ``train``, and none in ``val``: how to divide them is for the user.

    """

    form = 'openpcdet'
    folders = ('labels', 'points', 'ImageSets', EVIDENCE_FOLDER)
    label_folder = 'labels'
    cloud_file = 'points/{name}.npy'

    def begin(self) -> None:
        """Open the files."""
        self._names = self.text_file('ImageSets/train.txt')
        self.text_file('ImageSets/val.txt')

    def add(self, frame: LabelFrame) -> None:
        """Write the files of a frame, and its name to the split."""
        super().add(frame)
        self._names.write(f'{self.name}\n')

    def lines(self, array: BoxArray, rows: Ints, boxes: Floats) -> Iterator[str]:
        """Yield the line of each box; see `PerFrameWriter.lines`."""
        headings = matrix_from_rpy(boxes[:, ROLL:])[:, :, 0]  # (k, axis)
        yaws = np.arctan2(headings[:, 1], headings[:, 0])
        for row, box, yaw in zip(rows, boxes, yaws, strict=True):
            numbers = ' '.join(f'{value:.6f}' for value in (*box[:ROLL], yaw))
            class_name = self.class_names.word_of(array.class_names[row], UNKNOWN_CLASS)
            yield f'{numbers} {class_name}'


def read(path: Path) -> Iterator[LabelFrame]:
    """
    Yield the frames of a data set.

    Their stamps [ns] are those of ``timestamps.txt``, one per frame, or the names of the files.

    Parameters
    ----------
    path : Path
        Folder with ``labels/`` and, for frames without boxes, ``points/``; or a folder of label
        files alone.

    Yields
    ------
    frame : LabelFrame
        One per frame, in the order of the stamps.

    Raises
    ------
    RecordingError
        If a file is missing or does not follow the format.

    """
    labels = path / 'labels' if (path / 'labels').is_dir() else path
    names = {file.stem for file in visible(labels, '*.txt') if file.name != 'timestamps.txt'}
    names -= {'poses'} if labels == path else set()
    names |= {file.stem for file in visible(path, 'points/*') if file.suffix in CLOUD_SUFFIXES}
    if not names and not (path / 'timestamps.txt').exists():
        raise RecordingError(
            f'{path}: expected labels/NAME.txt, got none; name the folder of them'
        )
    what = 'lines of x y z dx dy dz heading class'
    yield from read_lines(path, labels, names, what, _boxes)


def _boxes(name: str, words: list[list[str]]) -> list[ReadBox | None]:
    """Return the boxes of the words of lines."""
    boxes: list[ReadBox | None] = []
    for line, numbers in zip(words, numbers_of(words, slice(7), COLUMN_COUNTS), strict=True):
        score = float(line[8]) if len(line) > 8 else None
        box = [*numbers[:6], 0.0, 0.0, float(require_radians(numbers[6]))]
        boxes.append(ReadBox('', line[7], box, {'score': score}))
    return boxes
