"""What is reported of one window, once, at its end: covariances (M26), residuals of its faces."""

from typing import Any, NamedTuple

from boxreg_ros.core.method.arrays import copy, EXTENT, GAP, PIVOT, POSE, SHARED, WIDTH
from boxreg_ros.core.method.arrowhead import add_sandwich, multiply_shared, NEXT
from boxreg_ros.core.method.compile import kernel, loop, small_array
from boxreg_ros.core.method.expectation import FACES, HEADING, SIZE
from boxreg_ros.core.method.kinematics import fill_kinematics
from boxreg_ros.core.method.rotation import fill_rotation
from boxreg_ros.core.method.weights import face_deviation
import numpy as np

MIN_DURATION = 1e-3
"""Least time between two observations [s]. Derived: stamps of one sweep are equal or further."""


class Inverse(NamedTuple):
    """
    The inverse curvature of one window.

    Attributes
    ----------
    poses, links, response : array, shapes (N, 6, 6), (N, 6, 12) and (N, 6, S)
        See `arrowhead.invert_poses`.
    shared : array, shape (S, S)
        Covariance of the shared variables, with the errors that no weight claims (M28).
    beside : array, shape (N, 6, S)
        That of each pose with them: its response times `shared`.

    """

    poses: Any
    links: Any
    response: Any
    shared: Any
    beside: Any


@kernel
def empty_inverse(N, S):
    """Return room for the inverse of a window of N observations."""
    return Inverse(
        np.empty((N, POSE, POSE)), np.empty((N, POSE, NEXT)), np.empty((N, POSE, S)),
        np.empty((S, S)), np.empty((N, POSE, S)),
    )  # fmt: skip


@loop
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


@loop
def fill_unclaimed(length, marginalised, terms, common, shape, constants, G):
    """
    Write the covariance (15, 15) of the gradient by shared variables that no weight claims.

    The mean of input extents has the errors that change, too; biases of low-noise input are held
    closer than they err. The margin of a kind has an error, which opposite faces have in common.
    Consecutive residuals of a face are correlated: the error of their mean is one of its margin
    (M28).

    """
    c, W = constants.residual_correlation, common.W_shared
    for k in range(PIVOT):
        for m in range(PIVOT):
            G[k, m] = 0.0
        if k < GAP:
            G[k, k] = W[k] ** 2 * common.unclaimed[k]
    for face in range(FACES):
        total = 0.0
        for n in range(length):
            total += terms[n].visibility[face]
        total *= (length + marginalised) / length
        own, opposite = GAP + face, GAP + face + 1 - 2 * (face % 2)
        G[own, own] = W[own] ** 2 * common.margin_variance[face]
        if total > 0.0:
            independent = face_deviation(face, shape, constants) ** 2 / total
            G[own, own] += W[own] ** 2 * independent * 2 * c / (1 - c)
        if face < 4:  # top and bottom have margins of their own
            G[own, opposite] = W[own] * W[opposite] * common.margin_variance[face]


@loop
def fill_shared_covariance(corner, G, inverse):
    """Write covariances of the shared variables, by their block (S, S) of the inverse and `G`."""
    S = len(corner)
    for s in range(S):
        copy(corner[s], inverse.shared[s])
    add_sandwich(corner, G, small_array(PIVOT), inverse.shared)
    shared, product = small_array(SHARED, WIDTH), small_array(POSE, WIDTH)
    for s in range(S):
        for r in range(WIDTH):
            shared[s, r] = inverse.shared[s, r] if r < S else 0.0
    for n in range(len(inverse.response)):
        multiply_shared(inverse.response[n], shared, product)
        for a in range(POSE):
            copy(product[a], inverse.beside[n, a])


@loop
def fill_pose_covariances(length, times, poses, inverse, constants, found):
    """Write the covariances of the poses, (N, 6, 6)."""
    shift = small_array(3)
    for n in range(len(poses)):
        beside, response = inverse.beside[n], inverse.response[n]
        for i in range(len(response)):
            for j in range(i, len(response)):
                total = inverse.poses[n, i, j]
                for s in range(beside.shape[1]):
                    total += beside[i, s] * response[j, s]
                found[n, i, j] = found[n, j, i] = total
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


@loop
def fill_extent_covariance(covariance, free, common, found):
    """Write the covariance of the extents, (3, 3); held ones have the errors of the input."""
    for i in range(SIZE):
        for j in range(SIZE):
            found[i, j] = covariance[EXTENT + i, EXTENT + j] * free[EXTENT + i] * free[EXTENT + j]
        variance = common.deviation[EXTENT + i] ** 2 + common.unclaimed[EXTENT + i]
        found[i, i] += (1 - free[EXTENT + i]) * variance


@loop
def fill_posterior(b, problem, poses, shared, terms, common, free, inverse, corner, constants,
                   found):  # fmt: skip
    """
    Write covariances, residuals of faces, velocities and accelerations of window `b`.

    Parameters
    ----------
    b : int
        The window.
    problem : Problem
        Input of the batch.
    poses, shared : array, shapes (N, 6) and (S,)
        Estimate of the window.
    terms, common : array of `TERMS`, shape (N,), and record `COMMON`
        Of the window in the last round.
    free : array, shape (6 N + S,)
        1 for variables that are estimated, 0 for those held fixed.
    inverse : Inverse
        Of its curvature; what depends on the shared variables is written.
    corner : array, shape (S, S)
        That of the shared variables.
    constants : record of `Constants`
        Of the method, with the settings.
    found : Posterior
        Of the batch: written for the window.

    """
    length, shape = problem.lengths[b], problem.of_class[b].roughness
    distances, free_shared = found.face_distances[b], free[6 * len(poses) :]
    R, G, deviations = small_array(3, 3), small_array(PIVOT, PIVOT), small_array(3)
    fill_face_distances(problem.boxes[b], poses, shared, common.shared, terms, R, distances)
    marginalised = problem.marginalised_extents[b, 3]
    fill_unclaimed(length, marginalised, terms, common, shape, constants, G)
    fill_shared_covariance(corner, G, inverse)
    fill_pose_covariances(length, problem.times[b], poses, inverse, constants, found.poses[b])
    fill_extent_covariance(inverse.shared, free_shared, common, found.extents[b])
    forward, sideways, _ = problem.of_class[b].motion
    deviations[0], deviations[1], deviations[2] = forward, sideways, constants.vertical
    fill_kinematics(length, problem.times[b], poses, deviations, inverse, found.kinematics[b])
