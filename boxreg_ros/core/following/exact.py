"""Boxes between exact keyframes: a line or a spline in time, where it errs less than the fits."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from boxreg_ros.rotations import wrap_angle
from boxreg_ros.structures import BOX_EXTENT, Floats, Ints, LENGTH, ROLL, YAW
import numpy as np
from scipy.interpolate import CubicSpline

Curve = Callable[[Floats, Floats, Floats], Floats]
"""Values (m, 9) at times (m,) [s] through values (n, 9) at times (n,) [s]."""


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
    Return `boxes` (N, 9) with a line or spline between keyframes where it errs less.

    Each is judged at the keyframes, without the one that it is compared with. An interpolation
    between keyframes errs by at most a h^2 / 8 with the acceleration a and the time h between
    them, and by a s t / 2 at one that is left out, s after the last and t before the next. Fits,
    from which the residuals of these neighbours are removed, err as between them. Two keyframes
    show nothing.

    """
    found = boxes.copy()
    if len(keyframes.stamps_ns) < 3:
        return found
    start_ns = keyframes.stamps_ns[0]
    at = (keyframes.stamps_ns - start_ns) * 1e-9
    times = (stamps_ns - start_ns) * 1e-9
    keys = keyframes.boxes.copy()
    keys[:, ROLL:] = np.unwrap(keys[:, ROLL:], axis=0)
    half_length = keys[1:-1, LENGTH, None] / 2
    residuals = keyframes.residuals
    errors = np.array([_left_out(at, keys, curve, half_length) for curve in (_line, _spline)])
    of_fits = _left_out(at, residuals, _line, half_length)  # (n - 2,)
    before, after = at[1:-1] - at[:-2], at[2:] - at[1:-1]
    for first in range(len(at) - 1):
        judges = np.unique(np.clip([first - 1, first], 0, len(at) - 3))  # keyframes at its ends
        ratio = (at[first + 1] - at[first]) ** 2 / (4 * before * after)[judges]
        expected = np.linalg.norm(errors[:, judges] * ratio, axis=1)
        best = int(expected.argmin())
        rows = np.flatnonzero((times > at[first]) & (times < at[first + 1]))
        if expected[best] > np.linalg.norm(of_fits[judges]):
            continue
        boxes_between = (_line, _spline)[best](at, keys, times[rows])
        boxes_between[:, BOX_EXTENT] = _line(at, keys[:, BOX_EXTENT], times[rows])
        boxes_between[:, ROLL:] = wrap_angle(boxes_between[:, ROLL:])
        found[rows] = boxes_between
    return found


def _line(at: Floats, values: Floats, times: Floats) -> Floats:
    return np.stack([np.interp(times, at, column) for column in values.T], axis=1)


def _spline(at: Floats, values: Floats, times: Floats) -> Floats:
    found: Floats = CubicSpline(at, values)(times)
    return found


def _left_out(at: Floats, values: Floats, curve: Curve, half_length: Floats) -> Floats:
    """Return how far a curve without each inner value (n, 9) is from it, at most in a box [m]."""
    away = [
        values[k] - curve(np.delete(at, k), np.delete(values, k, axis=0), at[k : k + 1])[0]
        for k in range(1, len(at) - 1)
    ]
    offsets = np.array(away)
    turned = half_length * offsets[:, [YAW]]
    distances: Floats = np.linalg.norm(np.hstack([offsets[:, :3], turned]), axis=1)
    return distances
