"""Covariances: the inverse curvature, and the model error."""

from boxreg_ros.config import Config
from boxreg_ros.core import covariance
from boxreg_ros.core.refine import refine
from boxreg_ros.rotations import matrix_from_rpy
from boxreg_ros.simulation.simulate import simulate
import numpy as np


def refined_tracks():
    """Return refined tracks of a simulated street."""
    return refine(simulate('street', 0).tracks()[:3], Config())


def test_model_errors_are_added_along_the_axes_of_the_box(monkeypatch):
    with_model = refined_tracks()
    pose_deviation = np.array(covariance.POSE_MODEL_DEVIATION)
    extent_deviation = np.array(covariance.EXTENT_MODEL_DEVIATION)
    monkeypatch.setattr(covariance, 'POSE_MODEL_DEVIATION', (0.0,) * 6)
    monkeypatch.setattr(covariance, 'EXTENT_MODEL_DEVIATION', (0.0,) * 3)
    for ours, bare in zip(with_model, refined_tracks(), strict=True):
        is_refined = np.array(ours.status) == 'refined'
        axes = np.tile(np.eye(6), (len(ours.boxes), 1, 1))
        axes[:, :3, :3] = matrix_from_rpy(ours.boxes[:, 6:])
        expected = axes * pose_deviation**2 @ axes.swapaxes(1, 2)
        difference = ours.covariances - bare.covariances
        np.testing.assert_allclose(difference[is_refined], expected[is_refined], atol=1e-9)
        difference = ours.extent_covariances - bare.extent_covariances
        expected = np.tile(np.diag(extent_deviation**2), (len(ours.boxes), 1, 1))
        np.testing.assert_allclose(difference[is_refined], expected[is_refined], atol=1e-9)


def test_extent_covariances_are_symmetric_and_positive():
    for track in refined_tracks():
        matrices = track.extent_covariances
        np.testing.assert_allclose(matrices, matrices.swapaxes(1, 2), atol=1e-12)
        assert (np.linalg.eigvalsh(matrices) > 0).all()
