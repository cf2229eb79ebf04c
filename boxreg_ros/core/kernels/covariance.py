"""
Covariances of one window, residuals of its faces, and evidence about its extents, in plain loops.

The torch twins are `boxreg_ros.core.covariance.posterior` and `evidence_of_extents` of
`boxreg_ros.core.input_model`; the formulas are (M17), (M26) and (M28).

"""

from math import isfinite, log

from boxreg_ros.core.kernels.compile import kernel
from boxreg_ros.core.kernels.normal_equations import BIAS, EXTENT, GAP, SHARED
from boxreg_ros.core.kernels.rotation import fill_rotation
import numpy as np

INPUT_ERRORS = BIAS + 6
"""Number of shared variables, the first ones, whose prior is the input: extents and bias."""


@kernel
def fill_underrated_information(deviation, error, free, underrated):
    """Write the variance of each prior's gradient beyond the one claimed (M28), (9,)."""
    for j in range(INPUT_ERRORS):
        claimed = deviation[j] ** 2
        is_free = free[len(free) - SHARED + j]
        underrated[j] = is_free * (error[j] ** 2 - claimed) / claimed**2


@kernel
def fill_pose_covariance(block, border, underrated, R, model_deviation, covariance):
    """Write the covariance (6, 6) of a pose with axes R, given its blocks in the inverse."""
    for a in range(6):
        for c in range(a, 6):
            total = block[a, c]
            for j in range(INPUT_ERRORS):
                total += border[a, j] * underrated[j] * border[c, j]
            if a < 3 and c < 3:
                for k in range(3):
                    total += R[a, k] * model_deviation[k] ** 2 * R[c, k]
            if a == c and a >= 3:
                total += model_deviation[a] ** 2
            covariance[a, c] = total
            covariance[c, a] = total


@kernel
def fill_extent_covariance(corner, free, underrated, input_error, model_deviation, covariance):
    """Write the covariance (3, 3) of the extents; without estimate they err as the input does."""
    first = len(free) - SHARED
    for k in range(3):
        for m in range(k, 3):
            total = corner[k, m]
            for j in range(INPUT_ERRORS):
                total += corner[k, j] * underrated[j] * corner[m, j]
            covariance[k, m] = total * free[first + k] * free[first + m]
            covariance[m, k] = covariance[k, m]
        of_input = (1 - free[first + k]) * input_error[k] ** 2
        covariance[k, k] += of_input + model_deviation[k] ** 2


@kernel
def fill_face_distances(shift, R, shared, moments, inset, weight, distances):
    """Write the mean of (M2) over the outermost points of each face of one box, (6,) [m]."""
    for face in range(6):
        axis = face // 2
        sign = 1.0 - 2.0 * (face % 2)
        outward = 0.0
        for k in range(3):
            outward += sign * R[k, axis] * (moments[face, 3, k] - shift[k])
        surface = shared[EXTENT + axis] / 2 - shared[GAP + face] - inset[face]
        distances[face] = outward - surface if weight[face] > 0.0 else 0.0


@kernel
def fill_evidence(given, expected, deviation, shared, corner, min_gain, evidence):
    """Write corrections of the extents by the points alone, and their weights, (2, 3) (M17)."""
    for k in range(3):
        gain = 1 - corner[k, k] / deviation[k] ** 2
        power = (deviation[k] / expected[k]) ** 2
        by_points = log(shared[EXTENT + k] / expected[k]) / gain + log(expected[k])
        is_evidence = gain > min_gain and isfinite(by_points)
        evidence[0, k] = (by_points - given[k]) / power if is_evidence else 0.0
        evidence[1, k] = gain * power if is_evidence else 0.0


@kernel
def fill_posterior(b, windows, faces, free, expected, blocks, border, corner, numbers, solution):
    """
    Write covariances and face residuals of window `b`.

    Parameters
    ----------
    b : int
        The window.
    windows : WindowArrays
        Input of the windows.
    faces : FaceArrays
        Face observations of this window, as the only one.
    free : array, shape (6 N + 23,)
        1 for variables that are estimated, 0 for those held fixed.
    expected : ExpectedArrays
        Means and deviations.
    blocks, border, corner : array, shapes (N, 6, 6), (N, 6, 23) and (23, 23)
        Of the inverse curvature.
    numbers : PosteriorNumbers
        Constants.
    solution : SolutionArrays
        Poses and shared variables are read; covariances and face distances are written.

    """
    underrated = np.empty(INPUT_ERRORS)
    shift = np.empty(3)
    R = np.empty((3, 3))
    poses, shared, error = solution.poses[b], solution.shared[b], expected.input_error[b]
    fill_underrated_information(expected.deviation[b], error, free, underrated)
    for n in range(len(poses)):
        fill_rotation(poses[n, 3], poses[n, 4], poses[n, 5], R)
        fill_pose_covariance(
            blocks[n], border[n], underrated, R, numbers.pose_model_deviation,
            solution.pose_covariances[b, n],
        )  # fmt: skip
        for k in range(3):
            shift[k] = poses[n, k] - windows.boxes[b, n, k]
        fill_face_distances(
            shift, R, shared, faces.moments[0, n], faces.inset[0, n], faces.weight[0, n],
            solution.face_distances[b, n],
        )  # fmt: skip
    fill_extent_covariance(
        corner, free, underrated, error, numbers.extent_model_deviation,
        solution.extent_covariances[b],
    )  # fmt: skip
