"""What pose and size of a box mean where a topic does not follow its type's own definition."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import permutations
from math import pi

from boxreg_ros.errors import ConfigError
from boxreg_ros.rotations import matrix_from_rpy, rpy_from_matrix
from boxreg_ros.structures import BoxArray, Floats, HEIGHT, LENGTH, ROLL, X, YAW, Z
import numpy as np

REFERENCES = {
    'center': (0.0, 0.0, 0.0),
    'bottom': (0.0, 0.0, -0.5),
    'top': (0.0, 0.0, 0.5),
    'front': (0.5, 0.0, 0.0),
    'rear': (-0.5, 0.0, 0.0),
    'front_bottom': (0.5, 0.0, -0.5),
    'rear_bottom': (-0.5, 0.0, -0.5),
    'rear_axle': (-0.3, 0.0, 0.0),
    'rear_axle_bottom': (-0.3, 0.0, -0.5),
}
"""Points of a box, from its centre in parts of length, width and height; axles are typical."""
SIZE_ORDERS = tuple(''.join(order) for order in permutations('lwh'))
FORWARD = {'x+': 0.0, 'y+': pi / 2, 'x-': pi, 'y-': -pi / 2}
"""
The axis of a pose that points forward, and how far about z it is from x [rad].

Spelt so that neither YAML takes one for a boolean nor a command line for an option.

"""


@dataclass(frozen=True, slots=True)
class Convention:
    """
    How the boxes of one topic are to be read.

    Attributes
    ----------
    pose_reference : str
        The point of the box that the pose is at, one of `REFERENCES`, or three numbers
        ``'-0.28,0,-0.5'``: from the centre, in parts of length, width and height.
    size_order : str
        What the size's x, y and z are: ``'lwh'`` length, width, height.
    forward_axis : str
        The axis of the pose that points forward, one of `FORWARD`.
    associate : bool
        Whether the boxes are given ids by association, whatever ids they come with.

    Raises
    ------
    ConfigError
        If a value is none of these.

    """

    pose_reference: str = 'center'
    size_order: str = 'lwh'
    forward_axis: str = 'x+'
    associate: bool = False

    def __post_init__(self) -> None:
        """Check the values."""
        for name, known in (('size_order', SIZE_ORDERS), ('forward_axis', tuple(FORWARD))):
            if getattr(self, name) not in known:
                raise ConfigError(
                    f'{name}: expected one of {", ".join(known)}, got {getattr(self, name)!r}'
                )
        _ = self.reference

    @property
    def is_standard(self) -> bool:
        """Tell whether pose and size mean what the message type says."""
        return replace(self, associate=False) == STANDARD

    @property
    def reference(self) -> Floats:
        """Return the point (3,) the pose is at, from the centre in parts of the extents."""
        known = REFERENCES.get(self.pose_reference)
        try:
            parts = known or tuple(float(part) for part in self.pose_reference.split(','))
        except ValueError:
            parts = ()
        if len(parts) != 3 or not np.isfinite(parts).all():
            raise ConfigError(
                f'pose_reference: expected one of {", ".join(REFERENCES)}, or three numbers as in '
                f"'-0.28,0,-0.5', got {self.pose_reference!r}"
            )
        return np.array(parts)

    def to_centers(self, boxes: BoxArray) -> BoxArray:
        """Return boxes read from messages of this convention as the core has them."""
        changed = self._turned(boxes.boxes, FORWARD[self.forward_axis])
        changed[:, LENGTH : HEIGHT + 1] = boxes.boxes[:, self._columns]
        changed[:, X : Z + 1] -= self._offsets(changed)
        return replace(boxes, boxes=changed)

    def from_centers(self, boxes: BoxArray) -> BoxArray:
        """Return boxes of the core as messages of this convention have them."""
        changed = self._turned(boxes.boxes, -FORWARD[self.forward_axis])
        changed[:, X : Z + 1] += self._offsets(boxes.boxes)
        changed[:, self._columns] = boxes.boxes[:, LENGTH : HEIGHT + 1]
        return replace(boxes, boxes=changed)

    def covariances_from_centers(self, boxes: BoxArray, covariances: Floats) -> Floats:
        """Return covariances (n, 6, 6) of the poses as messages of this convention have them."""
        axes, angle = _axes(boxes.boxes), FORWARD[self.forward_axis]
        J = np.tile(np.eye(6), (len(axes), 1, 1))
        J[:, :3, 3:] = np.cross(axes, self._offsets(boxes.boxes)[:, None]).swapaxes(1, 2)
        if angle:  # one small turn, by the angles of either
            after = np.linalg.pinv(np.nan_to_num(_axes(self._turned(boxes.boxes, -angle))))
            J[:, 3:, 3:] = (axes @ after).swapaxes(1, 2)
        return J @ covariances @ J.swapaxes(1, 2)

    @property
    def _columns(self) -> list[int]:
        """Return where, among the columns of a box, length, width and height are found."""
        return [LENGTH + self.size_order.index(name) for name in 'lwh']

    def _offsets(self, boxes: Floats) -> Floats:
        """Return, for each box (n, 9), the way from its centre to the reference (n, 3) [m]."""
        offsets = self.reference * boxes[:, LENGTH : HEIGHT + 1]
        if not self.reference.any():
            return offsets
        known = np.isfinite(boxes[:, ROLL:]).all(axis=1)
        R = matrix_from_rpy(boxes[known, ROLL:])
        offsets[known] = (R @ offsets[known, :, None])[..., 0]
        return offsets

    @staticmethod
    def _turned(boxes: Floats, angle: float) -> Floats:
        """Return a copy of boxes (n, 9), turned about their own z by `angle`."""
        changed = boxes.copy()
        if angle:
            turned = matrix_from_rpy(boxes[:, ROLL:]) @ matrix_from_rpy([0.0, 0.0, angle])
            changed[:, ROLL:] = rpy_from_matrix(turned)
        return changed


def _axes(boxes: Floats) -> Floats:
    """Return what roll, pitch and yaw of boxes (n, 9) turn about, a row of (n, 3, 3) for each."""
    yaw, pitch = boxes[:, YAW], boxes[:, ROLL + 1]
    axes = np.zeros((len(boxes), 3, 3))
    axes[:, 0] = np.stack([np.cos(yaw), np.sin(yaw), -np.tan(pitch)], 1)
    axes[:, 0] *= np.cos(pitch)[:, None]
    axes[:, 1, 0], axes[:, 1, 1], axes[:, 2, 2] = -np.sin(yaw), np.cos(yaw), 1.0
    return axes


STANDARD = Convention()
"""Pose and size as the message types say."""
