"""
SemanticKITTI: a sequence of clouds with a number of class and instance per point.

A ``.label`` file has 32 bits per point: the class in the lower 16, the instance in the upper. An
object that moves at some time of the drive has a ``-moving`` class, as there. Points on no object
are of the class ``other-object`` (99), and points that cannot be known ``unlabeled`` (0). Poses
are those of the LiDAR, relative to the first one; the calibration is the identity.

"""

from __future__ import annotations

from typing import TYPE_CHECKING

from boxreg_ros.config import words_of
from boxreg_ros.io.transforms import inverse
from boxreg_ros.labels.folder import FolderWriter
from boxreg_ros.labels.protocol import Format, LabelFrame
from boxreg_ros.structures import Floats
import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from boxreg_ros.core.point_labels import PointLabels

FORMAT = Format(
    name='semantickitti',
    title='SemanticKITTI (labels of points)',
    frame='sensor',
    reference='none: labels are of points',
    sizes='none',
    rotation='none',
    files='sequences/00/, with labels/, velodyne/, poses.txt',
    has_points=True,
)
SEQUENCE_FOLDER = 'sequences/00'
UNLABELED, OTHER_OBJECT = 0, 99
CLASSES = (
    # Words of class names; class of objects that never move, and of those that do.
    (('rack', 'sign', 'signs', 'depiction', 'cone', 'barrier', 'barriers', 'barrel'), 99, 99),
    (('motorcyclist',), 32, 255),
    (('cyclist', 'bicyclist', 'rider'), 31, 253),
    (('motorcycle', 'motorbike'), 15, 255),
    (('bicycle', 'bike'), 11, 253),
    (('pedestrian', 'person', 'adult', 'child'), 30, 254),
    (('bus',), 13, 257),
    (('tram', 'train'), 16, 256),
    (('trailer', 'construction'), 20, 259),
    (('truck', 'lorry'), 18, 258),
    (('car', 'van', 'suv', 'vehicle', 'taxi', 'pickup'), 10, 252),
)
OTHER_VEHICLE = 20, 259
MAX_INSTANCE = 2**16 - 1


class Writer(FolderWriter):
    """Write a file of points and one of labels per sweep."""

    folders = (f'{SEQUENCE_FOLDER}/labels', f'{SEQUENCE_FOLDER}/velodyne')
    cloud_file = f'{SEQUENCE_FOLDER}/velodyne/{{number:06d}}.bin'
    has_sidecar = True
    needs_pose = True

    def begin(self) -> None:
        """Open the files."""
        self._sequence = self.folder / SEQUENCE_FOLDER
        identity = ' '.join(map(str, np.eye(4)[:3].ravel()))
        lines = [f'{name}: {identity}\n' for name in ('P0', 'P1', 'P2', 'P3', 'Tr')]
        self.text_file(f'{SEQUENCE_FOLDER}/calib.txt').writelines(lines)
        self._poses = self.text_file(f'{SEQUENCE_FOLDER}/poses.txt')
        self._times = self.text_file(f'{SEQUENCE_FOLDER}/times.txt')
        self._T_first_fixed: Floats | None = None
        self._first_ns = 0
        self._numbers: NDArray[np.uint32] | None = None

    def add(self, frame: LabelFrame) -> None:
        """Write the labels of a sweep, its pose and its time."""
        T = frame.T_fixed_sensor
        assert T is not None  # of `needs_pose`
        assert frame.points is not None
        stamp_ns = frame.refined.boxes.stamp_ns
        if self._T_first_fixed is None:
            self._T_first_fixed = inverse(T)
            self._first_ns = stamp_ns
        numbers = ' '.join(map(repr, (self._T_first_fixed @ T)[:3].ravel().tolist()))
        self._poses.write(f'{numbers}\n')
        self._times.write(f'{(stamp_ns - self._first_ns) * 1e-9:.6e}\n')
        if self._numbers is None:
            self._numbers = point_numbers(frame.points)
            names = [track.track_id for track in frame.points.tracks]
            self.about['tracks'] = {str(i + 1): name for i, name in enumerate(names)}
        labels = self._numbers[frame.points.track]
        labels.tofile(self._sequence / 'labels' / f'{self.number:06d}.label')


def point_numbers(points: PointLabels) -> NDArray[np.uint32]:
    """
    Return the number of the points of each track, of any sweep: all have the same tracks.

    Parameters
    ----------
    points : PointLabels
        Labels of a sweep; its t tracks and whether they move are used.

    Returns
    -------
    numbers : array of uint32, shape (t + 2,)
        By the track of a point; the last two are those of -2 (unknown) and -1 (on no object). In
        the lower 16 bits the class, in the upper ones the instance: the row of the track, from 1;
        0 for points on none, and beyond `MAX_INSTANCE`.

    """
    from boxreg_ros.core.point_labels import BACKGROUND, UNKNOWN  # numba, which reading needs not

    pairs = zip(points.tracks, points.moves.tolist(), strict=True)
    classes = [class_of(track.class_name, moves) for track, moves in pairs]
    assert (UNKNOWN, BACKGROUND) == (-2, -1)
    instances = np.append(np.arange(1, len(classes) + 1), [0, 0])
    instances[instances > MAX_INSTANCE] = 0
    numbers = np.array([*classes, UNLABELED, OTHER_OBJECT]) | instances << 16
    return np.asarray(numbers, '<u4')


def class_of(class_name: str, moves: bool) -> int:
    """Return the class of objects of this name, that move at some time or never."""
    words = words_of(class_name)
    for names, still, moving in CLASSES:
        if not words.isdisjoint(names):
            return moving if moves else still
    return OTHER_VEHICLE[moves]
