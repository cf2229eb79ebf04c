"""Covariances of the estimate, and the residuals of its faces: once per window, at its end."""

from boxreg_ros.config import Config
from boxreg_ros.core.arrowhead import InverseBlocks, product
from boxreg_ros.core.batch import EXTENT, GAP, Posterior, Problem, SHARED, State
from boxreg_ros.core.expectation import Expectation
from boxreg_ros.core.face_support import FaceObservations
from boxreg_ros.core.geometry import FACE_AXIS, FACE_SIGN, rotation_from_rpy
from boxreg_ros.core.input_noise import (
    MAX_CORRELATION,
    MIN_LEFT,
    MIN_POWER,
    OBSERVATIONS_FOR_HALF_WEIGHT,
)
from boxreg_ros.core.kernels.arrays import CovarianceNumbers
from boxreg_ros.core.weights import face_deviations
import torch
from torch import Tensor

RESIDUAL_CORRELATION = 0.55
"""
Correlation of the distances of a face from its points, from one observation to the next.

Used as far as a window has few observations. Measured about the mean of each track on five
recordings, for ends, sides and roof: 0.4 to 0.65.

"""
MIN_DURATION = 1e-3
"""Shortest time between two observations [s]; padding has none."""
MIN_WEIGHT = 1e-9
"""Faces with less weight in total have no residuals."""
CORRELATED_FACES = (1.0, 1.0, 0.0, 0.0, 1.0, 1.0)
"""Faces whose correlation counts. The spread of the margins of the sides, `gap_spread`, covers
theirs: with them too, normalised squared errors across are 0.3 on simulated data."""
TIME_DEVIATION = 0.01
"""
Deviation of the time of a label from that of its points [s].

Measured along the heading: moving objects of PandaSet err by 12 ms more than parked ones,
simulated ones by less than 3 ms.

"""
HEADING_MODEL_DEVIATION = 0.01
"""Angle from the heading of a label to its surface [rad]. That of the setting `sideslip`: between
those of the labels of PandaSet and of Argoverse 2."""
UNDERRATED = slice(EXTENT.start, GAP.stop)
"""Shared variables of (M28): extents, bias and labelling margins."""


def covariance_numbers() -> CovarianceNumbers:
    """Return the constants for the kernel."""
    return CovarianceNumbers(
        residual_correlation=RESIDUAL_CORRELATION,
        max_correlation=MAX_CORRELATION,
        half_weight=float(OBSERVATIONS_FOR_HALF_WEIGHT),
        min_left=MIN_LEFT,
        min_power=MIN_POWER,
        min_weight=MIN_WEIGHT,
        min_duration=MIN_DURATION,
        time_deviation=TIME_DEVIATION,
        heading_deviation=HEADING_MODEL_DEVIATION,
        correlated_faces=CORRELATED_FACES,
    )


def posterior(
    problem: Problem,
    state: State,
    observations: FaceObservations,
    expected: Expectation,
    free: Tensor,
    shared_weight: Tensor,
    inverse: InverseBlocks,
    config: Config,
) -> Posterior:
    """
    Return the covariances of settled windows (M26, M28), and the residuals of their faces.

    Parameters
    ----------
    problem : Problem
        B windows.
    state : State
        Their estimate.
    observations : FaceObservations
        Of the last round.
    expected : Expectation
        Means and deviations of the last round.
    free : Tensor, shape (B, 6 N + 23)
        1 for variables that are estimated, 0 for those held fixed.
    shared_weight : Tensor, shape (B, 23)
        Weights of the shared variables (M22) in the last round.
    inverse : InverseBlocks
        Of the Gauss-Newton curvature of the last round.
    config : Config
        Settings.

    """
    R = rotation_from_rpy(state.pose[..., 3:])
    estimated = free[:, -SHARED:][:, UNDERRATED]
    distances = _face_distances(problem, state, expected, R, observations)
    underrated = estimated * _underrated_information(expected, shared_weight)
    underrated[:, GAP] += _correlated_information(
        problem, observations.weight, distances, expected, config
    )
    columns = inverse.border[..., UNDERRATED]  # (B, N, 6, 15)
    poses = inverse.links + product(columns * underrated[:, None, None], columns.mT)
    shift = TIME_DEVIATION * _velocities(problem, state)
    poses[..., :3, :3] += shift[..., None] * shift[..., None, :]
    poses[..., 5, 5] += HEADING_MODEL_DEVIATION**2
    extents = _extent_covariance(expected, estimated, inverse.corner, underrated)
    return Posterior(poses, extents, distances)


def _underrated_information(expected: Expectation, weight: Tensor) -> Tensor:
    """
    Return w (s^2 / d^2 - 1) of extents, bias and margins, shape (B, 15) (M28).

    With the `weight` w (B, 23) and the deviation d of their prior, and the deviation s of their
    errors: the variance of the gradient of the prior beyond the one that w claims. A margin whose
    weight is lowered as that of an outlier has errors as much wider.

    """
    claimed = expected.deviation[:, UNDERRATED] ** 2
    return weight[:, UNDERRATED] * (expected.error**2 / claimed - 1)


def _correlated_information(
    problem: Problem, weight: Tensor, distances: Tensor, expected: Expectation, config: Config
) -> Tensor:
    """
    Return w^2 s^2 of the labelling margins, shape (B, 6), for the errors of faces (M28).

    An error common to all observations of a face acts on the estimate as one of its margin, which
    has the weight w of its prior. s^2 is the variance of the mean of the observations, by their
    scatter and correlation, less the one that their weights claim. `weight` (B, N, 6) is that of
    each, 1 for a visible face, `distances` (B, N, 6) are their residuals [m]. Observations that
    were marginalised count as those of the window.

    """
    weight = weight * problem.valid[..., None]
    total = weight.sum(1)
    share = weight / total.clamp(min=MIN_WEIGHT)[:, None]
    off_mean = distances - (share * distances).sum(1, keepdim=True)
    claimed = face_deviations(problem, config) ** 2
    of_mean = _variance_of_mean(off_mean / claimed.sqrt()[:, None], weight > 0)
    count = (weight > 0).sum(1).to(distances)
    left = (1 - of_mean / count.clamp(min=1)).clamp(min=MIN_LEFT)
    scatter = (share * off_mean**2).sum(1) / left
    variance = of_mean * torch.lerp(claimed, scatter, _weight_of(count)) - claimed
    valid = problem.valid.sum(1, keepdim=True)
    total = total * (valid + problem.marginalised_extents[:, 3:]) / valid
    variance = torch.where(total > 0, variance / total, 0.0)
    return variance * variance.new_tensor(CORRELATED_FACES) / expected.deviation[:, GAP] ** 4


def _variance_of_mean(residuals: Tensor, is_seen: Tensor) -> Tensor:
    """
    Return the variance of the mean of many residuals over that of independent ones, (B, 1).

    That of a first-order autoregressive process with the correlation of consecutive `residuals`
    (B, N, 6) from their mean, where `is_seen`, all faces together. The mean of n residuals lowers
    their correlation r by (1 + 4 r) / n (Marriott and Pope, 1954).

    """
    both = is_seen[:, 1:] & is_seen[:, :-1]
    first, second = residuals[:, :-1] * both, residuals[:, 1:] * both
    power = (first**2 + second**2).sum((1, 2)) / 2
    ratio = (first * second).sum((1, 2)) / power.clamp(min=MIN_POWER)
    n = is_seen.sum((1, 2)).to(residuals) / is_seen.any(1).sum(1).clamp(min=1)
    n = n.clamp(min=1)
    unbiased = (ratio + 1 / n) / (1 - 4 / n).clamp(min=MIN_LEFT)
    correlation = RESIDUAL_CORRELATION + _weight_of(n) * (unbiased - RESIDUAL_CORRELATION)
    correlation = correlation.clamp(0.0, MAX_CORRELATION)
    return ((1 + correlation) / (1 - correlation))[:, None]


def _weight_of(count: Tensor) -> Tensor:
    """Return the weight of what `count` observations show against what is usual."""
    return count / (count + OBSERVATIONS_FOR_HALF_WEIGHT)


def _velocities(problem: Problem, state: State) -> Tensor:
    """Return the velocities of the estimate by its neighbours, shape (B, N, 3) [m/s]."""
    here = torch.arange(problem.length).to(problem.first)
    last = problem.valid.sum(1, keepdim=True) - 1
    after = (here + 1).minimum(last)
    before = (here - 1).clamp(min=0).minimum(after)
    rows = torch.arange(len(last)).to(last)[:, None]
    step = state.pose[rows, after, :3] - state.pose[rows, before, :3]
    duration = problem.times[rows, after] - problem.times[rows, before]
    return step / duration.clamp(min=MIN_DURATION)[..., None]


def _extent_covariance(
    expected: Expectation, estimated: Tensor, covariance: Tensor, underrated: Tensor
) -> Tensor:
    """
    Return the covariances of the extents, shape (B, 3, 3).

    Extents that are not estimated have the errors of the input.

    """
    is_free = estimated[:, EXTENT]
    columns = covariance[:, EXTENT, UNDERRATED] * is_free[..., None]
    found = product(columns * underrated[:, None], columns.mT)
    found = found + covariance[:, EXTENT, EXTENT] * is_free[..., None] * is_free[:, None]
    of_input = (1 - is_free) * expected.error[:, EXTENT] ** 2
    return found + torch.diag_embed(of_input)


def _face_distances(
    problem: Problem,
    state: State,
    expected: Expectation,
    R: Tensor,
    observations: FaceObservations,
) -> Tensor:
    """
    Return the mean of (M2) over the outermost points of each face, shape (B, N, 6) [m].

    With the labelling margins `expected` by other tracks: those of the estimate would take up the
    error of extents that are held. 0 without points. `R` (B, N, 3, 3) are the axes of the boxes.

    """
    centroid = observations.moments[..., 3, :3]  # from the centre of the input box [m]
    normals = R.mT[..., FACE_AXIS, :] * FACE_SIGN.to(R)[:, None]  # (B, N, 6, 3)
    shift = (state.pose - problem.pose)[..., None, :3]
    outward = ((centroid - shift) * normals).sum(-1)
    half = state.shared[:, EXTENT][:, FACE_AXIS] / 2
    surface = (half - expected.shared[:, GAP])[:, None] - observations.inset
    return torch.where(observations.weight > 0, outward - surface, 0.0)
