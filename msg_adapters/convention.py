"""Meaning of pose and size for topics that do not follow the definition of their type."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from itertools import permutations
from math import isfinite, pi

from boxreg_ros.errors import ConfigError
from boxreg_ros.options import option
from boxreg_ros.rotations import (
    matrix_from_rpy,
    quaternion_from_rpy,
    rpy_from_matrix,
    rpy_from_quaternion,
)
from boxreg_ros.structures import (
    BOX_CENTER,
    BOX_EXTENT,
    BoxArray,
    Floats,
    LENGTH,
    PITCH,
    ROLL,
    YAW,
)
import numpy as np
from numpy.typing import NDArray

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
"""Points of a box relative to its centre, in units of length, width and height."""
SIZE_ORDERS = tuple(''.join(order) for order in permutations('lwh'))
FORWARD = {'x+': 0.0, 'y+': pi / 2, 'x-': pi, 'y-': -pi / 2}
"""
Axis of the pose that points forward -> its angle about z from x [rad].

The sign follows the letter: YAML reads ``y`` as a boolean, a command line ``-y`` as an option.

"""

ORIENTATIONS = ('xyzw', 'wxyz', 'clockwise', 'left_handed')
"""
Meanings of the orientation of a pose.

As ROS defines it; a quaternion whose w comes first; a yaw that grows to the right; this, and a y
axis of the frame that points to the right, as in Unreal and CARLA.

"""
MIRRORED = np.array([1.0, 1, 1, 1, 1, 1, -1, 1, -1])
"""Signs of the columns of a box where y is mirrored, but for its position."""


@dataclass(frozen=True, slots=True)
class Convention:
    """Meaning of pose, size and stamp on one topic; ConfigError if a value is not one of those."""

    pose_reference: str = option(
        'center',
        f'point of the box at its pose: {", ".join(REFERENCES)}, or X,Y,Z as fractions of length, '
        f'width and height',
        metavar='POINT',
    )
    size_order: str = option(
        'lwh',
        'order of length, width and height in x, y and z of a size',
        choices=SIZE_ORDERS,
    )
    forward_axis: str = option(
        'x+',
        'axis of the box pose that points forward',
        choices=tuple(FORWARD),
    )
    orientation: str = option(
        'xyzw',
        'meaning of the orientation of a box: wxyz if w of its quaternion comes first, clockwise '
        'if yaw grows to the right, left_handed if y points to the right, too',
        choices=ORIENTATIONS,
    )
    size_scale: float = option(
        1.0,
        'full lengths per given size: 2 for half extents',
        metavar='FACTOR',
        parse=float,
        low=0.001,
        high=1000.0,
    )
    boxes_frame: str = option(
        '',
        'frame of the boxes, where their messages name another one; empty: theirs',
        metavar='FRAME',
    )
    associate: bool = option(
        False, 'replace the track ids of the input: associate boxes over time'
    )
    boxes_offset: float = option(
        0.0,
        'added to the stamps of the boxes, where their clock is behind that of the clouds',
        metavar='S',
        parse=float,
        unit='s',
        low=-1e10,
        high=1e10,
    )

    def __post_init__(self) -> None:
        """Check the values."""
        for item in fields(self):
            name, known = item.name, item.metadata['option'].choices
            if known and getattr(self, name) not in known:
                raise ConfigError(
                    f'{name}: expected one of {", ".join(known)}, got {getattr(self, name)!r}'
                )
        if not (isfinite(self.size_scale) and self.size_scale > 0):
            raise ConfigError(
                f'size_scale: expected a positive factor, got {self.size_scale}; half extents '
                f'have 2'
            )
        if not isfinite(self.boxes_offset):
            raise ConfigError(
                f'boxes_offset: expected seconds, got {self.boxes_offset}; leave it out for none'
            )
        _ = self.reference

    @property
    def is_standard(self) -> bool:
        """Return whether pose and size follow the definition of the message type."""
        return replace(self, associate=False) == STANDARD

    @property
    def reference(self) -> Floats:
        """Return the reference point (3,) relative to the centre, in units of the extents."""
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
        """
        Return boxes of this convention with the pose at their centre, as in `structures`.

        Parameters
        ----------
        boxes : BoxArray
            n boxes as an adapter reads them: the pose of the reference point, the axes and the
            sizes of the publisher.

        Returns
        -------
        boxes : BoxArray
            The centre, x forward, and the extents along x, y and z [m, rad], in `boxes_frame` if
            that is set. `boxes_offset` is added to a stamp above 0. Angles that are NaN stay so.

        """
        changed = self._rotated(self._oriented(boxes.boxes), FORWARD[self.forward_axis])
        changed[:, BOX_EXTENT] = boxes.boxes[:, self._columns] * self.size_scale
        changed[:, BOX_CENTER] -= self._offsets(changed)
        frame_id = self.boxes_frame or boxes.frame_id
        return self._stamped(replace(boxes, boxes=changed, frame_id=frame_id))

    def _stamped(self, boxes: BoxArray) -> BoxArray:
        """Return boxes with the stamp that theirs means; an array without a stamp has none."""
        if not self.boxes_offset or boxes.stamp_ns <= 0:
            return boxes
        return replace(boxes, stamp_ns=boxes.stamp_ns + round(self.boxes_offset * 1e9))

    def from_centers(self, boxes: BoxArray) -> BoxArray:
        """
        Return boxes with the pose at their centre in this convention.

        Parameters
        ----------
        boxes : BoxArray
            n boxes as of `to_centers` [m, rad].

        Returns
        -------
        boxes : BoxArray
            What an adapter writes: the pose of the reference point, axes and sizes of the
            publisher. Kinematics are those of the reference point. Frame and stamp are not
            changed.

        """
        changed = self._rotated(boxes.boxes, -FORWARD[self.forward_axis])
        changed[:, BOX_CENTER] += self._offsets(boxes.boxes)
        changed[:, self._columns] = boxes.boxes[:, BOX_EXTENT] / self.size_scale
        changed = self._oriented(changed, is_inverse=True)
        return replace(boxes, boxes=changed, kinematics=self._kinematics(boxes))

    def covariances_from_centers(self, boxes: BoxArray, covariances: Floats) -> Floats:
        """
        Return covariances of centre poses as those of this convention.

        Parameters
        ----------
        boxes : BoxArray
            The n boxes, as of `to_centers` [m, rad].
        covariances : array, shape (n, 6, 6)
            Of x y z roll pitch yaw of their centres [m, rad].

        Returns
        -------
        covariances : array, shape (n, 6, 6)
            Of the same of their reference points, in the axes of the publisher, to first order.

        """
        axes = _rotation_axes(boxes.boxes)
        angle = FORWARD[self.forward_axis]
        J = np.tile(np.eye(6), (len(axes), 1, 1))  # (n, 6, 6) d(output pose) / d(centre pose)
        J[:, :3, 3:] = np.cross(axes, self._offsets(boxes.boxes)[:, None]).swapaxes(1, 2)
        if angle:  # the same small rotation, expressed in the angles before and after
            rotated_axes = _rotation_axes(self._rotated(boxes.boxes, -angle))
            inverse = np.linalg.pinv(np.nan_to_num(rotated_axes))
            J[:, 3:, 3:] = (axes @ inverse).swapaxes(1, 2)
        if self._is_mirrored:
            J = (MIRRORED * self._y_sign)[[0, 1, 2, 6, 7, 8], None] * J
        return J @ covariances @ J.swapaxes(1, 2)

    def _kinematics(self, boxes: BoxArray) -> NDArray[np.void] | None:
        """Return the kinematics of the references of boxes, which turn about their centres."""
        if boxes.kinematics is None:
            return None
        found = boxes.kinematics.copy()
        offsets = np.nan_to_num(self._offsets(boxes.boxes))
        rates = found['velocity'][:, 3]
        J = np.tile(np.eye(4), (len(found), 1, 1))
        J[:, 0, 3], J[:, 1, 3] = -offsets[:, 1], offsets[:, 0]
        found['velocity'] = (J @ found['velocity'][..., None])[..., 0]
        found['velocity_covariance'] = J @ found['velocity_covariance'] @ J.swapaxes(1, 2)
        found['acceleration'][:, :2] -= rates[:, None] ** 2 * offsets[:, :2]
        if self._is_mirrored:
            signs = np.array([1.0, self._y_sign[1], 1.0, -1.0])  # x y z and the rate of yaw
            found['velocity'] *= signs
            found['velocity_covariance'] *= signs[:, None] * signs
            found['acceleration'] *= signs[:3]
            found['acceleration_covariance'] *= signs[:3, None] * signs[:3]
        return found

    @property
    def _is_mirrored(self) -> bool:
        return self.orientation in ('clockwise', 'left_handed')

    @property
    def _y_sign(self) -> Floats:
        """Return the signs (9,) of the columns of a box that the y axis of its frame has."""
        signs = np.ones(9)
        signs[1] = -1.0 if self.orientation == 'left_handed' else 1.0
        return signs

    def _oriented(self, boxes: Floats, is_inverse: bool = False) -> Floats:
        """Return boxes (n, 9) with the orientation that theirs means, or the inverse of it."""
        if self._is_mirrored:
            return np.asarray(boxes * MIRRORED * self._y_sign)
        if self.orientation == 'xyzw':
            return boxes
        changed = boxes.copy()
        has_angles = np.isfinite(boxes[:, ROLL:]).all(axis=1)
        order = [3, 0, 1, 2] if is_inverse else [1, 2, 3, 0]
        quaternions = quaternion_from_rpy(boxes[has_angles, ROLL:])[:, order]
        changed[has_angles, ROLL:] = rpy_from_quaternion(quaternions)
        return changed

    @property
    def _columns(self) -> list[int]:
        """Return the columns of length, width and height in a box of this convention."""
        return [LENGTH + self.size_order.index(name) for name in 'lwh']

    def _offsets(self, boxes: Floats) -> Floats:
        """Return the vectors (n, 3) from the centres of boxes (n, 9) to their references [m]."""
        offsets = self.reference * boxes[:, BOX_EXTENT]
        if not self.reference.any():
            return offsets
        has_angles = np.isfinite(boxes[:, ROLL:]).all(axis=1)
        R = matrix_from_rpy(boxes[has_angles, ROLL:])
        offsets[has_angles] = (R @ offsets[has_angles, :, None])[..., 0]
        return offsets

    @staticmethod
    def _rotated(boxes: Floats, angle: float) -> Floats:
        """Return a copy of boxes (n, 9), rotated about z of the box by `angle` [rad]."""
        changed = boxes.copy()
        if angle:
            R = matrix_from_rpy(boxes[:, ROLL:]) @ matrix_from_rpy([0.0, 0.0, angle])
            changed[:, ROLL:] = rpy_from_matrix(R)
        return changed


def _rotation_axes(boxes: Floats) -> Floats:
    """Return the rotation axes (n, 3, 3) of roll, pitch and yaw of boxes (n, 9), as rows."""
    yaw = boxes[:, YAW]
    pitch = boxes[:, PITCH]
    axes = np.zeros((len(boxes), 3, 3))  # (n, angle, axis)
    axes[:, 0] = np.stack([np.cos(yaw), np.sin(yaw), -np.tan(pitch)], 1)
    axes[:, 0] *= np.cos(pitch)[:, None]
    axes[:, 1, 0] = -np.sin(yaw)
    axes[:, 1, 1] = np.cos(yaw)
    axes[:, 2, 2] = 1.0
    return axes


STANDARD = Convention()
"""Pose and size as the message types define them."""
