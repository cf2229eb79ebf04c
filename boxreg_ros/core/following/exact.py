"""Boxes between exact keyframes: a spline in time, or a line or fits where they err less."""

from __future__ import annotations

from typing import Any, NamedTuple

from boxreg_ros.rotations import wrap_angle
from boxreg_ros.structures import BOX_EXTENT, Floats, Ints, LENGTH, on_lines, ROLL, YAW
import numpy as np
from scipy.interpolate import CubicSpline

SCATTER = 2.0
"""
Factor by which errors judged at one or two keyframes scatter; chosen. A spline is what a body with
a steady force does: the line or the fits have to err by so much less.
"""
EVEN = 0.25
"""Ratio of squared times, see `between_exact`, of evenly spaced keyframes. Derived."""


class Keyframes(NamedTuple):
    """The keyframes of one track, exact ones."""

    stamps_ns: Ints
    """(n,), strictly increasing [ns]."""
    boxes: Floats
    """(n, 9), as given [m, rad]."""
    residuals: Floats
    """(n, 9), what they are less their fits [m, rad]; NaN without one."""

    def take(self, rows: Any) -> Keyframes:
        """Return some of them."""
        return Keyframes(*(column[rows] for column in self))


def between_exact(stamps_ns: Ints, boxes: Floats, keyframes: Keyframes) -> Floats:
    """
    Return boxes with a spline or line between keyframes, but where the fits err less.

    Each is judged at the keyframes, without the one that it is compared with. An interpolation
    between keyframes errs by at most a h^2 / 8 with the acceleration a and the time h between
    them, and by a s t / 2 at one that is left out, s after the last and t before the next. That of
    a spline, whose errors are of the fourth order, grows with the square of the ratio of both from
    evenly spaced keyframes on: small errors of close ones bend it far in a long gap. Fits, from
    which the residuals of these neighbours are removed, err as between them; where one of them has
    no fit, it is not known by how much, and they are not taken. Two keyframes show nothing.

    Parameters
    ----------
    stamps_ns : array, shape (N,)
        Strictly increasing stamps of the boxes [ns].
    boxes : array, shape (N, 9)
        Fits of one track in one frame [m, rad].
    keyframes : Keyframes
        Those of this track, in the same frame.

    Returns
    -------
    boxes : array, shape (N, 9)
        A copy. Boxes at keyframes and beyond them are not changed, and none with fewer than three
        keyframes.

    """
    found = boxes.copy()
    if len(keyframes.stamps_ns) < 3:
        return found
    start_ns = keyframes.stamps_ns[0]
    at = (keyframes.stamps_ns - start_ns) * 1e-9
    times = (stamps_ns - start_ns) * 1e-9
    is_between = (times > at[0]) & (times < at[-1]) & ~np.isin(times, at)
    if not is_between.any():
        return found
    keys = keyframes.boxes.copy()
    keys[:, ROLL:] = np.unwrap(keys[:, ROLL:], axis=0)
    half_length = keys[1:-1, LENGTH, None] / 2
    residuals = keyframes.residuals
    errors = np.array(
        [
            _sizes(keys[1:-1] - _spline_without(at, keys), half_length),
            _sizes(keys[1:-1] - _line_without(at, keys), half_length),
        ]
    )
    of_fits = _sizes(residuals[1:-1] - _line_without(at, residuals), half_length)  # (n - 2,)
    curves = np.array([_spline(at, keys, times), on_lines(at, keys, times)])  # (2, N, 9)
    curves[:, :, BOX_EXTENT] = curves[1, :, BOX_EXTENT]
    before, after = at[1:-1] - at[:-2], at[2:] - at[1:-1]
    for first in range(len(at) - 1):
        judges = np.unique(np.clip([first - 1, first], 0, len(at) - 3))  # keyframes at its ends
        ratio = (at[first + 1] - at[first]) ** 2 / (4 * before * after)[judges]
        ratios = ratio * np.maximum(ratio / EVEN, 1), ratio
        spline, line = np.linalg.norm(errors[:, judges] * ratios, axis=1)
        of_fit = np.linalg.norm(of_fits[judges])
        best = int(np.nanargmin([spline, SCATTER * line, SCATTER * of_fit]))
        if best == len(curves):
            continue
        rows = np.flatnonzero((times > at[first]) & (times < at[first + 1]))
        found[rows] = curves[best, rows]
        found[rows, ROLL:] = wrap_angle(found[rows, ROLL:])
    return found


def _spline(at: Floats, values: Floats, times: Floats) -> Floats:
    found: Floats = CubicSpline(at, values)(times)
    return found


def _line_without(at: Floats, values: Floats) -> Floats:
    """Return the line at each inner one of values (n, 9), between those before and after it."""
    share = (at[1:-1] - at[:-2]) / (at[2:] - at[:-2])
    found: Floats = values[:-2] + share[:, None] * (values[2:] - values[:-2])
    return found


def _spline_without(at: Floats, values: Floats) -> Floats:
    """Return the spline at each inner one of values (n, 9) through all others."""
    without = [
        _spline(np.delete(at, k), np.delete(values, k, axis=0), at[k : k + 1])[0]
        for k in range(1, len(at) - 1)
    ]
    return np.array(without)


def _sizes(offsets: Floats, half_length: Floats) -> Floats:
    """Return how far offsets (n, 9) move a box, at most in it (n,) [m]."""
    turned = half_length * offsets[:, [YAW]]
    distances: Floats = np.linalg.norm(np.hstack([offsets[:, :3], turned]), axis=1)
    return distances
