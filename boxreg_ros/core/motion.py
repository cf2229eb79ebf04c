"""Motion of an object at the first or last of its boxes: constant turn rate and velocity."""

from __future__ import annotations

from dataclasses import dataclass

from boxreg_ros.config import ClassConfig
from boxreg_ros.core.method.constants import CONSTANTS
from boxreg_ros.rotations import wrap_angle
from boxreg_ros.structures import Floats, Ints, X, Y, YAW, Z
import numpy as np

MOTION_SECONDS = 1.0
"""The motion is estimated from the boxes within this time of the end [s]; chosen."""
CENTRE_DEVIATION = 0.1
"""
Standard deviation of a registered centre [m].

Measured: the error of the centre is 0.07 to 0.13 m on the recordings of the results.

"""
UNKNOWN_SPEED_DEVIATION = 8.0
"""Standard deviation of the speed of an object with one box [m/s]; chosen: urban traffic."""
TURN_RATE = 0.5
"""Standard deviation of an unknown turn rate [rad/s]; chosen: a bend of 20 m at 10 m/s."""


@dataclass(frozen=True, slots=True)
class EndMotion:
    """Motion at the first or last box of a track."""

    stamp_ns: int
    """Of that box [ns]."""
    box: Floats
    """That box, (9,)."""
    velocity: Floats
    """(3,), of the centre [m/s]."""
    turn_rate: float
    """Of the heading [rad/s]."""
    speed_variance: float
    """Of each component of the velocity [m^2/s^2]."""
    model: ClassConfig
    """Accelerations of its kind of object."""

    def predict(self, stamp_ns: int) -> Floats:
        """
        Return the box at a stamp, on a circle at constant speed.

        Parameters
        ----------
        stamp_ns : int
            Before or after that of `box` [ns].

        Returns
        -------
        box : array, shape (9,)
            With the extents, roll and pitch of `box` [m, rad]; yaw in [-pi, pi).

        """
        seconds = (stamp_ns - self.stamp_ns) * 1e-9
        half_turn = self.turn_rate * seconds / 2
        chord = self.velocity * seconds
        if half_turn:
            chord[:2] *= np.sin(half_turn) / half_turn
        cos = np.cos(half_turn)
        sin = np.sin(half_turn)
        box = self.box.copy()
        box[X] += cos * chord[0] - sin * chord[1]
        box[Y] += sin * chord[0] + cos * chord[1]
        box[Z] += chord[2]
        box[YAW] = wrap_angle(box[YAW] + 2 * half_turn)
        return box

    def covariance(self, stamp_ns: int) -> Floats:
        """
        Return the covariance of x and y of the prediction, shape (2, 2) [m^2].

        With an acceleration a, the object is a t^2 / 2 off the prediction: a is the usual one
        along the heading, and the speed times `TURN_RATE` across it, but no more than usual.

        """
        seconds = (stamp_ns - self.stamp_ns) * 1e-9
        speed = float(np.linalg.norm(self.velocity[:2]))
        across = min(self.model.cornering, speed * TURN_RATE)
        deviations = np.array([self.model.acceleration, across]) * seconds**2 / 2
        variances = deviations**2 + self.speed_variance * seconds**2 + CENTRE_DEVIATION**2
        cos = np.cos(self.box[YAW])
        sin = np.sin(self.box[YAW])
        R = np.array([[cos, -sin], [sin, cos]])
        return np.asarray((R * variances) @ R.T)


def motion_at(stamps_ns: Ints, boxes: Floats, row: int, model: ClassConfig) -> EndMotion:
    """
    Return the motion at the first or last of the boxes of one object.

    Parameters
    ----------
    stamps_ns : array, shape (n,)
        Ascending [ns].
    boxes : array, shape (n, 9)
        Finite boxes in the fixed frame [m, rad]; their headings may be flipped.
    row : int
        0 for the first, -1 for the last.
    model : ClassConfig
        Of the kind of object; returned with the motion.

    Returns
    -------
    motion : EndMotion
        By the boxes within `MOTION_SECONDS`; of a single one the velocity is 0, with the deviation
        `UNKNOWN_SPEED_DEVIATION`. A slow object, or one of three boxes or fewer, does not turn.

    """
    seconds = (stamps_ns - stamps_ns[row]) * 1e-9
    is_near = np.abs(seconds) <= MOTION_SECONDS
    seconds = seconds[is_near]
    near = boxes[is_near]
    box = boxes[row].copy()
    stamp_ns = int(stamps_ns[row])
    if len(near) < 2:
        return EndMotion(stamp_ns, box, np.zeros(3), 0.0, UNKNOWN_SPEED_DEVIATION**2, model)
    offsets = seconds - seconds.mean()
    spread = np.square(offsets).sum()
    velocity = offsets @ near[:, X : Z + 1] / spread
    turn_rate = 0.0
    if np.linalg.norm(velocity[:2]) > CONSTANTS.driving_speed and len(near) > 3:
        turn_rate = float(offsets @ unflipped(near[:, YAW]) / spread)
        # The slope is the velocity in the middle of the boxes; its direction turns up to the end.
        turn = -turn_rate * seconds.mean()
        velocity[:2] = velocity[:2] @ [[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]]
    variance = CENTRE_DEVIATION**2 / spread
    return EndMotion(stamp_ns, box, velocity, turn_rate, float(variance), model)


def unflipped(yaws: Floats) -> Floats:
    """Return headings (n,) along a track, continuous, without half turns between boxes [rad]."""
    return np.asarray(np.unwrap(yaws, period=np.pi))
