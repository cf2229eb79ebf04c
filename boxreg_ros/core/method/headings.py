"""The heading sign of a window: detectors take the back of an object for its front."""

from math import cos, pi, sin

from boxreg_ros.core.method.compile import kernel
from boxreg_ros.core.method.selection import lower_median
import numpy as np

HEADING = 8
"""Place of the yaw in a box."""
MAX_REVERSE_SPEED = 6.0
"""A faster object moves forward [m/s]; chosen: no road vehicle reverses at 22 km/h."""
KNOWN_FLIP_SHARE = 0.75
"""
Share of contrary headings above which a known heading sign is changed; chosen.

Without a known sign the majority decides: a share of 0.5.

"""


@kernel
def unwrap_half_turns(yaw):
    """
    Move each angle (N,) by half turns to the trend of those before.

    A single heading that is off by a quarter turn does not affect those after it.

    """
    trend = yaw[0]
    for n in range(1, len(yaw)):
        change = (yaw[n] - trend + pi / 2) % pi - pi / 2
        yaw[n] = trend + change
        trend += change * 2 / 3  # an outlier of a quarter turn moves it by 60° only


@kernel
def forward_speed(boxes, times, yaw):
    """Return the median speed of the centres of boxes (n, 9) along `yaw` (n,) [m/s]."""
    along = np.zeros(len(boxes))
    for n in range(1, len(boxes)):
        dx, dy = boxes[n, 0] - boxes[n - 1, 0], boxes[n, 1] - boxes[n - 1, 1]
        along[n] = (dx * cos(yaw[n]) + dy * sin(yaw[n])) / (times[n] - times[n - 1])
    return lower_median(along)


@kernel
def is_reversed(boxes, times, known_yaw, yaw):
    """Return whether the headings `yaw` (n,) of boxes (n, 9) need the other sign."""
    speed = forward_speed(boxes, times, yaw)
    if abs(speed) > MAX_REVERSE_SPEED:
        return speed < 0
    contrary = 0
    for n in range(len(boxes)):
        contrary += cos(boxes[n, HEADING] - yaw[n]) < 0
    limit = KNOWN_FLIP_SHARE
    if known_yaw != known_yaw:
        limit = 0.5
    elif cos(known_yaw - yaw[0]) < 0:
        limit = 1 - KNOWN_FLIP_SHARE
    return contrary > limit * len(boxes)


@kernel
def resolve_headings(boxes, times, lengths, known_yaw, yaw):
    """
    Write unwrapped yaw angles with one heading sign per window, 180° flips corrected.

    The majority of a window decides on the sign; against a known sign, three quarters. An object
    faster than `MAX_REVERSE_SPEED` heads where it moves. Each angle is within a whole number of
    half turns of the input.

    Parameters
    ----------
    boxes, times : array, shapes (B, N, 9) and (B, N)
        Input boxes [m, rad], at increasing times [s].
    lengths : array, shape (B,)
        Observations of each window; the others are padding.
    known_yaw : array, shape (B,)
        Yaw of the first box as estimated before [rad]; NaN where unknown.
    yaw : array, shape (B, N)
        Written.

    """
    for b in range(len(boxes)):
        length = lengths[b]
        yaw[b] = boxes[b, :, HEADING]
        if boxes.shape[1] == 1:
            continue  # nothing contradicts a single heading
        unwrap_half_turns(yaw[b])
        if is_reversed(boxes[b, :length], times[b, :length], known_yaw[b], yaw[b, :length]):
            yaw[b] += pi
