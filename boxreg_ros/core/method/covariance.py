"""Covariances of one window (M26, M28), and the residuals of its faces: once, at its end."""

from typing import Any, NamedTuple

from boxreg_ros.core.method.arrays import EXTENT, GAP
from boxreg_ros.core.method.compile import kernel
from boxreg_ros.core.method.expectation import clamp, HEADING, SIZE
from boxreg_ros.core.method.rotation import fill_rotation
from boxreg_ros.core.method.weights import face_deviation
import numpy as np

FACES = 6
CORRELATED_FACES = (1.0, 1.0, 0.0, 0.0, 1.0, 1.0)
"""Faces whose correlation counts. Measured: the spread of the margins of the sides, `gap_spread`,
covers theirs; with them too, normalised squared errors across are 0.3 on simulated data."""
MIN_POWER = 1e-12
"""Errors with a smaller variance do not change along a track [m^2, rad^2]. Derived: rounding."""
MIN_WEIGHT = 1e-9
"""Faces with less weight in total have no residuals. Derived: rounding."""
UNDERRATED = GAP + FACES
"""Shared variables of (M28), the first ones: extents, bias, margins."""


MIN_DURATION = 1e-3
"""Least time between two observations [s]. Derived: stamps of one sweep are equal or further."""


class Inverse(NamedTuple):
    """
    Blocks of the inverse curvature of one window.

    Attributes
    ----------
    poses, border : array, shapes (N, 6, 6) and (N, 6, 23)
        Of each pose: its own, and those with the shared variables.
    corner : array, shape (23, 23)
        Of the shared variables.

    """

    poses: Any
    border: Any
    corner: Any


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
def fill_face_distances(boxes, poses, shared, expected, terms, R, distances):
    """Write the residuals (N, 6) of all faces [m], 0 for those without weight."""
    for n in range(len(poses)):
        pose, box = poses[n], boxes[n]
        fill_rotation(pose[3], pose[4], pose[5], R)
        for face in range(FACES):
            distances[n, face] = 0.0
            if not terms[n].visibility[face] > 0.0:
                continue
            axis = face // 2
            sign = 1.0 - 2.0 * (face % 2)
            centroid = terms[n].W_faces[face, 3]
            outward = 0.0
            for k in range(3):
                centre = centroid[k] / centroid[3]
                outward += sign * R[k, axis] * (centre - (pose[k] - box[k]))
            surface = shared[EXTENT + axis] / 2 - expected[GAP + face] - terms[n].inset[face]
            distances[n, face] = outward - surface


@kernel
def remove_means(length, terms, distances, work):
    """Write the residuals of a window less their weighted mean, and the sums of its weights."""
    for face in range(FACES):
        total, count, mean = 0.0, 0, 0.0
        for n in range(length):
            total += terms[n].visibility[face]
            count += terms[n].visibility[face] > 0.0
            mean += terms[n].visibility[face] * distances[n, face]
        mean /= max(total, MIN_WEIGHT)
        for n in range(length):
            work.off_mean[n, face] = distances[n, face] - mean
        work.total[face] = total
        work.count[face] = count


@kernel
def weight_of(count, half_weight):
    """Return the weight of what `count` observations show against what is usual."""
    return count / (count + half_weight)


@kernel
def variance_of_mean(length, terms, constants, work):
    """Return the variance of the mean of many residuals over that of independent ones."""
    power, products = 0.0, 0.0
    for n in range(length - 1):
        for face in range(FACES):
            if terms[n].visibility[face] > 0.0 and terms[n + 1].visibility[face] > 0.0:
                first, second = work.off_mean[n, face], work.off_mean[n + 1, face]
                power += (first**2 + second**2) / 2 / work.claimed[face]
                products += first * second / work.claimed[face]
    faces = 0
    for face in range(FACES):
        faces += work.count[face] > 0
    n = max(work.count.sum() / max(faces, 1), 1.0)
    unbiased = (products / max(power, MIN_POWER) + 1 / n) / max(1 - 4 / n, constants.min_left)
    usual = constants.residual_correlation
    correlation = usual + weight_of(n, constants.half_weight) * (unbiased - usual)
    correlation = clamp(correlation, 0.0, constants.max_correlation)
    return (1 + correlation) / (1 - correlation)


@kernel
def fill_information_of_faces(length, marginalised, terms, spread, constants, work):
    """Add the information of the labelling margins for the errors of faces (M28), (6,)."""
    of_mean = variance_of_mean(length, terms, constants, work)
    for face in range(FACES):
        total, count, claimed = work.total[face], work.count[face], work.claimed[face]
        scatter = 0.0
        for n in range(length):
            share = terms[n].visibility[face] / max(total, MIN_WEIGHT)
            scatter += share * work.off_mean[n, face] ** 2
        scatter /= max(1 - of_mean / max(count, 1.0), constants.min_left)
        shown = weight_of(count, constants.half_weight)
        variance = of_mean * (claimed + shown * (scatter - claimed)) - claimed
        total *= (length + marginalised) / length
        share = CORRELATED_FACES[face] / spread[face] ** 4
        work.underrated[GAP + face] += variance / total * share if total > 0.0 else 0.0


@kernel
def fill_underrated_information(deviation, error, weight, free, underrated):
    """Write the information of extents, bias and margins, (15,), beyond that of their prior."""
    for s in range(UNDERRATED):
        underrated[s] = free[s] * weight[s] * (error[s] ** 2 / deviation[s] ** 2 - 1)


@kernel
def fill_pose_covariances(length, times, poses, inverse, underrated, constants, found):
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
        found[n, HEADING, HEADING] += constants.heading_deviation**2
        if n >= length:
            continue
        after = min(n + 1, length - 1)
        before = max(n - 1, 0)
        duration = max(times[after] - times[before], MIN_DURATION)
        for k in range(3):
            speed = (poses[after, k] - poses[before, k]) / duration
            shift[k] = constants.time_deviation * speed
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
    b, problem, poses, shared, terms, common, free, inverse, constants, work, found
):
    """
    Write the covariances of window `b`, and the residuals of its faces.

    Parameters
    ----------
    b : int
        The window.
    problem : Problem
        Input of the batch.
    poses, shared : array, shapes (N, 6) and (23,)
        Estimate of the window.
    terms, common : array of `TERMS`, shape (N,), and record `COMMON`
        Of the window in the last round.
    free : array, shape (6 N + 23,)
        1 for variables that are estimated, 0 for those held fixed.
    inverse : Inverse
        Blocks of its inverse curvature.
    constants : record of `Constants`
    work : CovarianceWork
        Arrays to work in.
    found : Posterior
        Of the batch: written for the window.

    """
    length, shape = problem.lengths[b], problem.of_class[b].roughness
    distances, free_shared = found.face_distances[b], free[6 * len(poses) :]
    deviation, error = common.deviation, common.error
    for face in range(FACES):
        work.claimed[face] = face_deviation(face, shape, constants) ** 2
    fill_face_distances(problem.boxes[b], poses, shared, common.shared, terms, work.R, distances)
    remove_means(length, terms, distances, work)
    fill_underrated_information(deviation, error, common.W_shared, free_shared, work.underrated)
    fill_information_of_faces(
        length, problem.marginalised_extents[b, 3], terms, deviation[GAP:], constants, work
    )
    fill_pose_covariances(
        length, problem.times[b], poses, inverse, work.underrated, constants, found.poses[b]
    )
    fill_extent_covariance(inverse.corner, free_shared, error, work.underrated, found.extents[b])
