"""The heading sign of a window: detectors take the back of an object for its front."""

from math import cos, pi, sin

from boxreg_ros.core.method.arrays import copy, POSE
from boxreg_ros.core.method.compile import kernel, loop
from boxreg_ros.core.method.selection import lower_median
import numpy as np

ANGLES = (6, 7, 8)
"""Places of roll, pitch and yaw in a box."""
HEADING = 8
"""Place of the yaw in a box."""
MAX_REVERSE_SPEED = 6.0
"""A faster object moves forward [m/s]; chosen: no road vehicle reverses at 22 km/h."""
KNOWN_FLIP_SHARE = 0.75
"""
Share of contrary headings above which a known heading sign is changed; chosen.

Without a known sign the majority decides: a share of 0.5.

"""


@loop
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
    along = np.empty(len(boxes))
    along[0] = 0.0
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
        copy(boxes[b, :, HEADING], yaw[b])
        if boxes.shape[1] == 1:
            continue  # nothing contradicts a single heading
        unwrap_half_turns(yaw[b])
        if is_reversed(boxes[b, :length], times[b, :length], known_yaw[b], yaw[b, :length]):
            for n in range(yaw.shape[1]):
                yaw[b, n] += pi


@kernel
def correct_flips(boxes, times, lengths, pinned, known_yaw):
    """
    Correct 180° flips of the angles of boxes, as `resolve_headings`.

    The majority of the pinned boxes, `pinned` (B, N), decides on the heading sign of their window.

    """
    yaw = np.empty(times.shape)
    resolve_headings(boxes, times, lengths, known_yaw, yaw)
    for b in range(len(boxes)):
        contrary = 0  # pinned boxes that are, less those that are not
        for n in range(boxes.shape[1]):
            if pinned[b, n]:
                contrary += 1 if cos(yaw[b, n] - boxes[b, n, HEADING]) < 0 else -1
        for n in range(boxes.shape[1]):
            box = boxes[b, n]
            angle = yaw[b, n] + (pi if contrary > 0 else 0.0)
            # A half turn about the z axis of the box changes the signs of roll and pitch.
            sign = 1.0 if cos(angle - box[HEADING]) >= 0 else -1.0
            for k in ANGLES[:2]:
                box[k] = (sign * box[k] + pi) % (2 * pi) - pi
            box[HEADING] = angle


@loop
def align(boxes, start, state, minimum, information):
    """
    Move the angles of starts and priors by whole turns to those of the boxes (B, N, 9).

    Yaw, and the angles of priors, by half turns: a kept box is returned with the heading of its
    input. A prior that an odd number of them is needed for holds for the other heading sign.

    Parameters
    ----------
    boxes, start : array, shape (B, N, 9)
        Input boxes, and where the search starts, which is written [m, rad].
    state, minimum, information : array, shapes (B, 29), (B, 29) and (B, 29, 29)
        Linearisation point of each prior, NaN without one, and its minimum, which is written, as
        is the information: 0 of one that does not hold.

    """
    for b in range(len(boxes)):
        for n in range(boxes.shape[1]):
            for k in ANGLES:
                period = pi if k == HEADING else 2 * pi
                start[b, n, k] += period * np.rint((boxes[b, n, k] - start[b, n, k]) / period)
        is_contrary = False
        for pose in range(2):
            for k in range(3):
                j = POSE * pose + 3 + k
                angle = start[b, pose % start.shape[1], ANGLES[k]]
                half_turns = np.rint((angle - state[b, j]) / pi)
                minimum[b, j] += pi * half_turns
                is_contrary |= half_turns % 2 != 0
        if is_contrary:
            information[b] = 0.0
        if state[b, 0] != state[b, 0]:
            minimum[b] = 0.0
