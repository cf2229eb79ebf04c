"""
KITTI object detection: ``label_2/NAME.txt`` with ``calib/NAME.txt`` and ``velodyne/NAME.bin``.

The 15 columns of a label, and the score of a result, are those of KITTI tracking without frame and
track. Without attributes, truncation is 0 inside of the image, 1 outside of it and -1, unknown, at
its edge, and occlusion is 3, unknown. Names of files are stamps, see `per_frame`.

"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from boxreg_ros.errors import RecordingError, unreadable
from boxreg_ros.labels import kitti
from boxreg_ros.labels.attributes import TRUNCATED
from boxreg_ros.labels.camera import Camera
from boxreg_ros.labels.cameras import black_png
from boxreg_ros.labels.files import visible
from boxreg_ros.labels.kitti import (
    attributes_of,
    boxes_of,
    columns_of,
    CUT_OFF,
    decimals,
    IGNORED_CLASS,
    INSIDE_IMAGE,
    occlusion_of,
    OUTSIDE_IMAGE,
    truncation_of,
    write_calibration,
)
from boxreg_ros.labels.per_frame import EVIDENCE_FOLDER, numbers_of, PerFrameWriter, read_lines
from boxreg_ros.labels.protocol import absolute, LabelFrame
from boxreg_ros.labels.records import ReadBox
from boxreg_ros.structures import BoxArray, Floats, Ints
import numpy as np

FORMAT = replace(
    kitti.FORMAT,
    name='kitti_object',
    title='KITTI object',
    files='label_2/STAMP.txt, calib/STAMP.txt, velodyne/STAMP.bin',
    leaves_out='regions without a 3D box (counted), the rectangles in the image',
    read_back='datumaro 1.13.12',
    reads='15 or 16 columns, of labels or of a detector',
)
LABEL_FOLDER = 'label_2'
KITTI_IMAGES = 'image_2'
OBJECT_COLUMNS = (15, 16)
TRUNCATION = {INSIDE_IMAGE: '0.00', CUT_OFF: '-1.00', OUTSIDE_IMAGE: '1.00'}
"""Text of the values of KITTI tracking; the part outside of the image is not known."""
CALIBRATION_NAMES = ('R0_rect', 'Tr_velo_to_cam', 'Tr_imu_to_velo')


class Writer(PerFrameWriter):
    """Write one file of labels and of the calibration per frame, and one of points on request."""

    form = 'kitti_object'
    folders = (LABEL_FOLDER, 'calib', EVIDENCE_FOLDER)
    label_folder = LABEL_FOLDER
    cloud_file = 'velodyne/{name}.bin'
    image_file = f'{KITTI_IMAGES}/{{name}}.png'
    has_kitti_camera = True

    def add(self, frame: LabelFrame) -> None:
        """Write the files of a frame."""
        self._camera = self.kitti_camera.in_frame(frame.sensor_frame)
        super().add(frame)
        path = self.folder / 'calib' / f'{self.name}.txt'
        write_calibration(self._camera, path, CALIBRATION_NAMES)
        if self.kitti_camera.is_assumed:  # OpenPCDet takes the size of the image from its file
            image = self.folder / KITTI_IMAGES / f'{self.name}.png'
            image.parent.mkdir(exist_ok=True)
            image.write_bytes(black_png(*self._camera.size))

    def lines(self, array: BoxArray, rows: Ints, boxes: Floats) -> Iterator[str]:
        """Yield the line of each box; see `PerFrameWriter.lines`."""
        truncation, columns = columns_of(self._camera, boxes)
        for i, row in enumerate(rows):
            name = self.class_names.word_of(array.class_names[row], 'Misc')
            attributes = array.attributes_of(row)
            cut = TRUNCATION[truncation_of(attributes, int(truncation[i]))]
            with suppress(ValueError):  # the part that is stated
                cut = f'{float(attributes.get(TRUNCATED, "")):.2f}'
            numbers = decimals(columns[i], array.scores[row])
            yield f'{name} {cut} {occlusion_of(attributes)} {numbers}'


def read(path: Path) -> Iterator[LabelFrame]:
    """
    Yield the frames of a split, or of a folder of results.

    Their stamps [ns] are those of ``timestamps.txt``, one per frame, or the names of the files.
    Regions of the class DontCare without extents are counted.

    Parameters
    ----------
    path : Path
        Folder with ``label_2/`` or ``data/`` (of results), the root of the data set with
        ``training/``, or the folder of label files itself.
        ``calib/`` is in the same folder, or in one above it.

    Yields
    ------
    frame : LabelFrame
        One per frame, in the order of the stamps.

    Raises
    ------
    RecordingError
        If a file is missing or does not follow the format.

    """
    parts = [path / name for name in (LABEL_FOLDER, f'training/{LABEL_FOLDER}', 'data')]
    labels = next((part for part in parts if part.is_dir()), path)
    calibrations = _calibrations(labels)
    folder = calibrations.parent
    names = {file.stem for file in visible(labels, '*.txt')}
    names |= {file.stem for file in visible(folder, 'velodyne/*.bin')}
    cameras: dict[bytes, Camera] = {}

    def boxes_by_name(name: str, words: list[list[str]]) -> list[ReadBox | None]:
        numbers = np.reshape(numbers_of(words, slice(8, 15), OBJECT_COLUMNS), (-1, 7))
        boxes = boxes_of(_camera(calibrations / f'{name}.txt', cameras), numbers)
        found: list[ReadBox | None] = []
        for line, box in zip(words, boxes, strict=True):
            score = float(line[15]) if len(line) > 15 else None
            is_region = line[0] == IGNORED_CLASS and float(line[8]) <= 0
            evidence = {'score': score, 'attributes': attributes_of(*line[1:3])}
            found.append(None if is_region else ReadBox('', line[0], box, evidence))
        return found

    what = '15 or 16 columns of KITTI object'
    yield from read_lines(folder, labels, names, what, boxes_by_name)


def _calibrations(labels: Path) -> Path:
    """Return the folder of calibrations, beside the labels or in a folder above them."""
    folders = [folder / 'calib' for folder in (absolute(labels), *absolute(labels).parents[:2])]
    for folder in folders:
        if folder.is_dir():
            return folder
    raise RecordingError(
        f'{labels}: expected calib/NAME.txt for each frame, got none in {folders[0].parent} or '
        f'above it; copy the calibration of the data set there'
    )


def _camera(path: Path, known: dict[bytes, Camera]) -> Camera:
    """Return the calibration of a frame; most frames have that of the one before."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise RecordingError(f'{unreadable(path, error)}: the calibration of a frame') from None
    if content not in known:
        known.clear()
        known[content] = Camera.read(path)
    return known[content]
