"""
KITTI tracking: one line per box, in the rectified frame of a camera.

The folder is one sequence of the benchmark: ``label_02/0000.txt``, ``calib/0000.txt`` and
``velodyne/0000``. Boxes outside of the image are written too, with truncation 2 and a rectangle
of -1. Occlusion is 3, unknown, where boxes have no attribute ``occluded``. Truncation is that of
the rectangle where they have no attribute ``truncated``: those that have are in ``boxreg.json``.
Stamps and poses are in the files of `sidecar`.

"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path

from boxreg_ros.errors import RecordingError
from boxreg_ros.labels.attributes import FALSE, is_set, OCCLUDED, PARTLY, TRUE, TRUNCATED
from boxreg_ros.labels.camera import Camera
from boxreg_ros.labels.files import at, following, read_provenance, require_single, visible
from boxreg_ros.labels.folder import FolderWriter, noted
from boxreg_ros.labels.protocol import (
    absolute,
    Format,
    LabelFrame,
    SceneFrames,
)
from boxreg_ros.labels.records import FrameBoxes, ReadBox, require_radians, TrackNumbers
from boxreg_ros.labels.sidecar import numbered_frames, numbered_scene
from boxreg_ros.reasons import Reason
from boxreg_ros.rotations import wrap_angle
from boxreg_ros.structures import Floats, HEIGHT, Ints, LENGTH, WIDTH
import numpy as np

FORMAT = Format(
    name='kitti',
    title='KITTI tracking',
    frame='rectified camera (`--camera`)',
    reference='centre of the bottom face',
    sizes='height width length',
    rotation="rotation_y about the camera's y; roll and pitch are lost",
    files='label_02/, calib/, velodyne/',
    options=('camera', 'with_points', 'with_images', 'class_map'),
    leaves_out='regions without a 3D box (counted)',
    read_back='pykitti 0.3.1',
    reads='17 or 18 columns of one sequence, of labels or of a tracker',
)
SEQUENCE = '0000'
INSIDE_IMAGE, CUT_OFF, OUTSIDE_IMAGE = 0, 1, 2
"""Values of truncation."""
UNKNOWN_OCCLUSION = 3
OCCLUSION = {FALSE: 0, PARTLY: 1, TRUE: 2}
"""By the value of the attribute."""
OTHER_COLUMNS = dict.fromkeys((15, 16), ': those of KITTI object, which is read as kitti_object')
"""Hint by the number of columns of another format."""
NO_TRACK = '-1'
"""Of boxes of a detector in this format."""
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
    image_file = f'image_02/{SEQUENCE}/{{number:06d}}.png'
    has_sidecar = True
    has_kitti_camera = True

    def begin(self) -> None:
        """Open the files."""
        self._file = self.text_file(f'label_02/{SEQUENCE}.txt')
        self._tracks = TrackNumbers()
        self._given_classes: dict[str, str] = {}  # by number of the track and class as written
        self.about[TRUNCATED] = {}

    def add(self, frame: LabelFrame) -> None:
        """Add the lines of a frame."""
        rows, boxes = frame.boxes_in('sensor', self.dropped)
        array = frame.refined.boxes
        camera = self.kitti_camera.in_frame(frame.sensor_frame)
        truncation, columns = columns_of(camera, boxes)
        for i, row in enumerate(rows):
            track = self._tracks.of(array.track_ids[row])
            given = array.class_names[row]
            name = self.class_names.word_of(given, 'Misc')
            if name != given:
                self._given_classes[f'{track} {name}'] = given
            attributes = array.attributes_of(row)
            cut = truncation_of(attributes, int(truncation[i]))
            self.note_status(str(track), frame.refined.status[row])
            if TRUNCATED in attributes:
                self.note(TRUNCATED, attributes[TRUNCATED], str(track))
            self._file.write(f'{self.number} {track} {name} {cut} {occlusion_of(attributes)} ')
            self._file.write(decimals(columns[i], array.scores[row]) + '\n')

    def finish(self) -> None:
        """Name the tracks, and write the calibration."""
        write_calibration(self.kitti_camera.camera, self.folder / 'calib' / f'{SEQUENCE}.txt')
        if names := self._tracks.names():
            self.about['tracks'] = names
        if self._given_classes:
            self.about['given_classes'] = self._given_classes


def occlusion_of(attributes: Mapping[str, str], unknown: int = UNKNOWN_OCCLUSION) -> int:
    """Return the occlusion of a box as KITTI numbers it; `unknown` without the attribute."""
    value = attributes.get(OCCLUDED, '').lower()
    default = TRUE if is_set(value) else FALSE
    return OCCLUSION.get(value, OCCLUSION[default]) if value else unknown


def truncation_of(attributes: Mapping[str, str], seen: int) -> int:
    """Return the truncation of a box: the attribute, else that of its rectangle, `seen`."""
    if seen == OUTSIDE_IMAGE or TRUNCATED not in attributes:
        return seen
    return CUT_OFF if is_set(attributes[TRUNCATED]) else INSIDE_IMAGE


def attributes_of(truncation: str, occlusion: str) -> dict[str, str]:
    """Return the attributes of the columns of KITTI; unknown ones are none."""
    names = {str(number): value for value, number in OCCLUSION.items()}
    found = {OCCLUDED: names[occlusion]} if occlusion in names else {}
    part = float(truncation)
    if 0 <= part <= 1:
        found[TRUNCATED] = TRUE if part == 1 else truncation if part else FALSE
    return found


def columns_of(camera: Camera, boxes: Floats) -> tuple[Ints, Floats]:
    """
    Return the columns of boxes that both formats of KITTI have.

    Parameters
    ----------
    camera : Camera
        That the boxes refer to.
    boxes : array, shape (n, 9)
        In the frame of the LiDAR [m, rad].

    Returns
    -------
    truncation : array, shape (n,)
        `INSIDE_IMAGE`, `CUT_OFF` or `OUTSIDE_IMAGE`.
    columns : array, shape (n, 12)
        alpha [rad]; left, top, right, bottom [px], -1 outside of the image; height, width, length
        and the centre of the bottom face in the rectified camera frame [m]; rotation_y [rad].

    """
    centres, rotations_y = camera.to_upright(boxes)
    rectangles, is_inside = camera.project(boxes)
    is_outside = np.isnan(rectangles).any(axis=1)
    rectangles[is_outside] = -1.0
    truncation = np.where(is_inside, INSIDE_IMAGE, CUT_OFF)
    truncation[is_outside] = OUTSIDE_IMAGE
    alpha = wrap_angle(rotations_y - np.arctan2(centres[:, 0], centres[:, 2]))
    sizes = boxes[:, [HEIGHT, WIDTH, LENGTH]]
    locations = centres.copy()
    locations[:, 1] += boxes[:, HEIGHT] / 2
    return truncation, np.column_stack([alpha, rectangles, sizes, locations, rotations_y])


def boxes_of(camera: Camera, numbers: Floats) -> Floats:
    """
    Return the boxes of the last columns of KITTI.

    Parameters
    ----------
    camera : Camera
        That the boxes refer to.
    numbers : array, shape (n, 7)
        Height, width, length, centre of the bottom face [m] and rotation_y [rad].

    Returns
    -------
    boxes : array, shape (n, 9)
        In the frame of the LiDAR [m, rad].

    Raises
    ------
    ValueError
        If a rotation is in degrees.

    """
    require_radians(numbers[:, 6])
    centres = numbers[:, 3:6].copy()
    centres[:, 1] -= numbers[:, 0] / 2
    return camera.from_upright(centres, numbers[:, 6], numbers[:, [2, 1, 0]])


def decimals(numbers: Floats, score: float) -> str:
    """Return numbers as text, and the score after them if there is one."""
    values = [*numbers, score] if np.isfinite(score) else numbers
    return ' '.join(f'{value:.6f}' for value in values)


def read(path: Path) -> Iterator[LabelFrame]:
    """
    Yield the frames of a label file, or of the only sequence of a folder.

    ``calib/NAME.txt`` is beside ``label_02/NAME.txt``; the files of `sidecar` are in the folder
    that contains both. Regions of the class DontCare without extents are counted.

    """
    if path.is_dir():
        found = visible(path, 'label_02/*.txt')
        path = require_single(found, path, 'sequence, label_02/NAME.txt')
    folder = absolute(path).parent.parent
    lines = _read_lines(path)
    camera = Camera.read(folder / 'calib' / path.name)
    yield from numbered_frames(folder, _placed(path, lines, camera))


def read_scene(path: Path, scene: SceneFrames) -> Iterator[LabelFrame]:
    """
    Yield the frames of a sequence, by the stamps and the camera of the data set.

    Parameters
    ----------
    path : Path
        A label file as the benchmark has it and trackers submit it, or a folder with ``NAME.txt``
        or ``label_02/NAME.txt`` of the sequence.
    scene : SceneFrames
        Its `camera` is needed, its `stamps_ns` are by the number of the frame.

    Yields
    ------
    frame : LabelFrame
        One per frame of the scene, with or without boxes; boxes in the frame of the LiDAR.

    Raises
    ------
    RecordingError
        If the file is missing, does not follow the format or has frames that the scene lacks, or
        the scene has no camera.

    """
    if path.is_dir():
        path = _file_of_sequence(path, scene.name)
    lines = _read_lines(path)
    if scene.camera is None:
        raise RecordingError(
            f'{path}: expected the calibration of a camera, which the scene {scene.name!r} '
            f'lacks; read it with a scene of kitti-tracking'
        )
    yield from numbered_scene(path, _placed(path, lines, scene.camera), scene)


def _file_of_sequence(folder: Path, name: str) -> Path:
    """Return the label file of a sequence."""
    for path in (folder / f'{name}.txt', folder / 'label_02' / f'{name}.txt'):
        if path.is_file():
            return path
    there = ', '.join(path.name for path in visible(folder, '*.txt')) or 'none'
    raise RecordingError(
        f'{folder}: expected {name}.txt or label_02/{name}.txt, got {there}; name the file'
    )


def _read_lines(path: Path) -> dict[int, FrameBoxes]:
    """
    Return the lines of each frame of a label file, in their order, and the number of its regions.

    The numbers of a line are height, width, length, x, y, z and rotation_y.

    """
    frames: dict[int, tuple[list[ReadBox], Counter[str]]] = {}
    with following(path, '17 or 18 columns of KITTI tracking'):
        for number, text in enumerate(path.read_text(encoding='utf-8').splitlines(), 1):
            words = text.split()
            if not words:
                continue
            with at(f'line {number}'):
                if len(words) not in (17, 18):
                    raise ValueError(
                        f'got {len(words)} columns{OTHER_COLUMNS.get(len(words), "")}'
                    )
                boxes, left_out = frames.setdefault(int(words[0]), ([], Counter()))
                numbers = [float(word) for word in words[10:17]]
                if words[2] == IGNORED_CLASS and numbers[0] <= 0:
                    left_out[Reason.NO_BOX] += 1
                    continue
                score = float(words[17]) if len(words) > 17 else np.nan
                evidence = {'score': score, 'attributes': attributes_of(*words[3:5])}
                boxes.append(ReadBox(words[1], words[2], numbers, evidence))
    return {**frames}


def _placed(path: Path, lines: Mapping[int, FrameBoxes], camera: Camera) -> dict[int, FrameBoxes]:
    """Return the boxes of lines in the LiDAR frame; tracks have the names beside the file."""
    about = read_provenance(absolute(path).parent.parent)
    tracks, given = {NO_TRACK: ''} | about.get('tracks', {}), about.get('given_classes', {})
    status, truncated = noted(about, 'status'), noted(about, TRUNCATED)
    found: dict[int, FrameBoxes] = {}
    for frame, (items, left_out) in lines.items():
        with following(path, 'rotations in radians'):
            boxes = boxes_of(camera, np.reshape([item.box for item in items], (-1, 7)))
        if TRUNCATED in about:  # else they are labels of others, which state what they have
            for item in items:
                item.evidence['attributes'].pop(TRUNCATED, None)
                if value := truncated.get((item.track_id, frame)):
                    item.evidence['attributes'][TRUNCATED] = value
        placed = [
            item._replace(
                track_id=tracks.get(item.track_id, item.track_id),
                class_name=given.get(f'{item.track_id} {item.class_name}', item.class_name),
                box=box,
                evidence={**item.evidence, 'status': status.get((item.track_id, frame))},
            )
            for item, box in zip(items, boxes, strict=True)
        ]
        found[frame] = placed, left_out
    return found


def write_calibration(
    camera: Camera,
    path: Path,
    names: tuple[str, str, str] = ('R_rect', 'Tr_velo_cam', 'Tr_imu_velo'),
) -> None:
    """
    Write the calibration as the benchmark has it, the same for all four cameras.

    Parameters
    ----------
    camera : Camera
        The pose of the LiDAR is in the frame of camera 0; that of the IMU is written as the
        identity.
    path : Path
        The file; an old one is replaced.
    names : tuple of 3 str
        Of the rectification, and of the poses of LiDAR and IMU.

    Raises
    ------
    OSError
        If the file cannot be written.

    """
    parts = {f'P{i}': camera.projection for i in range(4)}
    matrices = camera.rectification, camera.T_camera_sensor[:3], np.eye(4)[:3]
    parts |= zip(names, matrices, strict=True)
    parts['S_rect_02'] = np.array(camera.size, float)
    with path.open('w', encoding='utf-8') as file:
        for name, values in parts.items():
            numbers = ' '.join(f'{value:.12e}' for value in values.ravel())
            file.write(f'{name}: {numbers}\n')
