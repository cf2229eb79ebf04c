"""
The weights of all residuals of one window, in plain loops.

The torch twins are the functions of `boxreg_ros.core.weights`; the formulas are (M19) to (M25).

"""

from math import hypot, inf, sqrt

from boxreg_ros.core.kernels.compile import kernel
from boxreg_ros.core.kernels.normal_equations import (
    BIAS,
    EXTENT,
    fill_acceleration,
    fill_step,
    GAP,
    SHARED,
    slip_of,
)
from boxreg_ros.core.kernels.rotation import fill_rotation
from boxreg_ros.core.kernels.selection import lower_median
import numpy as np

BOTTOM = 5
"""The face that is observed by the road."""
POSE = (0, 1, 2, 6, 7, 8)
"""Indices of the pose in a box."""


@kernel
def prediction_error(boxes, times, n, a, b, axes, error):
    """Write the error (6,) of box n as predicted from boxes a and b with constant velocity."""
    share = (times[n] - times[a]) / (times[b] - times[a])
    off = np.empty(6)
    for k in range(6):
        here, first, second = boxes[n, POSE[k]], boxes[a, POSE[k]], boxes[b, POSE[k]]
        off[k] = here - first - (second - first) * share
    for k in range(3):
        error[k] = abs(axes[0, k] * off[0] + axes[1, k] * off[1] + axes[2, k] * off[2])
        error[3 + k] = abs(off[3 + k])


@kernel
def fill_neighbour_deviation(boxes, times, length, axes, numbers, off_track):
    """Write how far each input pose is off the track of its neighbours (M19), (N, 6)."""
    error = np.empty(6)
    for n in range(length):
        off_track[n] = inf
        for a, b in ((n - 2, n - 1), (n - 1, n + 1), (n + 1, n + 2)):
            if a >= 0 and b < length:
                prediction_error(boxes, times, n, a, b, axes[n], error)
                for k in range(6):
                    off_track[n, k] = min(off_track[n, k], error[k])
        for k in range(6):
            is_known = off_track[n, k] < inf
            off_track[n, k] = off_track[n, k] / numbers.neighbour_factor if is_known else 0.0


@kernel
def fill_rates(boxes, times, length, rate):
    """
    Write the slopes of x, y and yaw over time by linear regression, (3,) [m/s, rad/s].

    Return the sum of squares of the times about their mean [s^2].

    """
    mean = 0.0
    for n in range(length):
        mean += times[n] / length
    x_y_yaw = (0, 1, 8)
    rate[:] = 0.0
    power = 0.0
    for n in range(length):
        for k in range(3):
            rate[k] += (times[n] - mean) * boxes[n, x_y_yaw[k]]
        power += (times[n] - mean) * times[n]
    for k in range(3):
        rate[k] /= power
    return power


@kernel
def is_parked(boxes, times, length, rate, yaw_deviation, numbers):
    """Return whether an object is parked over its window (M25)."""
    duration = times[length - 1]
    speed = hypot(rate[0], rate[1])
    turned = abs(rate[2]) * duration / yaw_deviation
    x = lower_median(boxes[:length, 0].copy())
    y = lower_median(boxes[:length, 1].copy())
    distance = np.empty(length)
    for n in range(length):
        distance[n] = hypot(boxes[n, 0] - x, boxes[n, 1] - y)
    moved = max(speed * duration, 2 * lower_median(distance))
    return (
        speed < numbers.parked_speed
        and moved < numbers.parked_distance
        and turned < numbers.parked_turn
    )


@kernel
def median_place(boxes, times, first, last):
    """Return the medians of x, y and time of the boxes `first` to `last`."""
    x = lower_median(boxes[first:last, 0].copy())
    y = lower_median(boxes[first:last, 1].copy())
    return x, y, lower_median(times[first:last].copy())


@kernel
def fill_parked_steps(boxes, times, length, rate, yaw_deviation, numbers, parked):
    """Write whether the object is parked from each box to the next (M25), (N - 1,)."""
    parked[:] = False
    if not is_parked(boxes, times, length, rate, yaw_deviation, numbers):
        return
    parked[: length - 1] = True
    span, reach = numbers.driving_span, numbers.driving_reach
    for step in range(span - 1, length - span):
        x0, y0, t0 = median_place(boxes, times, step + 1 - span, step + 1)
        x1, y1, t1 = median_place(boxes, times, step + 1, step + 1 + span)
        if hypot(x1 - x0, y1 - y0) > numbers.driving_speed * (t1 - t0):
            parked[max(0, step - reach) : step + reach + 1] = False


@kernel
def fill_input_weights(poses, bias, length, off_track, deviation, widened, numbers, terms):
    """Write the weights of the input poses (M21), (N, 6)."""
    r = np.empty(6)
    for n in range(length):
        fill_step(poses[n], terms.given[n], terms.axes[n], r)
        for k in range(6):
            off = (abs(r[k] - bias[k]) + off_track[n, k]) / deviation[k]
            terms.W_input[n, k] = 1 / widened[k] ** 2 / (1 + (off / numbers.input_outlier) ** 2)


@kernel
def weigh_pins(pinned, length, widened, unmodelled_bias, pin_deviations, W):
    """
    Change the weights (N, 6) of the input poses of a window with pinned boxes (M21a).

    The bias of the other boxes is part of their noise.

    """
    if not pinned.any():
        return
    for k in range(6):
        variance = widened[k] ** 2
        factor = variance / (variance + sqrt(float(length)) * unmodelled_bias[k] ** 2)
        for n in range(length):
            W[n, k] = 1 / pin_deviations[k] ** 2 if pinned[n] else W[n, k] * factor


@kernel
def face_deviation(face, shape, deviations):
    """Return the deviation of one observation of a face of an object rigid up to `shape` [m]."""
    return deviations[face] if face == BOTTOM else max(deviations[face], shape)


@kernel
def fill_face_weights(distance, weight, off_track, length, shape, numbers, face_weight):
    """Write the weights of the faces (M20), (N, 6) [1/m^2], of an object rigid up to `shape`."""
    for n in range(length):
        off = off_track[n, 0] ** 2 + off_track[n, 1] ** 2
        same_object = 1 / (1 + off**2) ** 2
        for face in range(6):
            deviation = face_deviation(face, shape, numbers.face_deviations)
            robust = 1 / (1 + (distance[n, face] / numbers.face_outlier) ** 2) ** 2
            face_weight[n, face] = weight[n, face] * robust * same_object / deviation**2


@kernel
def scale_moments(moments, weight, W):
    """Write the weights of the planes of one box, (6, 4, 4): weighted second moments."""
    for face in range(6):
        for i in range(4):
            for j in range(4):
                W[face, i, j] = moments[face, i, j] * weight[face]


@kernel
def fill_shared_weights(shared, deviation, distance, face_weight, length, numbers, terms):
    """Write the weights of the shared variables (M22), (23,)."""
    for s in range(SHARED):
        terms.W_shared[s] = 1 / deviation[s] ** 2
    for face in range(6):
        axis = face // 2
        total = 0.0
        pull = 0.0
        for n in range(length):
            total += face_weight[n, face]
            pull += distance[n, face] * face_weight[n, face]
        # Points and the face of the input are apart by margin, bias and half the extent's error.
        half_extent = deviation[EXTENT + axis] / 2
        spread = deviation[GAP + face]
        variance = spread**2 + deviation[BIAS + axis] ** 2 + half_extent**2
        of_points = (pull / max(total, 1e-9)) ** 2 / variance
        of_gap = (shared[GAP + face] - terms.expected[GAP + face]) ** 2 / spread**2
        off = max(of_points, of_gap)
        terms.W_shared[GAP + face] = 1 / (spread**2 * (1 + off / numbers.gap_outlier**2))


@kernel
def fill_acceleration_weights(deviation, length, terms):
    """Write the weights of the accelerations (M23), in the fixed frame."""
    for n in range(length - 2):
        R = terms.axes[n + 1]
        for j in range(3):
            for k in range(3):
                total = 0.0
                for axis in range(3):
                    total += R[j, axis] * R[k, axis] / deviation[axis] ** 2
                terms.W_acceleration[n, j, k] = total
            terms.W_turning[n, j] = 1 / deviation[3 + j] ** 2


@kernel
def fill_motion_weights(times, length, parked, slip, drift, squared_speed, numbers, terms):
    """Write the weights of slip and, where the object is parked, of zero motion (M25)."""
    for n in range(length - 1):
        seconds = times[n + 1] - times[n]
        for k in range(2):
            terms.W_slip[n, k] = 1 / slip[k] ** 2
        for k in range(6):
            if parked[n]:
                variance = (drift * numbers.drift_ratios[k]) ** 2
                if k < 2:
                    variance += squared_speed * seconds**2
                terms.W_zero_motion[n, k] = 1 / variance


@kernel
def robust_scale(squared, n, outlier):
    """Return the factor (M24) of residual n: of the least of its own and the two before."""
    least = squared[n]
    if n >= 2:
        least = min(squared[n], squared[n - 1], squared[n - 2])
    return 1 / (1 + least / outlier**2) ** 2


@kernel
def robustify_motion(poses, shared, length, outlier, terms):
    """Down-weight motion residuals that are far off at the start of the round (M24)."""
    squared = np.empty(len(poses))
    r = np.empty(6)
    between = np.empty((3, 3))
    for n in range(length - 2):
        W, w = terms.W_acceleration[n], terms.W_turning[n]
        fill_acceleration(n, poses, terms.times, r)
        squared[n] = 0.0
        for k in range(3):
            squared[n] += r[k] * (W[k, 0] * r[0] + W[k, 1] * r[1] + W[k, 2] * r[2])
            squared[n] += w[k] * r[3 + k] ** 2
    for n in range(length - 2):
        scale = robust_scale(squared, n, outlier)
        for j in range(3):
            terms.W_turning[n, j] *= scale
            for k in range(3):
                terms.W_acceleration[n, j, k] *= scale
    for n in range(length - 1):
        dt = terms.times[n + 1] - terms.times[n]
        slip_of(n, poses, terms.axes, dt, shared, between, r)
        squared[n] = terms.W_slip[n, 0] * r[0] ** 2 + terms.W_slip[n, 1] * r[1] ** 2
    for n in range(length - 1):
        scale = robust_scale(squared, n, outlier)
        for k in range(2):
            terms.W_slip[n, k] *= scale


@kernel
def weigh(b, windows, poses, shared, row, faces, expected, of_class, numbers, terms):
    """
    Write data and weights of the terms of window `b`, but those of rigid shape and prior.

    The weights of padding are left as they are: zero.

    Parameters
    ----------
    b : int
        The window.
    windows : WindowArrays
        Input of the windows.
    poses, shared : array, shapes (N, 6) and (23,)
        Its boxes and shared variables at the start of the round.
    row : int
        Where the window is in `faces`.
    faces : FaceArrays
        Face observations.
    expected : ExpectedArrays
        Means and deviations of input and shared variables.
    of_class : ClassArrays
        Settings of the class of each window.
    numbers : WeightNumbers
        Constants and settings.
    terms : TermArrays
        Written.

    """
    N = len(poses)
    off_track = np.empty((N, 6))
    face_weight = np.empty((N, 6))
    parked = np.empty(N, np.bool_)
    length = windows.lengths[b]
    boxes, times = windows.boxes[b], windows.times[b]
    terms.times[:] = times
    terms.inset[:] = faces.inset[row]
    terms.expected[:] = expected.shared
    for n in range(N):
        fill_rotation(poses[n, 3], poses[n, 4], poses[n, 5], terms.axes[n])
        for k in range(6):
            terms.given[n, k] = boxes[n, POSE[k]]
    fill_neighbour_deviation(boxes, times, length, terms.axes, numbers, off_track)
    distance = faces.distance[row]
    fill_face_weights(
        distance, faces.weight[row], off_track, length, of_class.shape[b], numbers, face_weight
    )
    for n in range(length):
        scale_moments(faces.moments[row, n], face_weight[n], terms.W_faces[n])
    deviation, widened = expected.pose_deviation, expected.widened_deviation
    fill_input_weights(
        poses, shared[BIAS:GAP], length, off_track, deviation, widened, numbers, terms
    )
    weigh_pins(
        windows.pinned[b], length, widened, expected.unmodelled_bias, numbers.pin_deviations,
        terms.W_input,
    )  # fmt: skip
    fill_shared_weights(shared, expected.deviation, distance, face_weight, length, numbers, terms)
    fill_acceleration_weights(of_class.acceleration[b], length, terms)
    yaw_deviation = max(deviation[5], of_class.pose[b, 5])
    rate = np.empty(3)
    power = fill_rates(boxes, times, length, rate)
    fill_parked_steps(boxes, times, length, rate, yaw_deviation, numbers, parked)
    squared_speed = rate[0] ** 2 + rate[1] ** 2
    noise = (widened[0] ** 2 + widened[1] ** 2) / power
    shown = squared_speed - noise if squared_speed > numbers.drift_gate * noise else 0.0
    fill_motion_weights(
        times, length, parked, of_class.slip[b], of_class.drift[b], shown, numbers, terms
    )
    if numbers.is_robust:
        robustify_motion(poses, shared, length, numbers.motion_outlier, terms)
