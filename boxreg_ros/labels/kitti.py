"""
KITTI tracking: one line per box, in the rectified frame of a camera.

The folder is one sequence of the benchmark: ``label_02/0000.txt``, ``calib/0000.txt`` and
``velodyne/0000``. Boxes outside of the image are written too, with truncation 2 and a rectangle
of -1. Occlusion is 3, unknown. Stamps and poses are in the files of `sidecar`.

"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from boxreg_ros.errors import RecordingError
from boxreg_ros.labels.camera import Camera
from boxreg_ros.labels.files import following, read_provenance, require_single
from boxreg_ros.labels.folder import FolderWriter
from boxreg_ros.labels.protocol import (
    absolute,
    Format,
    LabelFrame,
    Options,
    Provenance,
    SceneFrames,
)
from boxreg_ros.labels.records import ReadBox, TrackNumbers
from boxreg_ros.labels.sidecar import numbered_frames, numbered_scene
from boxreg_ros.rotations import wrap_angle
from boxreg_ros.structures import HEIGHT, LENGTH, WIDTH
import numpy as np

FORMAT = Format(
    name='kitti',
    title='KITTI tracking',
    frame='rectified camera (`--camera`)',
    reference='centre of the bottom face',
    sizes='height width length',
    rotation="rotation_y about the camera's y; roll and pitch are lost",
    files='label_02/, calib/, velodyne/',
    options=('camera', 'with_points', 'class_map'),
)
SEQUENCE = '0000'
INSIDE_IMAGE, TRUNCATED, OUTSIDE_IMAGE = 0, 1, 2
"""Values of truncation."""
UNKNOWN_OCCLUSION = 3
IGNORED_CLASS = 'DontCare'
"""Regions without labels, which have no 3D box."""


class Writer(FolderWriter):
    """
    Write one line per box.

    The location is half a height below the centre along y of the camera, because readers
    reconstruct the box upright along that axis: so its centre is right for a tilted camera too.

    """

    form = 'kitti'
    folders = ('label_02', 'calib')
    cloud_file = f'velodyne/{SEQUENCE}/{{number:06d}}.bin'
    has_sidecar = True

    def __init__(self, folder: Path, provenance: Provenance, options: Options) -> None:
        self._camera = Camera.read(options.camera, 'format kitti')
        super().__init__(folder, provenance, options)
        _write_calibration(self._camera, folder / 'calib' / f'{SEQUENCE}.txt')
        self._file = self.text_file(f'label_02/{SEQUENCE}.txt')
        self._tracks = TrackNumbers()
        self._given_classes: dict[str, str] = {}  # by number of the track and class as written

    def add(self, frame: LabelFrame) -> None:
        """Add the lines of a frame."""
        rows, boxes = frame.boxes_in('sensor', self.dropped)
        array = frame.refined.boxes
        centres, rotations_y = self._camera.to_upright(boxes)
        rectangles, is_inside = self._camera.project(boxes)
        is_outside = np.isnan(rectangles).any(axis=1)
        rectangles[is_outside] = -1.0
        truncation = np.where(is_inside, INSIDE_IMAGE, TRUNCATED)
        truncation[is_outside] = OUTSIDE_IMAGE
        for i, (row, box) in enumerate(zip(rows, boxes, strict=True)):
            x, y, z = centres[i]
            alpha = float(wrap_angle(rotations_y[i] - np.arctan2(x, z)))
            size = box[[HEIGHT, WIDTH, LENGTH]]
            location = (x, y + box[HEIGHT] / 2, z)
            numbers = [alpha, *rectangles[i], *size, *location, rotations_y[i]]
            if np.isfinite(array.scores[row]):
                numbers.append(array.scores[row])
            track = self._tracks.of(array.track_ids[row])
            given = array.class_names[row]
            name = '_'.join(self.class_names.of(given).split()) or 'Misc'
            if name != given:
                self._given_classes[f'{track} {name}'] = given
            self._file.write(f'{self.number} {track} {name} {truncation[i]} {UNKNOWN_OCCLUSION} ')
            self._file.write(' '.join(f'{value:.6f}' for value in numbers) + '\n')

    def finish(self) -> None:
        """Name the tracks."""
        if names := self._tracks.names():
            self.about['tracks'] = names
        if self._given_classes:
            self.about['given_classes'] = self._given_classes


class _Line(NamedTuple):
    """A box of a label file; `numbers` are height, width, length, x, y, z and rotation_y."""

    frame: int
    track: str
    class_name: str
    numbers: list[float]
    score: float


def read(path: Path) -> Iterator[LabelFrame]:
    """
    Yield the frames of a label file, or of the only sequence of a folder.

    ``calib/NAME.txt`` is beside ``label_02/NAME.txt``; the files of `sidecar` are in the folder
    that contains both. Regions of the class DontCare are skipped.

    """
    if path.is_dir():
        found = sorted((path / 'label_02').glob('*.txt'))
        path = require_single(found, path, 'sequence, label_02/NAME.txt')
    folder = absolute(path).parent.parent
    lines = _read_lines(path)
    camera = Camera.read(folder / 'calib' / path.name)
    yield from numbered_frames(folder, _boxes_by_frame(path, lines, camera))


def read_scene(path: Path, scene: SceneFrames) -> Iterator[LabelFrame]:
    """
    Yield the frames of a sequence, by the stamps and the camera of the data set.

    `path` is a label file as the benchmark has it and trackers submit it, or a folder with
    ``NAME.txt`` or ``label_02/NAME.txt`` of the sequence.

    """
    if path.is_dir():
        path = _file_of_sequence(path, scene.name)
    lines = _read_lines(path)
    if scene.camera is None:
        raise RecordingError(
            f'{path}: expected the calibration of a camera, which the scene {scene.name!r} '
            f'lacks; read it with a scene of kitti-tracking'
        )
    yield from numbered_scene(path, _boxes_by_frame(path, lines, scene.camera), scene)


def _file_of_sequence(folder: Path, name: str) -> Path:
    """Return the label file of a sequence."""
    for path in (folder / f'{name}.txt', folder / 'label_02' / f'{name}.txt'):
        if path.is_file():
            return path
    there = ', '.join(sorted(path.name for path in folder.glob('*.txt'))) or 'none'
    raise RecordingError(
        f'{folder}: expected {name}.txt or label_02/{name}.txt, got {there}; name the file'
    )


def _read_lines(path: Path) -> list[_Line]:
    """Return the lines of a label file, in their order."""
    lines = []
    with following(path, '17 or 18 columns of KITTI tracking'):
        for text in path.read_text(encoding='utf-8').splitlines():
            words = text.split()
            if not words or words[2] == IGNORED_CLASS:
                continue
            numbers = [float(word) for word in words[10:17]]
            score = float(words[17]) if len(words) > 17 else np.nan
            if len(numbers) != 7:
                raise ValueError(f'got {len(words)} columns')
            lines.append(_Line(int(words[0]), words[1], words[2], numbers, score))
    return lines


def _boxes_by_frame(
    path: Path, lines: Sequence[_Line], camera: Camera
) -> dict[int, list[ReadBox]]:
    """Return the boxes of a label file in the LiDAR frame; tracks have the names beside it."""
    about = read_provenance(absolute(path).parent.parent)
    tracks, given = about.get('tracks', {}), about.get('given_classes', {})
    numbers = np.array([line.numbers for line in lines]).reshape(-1, 7)
    centres = numbers[:, 3:6].copy()
    centres[:, 1] -= numbers[:, 0] / 2
    boxes = camera.from_upright(centres, numbers[:, 6], numbers[:, [2, 1, 0]])
    found: dict[int, list[ReadBox]] = {}
    for line, box in zip(lines, boxes, strict=True):
        track_id = tracks.get(line.track, line.track)
        class_name = given.get(f'{line.track} {line.class_name}', line.class_name)
        read_box = ReadBox(track_id, class_name, box, {'score': line.score})
        found.setdefault(line.frame, []).append(read_box)
    return found


def _write_calibration(camera: Camera, path: Path) -> None:
    """Write the calibration under the names of the benchmark, the same for all four cameras."""
    parts = {f'P{i}': camera.projection for i in range(4)}
    parts['R_rect'] = camera.rectification
    parts['Tr_velo_cam'] = camera.T_camera_sensor[:3]
    parts['Tr_imu_velo'] = np.eye(4)[:3]
    parts['S_rect_02'] = np.array(camera.size, float)
    with path.open('w', encoding='utf-8') as file:
        for name, values in parts.items():
            numbers = ' '.join(f'{value:.12e}' for value in values.ravel())
            file.write(f'{name}: {numbers}\n')
