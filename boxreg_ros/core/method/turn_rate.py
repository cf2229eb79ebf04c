"""
Constant turn rate and speed: prediction of one object, and its update by a registered pose.

The object turns about a point `pivot` behind its centre, where it has no sideways velocity.

"""

from typing import Any, NamedTuple

from boxreg_ros.core.method.compile import kernel
import numpy as np

STATE, YAW_STATE, SPEED_STATE, RATE_STATE = 6, 3, 4, 5
"""Variables of a state, and some of their places."""


class State(NamedTuple):
    """Values (6,) x y z yaw speed turn_rate [m, rad, m/s, rad/s], and their covariance (6, 6)."""

    values: Any
    covariance: Any

    @property
    def pose(self) -> Any:
        """Pose (4,) x y z yaw."""
        return self.values[:SPEED_STATE]

    @property
    def speed(self) -> float:
        """Speed along the heading [m/s]."""
        return float(self.values[SPEED_STATE])


@kernel
def predict(state, seconds, noise, pivot):
    """
    Return the state after some seconds, or before.

    `noise` are the densities of acceleration [m^2/s^3] and of angular acceleration [rad^2/s^3],
    and of slip sideways and upward [m^2/s] and turning [rad^2/s] that the motion does not explain.

    """
    values, F = state.values.copy(), np.eye(STATE)
    yaw, speed, rate = values[YAW_STATE:]
    turned, middle = yaw + rate * seconds, yaw + rate * seconds / 2
    chord = seconds * np.sinc(rate * seconds / (2 * np.pi))  # of a speed of 1 m/s
    c, s = chord * np.cos(middle), chord * np.sin(middle)
    dx = speed * c + pivot * (np.cos(turned) - np.cos(yaw))
    dy = speed * s + pivot * (np.sin(turned) - np.sin(yaw))
    values[0] += dx
    values[1] += dy
    values[YAW_STATE] = turned
    F[0, YAW_STATE], F[1, YAW_STATE] = -dy, dx
    F[0, SPEED_STATE], F[1, SPEED_STATE] = c, s
    # The chord changes with the turn rate by its second order only.
    F[0, RATE_STATE] = -seconds * (speed * s / 2 + pivot * np.sin(turned))
    F[1, RATE_STATE] = seconds * (speed * c / 2 + pivot * np.cos(turned))
    F[YAW_STATE, RATE_STATE] = seconds
    found = F @ state.covariance @ F.T
    t = abs(seconds)
    place, rate_of = np.zeros((3, STATE)), np.zeros((2, STATE))
    place[0, 0], place[0, 1] = np.cos(yaw), np.sin(yaw)
    place[1, YAW_STATE] = 1.0
    place[2, 0], place[2, 1] = -np.sin(yaw), np.cos(yaw)
    rate_of[0, SPEED_STATE] = rate_of[1, RATE_STATE] = np.sign(seconds)
    for k in range(2):  # white accelerations along the heading, and of it
        a, b = place[k], rate_of[k]
        both = np.outer(a, b) + np.outer(b, a)
        found += noise[k] * (np.outer(a, a) * t**3 / 3 + both * t**2 / 2 + np.outer(b, b) * t)
    found += noise[2] * t * np.outer(place[2], place[2])
    found[2, 2] += noise[3] * t
    found[YAW_STATE, YAW_STATE] += noise[4] * t
    return State(values, found)


@kernel
def pose_information(state):
    """Return the information (4, 4) about x y z yaw."""
    return np.linalg.inv(state.covariance[:SPEED_STATE, :SPEED_STATE].copy())


@kernel
def update(state, pose, covariance):
    """
    Return the state for the estimate `pose` (4,) of x y z yaw, its covariance (4, 4).

    The estimate includes the prior from `state`: it replaces the pose, and speed and turn rate
    follow by their regression on the pose.

    """
    of_pose = np.ascontiguousarray(state.covariance[:, :SPEED_STATE])
    gain = of_pose @ pose_information(state)  # (6, 4)
    step = pose - state.values[:SPEED_STATE]
    change = of_pose[:SPEED_STATE] - covariance
    found = state.covariance - gain @ change @ gain.T
    return State(state.values + gain @ step, (found + found.T) / 2)
