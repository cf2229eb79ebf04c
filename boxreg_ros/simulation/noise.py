"""Errors of simulated boxes: those of a published detector, and those of the paper's Table I."""

from __future__ import annotations

from collections.abc import Callable

from boxreg_ros.rotations import matrix_from_rpy
from boxreg_ros.structures import Floats, LENGTH, ROLL, YAW
import numpy as np

# Standard deviations of a published detector, measured on its detections: along, across, up [m],
# yaw [rad], length, width, height [m].
TRACK_DEVIATION = np.array([0.101, 0.040, 0.047, 0.0166, 0.217, 0.083, 0.071])  # per track
BOX_DEVIATION = np.array([0.139, 0.068, 0.059, 0.0319, 0.176, 0.030, 0.052])  # within a track
CORRELATION = np.array([0.70, 0.53, 0.71, 0.50, 0.77, 0.94, 0.84])  # of the latter, after 0.1 s
DEGREES_OF_FREEDOM = 4  # of Student's t distribution, heavy-tailed
LENGTH_COUPLING = 0.57  # correlation of the centre along the heading with the length
FLIP_PROBABILITY = 0.024
FULL_SIZE = 4.0  # errors of the centre shrink in proportion for objects shorter than this [m]
MAX_EXTENT_ERROR = 0.4  # as part of the extent

# Table I of the paper: mean absolute errors of x y z roll pitch yaw [m, rad].
TABLE_ONE = np.array([0.392, 0.124, 0.082, 0.083, 0.1, 0.18])

Noise = Callable[[Floats, Floats, np.random.Generator], Floats]
"""Noisy boxes (n, 9) from true boxes (n, 9) of one track and sensor origins (n, 3)."""


def detector_noise(boxes: Floats, origins: Floats, rng: np.random.Generator) -> Floats:
    """
    Return the boxes of one track as a detector reports them.

    An error is a constant of the track plus an autoregressive, heavy-tailed part. The end that
    faces the sensor is the most accurate: a wrong length moves the other end. Some boxes are
    flipped.

    Parameters
    ----------
    boxes : array, shape (n, 9)
        True ones of each sweep, in the fixed frame [m, rad]; at least one.
    origins : array, shape (n, 3)
        Positions of the sensor in the same frame [m].
    rng : numpy.random.Generator
        Source of all random numbers.

    Returns
    -------
    noisy : array, shape (n, 9)
        In the same frame; yaw is not wrapped.

    """
    errors = _detector_errors(len(boxes), rng)
    errors[:, :3] *= min(1.0, boxes[0, LENGTH] / FULL_SIZE)
    extent = boxes[:, LENGTH:ROLL]
    extent_errors = np.clip(errors[:, 4:], -MAX_EXTENT_ERROR * extent, MAX_EXTENT_ERROR * extent)
    R = matrix_from_rpy(boxes[:, ROLL:])
    forward = R[:, :, 0]
    # Position of the sensor along the heading, in lengths: negative behind the object.
    toward = ((origins - boxes[:, :3]) * forward).sum(axis=1) / boxes[:, LENGTH]
    slope = LENGTH_COUPLING * BOX_DEVIATION[0] / BOX_DEVIATION[4]
    shift = errors[:, :3].copy()
    shift[:, 0] *= np.sqrt(1 - LENGTH_COUPLING**2)
    shift[:, 0] -= slope * np.clip(toward, -1, 1) * extent_errors[:, 0]
    is_flipped = rng.random(len(boxes)) < FLIP_PROBABILITY
    noisy = boxes.copy()
    noisy[:, :3] += (R @ shift[..., None])[..., 0]
    noisy[:, LENGTH:ROLL] += extent_errors
    noisy[:, YAW] += errors[:, 3] + np.pi * is_flipped
    return noisy


def _detector_errors(n: int, rng: np.random.Generator) -> Floats:
    """Return correlated errors (n, 7): along, across, up, yaw, length, width, height."""
    errors = np.empty((n, 7))
    state = rng.standard_t(DEGREES_OF_FREEDOM, 7)
    for i in range(n):
        innovation = rng.standard_t(DEGREES_OF_FREEDOM, 7)
        state = CORRELATION * state + np.sqrt(1 - CORRELATION**2) * innovation
        errors[i] = state
    variance = DEGREES_OF_FREEDOM / (DEGREES_OF_FREEDOM - 2)
    errors *= BOX_DEVIATION / np.sqrt(variance)
    errors += rng.normal(size=7) * TRACK_DEVIATION
    return errors


def table_one_noise(is_flat: bool) -> Noise:
    """Return normal noise with the errors of Table I; `is_flat` leaves z, roll and pitch exact."""
    free = np.array([1, 1, 0, 0, 0, 1]) if is_flat else np.ones(6, np.int64)

    def noise(boxes: Floats, _: Floats, rng: np.random.Generator) -> Floats:
        mean_to_deviation = np.sqrt(np.pi / 2)
        errors = rng.normal(size=(len(boxes), 6)) * TABLE_ONE * mean_to_deviation * free
        noisy = boxes.copy()
        noisy[:, :3] += (matrix_from_rpy(boxes[:, ROLL:]) @ errors[:, :3, None])[..., 0]
        noisy[:, ROLL:] += errors[:, 3:]
        return noisy

    return noise
