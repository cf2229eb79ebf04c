"""Covariances: the inverse curvature, errors of input and faces, and the model error."""

from boxreg_ros.config import Config
from boxreg_ros.core.method import constants
from boxreg_ros.core.method.arrays import COMMON, EXTENT, GAP, PIVOT
from boxreg_ros.core.method.covariance import (
    empty_inverse,
    fill_extent_covariance,
    fill_face_distances,
    fill_shared_covariance,
    fill_unclaimed,
)
from boxreg_ros.core.method.residuals import TERMS
from boxreg_ros.core.refine import refine
from measure.drives import tracks_of
import numpy as np
from scenes import drive, shared_of, simulated, track_of

CONSTANTS = constants.CONSTANTS
RECORD = CONSTANTS.with_settings(Config()).record()[0]
SWEEPS = 15  # of a simulated street


def refined_tracks():
    """Return refined tracks of a simulated street."""
    return refine(tracks_of(simulated('street', 0, SWEEPS))[:3], Config())


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


def unclaimed(visibility=0.0, variance=0.0, extent=0.0, count=40, marginalised=0.0):
    """Return the weights of extents and margins of 5 cm, and what (M28) adds to (M26)."""
    terms, common = np.zeros(count, TERMS), np.zeros((), COMMON)[()]
    terms['visibility'] = visibility
    common['margin_variance'], common['unclaimed'][:3] = variance, extent
    common['W_shared'] = 0.05**-2
    G = np.empty((PIVOT, PIVOT))
    fill_unclaimed(count, marginalised, terms, common, 0.0, RECORD, G)
    return 0.05**-2, G


def covariance_of(columns, free=1.0, G=None, deviation=0.0, variance=0.0):
    """Return the covariance of the extents by columns (23, 23) of the inverse curvature."""
    common, found = np.zeros((), COMMON)[()], np.empty((3, 3))
    common['deviation'], common['unclaimed'] = deviation, variance
    G, inverse = np.zeros((PIVOT, PIVOT)) if G is None else G, empty_inverse(1, len(columns))
    fill_shared_covariance(columns, G, inverse)
    fill_extent_covariance(inverse.shared, np.full(23, free), common, found)
    return found


def test_the_error_of_the_margin_of_a_kind_is_common_to_opposite_faces():
    # Points are on both sides of a box: its width errs by twice the error of the margin where
    # the prior is exact, else by a share; the sum of two margins with the variances V + s^2.
    V = 0.03**2
    W, G = unclaimed(variance=V)
    known = W**2 * V * np.kron(np.diag([1.0, 1.0, 0.0]), np.ones((2, 2)))
    known[4:, 4:] = W**2 * V * np.eye(2)
    np.testing.assert_allclose(G[GAP:, GAP:], known)
    # Sides are seen exactly: width = 2 y + g + g', and margins are free within their prior.
    columns = np.zeros((23, 23))
    columns[1, 1] = 2 * 0.05**2
    columns[1, GAP + 2] = columns[1, GAP + 3] = 0.05**2
    np.testing.assert_allclose(covariance_of(columns, G=G)[1, 1], 2 * 0.05**2 + 4 * V)


def test_errors_of_extents_that_no_weight_claims():
    # A fit that follows the input, whose prior claims 5 cm: the variances add up.
    W, G = unclaimed(extent=[0.01, 0.02, 0.03])
    columns = np.zeros((23, 23))
    columns[EXTENT : EXTENT + 3, EXTENT : EXTENT + 3] = np.eye(3) / W
    found = covariance_of(columns, G=G)
    np.testing.assert_allclose(found, np.diag([0.01, 0.02, 0.03]) + 0.05**2 * np.eye(3))


def test_correlated_residuals_of_a_face_are_an_error_of_its_margin():
    # 40 observations in the window and 40 before it, of weight 1/2, count as 40 independent ones;
    # correlated by c as one in (1 + c) / (1 - c).
    c = CONSTANTS.residual_correlation
    W, G = unclaimed(visibility=[0.5, 0, 0, 0, 0, 0], marginalised=40.0)
    known = W**2 * Config().faces.ends ** 2 / 40 * ((1 + c) / (1 - c) - 1)
    np.testing.assert_allclose(G[GAP:, GAP:], np.diag([known, 0, 0, 0, 0, 0]))


def test_fixed_extents_have_the_errors_of_the_input():
    found = covariance_of(np.eye(23), free=0.0, deviation=0.2, variance=0.01)
    np.testing.assert_allclose(found, 0.05 * np.eye(3))
    for track in refine(tracks_of(simulated('street', 0, SWEEPS))[:2], Config(extent='fixed')):
        deviations = np.sqrt(np.diagonal(track.extent_covariances, axis1=1, axis2=2))
        assert (deviations > 0.01 * track.boxes[:, 3:6]).all()
        assert (deviations < 0.2 * track.boxes[:, 3:6]).all()


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
