"""Covariances of the estimate, and the residuals of its faces: once per window, at its end."""

from boxreg_ros.core.arrowhead import InverseBlocks, product
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
    inverse : InverseBlocks
        Of the Gauss-Newton curvature of the last round.

    """
    R = rotation_from_rpy(state.pose[..., 3:])
    poses = inverse.links.clone()
    _add_pose_model_covariance(poses, R)
    extents = inverse.corner[:, EXTENT, EXTENT]
    extents = extents + torch.diag(extents.new_tensor(EXTENT_MODEL_DEVIATION) ** 2)
    distances = _face_distances(problem, state, R, moments[..., 3, :3], inset)
    return Posterior(poses, extents, torch.where(weight > 0, distances, 0.0))


def _add_pose_model_covariance(poses: Tensor, R: Tensor) -> None:
    """Add the model errors of boxes with axes `R` (B, N, 3, 3) to `poses` (B, N, 6, 6) (M28)."""
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
