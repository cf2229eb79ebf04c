"""Covariances: the inverse curvature, and the model error."""

from boxreg_ros.config import Config
from boxreg_ros.core import covariance
from boxreg_ros.core.batch import SHARED
from boxreg_ros.core.input_model import Expectation
from boxreg_ros.core.refine import refine
from boxreg_ros.rotations import matrix_from_rpy
from boxreg_ros.simulation.simulate import simulate
import numpy as np
import torch


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


def expectation(deviation, error):
    """Return an expectation of one window, its priors with `deviation`, off by `error` (9,)."""
    deviations = torch.full((1, SHARED), deviation, dtype=torch.float64)
    errors = torch.tensor(error, dtype=torch.float64).expand(1, 9)
    return Expectation(torch.zeros(1, SHARED), deviations, *torch.ones(3, 1, 6), errors)


def extent_variances(expected, is_free=1.0, measured=0.1):
    """Return the variances of extents that are each `measured` once with this deviation [m]."""
    information = expected.deviation**-2 + measured**-2
    inverse = torch.diag_embed(1 / information)
    free = torch.full((1, 9), is_free, dtype=torch.float64)
    underrated = covariance._underrated_information(expected, free)
    found = covariance._extent_covariance(expected, free, inverse, underrated)
    model = np.array(covariance.EXTENT_MODEL_DEVIATION) ** 2
    return found[0].diagonal().numpy() - model


def test_a_prior_that_is_too_tight_is_no_evidence():
    # An extent with prior weight w = 1 / .05^2 and one measurement of information m = 1 / .1^2 is
    # (w a + m b) / (w + m): the errors of a and b are .2 and .1 m.
    w, m = 0.05**-2, 0.1**-2
    known = (w**2 * 0.2**2 + m) / (w + m) ** 2
    np.testing.assert_allclose(extent_variances(expectation(0.05, [0.2] * 9)), known)


def test_a_prior_that_holds_leaves_the_inverse_curvature():
    known = 1 / (0.05**-2 + 0.1**-2)
    np.testing.assert_allclose(extent_variances(expectation(0.05, [0.05] * 9)), known)


def test_fixed_extents_have_the_errors_of_the_input():
    variances = extent_variances(expectation(0.05, [0.2] * 9), is_free=0.0)
    np.testing.assert_allclose(variances, 0.2**2)
    for track in refine(simulate('street', 0).tracks()[:2], Config(extent='fixed')):
        deviations = np.sqrt(np.diagonal(track.extent_covariances, axis1=1, axis2=2))
        assert (deviations > 0.01 * track.boxes[:, 3:6]).all()
        assert (deviations < 0.2 * track.boxes[:, 3:6]).all()
