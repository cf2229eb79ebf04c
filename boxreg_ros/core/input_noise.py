"""
The errors of the input poses and extents, estimated from their residuals (M14).

docs/method.md, section Input model, has the formulas.

"""

from collections.abc import Iterator
from itertools import chain
from typing import NamedTuple

from boxreg_ros.config import KINDS
from boxreg_ros.core.batch import EXTENT, POSE_ERRORS, Problem, State
from boxreg_ros.core.kernels import compiled, contiguous
from boxreg_ros.core.kernels.arrays import NoiseNumbers
from boxreg_ros.rotations import matrix_from_rpy
from boxreg_ros.structures import BOX_EXTENT, Floats, Ints, POSE
import numpy as np
from numpy.typing import NDArray
import torch
from torch import Tensor

# Constants whose origin is not stated are chosen; `boxreg bench sensitivity` halves and doubles
# each of them.
MAD_TO_DEVIATION = 1.48
"""Standard deviation over median absolute deviation. Derived: 1 / 0.6745 for a Gaussian."""
MIN_OBSERVATIONS_FOR_NOISE = 5
"""Fewest observations of a track that noise is estimated from."""
OBSERVATIONS_FOR_HALF_WEIGHT = 14
"""With as many observations in total the estimated noise has weight 1/2."""
MAX_CORRELATION = 0.9
"""Largest correlation of the errors of consecutive observations."""
CORRELATION_ITERATIONS = 5
"""Alternating evaluations of the correlation and of the variance that track means remove."""
MIN_LEFT = 0.3
"""Least part of a variance or correlation that the mean of a track or window is taken to leave."""
MIN_POWER = 1e-12
"""Errors with a smaller variance do not change along a track [m^2, rad^2]."""
REPEATED_BOX_TOLERANCE = 1e-3
"""A box that differs from the one before by less repeats it [m, rad]."""
RESIDUAL_ERRORS = (*POSE_ERRORS, 'extent', 'extent', 'extent')
"""Settings of `ClassConfig` that are the expected deviations of `input_residuals`."""


class InputNoise(NamedTuple):
    """
    Estimated errors of the input poses and extents.

    One row for each of `KINDS`; without that axis, the same for all kinds. Lengths are in units
    of the expected deviation, from the settings of the kind.

    Attributes
    ----------
    deviation : Tensor, shape (K, 9) or (9,)
        Robust standard deviation about the mean of a track, along the box axes: lon lat z roll
        pitch yaw, and the extents.
    correlation : Tensor, shape (K, 9) or (9,)
        Correlation from one observation to the next, 0 to 0.9.
    offset : Tensor, shape (K, 9) or (9,)
        Robust standard deviation of the means of the tracks about zero.
    weight : Tensor, shape (K, 1) or (1,)
        Weight of the estimate against the settings: 0 without observations, 1/2 after
        `OBSERVATIONS_FOR_HALF_WEIGHT`, near 1 after many.

    """

    deviation: Tensor = torch.zeros(9, dtype=torch.float64)
    correlation: Tensor = torch.zeros(9, dtype=torch.float64)
    offset: Tensor = torch.zeros(9, dtype=torch.float64)
    weight: Tensor = torch.zeros(1, dtype=torch.float64)

    @classmethod
    def estimate(cls, residuals: Tensor) -> 'InputNoise':
        """
        Estimate the noise of tracks (B, N, 9) of one kind (M14), NaN is left out.

        Of `input_residuals`, over their expected deviations. Tracks with fewer than
        `MIN_OBSERVATIONS_FOR_NOISE` observations are left out too.

        """
        by_kernel = compiled(residuals) is not None
        return (estimate_noise_compiled if by_kernel else estimate_noise_torch)(residuals)

    @classmethod
    def estimate_by_kind(cls, residuals: Tensor, kind: Tensor) -> 'InputNoise':
        """
        Estimate the noise of each of `KINDS` from tracks (B, N, 9) of a `kind` (B,).

        The noise of all other kinds together is the prior of each: a kind of which few boxes were
        seen is expected to err as the others do, in proportion to the settings of its kind.

        """
        seen = frozenset(kind.tolist())
        # Often all tracks are of one kind, and the same set is needed for several kinds.
        sets = [(seen & {k}, seen - {k}) for k in range(len(KINDS))]
        estimates = {frozenset[int](): cls(), seen: cls.estimate(residuals)}
        for kinds in set(chain.from_iterable(sets)) - estimates.keys():
            rows = torch.isin(kind, kind.new_tensor(list(kinds)))
            estimates[kinds] = cls.estimate(residuals[rows])
        own, others = (
            cls(*map(torch.stack, zip(*(estimates[kinds] for kinds in side), strict=True)))
            for side in zip(*sets, strict=True)
        )
        return own._with_prior(others)

    def _with_prior(self, others: 'InputNoise') -> 'InputNoise':
        """Return these estimates by kind, and as far as they have no weight those of `others`."""
        weight = self.weight + (1 - self.weight) * others.weight
        share = self.weight / weight.clamp(min=1e-9)
        return InputNoise(
            torch.lerp(others.deviation, self.deviation, share),
            torch.lerp(others.correlation, self.correlation, share),
            torch.lerp(others.offset, self.offset, share),
            weight,
        )

    def of(self, problem: Problem) -> 'InputNoise':
        """Return the noise of each window of `problem`, shapes (B, 9) and (B, 1)."""
        rows = (part.to(problem.boxes).expand(len(KINDS), -1) for part in self)
        return InputNoise(*(part[problem.kind] for part in rows))


def _removed_by_means(correlation: Tensor, n: Tensor) -> tuple[Tensor, Tensor]:
    """
    Return the loss of variance when the mean of `n` autoregressive errors is subtracted.

    The second value is the loss of the mean product of neighbours; both are over the variance of
    an error.

    """
    c = correlation
    with_mean = (1 - c**n) / (n * (1 - c))  # covariance of the first or last error with the mean
    of_mean = (1 + c) / (1 - c) / n - 2 * c * with_mean / (n * (1 - c))
    # Neighbours leave out one end each.
    inner = (n * of_mean - with_mean) / (n - 1)
    return of_mean, 2 * inner - of_mean


def estimate_noise_compiled(residuals: Tensor) -> InputNoise:
    """Return the same as `InputNoise.estimate`, by the kernel."""
    kernels = compiled(residuals)
    assert kernels is not None
    numbers = NoiseNumbers(
        MAD_TO_DEVIATION, MIN_OBSERVATIONS_FOR_NOISE, CORRELATION_ITERATIONS, MAX_CORRELATION,
        MIN_LEFT, MIN_POWER,
    )  # fmt: skip
    deviation, correlation, offset = np.empty((3, 9))
    values = contiguous(residuals.to(torch.float64))
    total = kernels.noise.estimate(values, numbers, deviation, correlation, offset)
    if not total:
        return UNKNOWN_NOISE
    weight = np.array([total / (total + OBSERVATIONS_FOR_HALF_WEIGHT)])
    return InputNoise(*map(torch.from_numpy, (deviation, correlation, offset, weight)))


def estimate_noise_torch(residuals: Tensor) -> InputNoise:
    """Return the same as `InputNoise.estimate`, by torch."""
    valid = residuals.isfinite().all(2)
    valid &= valid.sum(1, keepdim=True) >= MIN_OBSERVATIONS_FOR_NOISE
    residuals = residuals.nan_to_num()
    total = int(valid.sum())
    if not total:
        return UNKNOWN_NOISE
    tracks = valid.any(1).sum().to(residuals)
    count = valid.sum(1)[:, None, None].clamp(min=1)
    mean = (residuals * valid[..., None]).sum(1, keepdim=True) / count
    offset = MAD_TO_DEVIATION * mean[valid.any(1), 0].abs().median(0).values
    centred = residuals - mean
    deviation = MAD_TO_DEVIATION * centred[valid].abs().median(0).values
    # Lag-one autocorrelation of errors clipped at three deviations.
    bounded = centred.clamp(-3 * deviation, 3 * deviation)
    both = valid[:, 1:] & valid[:, :-1]
    first, second = bounded[:, :-1][both], bounded[:, 1:][both]
    power = (first.square() + second.square()).sum(0) / 2
    # A constant error, such as that of an extent that a tracker holds, is fully correlated;
    # with one or two tracks it cannot be distinguished from the labelling margin.
    constant = 1 - 2 / tracks
    ratio = (first * second).sum(0) / power.clamp(min=MIN_POWER)
    # The mean of a track removes part of the variance of its errors, the more the slower they
    # change, and part of the products of neighbours.
    removed = torch.zeros_like(ratio)
    for _ in range(CORRELATION_ITERATIONS):
        whole = ratio + (1 - ratio) * removed
        correlation = whole.where(power > MIN_POWER, constant).clamp(0.0, MAX_CORRELATION)
        variance, removed = _removed_by_means(correlation, total / tracks)
    deviation = deviation / (1 - variance).clamp(min=MIN_LEFT).sqrt()
    weight = deviation.new_tensor([total / (total + OBSERVATIONS_FOR_HALF_WEIGHT)])
    return InputNoise(deviation, correlation, offset, weight)


UNKNOWN_NOISE = InputNoise()


def input_residuals(problem: Problem, state: State) -> Tensor:
    """
    Return input minus fit along the box axes, in the order of `InputNoise`, shape (B, N, 9).

    NaN for boxes that repeat the one before, since boxes that a tracker holds have no new error,
    and for those without points, since their fit follows the input.

    """
    boxes, pose, extent, counts = _boxes_and_fit(problem, state)
    # The first box is compared with the last one: a track that is held throughout is left out.
    before = np.roll(boxes, 1, axis=1)
    residuals = _residuals(boxes, before, pose, extent[:, None], counts > 0)
    return torch.from_numpy(residuals).to(problem.boxes)


def residuals_at(problem: Problem, state: State, columns: Ints) -> Floats:
    """Return `normalised_residuals` (B, 9) of one observation of each window, in `columns`."""
    boxes, pose, extent, counts = _boxes_and_fit(problem, state)
    rows = np.arange(len(boxes))
    before, has_points = boxes[rows, columns - 1], counts[rows, columns] > 0
    residuals = _residuals(boxes[rows, columns], before, pose[rows, columns], extent, has_points)
    normalised: Floats = residuals / problem.of_class(*RESIDUAL_ERRORS).cpu().numpy()
    return normalised


def _boxes_and_fit(problem: Problem, state: State) -> Iterator[Floats]:
    parts = problem.boxes, state.pose, state.shared[:, EXTENT], problem.counts
    return (part.cpu().numpy() for part in parts)


def _residuals(
    boxes: Floats, before: Floats, pose: Floats, extent: Floats, has_points: NDArray[np.bool_]
) -> Floats:
    """Return input minus fit (..., 9), NaN for boxes without points or as the one `before`."""
    difference = boxes[..., POSE] - pose
    to_box = np.swapaxes(matrix_from_rpy(pose[..., 3:]), -1, -2)
    along = (to_box @ difference[..., :3, None])[..., 0]
    residuals = np.concatenate(
        [along, difference[..., 3:], boxes[..., BOX_EXTENT] / extent - 1], axis=-1
    )
    is_repeated = np.abs(boxes - before).max(-1) < REPEATED_BOX_TOLERANCE
    residuals[~has_points | is_repeated] = np.nan
    return residuals


def normalised_residuals(problem: Problem, state: State) -> Tensor:
    """Return `input_residuals` over the expected deviations of the class, (B, N, 9)."""
    return input_residuals(problem, state) / problem.of_class(*RESIDUAL_ERRORS)[:, None]
