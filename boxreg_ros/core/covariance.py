"""Covariances of the estimate, and the residuals of its faces: once per window, at its end."""

from boxreg_ros.core.arrowhead import BandedFactor, Factor
from boxreg_ros.core.batch import EXTENT, GAP, Posterior, Problem, State
from boxreg_ros.core.geometry import FACE_AXIS, FACE_SIGN, rotation_from_rpy
import torch
from torch import Tensor

POSE_MODEL_DEVIATION = (0.03, 0.0, 0.0, 0.0, 0.0, 0.01)
"""
Model error of a pose along the axes of its box, x y z [m] and roll pitch yaw [rad].

The objective takes the errors of observations for independent, so that its curvature grows with
their number. But all observations of a track share the shape of its body and the person or
detector that drew its box: their number does not lower this part. Chosen by hand on the recordings
of docs/results.md, so that the mean normalised squared errors of vehicles there come near 1.

"""
EXTENT_MODEL_DEVIATION = (0.03, 0.012, 0.012)
"""The same of length, width and height [m]."""


def posterior(
    problem: Problem,
    state: State,
    moments: Tensor,
    inset: Tensor,
    weight: Tensor,
    factor: Factor | BandedFactor,
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
    factor : Factor or BandedFactor
        Of the Gauss-Newton curvature of the last round.

    """
    poses = factor.inverse_of_links(problem.length) + _pose_model_covariance(state)
    extents = torch.cholesky_inverse(factor.corner)[:, EXTENT, EXTENT]
    extents = extents + torch.diag(extents.new_tensor(EXTENT_MODEL_DEVIATION) ** 2)
    distances = _face_distances(problem, state, moments[..., 3, :3], inset)
    return Posterior(poses, extents, torch.where(weight > 0, distances, 0.0))


def _pose_model_covariance(state: State) -> Tensor:
    """Return the covariance of the model errors in the fixed frame (M28), (B, N, 6, 6)."""
    axes = torch.eye(6).to(state.pose).repeat(*state.pose.shape[:2], 1, 1)
    axes[..., :3, :3] = rotation_from_rpy(state.pose[..., 3:])
    return axes * axes.new_tensor(POSE_MODEL_DEVIATION) ** 2 @ axes.mT


def _face_distances(problem: Problem, state: State, centroid: Tensor, inset: Tensor) -> Tensor:
    """
    Return the mean of (M2) over the outermost points of each face, shape (B, N, 6) [m].

    `centroid` (B, N, 6, 3) is that of the points, from the centre of the input box [m].

    """
    shift = (state.pose - problem.pose)[..., None, :3]
    local = (centroid - shift) @ rotation_from_rpy(state.pose[..., 3:])
    outward = local[..., range(6), FACE_AXIS] * FACE_SIGN.to(local)
    half = state.shared[:, EXTENT][:, FACE_AXIS] / 2
    surface = (half - state.shared[:, GAP])[:, None] - inset
    return outward - surface
