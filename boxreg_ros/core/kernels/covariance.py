"""
Covariances of one window, and the residuals of its faces, in plain loops.

The torch twin is `boxreg_ros.core.covariance.posterior`; the formulas are (M26) and (M28).

"""

from typing import Any, NamedTuple

from boxreg_ros.core.kernels.compile import kernel
from boxreg_ros.core.kernels.expectation import clamp
from boxreg_ros.core.kernels.normal_equations import EXTENT, GAP
from boxreg_ros.core.kernels.rotation import fill_rotation
from boxreg_ros.core.kernels.weights import face_deviation
import numpy as np

FACES = 6
SIZE = 3
"""Numbers of an extent."""
YAW = 5
"""Place of the yaw in a pose."""
UNDERRATED = GAP + FACES
"""Shared variables of (M28), the first ones: extents, bias, margins."""


class CovarianceWork(NamedTuple):
    """
    Arrays that the covariances of one window work in.

    Attributes
    ----------
    R : array, shape (3, 3)
        Axes of a box.
    off_mean : array, shape (N, 6)
        Residuals of the faces from their mean over the window [m].
    total, count, claimed : array, shape (6,)
        Of each face: weight and number of its observations; their variance by these weights.
    underrated : array, shape (15,)
        Information of (M28) for extents, bias and margins.

    """

    R: Any
    off_mean: Any
    total: Any
    count: Any
    claimed: Any
    underrated: Any


@kernel
def empty_covariance_work(N):
    """Return the arrays for a window of N observations."""
    return CovarianceWork(
        np.empty((3, 3)), np.empty((N, FACES)), np.empty(FACES), np.empty(FACES), np.empty(FACES),
        np.empty(UNDERRATED),
    )  # fmt: skip


@kernel
def fill_face_distances(boxes, poses, shared, expected, row, faces, R, distances):
    """Write the residuals (N, 6) of all faces [m], 0 for those without weight."""
    for n in range(len(poses)):
        pose, box = poses[n], boxes[n]
        fill_rotation(pose[3], pose[4], pose[5], R)
        for face in range(FACES):
            distances[n, face] = 0.0
            if not faces.weight[row, n, face] > 0.0:
                continue
            axis = face // 2
            sign = 1.0 - 2.0 * (face % 2)
            centroid = faces.moments[row, n, face, 3]
            outward = 0.0
            for k in range(3):
                outward += sign * R[k, axis] * (centroid[k] - (pose[k] - box[k]))
            surface = shared[EXTENT + axis] / 2 - expected[GAP + face] - faces.inset[row, n, face]
            distances[n, face] = outward - surface


@kernel
def remove_means(length, weight, distances, min_weight, work):
    """Write the residuals of a window less their weighted mean, and the sums of its weights."""
    for face in range(FACES):
        total, count, mean = 0.0, 0, 0.0
        for n in range(length):
            total += weight[n, face]
            count += weight[n, face] > 0.0
            mean += weight[n, face] * distances[n, face]
        mean /= max(total, min_weight)
        for n in range(length):
            work.off_mean[n, face] = distances[n, face] - mean
        work.total[face] = total
        work.count[face] = count


@kernel
def weight_of(count, half_weight):
    """Return the weight of what `count` observations show against what is usual."""
    return count / (count + half_weight)


@kernel
def variance_of_mean(length, weight, numbers, work):
    """Return the variance of the mean of many residuals over that of independent ones."""
    power, products = 0.0, 0.0
    for n in range(length - 1):
        for face in range(FACES):
            if weight[n, face] > 0.0 and weight[n + 1, face] > 0.0:
                first, second = work.off_mean[n, face], work.off_mean[n + 1, face]
                power += (first**2 + second**2) / 2 / work.claimed[face]
                products += first * second / work.claimed[face]
    faces = 0
    for face in range(FACES):
        faces += work.count[face] > 0
    n = max(work.count.sum() / max(faces, 1), 1.0)
    unbiased = (products / max(power, numbers.min_power) + 1 / n) / max(
        1 - 4 / n, numbers.min_left
    )
    usual = numbers.residual_correlation
    correlation = usual + weight_of(n, numbers.half_weight) * (unbiased - usual)
    correlation = clamp(correlation, 0.0, numbers.max_correlation)
    return (1 + correlation) / (1 - correlation)


@kernel
def fill_information_of_faces(length, marginalised, weight, spread, numbers, work):
    """Add the information of the labelling margins for the errors of faces (M28), (6,)."""
    of_mean = variance_of_mean(length, weight, numbers, work)
    for face in range(FACES):
        total, count, claimed = work.total[face], work.count[face], work.claimed[face]
        scatter = 0.0
        for n in range(length):
            share = weight[n, face] / max(total, numbers.min_weight)
            scatter += share * work.off_mean[n, face] ** 2
        scatter /= max(1 - of_mean / max(count, 1.0), numbers.min_left)
        shown = weight_of(count, numbers.half_weight)
        variance = of_mean * (claimed + shown * (scatter - claimed)) - claimed
        total *= (length + marginalised) / length
        share = numbers.correlated_faces[face] / spread[face] ** 4
        work.underrated[GAP + face] += variance / total * share if total > 0.0 else 0.0


@kernel
def fill_underrated_information(deviation, error, weight, free, underrated):
    """Write the information of extents, bias and margins, (15,), beyond that of their prior."""
    for s in range(UNDERRATED):
        underrated[s] = free[s] * weight[s] * (error[s] ** 2 / deviation[s] ** 2 - 1)


@kernel
def fill_pose_covariances(length, times, poses, inverse, underrated, numbers, found):
    """Write the covariances of the poses, (N, 6, 6)."""
    shift = np.zeros(3)
    for n in range(len(poses)):
        columns = inverse.border[n]
        for i in range(6):
            for j in range(6):
                total = inverse.poses[n, i, j]
                for s in range(UNDERRATED):
                    total += columns[i, s] * underrated[s] * columns[j, s]
                found[n, i, j] = total
        found[n, YAW, YAW] += numbers.heading_deviation**2
        if n >= length:
            continue
        after = min(n + 1, length - 1)
        before = max(n - 1, 0)
        duration = max(times[after] - times[before], numbers.min_duration)
        for k in range(3):
            speed = (poses[after, k] - poses[before, k]) / duration
            shift[k] = numbers.time_deviation * speed
        for i in range(3):
            for j in range(3):
                found[n, i, j] += shift[i] * shift[j]


@kernel
def fill_extent_covariance(corner, free, error, underrated, found):
    """Write the covariance of the extents, (3, 3); held ones have the errors of the input."""
    for i in range(SIZE):
        for j in range(SIZE):
            total = corner[EXTENT + i, EXTENT + j]
            for s in range(UNDERRATED):
                total += corner[EXTENT + i, s] * underrated[s] * corner[EXTENT + j, s]
            found[i, j] = total * free[EXTENT + i] * free[EXTENT + j]
        found[i, i] += (1 - free[EXTENT + i]) * error[EXTENT + i] ** 2


@kernel
def fill_posterior(
    b, windows, poses, shared, row, faces, expected, shape, free, shared_weight, inverse, weights,
    numbers, work, found,
):  # fmt: skip
    """
    Write the covariances of window `b`, and the residuals of its faces.

    Parameters
    ----------
    b : int
        The window.
    windows : WindowArrays
        Input of the windows.
    poses, shared : array, shapes (N, 6) and (23,)
        Its estimate.
    row : int
        Where the window is in `faces`.
    faces : FaceArrays
        Face observations of the last round.
    expected : ExpectedArrays
        Means and deviations of the last round.
    shape : float
        How far its surface is from rigid [m].
    free : array, shape (6 N + 23,)
        1 for variables that are estimated, 0 for those held fixed.
    shared_weight : array, shape (23,)
        Weights of the shared variables (M22) in the last round.
    inverse : InverseArrays
        Blocks of its inverse curvature.
    weights : WeightNumbers
        Deviations of faces.
    numbers : CovarianceNumbers
        Constants and settings.
    work : CovarianceWork
        Arrays to work in.
    found : PosteriorArrays
        Written.

    """
    length = windows.lengths[b]
    distances, free_shared = found.face_distances[b], free[6 * len(poses) :]
    deviation, error = expected.deviation, expected.error
    for face in range(FACES):
        work.claimed[face] = face_deviation(face, shape, weights.face_deviations) ** 2
    fill_face_distances(
        windows.boxes[b], poses, shared, expected.shared, row, faces, work.R, distances
    )
    weight = faces.weight[row]
    remove_means(length, weight, distances, numbers.min_weight, work)
    fill_underrated_information(deviation, error, shared_weight, free_shared, work.underrated)
    fill_information_of_faces(
        length, windows.marginalised_extents[b, 3], weight, deviation[GAP:], numbers, work
    )
    fill_pose_covariances(
        length, windows.times[b], poses, inverse, work.underrated, numbers, found.poses[b]
    )
    fill_extent_covariance(inverse.corner, free_shared, error, work.underrated, found.extents[b])
