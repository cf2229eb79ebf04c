"""A camera as label formats need it: where it is, and what it sees of a box."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from boxreg_ros.errors import ConfigError
from boxreg_ros.io.transforms import inverse
from boxreg_ros.rotations import matrix_from_rpy, rpy_from_matrix
from boxreg_ros.structures import Floats, HEIGHT, LENGTH, ROLL, X, Z
import numpy as np
from numpy.typing import NDArray
import yaml

Mask = NDArray[np.bool_]

KITTI_SIZE = (1242, 375)
NEAREST = 0.1
"""What is nearer than this to the image plane is not projected [m]."""
CORNERS = np.array([(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
EDGES = np.array([(i, i | bit) for i in range(8) for bit in (1, 2, 4) if not i & bit])

NAMES = {
    'projection': ('P2', 'P_rect_02', 'projection_matrix'),
    'rectification': ('R_rect', 'R0_rect', 'R_rect_00', 'rectification_matrix'),
    'pose': ('Tr_velo_cam', 'Tr_velo_to_cam', 'T_camera_sensor'),
    'size': ('S_rect_02', 'image_size'),
}
"""What each part is called in files of KITTI (tracking, object, raw) and in YAML."""


@dataclass(frozen=True, slots=True)
class Camera:
    """
    A calibrated camera: x right, y down, z forward.

    Attributes
    ----------
    projection : array, shape (3, 4)
        From rectified camera coordinates [m] to homogeneous pixels.
    rectification : array, shape (3, 3)
        From camera to rectified camera coordinates.
    T_camera_sensor : array, shape (4, 4)
        Pose of the LiDAR in the camera's frame.
    size : tuple of two int
        Width and height of the image [px].

    """

    projection: Floats
    rectification: Floats
    T_camera_sensor: Floats
    size: tuple[int, int] = KITTI_SIZE

    @classmethod
    def read(cls, path: Path | None, needed_by: str = 'this format') -> Camera:
        """
        Read a calibration file of KITTI, or YAML with the keys of ROS's ``camera_info``.

        YAML holds ``projection_matrix``, ``T_camera_sensor`` (12 or 16 numbers, row by row),
        and where they matter ``rectification_matrix``, ``image_width`` and ``image_height``.

        Raises
        ------
        ConfigError
            If there is no file, or it lacks a part or numbers.

        """
        if path is None:
            raise ConfigError(f'{needed_by} looks through a camera: say which with --camera FILE')
        try:
            text = path.read_text(encoding='utf-8')
            is_yaml = path.suffix.lower() in ('.yaml', '.yml')
            values = _from_yaml(text) if is_yaml else _from_lines(text)
        except OSError as error:
            raise ConfigError(f'{path}: cannot be read: {error.strerror}') from None
        except (ValueError, TypeError, AttributeError, yaml.YAMLError) as error:
            raise ConfigError(f'{path}: no calibration of a camera: {error}') from None

        def part(name: str, counts: tuple[int, ...], default: Floats | None = None) -> Floats:
            found = next((values[key] for key in NAMES[name] if key in values), default)
            if found is None or found.size not in counts:
                raise ConfigError(
                    f'{path}: expected {" or ".join(map(str, counts))} numbers under one of '
                    f'{", ".join(NAMES[name])}, got {"none" if found is None else found.size}'
                )
            return found

        pose = np.eye(4)
        pose[:3] = part('pose', (12, 16))[:12].reshape(3, 4)
        width, height = part('size', (2,), np.array(KITTI_SIZE)).astype(int).tolist()
        return cls(
            part('projection', (12,)).reshape(3, 4),
            part('rectification', (9,), np.eye(3)).reshape(3, 3),
            pose,
            (width, height),
        )

    @property
    def T_rect_sensor(self) -> Floats:
        """Pose (4, 4) of the LiDAR in the rectified camera's frame."""
        T_rect_camera = np.eye(4)
        T_rect_camera[:3, :3] = self.rectification
        return T_rect_camera @ self.T_camera_sensor

    def views(self, boxes: Floats) -> tuple[Floats, Mask]:
        """
        Return what the image shows of boxes, and of which it shows all.

        Parameters
        ----------
        boxes : array, shape (n, 9)
            In the LiDAR's frame.

        Returns
        -------
        rectangles : array, shape (n, 4)
            Left, top, right and bottom [px] within the image; NaN where it shows nothing.
        is_whole : array, shape (n,)
            False where a part is outside of the image or behind the camera.

        """
        T, P = self.T_rect_sensor, self.projection
        turned = matrix_from_rpy(boxes[:, ROLL:])
        corners = (CORNERS * boxes[:, None, LENGTH : HEIGHT + 1]) @ turned.transpose(0, 2, 1)
        corners = (corners + boxes[:, None, X : Z + 1]) @ T[:3, :3].T + T[:3, 3]
        a, b = corners[:, EDGES[:, 0]], corners[:, EDGES[:, 1]]
        is_before = corners[..., 2] >= NEAREST
        crosses = (a[..., 2] >= NEAREST) != (b[..., 2] >= NEAREST)
        rise = np.where(crosses, b[..., 2] - a[..., 2], 1.0)
        cut = a + ((NEAREST - a[..., 2]) / rise)[..., None] * (b - a)
        seen = np.concatenate([corners, cut], axis=1)
        is_seen = np.concatenate([is_before, crosses], axis=1)[..., None]
        pixels = np.where(is_seen, seen, [0.0, 0.0, 1.0]) @ P[:, :3].T + P[:, 3]
        pixels = pixels[..., :2] / pixels[..., 2:]
        low = np.where(is_seen, pixels, np.inf).min(axis=1)
        high = np.where(is_seen, pixels, -np.inf).max(axis=1)
        edge = np.array(self.size) - 1.0
        is_inside = ((high >= 0) & (low <= edge)).all(axis=1)
        is_whole = is_before.all(axis=1) & ((low >= 0) & (high <= edge)).all(axis=1)
        rectangles = np.hstack([np.maximum(low, 0), np.minimum(high, edge)])
        return np.where(is_inside[:, None], rectangles, np.nan), is_whole

    def upright(self, boxes: Floats) -> tuple[Floats, Floats]:
        """
        Return where KITTI has boxes: centre (n, 3) in the rectified frame and rotation_y (n,).

        rotation_y turns the camera's x axis about its y axis into the box's heading; the rest
        of the orientation is lost.

        """
        T = self.T_rect_sensor
        centres = boxes[:, X : Z + 1] @ T[:3, :3].T + T[:3, 3]
        turned = matrix_from_rpy(boxes[:, ROLL:])
        headings = turned[:, :, 0] @ T[:3, :3].T
        return centres, np.arctan2(-headings[:, 2], headings[:, 0])

    def from_upright(self, centres: Floats, rotation_y: Floats, extents: Floats) -> Floats:
        """Return boxes (n, 9) in the LiDAR's frame: what `upright` is given, but for tilt."""
        cos, sin, zero = np.cos(rotation_y), np.sin(rotation_y), np.zeros(len(rotation_y))
        # Columns are the axes of the box: heading, left, and up, which is the camera's -y.
        R_rect_box = np.array([[cos, sin, zero], [zero, zero, zero - 1], [-sin, cos, zero]])
        R_rect_box = R_rect_box.transpose(2, 0, 1)
        T = inverse(self.T_rect_sensor)
        angles = rpy_from_matrix(T[:3, :3] @ R_rect_box)
        return np.hstack([centres @ T[:3, :3].T + T[:3, 3], extents, angles])


def _from_lines(text: str) -> dict[str, Floats]:
    """Return the numbers of each line by the name before them; KITTI leaves out some colons."""
    values = {}
    for line in text.splitlines():
        name, *rest = line.replace(':', ' ').split()[:17] or ['']
        if any(name in names for names in NAMES.values()):
            values[name] = np.array(rest, np.float64)
    return values


def _from_yaml(text: str) -> dict[str, Floats]:
    content = yaml.safe_load(text)
    values = {}
    for name, value in content.items():
        if any(name in names for names in NAMES.values()):
            value = value['data'] if isinstance(value, dict) else value
            values[name] = np.array(value, np.float64).ravel()
    if 'image_width' in content:
        values['image_size'] = np.array([content['image_width'], content['image_height']], float)
    return values
