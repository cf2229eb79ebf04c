"""
Constant turn rate and speed: prediction of one object, and its update by a registered pose.

A state is x y yaw speed turn_rate [m, rad, m/s, rad/s]; the object turns about a point `pivot`
behind its centre, where it has no sideways velocity.

"""

from boxreg_ros.core.method.compile import kernel
import numpy as np

STATE = 5
PLANAR = ((0, 0), (1, 1), (2, 3))
"""Columns of x y yaw in a state, and in a pose x y z yaw."""
STEP = 1e-5
"""Step of the numerical derivative of the motion [m, rad, ...]; derived: float64 rounding."""


@kernel
def moved(state, dt, pivot):
    """Return a state (5,) after `dt` seconds."""
    x, y, yaw, speed, rate = state
    turned = yaw + rate * dt
    chord = speed * dt * np.sinc(rate * dt / (2 * np.pi))
    middle = yaw + rate * dt / 2
    out = state.copy()
    out[0] = x + chord * np.cos(middle) + pivot * (np.cos(turned) - np.cos(yaw))
    out[1] = y + chord * np.sin(middle) + pivot * (np.sin(turned) - np.sin(yaw))
    out[2] = turned
    return out


@kernel
def predict(state, covariance, z_variance, dt, noise, climb, pivot):
    """
    Return state (5,), covariance (5, 5) and the variance of z after `dt` seconds, or before.

    And the information (4, 4) of x y z yaw. `noise` are the densities of acceleration [m^2/s^3],
    of angular acceleration [rad^2/s^3], and of sideways slip [m^2/s] and turning [rad^2/s] that
    the motion does not explain, `climb` that of z [m^2/s].

    """
    F = np.empty((STATE, STATE))
    for k in range(STATE):
        up, down = state.copy(), state.copy()
        up[k] += STEP
        down[k] -= STEP
        F[:, k] = (moved(up, dt, pivot) - moved(down, dt, pivot)) / (2 * STEP)
    out = F @ covariance @ F.T
    t = abs(dt)
    c, s = np.cos(state[2]), np.sin(state[2])
    along = noise[0] * t**3 / 3 + 1e-6
    across = noise[2] * t + 1e-6
    out[0, 0] += along * c * c + across * s * s
    out[1, 1] += along * s * s + across * c * c
    out[0, 1] += (along - across) * c * s
    out[1, 0] += (along - across) * c * s
    sign = np.sign(dt)
    for k, part in ((0, c), (1, s)):
        out[k, 3] += sign * noise[0] * t**2 / 2 * part
        out[3, k] += sign * noise[0] * t**2 / 2 * part
    out[3, 3] += noise[0] * t
    out[2, 2] += noise[1] * t**3 / 3 + noise[3] * t
    out[2, 4] += sign * noise[1] * t**2 / 2
    out[4, 2] += sign * noise[1] * t**2 / 2
    out[4, 4] += noise[1] * t
    z_variance += climb * t
    return moved(state, dt, pivot), out, z_variance, pose_information(out, z_variance)


@kernel
def pose_information(covariance, z_variance):
    """Return the information (4, 4) of x y z yaw, by the covariance of a state and of z."""
    full = np.zeros((4, 4))
    full[2, 2] = 1 / z_variance
    planar = np.linalg.inv(covariance[:3, :3].copy())
    for i, a in PLANAR:
        for j, b in PLANAR:
            full[a, b] = planar[i, j]
    return full


@kernel
def update(state, covariance, pose, pose_covariance):
    """
    Return state and covariance for the estimate `pose` (4,) of x y z yaw, its covariance (4, 4).

    The estimate includes the prior from `state`: it replaces the pose, and speed and turn rate
    follow by their regression on the pose.

    """
    gain = np.ascontiguousarray(covariance[:, :3]) @ np.linalg.inv(
        covariance[:3, :3].copy()
    )  # (5, 3)
    step, change = np.empty(3), np.empty((3, 3))
    for i, a in PLANAR:
        step[i] = pose[a] - state[i]
        for j, b in PLANAR:
            change[i, j] = covariance[i, j] - pose_covariance[a, b]
    out = state + gain @ step
    found = covariance - gain @ change @ gain.T
    return out, (found + found.T) / 2
