"""Velocity (M26a) and acceleration (M26b) of the boxes of one window, and their covariances."""

from boxreg_ros.core.method.arrays import POSE, SHARED
from boxreg_ros.core.method.compile import loop, small_array
import numpy as np

RATES = (0, 1, 2, 5)
"""Variables of a pose whose rates are estimated: x y z and yaw."""
MIN_GAIN = 0.5
"""
Least part of the variance of an acceleration that the window must remove; chosen.

Measured: with less, final accelerations err by more than zero does.

"""


@loop
def fill_combination(first, factors, inverse, found):
    """
    Write the covariance (4, 4) of the sum of `factors` times three poses, from `first` on.

    Of their variables `RATES`.

    """
    beside, response = small_array(4, SHARED), small_array(4, SHARED)
    for i in range(len(found)):
        combine(first, factors, inverse.beside, RATES[i], beside[i])
        combine(first, factors, inverse.response, RATES[i], response[i])
    for i in range(len(found)):
        k = RATES[i]
        for j in range(i, len(found)):
            m = RATES[j]
            total = 0.0
            for s in range(inverse.response.shape[2]):
                total += beside[i, s] * response[j, s]
            for a in range(3):
                total += factors[a] ** 2 * inverse.poses[first + a, k, m]
                links = inverse.links[first + a]
                for b in range(a + 1, 3):
                    of_other = POSE * (b - a - 1)
                    both = links[k, of_other + m] + links[m, of_other + k]
                    total += factors[a] * factors[b] * both
            found[i, j] = found[j, i] = total


@loop
def combine(first, factors, values, k, row):
    """Write the sum of `factors` times the rows (S,) of variable `k` of three poses."""
    for s in range(values.shape[2]):
        row[s] = (
            factors[0] * values[first, k, s]
            + factors[1] * values[first + 1, k, s]
            + factors[2] * values[first + 2, k, s]
        )


@loop
def fill_kinematics(length, times, poses, deviations, inverse, found):
    """
    Write velocity and acceleration of the boxes of a window, (N,) records `KINEMATICS`.

    They are those of the three poses nearest to a box: the first and second difference of (M5).
    At the ends the velocity has changed since the middle of the three, by an acceleration whose
    covariance is that of (M26b). No box shows the acceleration of the newest: it is not known.

    Parameters
    ----------
    length : int
        Observations of the window; with less than three, nothing is known.
    times, poses : array, shapes (N,) and (N, 6)
        Of the observations [s], and their estimate [m, rad].
    deviations : array, shape (3,)
        Of accelerations forward, sideways and upward (M23) [m/s^2].
    inverse : Inverse
        The inverse curvature.
    found : array, shape (N,)
        Written.

    """
    of_change, of_rate, factors = small_array(4, 4), small_array(4, 4), small_array(3)
    prior = 0.0
    for i in range(3):
        prior += deviations[i] ** 2
    for n in range(length if length > 2 else 0):
        own = found[n]
        first = min(max(n - 1, 0), length - 3)
        last = first + 2
        is_new = n == 0 or 1 < n < length - 1  # or the three are those of the box before
        before, after = times[first + 1] - times[first], times[last] - times[first + 1]
        duration = before + after
        elapsed = times[n] - (times[first] + times[last]) / 2

        factors[0], factors[2] = 2 / (before * duration), 2 / (after * duration)
        factors[1] = -factors[0] - factors[2]
        if is_new:
            fill_combination(first, factors, inverse, of_change)
        for i in range(3):
            middle = poses[first + 1, i]
            own.acceleration[i] = factors[0] * (poses[first, i] - middle)
            own.acceleration[i] += factors[2] * (poses[last, i] - middle)
            for j in range(3):
                own.acceleration_covariance[i, j] = of_change[i, j]
        gain = 1 - (of_change[0, 0] + of_change[1, 1] + of_change[2, 2]) / prior

        factors[0], factors[1], factors[2] = -1 / duration, 0.0, 1 / duration
        if is_new:
            fill_combination(first, factors, inverse, of_rate)
        is_finite = True
        for i in range(4):
            rate = (poses[last, RATES[i]] - poses[first, RATES[i]]) / duration
            own.velocity[i] = rate
            for j in range(4):
                own.velocity_covariance[i, j] = of_rate[i, j] + elapsed**2 * of_change[i, j]
            is_finite &= np.isfinite(rate) and np.isfinite(own.velocity_covariance[i, i])
        own.has_velocity = is_finite
        own.has_acceleration = is_finite and gain >= MIN_GAIN and n < length - 1
