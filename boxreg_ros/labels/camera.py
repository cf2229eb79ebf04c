"""A calibrated camera: reading its calibration, and projecting boxes into its image."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from boxreg_ros.config import YAML_ERRORS
from boxreg_ros.errors import ConfigError, unreadable
from boxreg_ros.io.transforms import inverse
from boxreg_ros.rotations import matrix_from_rpy, rpy_from_matrix
from boxreg_ros.structures import BOX_CENTER, BOX_EXTENT, Floats, ROLL
import numpy as np
from numpy.typing import NDArray
import yaml

Mask = NDArray[np.bool_]

KITTI_SIZE = (1242, 375)
"""Width and height of the images of KITTI [px], where the calibration states none."""
NEAR_PLANE = 0.1
"""Parts of a box with a smaller depth than this are clipped before projection [m]."""
CORNERS = np.array([(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
"""Corners (8, 3) of a unit cube; the bits of the index are x, y and z."""
EDGES = np.array([(i, i | bit) for i in range(8) for bit in (1, 2, 4) if not i & bit])
"""Indices (12, 2) of the corners at the ends of each edge."""

KEYS = {
    'projection': ('P2', 'P_rect_02', 'projection_matrix'),
    'rectification': ('R_rect', 'R0_rect', 'R_rect_00', 'rectification_matrix'),
    'pose': ('Tr_velo_cam', 'Tr_velo_to_cam', 'T_camera_sensor'),
    'size': ('S_rect_02', 'image_size'),
}
"""Names of each part in files of KITTI (tracking, object, raw) and in YAML."""


@dataclass(frozen=True, slots=True)
class Camera:
    """A calibrated camera: x right, y down, z forward."""

    projection: Floats
    """(3, 4), from rectified camera coordinates [m] to homogeneous pixels."""
    rectification: Floats
    """(3, 3), from camera to rectified camera coordinates."""
    T_camera_sensor: Floats
    """Pose (4, 4) of the LiDAR in the camera frame."""
    size: tuple[int, int] = KITTI_SIZE
    """Width and height of the image [px]."""

    @classmethod
    def read(cls, path: Path) -> Camera:
        """
        Read a calibration file of KITTI, or YAML with the keys of ``camera_info`` of ROS.

        Parameters
        ----------
        path : Path
            YAML, if its name ends in ``.yaml`` or ``.yml``, holds ``projection_matrix``,
            ``T_camera_sensor`` (12 or 16 numbers, row by row) and optionally
            ``rectification_matrix``, ``image_width`` and ``image_height``.

        Returns
        -------
        camera : Camera
            Without a rectification it is the identity, without a size that of KITTI.

        Raises
        ------
        ConfigError
            If `path` cannot be read, or a part is missing or has the wrong size.

        """
        try:
            text = path.read_text(encoding='utf-8')
            is_yaml = path.suffix.lower() in ('.yaml', '.yml')
            values = _from_yaml(text) if is_yaml else _from_lines(text)
        except OSError as error:
            raise ConfigError(unreadable(path, error)) from None
        except (TypeError, AttributeError, *YAML_ERRORS) as error:
            raise ConfigError(f'{path}: not a camera calibration: {error}') from None
        T_camera_sensor = np.eye(4)
        T_camera_sensor[:3] = _part(path, values, 'pose', (12, 16))[:12].reshape(3, 4)
        size = _part(path, values, 'size', (2,), np.array(KITTI_SIZE))
        width, height = size.astype(int).tolist()
        return cls(
            _part(path, values, 'projection', (12,)).reshape(3, 4),
            _part(path, values, 'rectification', (9,), np.eye(3)).reshape(3, 3),
            T_camera_sensor,
            (width, height),
        )

    @property
    def T_rect_sensor(self) -> Floats:
        """Pose (4, 4) of the LiDAR in the rectified camera's frame."""
        T_rect_camera = np.eye(4)
        T_rect_camera[:3, :3] = self.rectification
        return T_rect_camera @ self.T_camera_sensor

    def project(self, boxes: Floats) -> tuple[Floats, Mask]:
        """
        Return the rectangles of boxes in the image.

        Parameters
        ----------
        boxes : array, shape (n, 9)
            In the frame of the LiDAR [m, rad].

        Returns
        -------
        rectangles : array, shape (n, 4)
            Left, top, right and bottom [px], clipped to the image; NaN for boxes outside of it.
        is_inside : array, shape (n,)
            Whether all of a box is in the image and in front of the camera.

        """
        T = self.T_rect_sensor
        P = self.projection
        R = matrix_from_rpy(boxes[:, ROLL:])
        # (n, corner, axis) in the box, then the LiDAR, then the rectified camera frame.
        corners = (CORNERS * boxes[:, None, BOX_EXTENT]) @ R.transpose(0, 2, 1)
        corners = (corners + boxes[:, None, BOX_CENTER]) @ T[:3, :3].T + T[:3, 3]
        is_in_front = corners[..., 2] >= NEAR_PLANE
        clipped, is_clipped = _clipped_edges(corners)
        vertices = np.concatenate([corners, clipped], axis=1)
        is_visible = np.concatenate([is_in_front, is_clipped], axis=1)[..., None]
        pixels = np.where(is_visible, vertices, [0.0, 0.0, 1.0]) @ P[:, :3].T + P[:, 3]
        pixels = pixels[..., :2] / pixels[..., 2:]
        low = np.where(is_visible, pixels, np.inf).min(axis=1)
        high = np.where(is_visible, pixels, -np.inf).max(axis=1)
        edge = np.array(self.size) - 1.0
        overlaps = ((high >= 0) & (low <= edge)).all(axis=1)
        is_inside = is_in_front.all(axis=1) & ((low >= 0) & (high <= edge)).all(axis=1)
        rectangles = np.hstack([np.maximum(low, 0), np.minimum(high, edge)])
        return np.where(overlaps[:, None], rectangles, np.nan), is_inside

    def to_upright(self, boxes: Floats) -> tuple[Floats, Floats]:
        """
        Return the pose of boxes as KITTI states it; roll and pitch are lost.

        Parameters
        ----------
        boxes : array, shape (n, 9)
            In the frame of the LiDAR [m, rad].

        Returns
        -------
        centres : array, shape (n, 3)
            Geometric centres in the frame of the rectified camera [m]. KITTI has that of the
            bottom.
        rotation_y : array, shape (n,)
            About y of the camera, from its x axis to the heading [rad].

        """
        T = self.T_rect_sensor
        centres = boxes[:, BOX_CENTER] @ T[:3, :3].T + T[:3, 3]
        R = matrix_from_rpy(boxes[:, ROLL:])
        headings = R[:, :, 0] @ T[:3, :3].T
        return centres, np.arctan2(-headings[:, 2], headings[:, 0])

    def from_upright(self, centres: Floats, rotation_y: Floats, extents: Floats) -> Floats:
        """
        Return boxes in the frame of the LiDAR; the inverse of `to_upright`.

        Parameters
        ----------
        centres : array, shape (n, 3)
            Geometric centres in the frame of the rectified camera [m].
        rotation_y : array, shape (n,)
            About y of the camera, from its x axis to the heading [rad].
        extents : array, shape (n, 3)
            Length, width and height [m].

        Returns
        -------
        boxes : array, shape (n, 9)
            Upright in the frame of the camera [m, rad].

        """
        cos = np.cos(rotation_y)
        sin = np.sin(rotation_y)
        zero = np.zeros(len(rotation_y))
        # Columns are the axes of the box: heading, left, and up, which is -y of the camera.
        rows = [[cos, sin, zero], [zero, zero, zero - 1], [-sin, cos, zero]]
        R_rect_box = np.array(rows).transpose(2, 0, 1)  # (n, row, column)
        T = inverse(self.T_rect_sensor)
        angles = rpy_from_matrix(T[:3, :3] @ R_rect_box)
        return np.hstack([centres @ T[:3, :3].T + T[:3, 3], extents, angles])


def _clipped_edges(corners: Floats) -> tuple[Floats, Mask]:
    """Return where the edges of boxes (n, 8, 3) cross the near plane (n, 12, 3), and which do."""
    a = corners[:, EDGES[:, 0]]
    b = corners[:, EDGES[:, 1]]
    crosses = (a[..., 2] >= NEAR_PLANE) != (b[..., 2] >= NEAR_PLANE)
    depth = np.where(crosses, b[..., 2] - a[..., 2], 1.0)
    return a + ((NEAR_PLANE - a[..., 2]) / depth)[..., None] * (b - a), crosses


def _part(
    path: Path,
    values: dict[str, Floats],
    name: str,
    sizes: tuple[int, ...],
    default: Floats | None = None,
) -> Floats:
    """Return the numbers of a part of a calibration, one of `KEYS`, checked for their count."""
    found = next((values[key] for key in KEYS[name] if key in values), default)
    if found is None or found.size not in sizes:
        count = 'none' if found is None else found.size
        raise ConfigError(
            f'{path}: expected {" or ".join(map(str, sizes))} numbers under one of '
            f'{", ".join(KEYS[name])}, got {count}'
        )
    return found


def _is_key(name: object) -> bool:
    return any(name in keys for keys in KEYS.values())


def _from_lines(text: str) -> dict[str, Floats]:
    """Return the numbers of each line by the name before them; some names lack their colon."""
    values = {}
    for line in text.splitlines():
        name, *numbers = line.replace(':', ' ').split()[:17] or ['']
        if _is_key(name):
            values[name] = np.array(numbers, np.float64)
    return values


def _from_yaml(text: str) -> dict[str, Floats]:
    content = yaml.safe_load(text)
    values = {}
    for name, value in content.items():
        if _is_key(name):
            numbers = value['data'] if isinstance(value, dict) else value
            values[name] = np.array(numbers, np.float64).ravel()
    if 'image_width' in content:
        values['image_size'] = np.array([content['image_width'], content['image_height']], float)
    return values
