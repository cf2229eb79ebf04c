"""
The weights of all residuals of one window at the start of a round, (M20) to (M25).

The weight of a residual of `residuals.RESIDUALS` is a function of an observation n, its residual r
a `Weighing` and the constants, and writes the diagonal of W (6,).

"""

from math import hypot, sqrt
from typing import Any, NamedTuple

from boxreg_ros.core.method.arrays import BIAS, BOTTOM, EXTENT, GAP, POSE, SHARED
from boxreg_ros.core.method.compile import kernel, loop
from boxreg_ros.core.method.selection import lower_median
import numpy as np


class Weighing(NamedTuple):
    """
    What the weights of one window follow from.

    Attributes
    ----------
    length : int
        Observations, without padding.
    deviation, widened : array, shape (6,)
        Of the input poses, `pose_deviation` and `widened_deviation` of `COMMON`.
    pinned : array, shape (N,)
        Whether a person has corrected a box.
    pin_factor : array, shape (6,)
        Factor on the weights of the other boxes of a window with pinned ones (M21a); else 1.
    parked : array, shape (N,)
        Whether the object is parked from each box to the next (M25).
    of_class : record `CLASS_SETTINGS`
        Settings of its class.

    """

    length: int
    deviation: Any
    widened: Any
    pinned: Any
    pin_factor: Any
    parked: Any
    of_class: Any


@loop
def input_weight(n, r, window, constants, w):
    """Write Cauchy's weight of an input pose (M21); a pinned one has a deviation of its own."""
    for k in range(POSE):
        off = r[k] / window.deviation[k] / constants.outlier
        w[k] = window.pin_factor[k] / window.widened[k] ** 2 / (1 + off**2)
        if window.pinned[n]:
            w[k] = 1 / constants.pin_deviations[k] ** 2


@loop
def rigid_shape_weight(n, r, window, constants, w):
    """Write ones: the residual is whitened by the root of its information (M4)."""
    for k in range(POSE):
        w[k] = 1.0


@loop
def acceleration_weight(n, r, window, constants, w):
    """Write the weight of an acceleration along the axes of the body (M23)."""
    forward, sideways, turning = window.of_class.motion
    w[0], w[1], w[2] = 1 / forward**2, 1 / sideways**2, 1 / constants.vertical**2
    w[3] = w[4] = 1 / constants.tilting**2
    w[5] = 1 / turning**2


@loop
def zero_motion_weight(n, r, window, constants, w):
    """Write the weight of the step of a parked object; zero where it drives (M25)."""
    for k in range(POSE):
        w[k] = 1 / constants.drift[k] ** 2 if window.parked[n] else 0.0


@loop
def slip_weight(n, r, window, constants, w):
    """Write the weight of the velocity of the pivot across the path and upward (M7)."""
    w[0], w[1] = 1 / window.of_class.slip**2, 1 / constants.climb**2


@loop
def robustify(i, length, squared, outlier, terms):
    """
    Down-weight residual `i` where it is far off at the start of the round (M24).

    By the `squared` Mahalanobis norms (N,) of it: as the square of Cauchy's weight, and no more
    than the two observations before, since the newest boxes are nearly as noisy as their input.

    """
    for n in range(length):
        least = squared[n]
        if n >= 2:
            least = min(squared[n], squared[n - 1], squared[n - 2])
        for k in range(POSE):
            terms[n].W[i, k] /= (1 + least / outlier**2) ** 2


@loop
def fill_rates(boxes, times, length, rate):
    """Write the slopes of x, y and yaw over time by linear regression, (3,) [m/s, rad/s]."""
    mean = 0.0
    for n in range(length):
        mean += times[n] / length
    x_y_yaw = (0, 1, 8)
    rate[0] = rate[1] = rate[2] = power = 0.0
    for n in range(length):
        for k in range(3):
            rate[k] += (times[n] - mean) * boxes[n, x_y_yaw[k]]
        power += (times[n] - mean) * times[n]
    for k in range(3):
        rate[k] /= power


@kernel
def is_parked(boxes, times, length, yaw_deviation, constants):
    """Return whether an object is parked over its window (M25)."""
    rate = np.empty(3)
    fill_rates(boxes, times, length, rate)
    duration = times[length - 1]
    speed = hypot(rate[0], rate[1])
    turned = abs(rate[2]) * duration / yaw_deviation
    if not (speed < constants.parked_speed and turned < constants.gate):
        return False
    first = np.int64(0)  # a literal would be compiled by itself
    x, y, _ = median_place(boxes, times, first, length)
    distance = np.empty(length)
    for n in range(length):
        distance[n] = hypot(boxes[n, 0] - x, boxes[n, 1] - y)
    return max(speed * duration, 2 * lower_median(distance)) < constants.parked_distance


@kernel
def median_place(boxes, times, first, last):
    """Return the medians of x, y and time of the boxes `first` to `last`."""
    values, found = np.empty(last - first), np.empty(2)
    for k in range(len(found)):
        for n in range(last - first):
            values[n] = boxes[first + n, k]
        found[k] = lower_median(values)
    return found[0], found[1], times[(first + last - 1) // 2]  # which increase


@kernel
def fill_parked(boxes, times, length, yaw_deviation, constants, parked):
    """Write whether the object is parked from each box to the next (M25), (N,)."""
    known = is_parked(boxes, times, length, yaw_deviation, constants)
    for n in range(len(parked)):
        parked[n] = known
    if not known:
        return
    span = constants.driving_span
    for step in range(span - 1, length - span):
        x0, y0, t0 = median_place(boxes, times, step + 1 - span, step + 1)
        x1, y1, t1 = median_place(boxes, times, step + 1, step + 1 + span)
        if hypot(x1 - x0, y1 - y0) > constants.driving_speed * (t1 - t0):
            for n in range(step + 1 - span, step + span):
                parked[n] = False


@loop
def fill_pin_factor(length, common, factor):
    """Write the factor on the weights of the boxes beside pinned ones (M21a), (6,)."""
    for k in range(POSE):
        variance = common.widened_deviation[k] ** 2
        unmodelled = sqrt(float(length)) * common.unmodelled_bias[k] ** 2  # 0 without pinned ones
        factor[k] = variance / (variance + unmodelled)


@loop
def face_deviation(face, shape, constants):
    """Return the deviation of one observation of a face of an object rigid up to `shape` [m]."""
    deviation = constants.face_deviations[face]
    return deviation if face == BOTTOM else max(deviation, shape)


@loop
def weigh_faces(length, shape, constants, terms, face_weight):
    """
    Write the weights of the faces (M20), (N, 6) [1/m^2], and multiply their moments by them.

    The object is rigid up to `shape`: points on legs and arms deviate by more than the face.

    """
    for n in range(length):
        moments, distance, visibility = terms[n].W_faces, terms[n].distance, terms[n].visibility
        for face in range(6):
            deviation = face_deviation(face, shape, constants)
            robust = 1 / (1 + (distance[face] / constants.face_outlier) ** 2) ** 2
            w = visibility[face] * robust / deviation**2
            face_weight[n, face] = w
            for i in range(4):
                for j in range(4):
                    moments[face, i, j] *= w


@loop
def weigh_shared(length, shared, terms, common, face_weight, constants):
    """
    Write the weights of the shared variables (M22), (23,).

    Where points, or the margin, are far from where they are expected, the deviation of the margin
    is widened: points of a load, or of a branch above, must not raise the estimated roof.

    """
    deviation, W = common.deviation, common.W_shared
    for s in range(SHARED):
        W[s] = 1 / deviation[s] ** 2
    for face in range(6):
        axis = face // 2
        total, pull = 0.0, 0.0
        for n in range(length):
            total += face_weight[n, face]
            pull += terms[n].distance[face] * face_weight[n, face]
        # Points and the face of the input are apart by margin, bias and half the extent's error.
        half_extent = deviation[EXTENT + axis] / 2
        spread = deviation[GAP + face]
        variance = spread**2 + deviation[BIAS + axis] ** 2 + half_extent**2
        of_points = (pull / max(total, 1e-9)) ** 2 / variance
        of_gap = (shared[GAP + face] - common.shared[GAP + face]) ** 2 / spread**2
        off = max(of_points, of_gap)
        W[GAP + face] = 1 / (spread**2 * (1 + off / constants.gap_outlier**2))
