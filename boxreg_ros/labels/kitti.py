"""
KITTI tracking: a line per box, in the rectified frame of a camera.

The folder is one sequence of the benchmark: ``label_02/0000.txt``, ``calib/0000.txt`` and
``velodyne/0000``. All boxes are there, those outside of the image with truncation 2 and a
rectangle of -1; occlusion is 3, unknown. Beside the labels lie stamps and poses, see `Timeline`.

"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from itertools import groupby
from pathlib import Path

from boxreg_ros.errors import RecordingError
from boxreg_ros.labels import absolute, Format, LabelFrame, Options, Provenance
from boxreg_ros.labels.camera import Camera
from boxreg_ros.labels.clouds import write_cloud
from boxreg_ros.labels.files import read_timeline, refined_boxes, the_one, Timeline, TrackNumbers
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
    options=('camera', 'with_points'),
)
SEQUENCE = '0000'
CLASSES = {
    name.lower(): name
    for name in ('Car', 'Van', 'Truck', 'Pedestrian', 'Person_sitting', 'Cyclist', 'Tram', 'Misc')
}
"""Names as the benchmark spells them; others stay as they are."""
UNKNOWN_OCCLUSION = 3


class Writer:
    """
    Write a line per box as frames come.

    The location is half a height below the centre along the camera's y, as whoever reads it
    puts an upright box there: the centre stays what it is, however the camera is tilted.

    """

    def __init__(self, folder: Path, provenance: Provenance, options: Options) -> None:
        self.dropped: Counter[str] = Counter()
        self._camera = Camera.read(options.camera, 'format kitti')
        self._clouds = folder / 'velodyne' / SEQUENCE
        for name in ('label_02', 'calib'):
            (folder / name).mkdir()
        if options.with_points:
            self._clouds.mkdir(parents=True)
        _write_calibration(self._camera, folder / 'calib' / f'{SEQUENCE}.txt')
        path = folder / 'label_02' / f'{SEQUENCE}.txt'
        self._file = path.open('w', encoding='utf-8')
        self._timeline = Timeline(folder, provenance)
        self._numbers = TrackNumbers()
        self._frames = 0

    def write(self, frame: LabelFrame) -> None:
        """Add the lines of a frame."""
        rows, boxes = frame.placed('sensor', self.dropped)
        given = frame.refined.boxes
        centres, turns = self._camera.upright(boxes)
        views, are_whole = self._camera.views(boxes)
        is_outside = np.isnan(views).any(axis=1)
        views[is_outside] = -1.0
        truncation = np.where(is_outside, 2, np.where(are_whole, 0, 1))
        for i, (row, box, centre, turn) in enumerate(
            zip(rows, boxes, centres, turns, strict=True)
        ):
            alpha = _wrapped(turn - np.arctan2(centre[0], centre[2]))
            numbers = [
                alpha,
                *views[i],
                *box[[HEIGHT, WIDTH, LENGTH]],
                centre[0],
                centre[1] + box[HEIGHT] / 2,
                centre[2],
                turn,
            ]
            if np.isfinite(given.scores[row]):
                numbers.append(given.scores[row])
            number, name = self._numbers.of(given.track_ids[row]), _spelt(given.class_names[row])
            self._file.write(
                f'{self._frames} {number} {name} {truncation[i]} {UNKNOWN_OCCLUSION} '
            )
            self._file.write(' '.join(f'{value:.6f}' for value in numbers) + '\n')
        if frame.sweep is not None:
            write_cloud(
                self._clouds / f'{self._frames:06d}.bin', frame.sweep.points, frame.intensities
            )
        self._timeline.add(frame)
        self._frames += 1

    def close(self) -> None:
        """Complete the files."""
        self._file.close()
        self._timeline.close(self._numbers.names())


def read(path: Path) -> Iterator[LabelFrame]:
    """
    Yield the frames of a label file, or of the only sequence of a folder.

    ``calib/NAME.txt`` lies beside ``label_02/NAME.txt``, `Timeline`'s files in the folder of
    both. What is not to be cared for is left out.

    """
    if path.is_dir():
        found = sorted((path / 'label_02').glob('*.txt'))
        path = the_one(found, path, 'sequence, label_02/NAME.txt')
    folder = absolute(path).parent.parent
    try:
        lines = [line.split() for line in path.read_text(encoding='utf-8').splitlines()]
        rows = sorted((r for r in lines if r and r[2] != 'DontCare'), key=lambda r: int(r[0]))
        of_frame = {frame: list(part) for frame, part in groupby(rows, lambda r: int(r[0]))}
        numbers = {
            frame: np.array([[*map(float, row[10:17])] for row in part])
            for frame, part in of_frame.items()
        }
        scores = {
            frame: [float(row[17]) if len(row) > 17 else np.nan for row in part]
            for frame, part in of_frame.items()
        }
    except OSError as error:
        raise RecordingError(f'{path}: cannot be read: {error.strerror}') from None
    except (IndexError, ValueError) as error:
        raise RecordingError(
            f'{path}: expected 17 or 18 columns of KITTI tracking: {error}'
        ) from None
    camera = Camera.read(folder / 'calib' / path.name)
    timeline = read_timeline(folder, 1 + max(of_frame, default=-1))
    for index, stamp_ns in enumerate(timeline.stamps_ns):
        part = of_frame.get(index, [])
        h_w_l_x_y_z_turn = numbers.get(index, np.zeros((0, 7)))
        extents, centres = h_w_l_x_y_z_turn[:, [2, 1, 0]], h_w_l_x_y_z_turn[:, 3:6].copy()
        centres[:, 1] -= h_w_l_x_y_z_turn[:, 0] / 2
        refined = refined_boxes(
            stamp_ns,
            timeline.sensor_frame,
            [timeline.tracks.get(row[1], row[1]) for row in part],
            [row[2] for row in part],
            camera.from_upright(centres, h_w_l_x_y_z_turn[:, 6], extents),
            scores.get(index, []),
        )
        yield timeline.frame(index, refined)


def _write_calibration(camera: Camera, path: Path) -> None:
    """Write the calibration by the names of the benchmark; all four cameras are this one."""
    parts = {f'P{i}': camera.projection for i in range(4)} | {
        'R_rect': camera.rectification,
        'Tr_velo_cam': camera.T_camera_sensor[:3],
        'Tr_imu_velo': np.eye(4)[:3],
        'S_rect_02': np.array(camera.size, float),
    }
    lines = (f'{k}: {" ".join(f"{n:.12e}" for n in v.ravel())}\n' for k, v in parts.items())
    path.write_text(''.join(lines), encoding='utf-8')


def _spelt(class_name: str) -> str:
    """Return a class name without spaces, as the benchmark spells it."""
    name = '_'.join(class_name.split()) or 'Misc'
    return CLASSES.get(name.lower(), name)


def _wrapped(angle: float) -> float:
    return float((angle + np.pi) % (2 * np.pi) - np.pi)
