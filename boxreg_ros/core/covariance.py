"""Covariances of the estimate, and the residuals of its faces: once per window, at its end."""

from boxreg_ros.core.arrowhead import InverseBlocks, product
from boxreg_ros.core.batch import BIAS, EXTENT, GAP, Posterior, Problem, SHARED, State
from boxreg_ros.core.geometry import FACE_AXIS, FACE_SIGN, rotation_from_rpy
from boxreg_ros.core.input_model import Expectation
import torch
from torch import Tensor

POSE_MODEL_DEVIATION = (0.03, 0.0, 0.0, 0.0, 0.0, 0.01)
"""
Model error of a pose along the axes of its box, x y z [m] and roll pitch yaw [rad].

The shape of the object is no box: all observations of a track share that error, so that their
number does not lower it. Chosen so that normalised squared errors of vehicles come near 1.

"""
EXTENT_MODEL_DEVIATION = (0.03, 0.012, 0.012)
"""The same of length, width and height [m]."""
INPUT_ERRORS = slice(EXTENT.start, BIAS.stop)
"""Shared variables whose prior is the input: the extents and the bias of the poses."""


def posterior(
    problem: Problem,
    state: State,
    moments: Tensor,
    inset: Tensor,
    weight: Tensor,
    expected: Expectation,
    free: Tensor,
    inverse: InverseBlocks,
) -> Posterior:
    """
    Return the covariances of settled windows (M26, M28), and the residuals of their faces.

    Parameters
    ----------
    problem : Problem
        B windows.
    state : State
        Their estimate.
    moments, inset, weight : Tensor, shapes (B, N, 6, 4, 4), (B, N, 6) and (B, N, 6)
        Of the `FaceObservations` of the last round.
    expected : Expectation
        Means and deviations of the last round.
    free : Tensor, shape (B, 6 N + 23)
        1 for variables that are estimated, 0 for those held fixed.
    inverse : InverseBlocks
        Of the Gauss-Newton curvature of the last round.

    """
    R = rotation_from_rpy(state.pose[..., 3:])
    estimated = free[:, -SHARED:][:, INPUT_ERRORS]
    columns = inverse.border[..., INPUT_ERRORS]  # (B, N, 6, 9)
    underrated = _underrated_information(expected, estimated)
    poses = inverse.links + product(columns * underrated[:, None, None], columns.mT)
    _add_pose_model_covariance(poses, R)
    extents = _extent_covariance(expected, estimated, inverse.corner, underrated)
    distances = _face_distances(problem, state, R, moments[..., 3, :3], inset)
    return Posterior(poses, extents, torch.where(weight > 0, distances, 0.0))


def _underrated_information(expected: Expectation, estimated: Tensor) -> Tensor:
    """
    Return w^2 (s^2 - 1 / w) of the input extents and biases, shape (B, 9) (M28).

    With the weight w of their prior and the deviation s of their errors: the variance of the
    gradient of their prior beyond the one that w claims. 0 where they are not `estimated`.

    """
    claimed = expected.deviation[:, INPUT_ERRORS] ** 2
    return estimated * (expected.input_error**2 - claimed) / claimed**2


def _extent_covariance(
    expected: Expectation, estimated: Tensor, covariance: Tensor, underrated: Tensor
) -> Tensor:
    """
    Return the covariances of the extents, shape (B, 3, 3).

    Extents that are not estimated have the errors of the input.

    """
    is_free = estimated[:, EXTENT]
    columns = covariance[:, EXTENT, INPUT_ERRORS] * is_free[..., None]
    found = product(columns * underrated[:, None], columns.mT)
    found = found + covariance[:, EXTENT, EXTENT] * is_free[..., None] * is_free[:, None]
    of_input = (1 - is_free) * expected.input_error[:, EXTENT] ** 2
    model = found.new_tensor(EXTENT_MODEL_DEVIATION) ** 2
    return found + torch.diag_embed(of_input + model)


def _add_pose_model_covariance(poses: Tensor, R: Tensor) -> None:
    """Add the model errors of boxes with axes `R` (B, N, 3, 3) to `poses` (B, N, 6, 6)."""
    variance = poses.new_tensor(POSE_MODEL_DEVIATION) ** 2
    poses[..., :3, :3] += product(R * variance[:3], R.mT)
    poses[..., 3:, 3:] += torch.diag(variance[3:])


def _face_distances(
    problem: Problem, state: State, R: Tensor, centroid: Tensor, inset: Tensor
) -> Tensor:
    """
    Return the mean of (M2) over the outermost points of each face, shape (B, N, 6) [m].

    `R` (B, N, 3, 3) are the axes of the boxes, `centroid` (B, N, 6, 3) is that of the points, from
    the centre of the input box [m].

    """
    normals = R.mT[..., FACE_AXIS, :] * FACE_SIGN.to(R)[:, None]  # (B, N, 6, 3)
    shift = (state.pose - problem.pose)[..., None, :3]
    outward = ((centroid - shift) * normals).sum(-1)
    half = state.shared[:, EXTENT][:, FACE_AXIS] / 2
    surface = (half - state.shared[:, GAP])[:, None] - inset
    return outward - surface
