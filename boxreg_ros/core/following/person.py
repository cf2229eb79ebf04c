"""
The boxes of a person: how far they are from the object, and what the points say of that.

Keyframes are solved with the deviations `DEVIATIONS`. Where those of a drive show larger ones,
they are solved with these; where they show smaller ones, the solution moves toward them.

"""

from __future__ import annotations

from boxreg_ros.core.method.arrays import BOX_POSE
from boxreg_ros.core.method.constants import CONSTANTS, Constants
from boxreg_ros.core.method.follow_numbers import FOLLOW
from boxreg_ros.core.method.noise import LEAST_RATIO, MAD_TO_DEVIATION
from boxreg_ros.rotations import wrap_angle
from boxreg_ros.structures import Floats, Ints, LENGTH, on_lines, ROLL
import numpy as np

POSITION, ANGLE = 0.03, np.radians(1.0)
"""Deviations of a box that a person has drawn: centre and extents [m], angles [rad]. Measured."""
DEVIATIONS = np.repeat([POSITION, POSITION, ANGLE], 3)
"""Of the columns of a box [m, rad]."""
LARGEST_PART = 0.9
"""Most that a fit has of the variance of its keyframe; chosen: the rest is that of the others."""
GROUPS = (([0, 1, 2],) * 2, ([3, 4, 5],) * 2, ([8], [6, 7, 8]))
"""Columns of a box that show one deviation, and those it is of: position, extents, angles."""


def numbers(deviations: Floats) -> Constants:
    """
    Return the numbers of the method for keyframes of some deviations (9,).

    The boxes between them follow the points, and agree with the fit for this alone: they are no
    low-noise input.

    """
    of_pins = tuple(deviations[[*BOX_POSE, LENGTH]].tolist())
    return CONSTANTS._replace(pin_deviations=of_pins, low_noise=LEAST_RATIO)


def shown(keyframes: Floats, fits: Floats, variances: Floats, usual: Floats) -> Floats:
    """
    Return the deviations (9,) that keyframes show; the `usual` ones where they show no others.

    `keyframes` and `fits` (n, 9) are boxes of a person, and as they were solved with the `usual`
    deviations (9,); `variances` (n, 9) are those of the fits. Of each variable the fit is the mean
    of the keyframe, of variance s0^2, and of all else, of variance p^2, which follows from that of
    the fit. The residual has the variance (s^2 + p^2) s0^4 / (s0^2 + p^2)^2 for keyframes of the
    deviation s, and gives s; zero if it is smaller than that of exact keyframes.

    """
    found = usual.copy()
    if len(keyframes) < FOLLOW.min_keyframes:
        return found
    others = _variances_of_others(variances, usual)
    errors = residuals(keyframes, fits) * (1 + others / usual**2)
    for columns, of_group in GROUPS:
        variance = MAD_TO_DEVIATION**2 * np.median(errors[:, columns] ** 2)
        variance -= np.median(others[:, columns])
        deviation = np.sqrt(max(variance, 0.0))
        if not 1 / FOLLOW.evidence < deviation / usual[of_group[0]] < FOLLOW.evidence:
            found[of_group] = deviation
    return found


def are_exact(keyframes: Floats, fits: Floats, variances: Floats, usual: Floats) -> bool:
    """Return whether keyframes show smaller deviations of position and angles than the usual."""
    deviations = shown(keyframes, fits, variances, usual)
    return bool((deviations < usual)[list(BOX_POSE)].all())


def corrections(keyframes: Floats, fits: Floats, variances: Floats, usual: Floats) -> Floats:
    """Return the steps (n, 9) from fits to those with smaller deviations, if `shown`."""
    smaller = np.minimum(shown(keyframes, fits, variances, usual), usual)
    others = _variances_of_others(variances, usual)
    weight = others / (usual**2 + others)  # of the keyframe in the fit
    better = others / (smaller**2 + others)
    return residuals(keyframes, fits) * (better - weight) / (1 - weight)


def residuals(keyframes: Floats, fits: Floats) -> Floats:
    """Return keyframes less their fits, (n, 9) [m, rad]."""
    found: Floats = keyframes - fits
    found[:, ROLL:] = wrap_angle(found[:, ROLL:])
    return found


def _variances_of_others(variances: Floats, usual: Floats) -> Floats:
    """Return p^2 of `shown`, (n, 9)."""
    of_fit = np.minimum(variances, LARGEST_PART * usual**2)
    found: Floats = 1 / (1 / of_fit - usual**-2)
    return found


def diagonals(pose: Floats, extent: Floats) -> Floats:
    """Return the diagonals of two covariances, in the order of the columns of a box (..., 9)."""
    of_pose = np.diagonal(pose, axis1=-2, axis2=-1)
    of_extent = np.diagonal(extent, axis1=-2, axis2=-1)
    return np.concatenate([of_pose[..., :3], of_extent, of_pose[..., 3:]], axis=-1)


def moved(stamps_ns: Ints, boxes: Floats, at_ns: Ints, steps: Floats) -> Floats:
    """Return boxes (N, 9) moved by the steps (n, 9) at stamps `at_ns`, interpolated in time."""
    found = boxes.copy()
    if not steps.any():
        return found
    found += on_lines(at_ns - at_ns[0], steps, stamps_ns - at_ns[0])
    found[:, ROLL:] = wrap_angle(found[:, ROLL:])
    return found
