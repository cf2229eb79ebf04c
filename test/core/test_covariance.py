"""Covariances: the inverse curvature, errors of input and faces, and the model error."""

from boxreg_ros.config import Config
from boxreg_ros.core import covariance
from boxreg_ros.core.batch import EXTENT, GAP, SHARED, State
from boxreg_ros.core.expectation import Expectation
from boxreg_ros.core.face_support import FaceObservations
from boxreg_ros.core.refine import refine
from boxreg_ros.simulation.simulate import simulate
import numpy as np
import pytest
from scenes import drive, problem_of, track_of
import torch

D = torch.float64


def refined_tracks():
    """Return refined tracks of a simulated street."""
    return refine(simulate('street', 0).tracks()[:3], Config())


def test_the_model_errors_are_those_of_time_and_heading(monkeypatch):
    tracks = [drive_of(12, speed) for speed in (0.0, 10.0)]
    with_model = refine(tracks, Config())
    time, heading = covariance.TIME_DEVIATION, covariance.HEADING_MODEL_DEVIATION
    monkeypatch.setattr(covariance, 'TIME_DEVIATION', 0.0)
    monkeypatch.setattr(covariance, 'HEADING_MODEL_DEVIATION', 0.0)
    for ours, bare in zip(with_model, refine(tracks, Config()), strict=True):
        difference = ours.covariances - bare.covariances
        step = np.gradient(ours.boxes[:, :3], 0.1, axis=0)
        expected = time**2 * step[:, :, None] * step[:, None]
        np.testing.assert_allclose(difference[:, :3, :3], expected, atol=1e-9)
        np.testing.assert_allclose(difference[:, 5, 5], heading**2, atol=1e-9)


def drive_of(count, speed):
    """Return a track that drives straight on, with points."""
    return track_of(drive(count, speed=speed, turn=0.0), np.random.default_rng(0), str(speed))


def test_extent_covariances_are_symmetric_and_positive():
    for track in refined_tracks():
        matrices = track.extent_covariances
        np.testing.assert_allclose(matrices, matrices.swapaxes(1, 2), atol=1e-12)
        assert (np.linalg.eigvalsh(matrices) > 0).all()


def expectation(deviation, error):
    """Return an expectation of one window, its priors with `deviation`, off by `error` (9,)."""
    deviations = torch.full((1, SHARED), deviation, dtype=D)
    errors = torch.tensor([*error, *[deviation] * 6], dtype=D)[None]  # margins as claimed
    return Expectation(torch.zeros(1, SHARED), deviations, *torch.ones(3, 1, 6), errors)


def extent_variances(expected, is_free=1.0, measured=0.1):
    """Return the variances of extents that are each `measured` once with this deviation [m]."""
    information = expected.deviation**-2 + measured**-2
    inverse = torch.diag_embed(1 / information)
    free = torch.full((1, 15), is_free, dtype=D)
    underrated = free * covariance._underrated_information(expected, expected.deviation**-2)
    found = covariance._extent_covariance(expected, free, inverse, underrated)
    return found[0].diagonal().numpy()


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


def test_scattered_residuals_of_faces_by_hand():
    # Of a face that is visible in 40 observations, whose residuals alternate about 0.03 m: they
    # are not correlated. Their scatter has the weight 40, the one of the settings 14.
    problem = problem_of(drive(40, turn=0.0)[None], class_numbers={'shape': 0.03})
    weight = torch.zeros(1, 40, 6, dtype=D)
    weight[..., 0] = 1.0
    distances = 0.03 + 0.06 * torch.tensor([1.0, -1.0], dtype=D).repeat(20)[None, :, None]
    found = covariance._correlated_information(
        problem, weight, distances * weight, expectation(0.05, [0.0] * 9), Config()
    )
    claimed = Config().faces.ends ** 2
    measured = 0.06**2 / (1 - 1 / 40)  # the mean of the window removes part of it
    known = ((40 * measured + 14 * claimed) / 54 - claimed) / 40 / 0.05**4
    np.testing.assert_allclose(found[0], [known, *[0] * 5], rtol=1e-9)


@pytest.mark.parametrize(
    ('correlation', 'count'), [(0.0, 3000), (0.5, 3000), (0.8, 3000), (0.8, 2)]
)
def test_variance_of_the_mean_of_correlated_residuals(correlation, count):
    rng = np.random.default_rng(0)
    residuals = torch.zeros(1, count, 6, dtype=D)
    noise = torch.from_numpy(rng.normal(size=(count, 6)))
    for i in range(1, count):
        residuals[0, i] = correlation * residuals[0, i - 1] + noise[i]
    residuals -= residuals.mean(1, keepdim=True)
    found = covariance._variance_of_mean(residuals, torch.ones(1, count, 6, dtype=torch.bool))
    known = (1 + correlation) / (1 - correlation)
    if count < 10:  # nearly the usual correlation
        assert 1.5 < found < 5
    else:
        np.testing.assert_allclose(found, known, rtol=0.1)


def test_residuals_of_faces_are_from_the_margins_of_other_tracks():
    # Points 1.9 m ahead of the centre, in a box 4 m long: with the expected margin of 0.05 m they
    # are 0.05 m inside. The margin of the estimate, 0.3 m, takes up an error of the length.
    problem = problem_of(np.array([[[0.0, 0, 0, 4, 2, 1.5, 0, 0, 0]]]))
    shared = torch.zeros(1, SHARED, dtype=D)
    shared[:, EXTENT] = torch.tensor([4.0, 2.0, 1.5], dtype=D)
    shared[:, GAP] = 0.3
    margins = torch.zeros(1, SHARED, dtype=D)
    margins[:, GAP] = 0.05
    expected = expectation(0.05, [0.0] * 9)._replace(shared=margins)
    moments = torch.zeros(1, 1, 6, 4, 4, dtype=D)
    moments[..., 3, 0] = 1.9
    ones = torch.ones(1, 1, 6, dtype=D)
    shares = torch.zeros(1, 1, 2, 6, dtype=D)
    observations = FaceObservations(moments, 0 * ones, ones, 0 * ones, shares, ones[..., 0])
    found = covariance._face_distances(
        problem, State(problem.pose, shared), expected, torch.eye(3, dtype=D)[None, None],
        observations,
    )  # fmt: skip
    np.testing.assert_allclose(found[0, 0, 0], -0.05)
