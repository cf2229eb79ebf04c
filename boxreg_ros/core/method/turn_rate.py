"""
Constant turn rate and speed: prediction of one object, and its update by a registered pose.

The object turns about a point `pivot` behind its centre, where it has no sideways velocity.

"""

from typing import Any, NamedTuple

from boxreg_ros.core.method.arrowhead import invert
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
def propagated(F, covariance):
    """
    Return F C F' (n, n) for a matrix F (n, m) and a covariance C (m, m).

    Products by BLAS, outer products and inverses by LAPACK take numba seconds to compile.

    """
    n, m = F.shape
    rows, found = np.zeros((n, m)), np.zeros((n, n))
    for i in range(n):
        for k in range(m):
            for j in range(m):
                rows[i, j] += F[i, k] * covariance[k, j]
        for j in range(n):
            for k in range(m):
                found[i, j] += rows[i, k] * F[j, k]
    return found


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
    half = rate * seconds / 2
    chord = seconds if half == 0 else seconds * np.sin(half) / half  # of a speed of 1 m/s
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
    found = propagated(F, state.covariance)
    t = abs(seconds)
    place, rate_of = np.zeros((3, STATE)), np.zeros((2, STATE))
    place[0, 0], place[0, 1] = np.cos(yaw), np.sin(yaw)
    place[1, YAW_STATE] = 1.0
    place[2, 0], place[2, 1] = -np.sin(yaw), np.cos(yaw)
    rate_of[0, SPEED_STATE] = rate_of[1, RATE_STATE] = np.sign(seconds)
    for i in range(STATE):
        for j in range(STATE):
            for k in range(2):  # white accelerations along the heading, and of it
                a, b = place[k], rate_of[k]
                both = a[i] * b[j] + b[i] * a[j]
                found[i, j] += noise[k] * (
                    a[i] * a[j] * t**3 / 3 + both * t**2 / 2 + b[i] * b[j] * t
                )
            found[i, j] += noise[2] * t * place[2, i] * place[2, j]
    found[2, 2] += noise[3] * t
    found[YAW_STATE, YAW_STATE] += noise[4] * t
    return State(values, found)


@kernel
def pose_information(state):
    """Return the information (4, 4) about x y z yaw."""
    information = state.covariance[:SPEED_STATE, :SPEED_STATE].copy()
    invert(information)
    return information


@kernel
def update(state, pose, covariance):
    """
    Return the state for the estimate `pose` (4,) of x y z yaw, its covariance (4, 4).

    The estimate includes the prior from `state`: it replaces the pose, and speed and turn rate
    follow by their regression on the pose.

    """
    information = pose_information(state)
    gain, change = np.zeros((STATE, SPEED_STATE)), np.empty((SPEED_STATE, SPEED_STATE))
    values = state.values.copy()
    for i in range(STATE):
        for j in range(SPEED_STATE):
            for k in range(SPEED_STATE):
                gain[i, j] += state.covariance[i, k] * information[k, j]
            values[i] += gain[i, j] * (pose[j] - state.values[j])
    for i in range(SPEED_STATE):
        for j in range(SPEED_STATE):
            change[i, j] = state.covariance[i, j] - covariance[i, j]
    found, explained = np.empty((STATE, STATE)), propagated(gain, change)
    for i in range(STATE):
        for j in range(STATE):
            both = state.covariance[i, j] + state.covariance[j, i]
            found[i, j] = (both - explained[i, j] - explained[j, i]) / 2
    return State(values, found)
