"""
The weights of all residuals of one window, in plain loops.

The torch twins are the functions of `boxreg_ros.core.weights`; the formulas are (M19) to (M25).

"""

from math import hypot, inf

from boxreg_ros.core.kernels.compile import kernel
from boxreg_ros.core.kernels.normal_equations import BIAS, EXTENT, GAP, PIVOT, SHARED, slip_of
from boxreg_ros.core.kernels.rotation import fill_rotation
from boxreg_ros.core.kernels.sorting import lower_median
import numpy as np

POSE = (0, 1, 2, 6, 7, 8)
"""Where the pose stands in a box."""


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
def is_parked(boxes, times, length, yaw_deviation, numbers):
    """Return whether an object is parked over its window (M25)."""
    mean = 0.0
    for n in range(length):
        mean += times[n] / length
    x_y_yaw = (0, 1, 8)
    rate = np.zeros(3)
    power = 0.0
    for n in range(length):
        for k in range(3):
            rate[k] += (times[n] - mean) * boxes[n, x_y_yaw[k]]
        power += (times[n] - mean) * times[n]
    duration = times[length - 1]
    speed = hypot(rate[0], rate[1]) / abs(power)
    turned = abs(rate[2] / power) * duration / yaw_deviation
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
def fill_parked_steps(boxes, times, length, yaw_deviation, numbers, parked):
    """Write whether the object rests from each box to the next (M25), (N - 1,)."""
    parked[:] = False
    if not is_parked(boxes, times, length, yaw_deviation, numbers):
        return
    parked[: length - 1] = True
    span, reach = numbers.driving_span, numbers.driving_reach
    for step in range(span - 1, length - span):
        x0, y0, t0 = median_place(boxes, times, step + 1 - span, step + 1)
        x1, y1, t1 = median_place(boxes, times, step + 1, step + 1 + span)
        if hypot(x1 - x0, y1 - y0) > numbers.driving_speed * (t1 - t0):
            parked[max(0, step - reach) : step + reach + 1] = False


@kernel
def fill_input_weights(
    boxes, poses, bias, length, axes, off_track, deviation, widened, numbers, W
):
    """Write the weights of the input poses (M21), (N, 6, 6)."""
    for n in range(length):
        box, R = boxes[n], axes[n]
        for k in range(6):
            r = -bias[k]
            if k < 3:
                for j in range(3):
                    r += R[j, k] * (poses[n, j] - box[j])
            else:
                r += poses[n, k] - box[3 + k]
            off = (abs(r) + off_track[n, k]) / deviation[k]
            W[n, k, k] = 1 / widened[k] ** 2 / (1 + (off / numbers.input_outlier) ** 2)


@kernel
def fill_face_weights(distance, weight, off_track, length, deviation, numbers, face_weight):
    """Write the weights of the faces (M20), (N, 6) [1/m^2]."""
    for n in range(length):
        off = off_track[n, 0] ** 2 + off_track[n, 1] ** 2
        same_object = 1 / (1 + off**2) ** 2
        for face in range(6):
            robust = 1 / (1 + (distance[n, face] / numbers.face_outlier) ** 2) ** 2
            precision = robust * same_object / deviation[face] ** 2
            face_weight[n, face] = weight[n, face] * precision


@kernel
def scale_moments(moments, weight, W):
    """Write the weights of the planes of one box, (6, 4, 4): weighted second moments."""
    for face in range(6):
        for i in range(4):
            for j in range(4):
                W[face, i, j] = moments[face, i, j] * weight[face]


@kernel
def fill_shared_weights(shared, expected, deviation, distance, face_weight, length, numbers, W):
    """Write the weights of the shared variables (M22), (22, 22)."""
    for s in range(SHARED):
        W[s, s] = 1 / deviation[s] ** 2
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
        of_gap = (shared[GAP + face] - expected[GAP + face]) ** 2 / spread**2
        off = max(of_points, of_gap)
        W[GAP + face, GAP + face] = 1 / (spread**2 * (1 + off / numbers.gap_outlier**2))


@kernel
def fill_acceleration_weights(axes, deviation, length, W):
    """Write the weights of the accelerations (M23), (N - 2, 6, 6), in the fixed frame."""
    for n in range(length - 2):
        R = axes[n + 1]
        for j in range(3):
            for k in range(3):
                total = 0.0
                for axis in range(3):
                    total += R[j, axis] * R[k, axis] / deviation[axis] ** 2
                W[n, j, k] = total
            W[n, 3 + j, 3 + j] = 1 / deviation[3 + j] ** 2


@kernel
def mahalanobis(W, r):
    """Return r' W r."""
    total = 0.0
    for j in range(len(r)):
        for k in range(len(r)):
            total += r[j] * W[j, k] * r[k]
    return total


@kernel
def scale_by_neighbours(squared, count, outlier, W):
    """Down-weight the first `count` matrices W (n, R, R) by Cauchy's weight, squared (M24)."""
    for n in range(count):
        least = squared[n]
        if n >= 2:
            least = min(squared[n], squared[n - 1], squared[n - 2])
        scale = 1 / (1 + least / outlier**2) ** 2
        for j in range(W.shape[1]):
            for k in range(W.shape[2]):
                W[n, j, k] *= scale


@kernel
def robustify_motion(poses, times, pivot, length, numbers, W_acceleration, W_slip):
    """Down-weight motion residuals that are far off at the start of the round (M24)."""
    squared = np.empty(len(poses))
    r = np.empty(6)
    for n in range(length - 2):
        first = times[n + 1] - times[n]
        second = times[n + 2] - times[n + 1]
        for k in range(6):
            forward = (poses[n + 2, k] - poses[n + 1, k]) / second
            r[k] = (forward - (poses[n + 1, k] - poses[n, k]) / first) * 2 / (first + second)
        squared[n] = mahalanobis(W_acceleration[n], r)
    scale_by_neighbours(squared, length - 2, numbers.motion_outlier, W_acceleration)
    for n in range(length - 1):
        slip_of(poses[n], poses[n + 1], times[n + 1] - times[n], pivot, r)
        squared[n] = mahalanobis(W_slip[n], r[:2])
    scale_by_neighbours(squared, length - 1, numbers.motion_outlier, W_slip)


@kernel
def weigh_windows(begin, end, windows, poses, shared, faces, expected, of_class, numbers, terms):
    """
    Write data and weights of the terms of the windows `begin` to `end`.

    Parameters
    ----------
    begin, end : int
        First window, and the one after the last.
    windows : WindowArrays
        Input of the windows.
    poses, shared : array, shapes (B, N, 6) and (B, 22)
        Boxes at the start of the round.
    faces : FaceArrays
        Face observations.
    expected : ExpectedArrays
        Means and deviations of input and shared variables.
    of_class : ClassDeviations
        Of the class of each window.
    numbers : WeightNumbers
        Constants and settings.
    terms : TermArrays
        `axes` and the weights of faces, input, motion and shared variables are written; the
        weights have to be zero.

    """
    N = poses.shape[1]
    off_track = np.empty((N, 6))
    face_weight = np.empty((N, 6))
    parked = np.empty(N, np.bool_)
    for b in range(begin, end):
        length = windows.lengths[b]
        boxes, times, axes = windows.boxes[b], windows.times[b], terms.axes[b]
        for n in range(N):
            fill_rotation(poses[b, n, 3], poses[b, n, 4], poses[b, n, 5], axes[n])
        fill_neighbour_deviation(boxes, times, length, axes, numbers, off_track)
        distance = faces.distance[b]
        fill_face_weights(
            distance, faces.weight[b], off_track, length, of_class.faces[b], numbers, face_weight
        )
        for n in range(length):
            scale_moments(faces.moments[b, n], face_weight[n], terms.W_faces[b, n])
        deviation = expected.pose_deviation[b]
        fill_input_weights(
            boxes, poses[b], shared[b, BIAS:GAP], length, axes, off_track, deviation,
            expected.widened_deviation[b], numbers, terms.W_input[b],
        )  # fmt: skip
        fill_shared_weights(
            shared[b], expected.shared[b], expected.deviation[b], distance, face_weight, length,
            numbers, terms.W_shared[b],
        )  # fmt: skip
        fill_acceleration_weights(axes, of_class.acceleration[b], length, terms.W_acceleration[b])
        yaw_deviation = max(deviation[5], of_class.heading[b])
        fill_parked_steps(boxes, times, length, yaw_deviation, numbers, parked)
        for n in range(length - 1):
            for k in range(2):
                terms.W_slip[b, n, k, k] = 1 / of_class.slip[b, k] ** 2
            if parked[n]:
                for k in range(6):
                    terms.W_zero_motion[b, n, k, k] = 1 / of_class.zero_motion[b, k] ** 2
        if numbers.is_robust:
            robustify_motion(
                poses[b], times, shared[b, PIVOT], length, numbers, terms.W_acceleration[b],
                terms.W_slip[b],
            )  # fmt: skip
