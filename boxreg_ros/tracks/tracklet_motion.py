"""Motion of an object along a tracklet: at its ends, and between two of its boxes."""

from __future__ import annotations

from boxreg_ros.config import Config
from boxreg_ros.core.motion import EndMotion, motion_at, UNKNOWN_SPEED_DEVIATION
from boxreg_ros.rotations import wrap_angle
from boxreg_ros.structures import BOX_CENTER, Floats, Ints, PITCH, ROLL, X, Y, YAW
from boxreg_ros.tracks.tracklet import Tracklet
import numpy as np

PARKED_RADIUS = 0.5
"""A parked object stays within this distance of its median position [m]; chosen: 5 deviations."""


def end_motion(tracklet: Tracklet, is_last: bool, config: Config) -> EndMotion:
    """Return the motion at the last or the first box of a tracklet, from a fit of lines."""
    row = -1 if is_last else 0
    return motion_at(tracklet.stamps_ns, tracklet.boxes, row, tracklet.model(config))


def is_parked(boxes: Floats) -> bool:
    """Return whether boxes (n, 9) of one object stand at one place."""
    offsets = boxes[:, X : Y + 1] - np.median(boxes[:, X : Y + 1], axis=0)
    return bool((np.linalg.norm(offsets, axis=1) < PARKED_RADIUS).all())


def between(before: EndMotion, after: EndMotion, stamps_ns: Ints) -> Floats:
    """
    Return the boxes (n, 9) of an object at stamps between two of its boxes.

    The centre follows the cubic Hermite curve of positions and velocities at both ends. Heading
    and extents are interpolated linearly; a half turn is no rotation of the object.

    """
    duration_ns = after.stamp_ns - before.stamp_ns
    s = ((stamps_ns - before.stamp_ns) / duration_ns)[:, None]
    seconds = duration_ns * 1e-9
    chord = (after.box - before.box)[BOX_CENTER] / seconds
    ends = [_velocity_or(motion, chord) * seconds for motion in (before, after)]
    boxes = (1 - s) * before.box + s * after.box
    boxes[:, BOX_CENTER] = (
        (1 + 2 * s) * (1 - s) ** 2 * before.box[BOX_CENTER]
        + s * (1 - s) ** 2 * ends[0]
        + s**2 * (3 - 2 * s) * after.box[BOX_CENTER]
        - s**2 * (1 - s) * ends[1]
    )
    turn = wrap_angle(2 * (after.box[YAW] - before.box[YAW])) / 2
    boxes[:, YAW] = wrap_angle(before.box[YAW] + s[:, 0] * turn)
    for angle in (ROLL, PITCH):
        boxes[:, angle] = before.box[angle]
    return np.asarray(boxes)


def _velocity_or(motion: EndMotion, chord: Floats) -> Floats:
    """Return the velocity at an end; that of the chord where only one box is known."""
    return chord if motion.speed_variance >= UNKNOWN_SPEED_DEVIATION**2 else motion.velocity
