"""Covariances: the inverse curvature, errors of input and faces, and the model error."""

from boxreg_ros.config import Config
from boxreg_ros.core.method import constants
from boxreg_ros.core.method.arrays import COMMON
from boxreg_ros.core.method.covariance import (
    empty_covariance_work,
    fill_extent_covariance,
    fill_face_distances,
    fill_information_of_faces,
    fill_underrated_information,
    remove_means,
    variance_of_mean,
)
from boxreg_ros.core.method.residuals import TERMS
from boxreg_ros.core.refine import refine
import numpy as np
import pytest
from scenes import drive, shared_of, simulated, track_of

RECORD = constants.CONSTANTS.with_settings(Config()).record()


def refined_tracks():
    """Return refined tracks of a simulated street."""
    return refine(simulated('street', 0).tracks()[:3], Config())


def test_the_model_errors_are_those_of_time_and_heading(set_constants):
    tracks = [drive_of(12, speed) for speed in (0.0, 10.0)]
    with_model = refine(tracks, Config())
    known = constants.CONSTANTS
    time, heading = known.time_deviation, known.heading_deviation
    set_constants(time_deviation=0.0, heading_deviation=0.0)
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


def extent_variances(deviation, error, is_free=1.0, measured=0.1):
    """Return variances of extents with priors `deviation`, each `measured` once [m]."""
    deviations, errors = np.full(23, deviation), np.full(15, error)
    inverse = np.diag(1 / (deviations**-2 + measured**-2))
    free = np.full(23, is_free)
    underrated, found = np.empty(15), np.empty((3, 3))
    fill_underrated_information(deviations, errors, deviations**-2, free, underrated)
    fill_extent_covariance(inverse, free, errors, underrated, found)
    return found.diagonal()


def test_a_prior_that_is_too_tight_is_no_evidence():
    # An extent with prior weight w = 1 / .05^2 and one measurement of information m = 1 / .1^2 is
    # (w a + m b) / (w + m): the errors of a and b are .2 and .1 m.
    w, m = 0.05**-2, 0.1**-2
    known = (w**2 * 0.2**2 + m) / (w + m) ** 2
    np.testing.assert_allclose(extent_variances(0.05, 0.2), known)


def test_a_prior_that_holds_leaves_the_inverse_curvature():
    np.testing.assert_allclose(extent_variances(0.05, 0.05), 1 / (0.05**-2 + 0.1**-2))


def test_fixed_extents_have_the_errors_of_the_input():
    np.testing.assert_allclose(extent_variances(0.05, 0.2, is_free=0.0), 0.2**2)
    for track in refine(simulated('street', 0).tracks()[:2], Config(extent='fixed')):
        deviations = np.sqrt(np.diagonal(track.extent_covariances, axis1=1, axis2=2))
        assert (deviations > 0.01 * track.boxes[:, 3:6]).all()
        assert (deviations < 0.2 * track.boxes[:, 3:6]).all()


def test_scattered_residuals_of_faces_by_hand():
    # Of a face that is visible in 40 observations, whose residuals alternate about 0.03 m: they
    # are not correlated. Their scatter has the weight 40, the one of the settings 14.
    terms, work = np.zeros(40, TERMS), empty_covariance_work(40)
    terms['visibility'][:, 0] = 1.0
    distances = np.zeros((40, 6))
    distances[:, 0] = 0.03 + 0.06 * np.tile([1.0, -1.0], 20)
    claimed = Config().faces.ends ** 2
    work.claimed[:], work.underrated[:] = claimed, 0.0
    remove_means(40, terms, distances, work)
    fill_information_of_faces(40, 0.0, terms, np.full(6, 0.05), RECORD, work)
    measured = 0.06**2 / (1 - 1 / 40)  # the mean of the window removes part of it
    known = ((40 * measured + 14 * claimed) / 54 - claimed) / 40 / 0.05**4
    np.testing.assert_allclose(work.underrated[9:15], [known, *[0] * 5], rtol=1e-9)


@pytest.mark.parametrize(
    ('correlation', 'count'), [(0.0, 3000), (0.5, 3000), (0.8, 3000), (0.8, 2)]
)
def test_variance_of_the_mean_of_correlated_residuals(correlation, count):
    rng = np.random.default_rng(0)
    residuals, noise = np.zeros((count, 6)), rng.normal(size=(count, 6))
    for i in range(1, count):
        residuals[i] = correlation * residuals[i - 1] + noise[i]
    terms, work = np.zeros(count, TERMS), empty_covariance_work(count)
    terms['visibility'], work.claimed[:] = 1.0, 1.0
    remove_means(count, terms, residuals, work)
    found = variance_of_mean(count, terms, RECORD, work)
    known = (1 + correlation) / (1 - correlation)
    if count < 10:  # nearly the usual correlation
        assert 1.5 < found < 5
    else:
        np.testing.assert_allclose(found, known, rtol=0.1)


def test_residuals_of_faces_are_from_the_margins_of_other_tracks():
    # Points 1.9 m ahead of the centre, in a box 4 m long: with the expected margin of 0.05 m they
    # are 0.05 m inside. The margin of the estimate, 0.3 m, takes up an error of the length.
    terms, common = np.zeros(1, TERMS), np.zeros((), COMMON)[()]
    terms['visibility'] = 1.0
    terms['W_faces'][..., 3, 3] = 7.0
    terms['W_faces'][..., 3, 0] = 7.0 * 1.9
    common['shared'][9:15] = 0.05
    distances, box = np.empty((1, 6)), np.array([[0.0, 0, 0, 4, 2, 1.5, 0, 0, 0]])
    shared = shared_of((4.0, 2.0, 1.5), GAP=0.3)[0]
    R = np.empty((3, 3))
    fill_face_distances(box, np.zeros((1, 6)), shared, common['shared'], terms, R, distances)
    np.testing.assert_allclose(distances[0, 0], -0.05)
