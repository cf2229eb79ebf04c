"""
The input model: labelling margins, noise of the input boxes, population prior on extents.

docs/method.md, section Input model, has the formulas (M14) to (M18).

"""

from collections.abc import Iterator, Sequence
from itertools import chain
from typing import Any, NamedTuple

from boxreg_ros.config import FaceConfig, KINDS
from boxreg_ros.core.batch import (
    EXTENT,
    FACE_GAPS,
    GAP,
    PIVOT,
    POSE_ERRORS,
    Problem,
    SHARED,
    State,
)
from boxreg_ros.core.face_support import FaceObservations, FaceOffsets
from boxreg_ros.core.geometry import FACE_AXIS
from boxreg_ros.core.kernels import compiled, contiguous, run
from boxreg_ros.core.kernels.arrays import (
    ExpectationNumbers,
    ExpectedArrays,
    InputArrays,
    NoiseNumbers,
)
from boxreg_ros.rotations import matrix_from_rpy
from boxreg_ros.structures import BOX_EXTENT, Floats, Ints, POSE, ROLL
import numpy as np
from numpy.typing import NDArray
import torch
from torch import Tensor

# Constants whose origin is not stated are chosen; `boxreg bench sensitivity` halves and doubles
# each of them.
MAD_TO_DEVIATION = 1.48
"""Standard deviation over median absolute deviation. Derived: 1 / 0.6745 for a Gaussian."""
QUARTILES_TO_DEVIATION = 0.74
"""Standard deviation over interquartile range. Derived: 1 / 1.349 for a Gaussian."""

FACE_GROUPS = ([0, 1], [2, 3], [4], [5])
"""Faces with one labelling margin: ends, sides, top, bottom."""
GAP_DEVIATIONS = {
    'vehicle': (0.05, 0.05, 0.05, 0.15),
    'cyclist': (0.15, 0.15, 0.15, 0.15),
    'pedestrian': (0.15, 0.15, 0.15, 0.15),
}
"""Prior deviation of each margin from the one of the settings of its kind [m]."""
LARGE_EXTENT = (5.0, 2.0, 2.0)
"""The margins of larger objects differ in proportion to their extent [m]; a large car."""
MIN_TRACK_OBSERVATIONS = 3
"""Fewest face observations of a track, and tracks, that a margin is estimated from."""
MIN_GAP_DEVIATION = 0.02
"""Added to the interquartile range of margins: few tracks may agree by chance [m]."""
MIDMEAN_FACTOR = 1.1
"""Error of the mean of the middle half over that of the mean. Derived: sqrt(1.2), the efficiency
of the midmean of a Gaussian."""
MAX_FACE_DISTANCE = 0.5
"""No margin is estimated from points further than this from where they are expected [m]."""
MIN_BOX_POINTS = 30
"""No margin is estimated from near boxes with fewer points."""
MAX_VISIBLE_SHARE = 0.25
"""A face with a smaller share of the occlusion inset counts as visible."""
MIN_OCCLUDED_SHARE = 0.5
"""A face with a larger share of the occlusion inset counts as occluded."""
MIN_DISTANT_SHARE = 0.5
"""A face with a larger share of the range inset counts as distant: beyond 45 m."""

MAX_TRACKS = 200
"""Tracks that the model keeps, those seen last."""
MAX_FITS_PER_TRACK = 100
"""Fits of each track that the model keeps, the last ones."""

MIN_OBSERVATIONS_FOR_NOISE = 5
"""Fewest observations of a track that noise is estimated from."""
OBSERVATIONS_FOR_HALF_WEIGHT = 14
"""With as many observations in total the estimated noise has weight 1/2."""
MAX_CORRELATION = 0.9
"""Largest correlation of the errors of consecutive observations."""
CORRELATION_ITERATIONS = 5
"""Alternating evaluations of the correlation and of the variance that track means remove."""
MIN_LEFT = 0.3
"""Least part of the variance that the means of tracks are taken to leave."""
MIN_POWER = 1e-12
"""Errors with a smaller variance do not change along a track [m^2, rad^2]."""
TYPICAL_CORRELATION = 0.385
"""Correlation of the errors of consecutive observations before any was estimated."""
CORRELATION_INTERVAL = 0.1
"""Time over which the errors of biased input are correlated [s]."""
WHITE_CORRELATION = 0.15
"""Input whose errors are correlated by less over that time has (nearly) no bias."""
CORRELATION_SPAN = 0.3
"""Above `WHITE_CORRELATION` by this much, the bias is as large as the error."""
FILTERED_OFFSET = 0.5
"""Input of tracks whose means are off by this multiple of its usual error has been filtered."""
MAX_FILTERED_BIAS = 0.7
"""Largest bias of filtered input, as a multiple of its usual error."""
LOW_NOISE_RATIO = 0.4
"""Input with less than this part of its usual error is low-noise input, such as human labels."""
RATIO_BOUNDS = (0.02, 4.0)
"""Bounds of estimated over expected error."""
YAW_BIAS = 0.5
"""Bias of the input yaw over that of the other variables, in deviations."""
CONSTANT_EXTENT_ERRORS = {
    'vehicle': (1.6, 2.9, 1.6),
    'cyclist': (1.9, 3.1, 2.0),
    'pedestrian': (2.9, 3.2, 1.7),
}
"""
Error of length, width and height that is constant along a track, over the one that changes.

Measured of PointRCNN on KITTI: of cars 0.217, 0.083 and 0.071 m over 0.176, 0.030 and 0.052 m,
times the ratios of standard to robust deviation, 1.28, 1.05 and 1.18; of cyclists 0.101, 0.112 and
0.078 m over 0.053, 0.036 and 0.039 m; of pedestrians 0.152, 0.117 and 0.080 m over 0.052, 0.037
and 0.047 m.

"""
PIVOT_DEVIATION = 0.25
"""Deviation of the pivot, as part of the length."""

POPULATION_RADIUS = 0.5
"""Distance in logarithms of extents at which objects have weight 1/2 for each other."""
SLOPE_DEVIATION = 240.0
"""Prior deviation of the slope of extent corrections, per squared error. Derived: 0.6 for input
whose extents err by 5 %, 0.6 / 0.05^2."""
CROSS_SLOPE_INFORMATION = 4.0
"""Prior information of slopes over the other two extents: half the deviation of the own one."""
MIN_EXTENT_GAIN = 0.2
"""Smallest part of the information about an extent that points must provide to be evidence."""
PINNED_EXTENT = 0.01
"""Deviation of the extents of a pinned box and of its bias [m, rad]: practically held."""
PINNED_MARGINS = 4.0
"""Factor on the deviation of labelling margins beside a pinned box, whose faces are evidence of
them. Chosen; 4 and 10 give the same."""
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


class Population(NamedTuple):
    """
    Evidence of the points of n tracks about their extents.

    Attributes
    ----------
    evidence : Tensor, shape (n, 3, 3)
        Rows of length, width and height: logarithms of the input's; corrections to these, over
        the square of their expected error; the weights of these, 0 without enough evidence.
    kind : Tensor, shape (n,)
        Indices among `KINDS`.

    """

    evidence: Tensor = torch.zeros(0, 3, 3, dtype=torch.float64)
    kind: Tensor = torch.zeros(0, dtype=torch.int64)

    def joined(self, evidence: Tensor, kind: Tensor) -> 'Population':
        """Return this population with more tracks."""
        evidence = torch.cat([self.evidence, evidence.to(self.evidence)])
        return Population(evidence, torch.cat([self.kind, kind.to(self.kind)]))

    def factors(self, problem: Problem, given: Tensor, error: Tensor) -> Tensor:
        """Return the `population_factor` of each window, by tracks of its kind, (B, 3)."""
        median, slopes = (torch.from_numpy(part).to(given)[problem.kind] for part in self.slopes())
        return _factor(median, slopes, given, error)

    def slopes(self) -> tuple[Floats, Floats]:
        """Return `population_slopes` by kind, shapes (K, 3) and (K, 3, 3); 0 without tracks."""
        evidence, kind = self.evidence.cpu().numpy(), self.kind.cpu().numpy()
        median, slopes = np.zeros((len(KINDS), 3)), np.zeros((len(KINDS), 3, 3))
        for k in set(kind.tolist()):
            median[k], slopes[k] = population_slopes(evidence[kind == k])
        return median, slopes


def _removed_by_means(correlation: Tensor, n: Tensor) -> tuple[Tensor, Tensor]:
    """
    Return what is lost when the mean of `n` autoregressive errors is subtracted from each.

    Of their variance, and of the mean product of neighbours; both over the variance of an error.

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
UNKNOWN_POPULATION = Population()


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


def smoothed_angles(problem: Problem) -> Tensor:
    """
    Return roll, pitch and yaw of the start of the search, smoothed over time, (B, N, 3) [rad].

    By the motion model alone: the noise, estimated from second differences, against the angular
    accelerations of the class. The outermost points of a box with a wrong yaw are its corners,
    further outside than its faces: margins are estimated at these angles.

    """
    angles = problem.start[..., ROLL:]
    B, N = problem.valid.shape
    if N < MIN_TRACK_OBSERVATIONS:
        return angles
    step = problem.times.diff(dim=1)
    mean_step = (step[:, 1:] + step[:, :-1]) / 2
    # Rows of the second derivative by time, (B, N - 2, N), without padding.
    before = 1 / (step[:, :-1] * mean_step)
    after = 1 / (step[:, 1:] * mean_step)
    rows = torch.stack([before, -before - after, after], 2) * problem.valid[:, 2:, None]
    derivative = angles.new_zeros((B, N - 2, N))
    for k in range(3):
        derivative.diagonal(k, 1, 2).copy_(rows[..., k])
    acceleration = derivative @ angles  # (B, N - 2, 3)
    noise_gain = derivative.square().sum(2, keepdim=True).sqrt().clamp(min=MIN_POWER)
    white = torch.where(problem.valid[:, 2:, None], acceleration.abs() / noise_gain, torch.nan)
    noise = MAD_TO_DEVIATION * white.nanmedian(1).values.nan_to_num()  # (B, 3)
    stiffness = (noise / problem.of_class('tilting', 'tilting', 'turning')) ** 2
    roughness = (derivative.mT @ derivative)[:, None] * stiffness[..., None, None]
    system = torch.eye(N).to(angles) + roughness  # (B, 3, N, N)
    smoothed, _ = torch.linalg.solve_ex(system, angles.mT[..., None])
    smoothed = smoothed[..., 0].mT
    # Noise of many radians makes the system singular to working precision.
    return torch.where(smoothed.isfinite(), smoothed, angles)


class Expectation(NamedTuple):
    """
    Means and deviations of a batch before its points are used.

    Attributes
    ----------
    shared : Tensor, shape (B, 23)
        Mean of the shared variables, see `State`.
    deviation : Tensor, shape (B, 23)
        Their deviations.
    pose_deviation : Tensor, shape (B, 6)
        Deviation of the input poses along the axes of their boxes, without their bias [m, rad].
    widened_deviation : Tensor, shape (B, 6)
        The same, widened for the correlation of the errors of neighbours [m, rad].
    unmodelled_bias : Tensor, shape (B, 6)
        Deviation of the bias of windows with a pinned box, where no bias is estimated; else 0.
    input_error : Tensor, shape (B, 9)
        Deviation of the errors of the mean input extents and of the bias, as in `State`, as far as
        these errors are known. At least `deviation`, which is smaller where extents or poses are
        held near the input.

    """

    shared: Tensor
    deviation: Tensor
    pose_deviation: Tensor
    widened_deviation: Tensor
    unmodelled_bias: Tensor
    input_error: Tensor


def expect(
    problem: Problem,
    offsets: FaceOffsets,
    noise: InputNoise = UNKNOWN_NOISE,
    population: Population = UNKNOWN_POPULATION,
) -> Expectation:
    """
    Return the expectation of a batch, given margins, noise and population of the input (M15).

    Notes
    -----
    The error of an input has a part that is constant over its track, the bias, and one that
    changes. The correlation widens the deviation of the latter; without correlation over
    `CORRELATION_INTERVAL` there is no bias. The estimated deviation of low-noise input is lowered
    further, and its bias and extents are held, unless it has been filtered: filtered input has as
    little scatter, but its errors are correlated along a whole track. Then the means of tracks are
    far off their fits, and bias and extents stay free. Labelling margins of low-noise input differ
    between objects by twice as much: human labels follow each object. So do those of objects
    larger than cars, in proportion: of trams, and of machines with booms.

    """
    by_kernel = compiled(problem.boxes) is not None
    return (expect_compiled if by_kernel else expect_torch)(problem, offsets, noise, population)


def expect_compiled(
    problem: Problem, offsets: FaceOffsets, noise: InputNoise, population: Population
) -> Expectation:
    """Return the same as `expect`, by the kernel."""
    arrays, widening, slow = _expected_arrays(problem, offsets, noise, population)
    shared, deviation, pose, widened, bias = map(torch.from_numpy, arrays)
    spread = torch.from_numpy(widening), torch.from_numpy(slow)
    error = _input_error(problem, noise.of(problem), *spread)
    error = _at_least_prior(problem, error, deviation)
    return Expectation(shared, deviation, pose, widened, bias, error)


def _expected_arrays(
    problem: Problem, offsets: FaceOffsets, noise: InputNoise, population: Population
) -> tuple[ExpectedArrays, Floats, Floats]:
    """Return what the kernel writes."""
    kernels = compiled(problem.boxes)
    assert kernels is not None
    B = len(problem.boxes)
    expected = ExpectedArrays(*(np.empty((B, size)) for size in (SHARED, SHARED, 6, 6, 6)))
    widening, slow = np.empty((B, 3)), np.empty((B, 1))
    run(
        kernels.expectation.expect, B, problem.arrays(), problem.class_arrays(),
        input_arrays(offsets, noise, population), _expectation_numbers(), expected, widening, slow,
    )  # fmt: skip
    return expected, widening, slow


def input_arrays(
    offsets: FaceOffsets,
    noise: InputNoise = UNKNOWN_NOISE,
    population: Population = UNKNOWN_POPULATION,
) -> InputArrays:
    """Return margins, noise and population of the input for the kernels."""

    def by_kind(part: Tensor) -> Floats:
        values = part.numpy()
        if values.ndim == 1:
            values = np.tile(values, (len(KINDS), 1))
        return values.astype(np.float64, copy=False)

    deviation, correlation, offset, weight = map(by_kind, noise)
    gap_correction, occlusion_inset, range_inset = map(by_kind, offsets)
    median, slopes = population.slopes()
    return InputArrays(
        deviation, correlation, offset, weight[:, 0], gap_correction, occlusion_inset, range_inset,
        median, slopes,
    )  # fmt: skip


def _expectation_numbers() -> ExpectationNumbers:
    return ExpectationNumbers(
        low_noise_ratio=LOW_NOISE_RATIO,
        ratio_bounds=RATIO_BOUNDS,
        typical_correlation=TYPICAL_CORRELATION,
        correlation_interval=CORRELATION_INTERVAL,
        white_correlation=WHITE_CORRELATION,
        correlation_span=CORRELATION_SPAN,
        filtered_offset=FILTERED_OFFSET,
        max_filtered_bias=MAX_FILTERED_BIAS,
        yaw_bias=YAW_BIAS,
        population_radius=POPULATION_RADIUS,
        large_extent=LARGE_EXTENT,
        pinned_extent=PINNED_EXTENT,
        pinned_margins=PINNED_MARGINS,
        pivot_deviation=PIVOT_DEVIATION,
    )


def expect_torch(
    problem: Problem, offsets: FaceOffsets, noise: InputNoise, population: Population
) -> Expectation:
    """Return the same as `expect`, by torch."""
    valid = problem.valid
    usual = problem.of_class(*POSE_ERRORS)
    usual_extent = problem.of_class('extent')
    noise = noise.of(problem)

    # Deviations: the expected ones, and by the weight of the noise the estimated ones.
    ratio = noise.deviation[:, :6]
    low_noise = (ratio / LOW_NOISE_RATIO).square().clamp(max=1.0)
    ratio = (ratio * low_noise).clamp(*RATIO_BOUNDS)
    ratio = (1 + noise.weight * (ratio**2 - 1)).sqrt()
    deviation = usual * ratio
    correlation = noise.correlation - TYPICAL_CORRELATION
    correlation = TYPICAL_CORRELATION + noise.weight * correlation
    widening = ((1 + correlation) / (1 - correlation)).sqrt()

    # Bias: by the correlation over a fixed time, and by how large constant errors can be.
    duration = (problem.times * valid).amax(1)
    interval = (duration / (valid.sum(1) - 1).clamp(1))[:, None]
    slow = correlation ** (CORRELATION_INTERVAL / interval) - WHITE_CORRELATION
    slow = (slow / CORRELATION_SPAN).clamp(0.1, 1.0)
    filtered = noise.offset[:, [0, 1, 6]].mean(1, keepdim=True)
    filtered = (filtered / FILTERED_OFFSET).square()
    filtered = noise.weight * filtered.clamp(max=MAX_FILTERED_BIAS)
    constant = torch.cat([ratio[:, :3].maximum(filtered), ratio[:, 3:]], 1).clamp(0.1, 2.0)
    bias = usual * usual.new_tensor([1, 1, 1, 1, 1, YAW_BIAS]) * slow[:, :6] * constant

    # Extents: the mean of the input, corrected by the population.
    mean = mean_input_extents(problem)
    part = usual_extent * slow[:, 6:] * (2 * constant[:, :3]).clamp(max=1)
    extent = mean * population.factors(problem, mean, part)

    one = torch.ones_like(usual)
    size = (mean / mean.new_tensor(LARGE_EXTENT)).clamp(min=1)[:, FACE_AXIS]
    spread = problem.of_class('gap_spread') * size * (2 - 2 * constant[:, :1]).clamp(1)
    # A pinned box has the true extents, and no bias: its pose is that of the object.
    has_pin = problem.pinned.any(1)[:, None]
    extent_deviation = torch.where(has_pin, PINNED_EXTENT, extent * part)
    unmodelled = torch.where(has_pin, bias, 0.0)
    spread = torch.where(has_pin, PINNED_MARGINS, 1.0) * spread
    bias = torch.where(has_pin, PINNED_EXTENT, bias)
    shared = expected_shared(problem, offsets, mean)
    shared[:, EXTENT] = torch.where(has_pin, mean, extent)
    sideslip = problem.of_class('sideslip')
    pivot = mean[:, :1] * PIVOT_DEVIATION
    deviations = torch.cat([extent_deviation, bias, spread, pivot, one, sideslip], 1)
    input_error = _input_error(problem, noise, widening[:, 6:], slow.amax(1, keepdim=True))
    return Expectation(
        shared,
        deviations,
        deviation,
        deviation * widening[:, :6],
        unmodelled,
        _at_least_prior(problem, input_error, deviations),
    )


def _at_least_prior(problem: Problem, error: Tensor, deviation: Tensor) -> Tensor:
    """Return errors of the input (B, 9), no less than its prior; that of pinned boxes is right."""
    prior = deviation[:, : GAP.start]
    return torch.where(problem.pinned.any(1)[:, None], prior, error.maximum(prior))


def _input_error(problem: Problem, noise: InputNoise, widening: Tensor, slow: Tensor) -> Tensor:
    """
    Return the deviations of the mean input extents and of the bias, shape (B, 9) (M28).

    From the measured `noise` of each window, without the lowering for low-noise input. `widening`
    (B, 3) is that for the correlation of extents, `slow` (B, 1) how correlated the errors are.

    """
    ratio = (1 + noise.weight * (noise.deviation**2 - 1)).sqrt()
    usual_extent = mean_input_extents(problem) * problem.of_class('extent')
    count = problem.valid.sum(1, keepdim=True) + problem.marginalised_extents[:, 3:]
    of_mean = (widening / count.sqrt()).clamp(max=1)
    noise_of_extents = ratio[:, 6:]
    # Extents of vehicles are estimated: the correlation of their errors shows constant ones. Those
    # of other kinds are held: their scatter shows only whether the input has low noise.
    as_published = (noise_of_extents / LOW_NOISE_RATIO).clamp(max=1).maximum(noise_of_extents)
    is_held = (problem.kind != KINDS.index('vehicle'))[:, None]
    constant = torch.where(is_held, as_published, slow * noise_of_extents)
    published = slow.new_tensor([CONSTANT_EXTENT_ERRORS[kind] for kind in KINDS])
    constant = constant * published[problem.kind]
    extent = usual_extent * torch.hypot(noise_of_extents * of_mean, constant)
    bias_ratio = slow * slow.new_tensor([1, 1, 1, 1, 1, YAW_BIAS])
    bias = problem.of_class(*POSE_ERRORS) * ratio[:, :6] * bias_ratio
    return torch.cat([extent, bias], 1)


def expect_shared(problem: Problem, offsets: FaceOffsets) -> Tensor:
    """Return the means of the shared variables as `expect` does without a population, (B, 23)."""
    if compiled(problem.boxes) is None:
        return expected_shared(problem, offsets, mean_input_extents(problem))
    arrays, _, _ = _expected_arrays(problem, offsets, UNKNOWN_NOISE, UNKNOWN_POPULATION)
    return torch.from_numpy(arrays.shared)


def expected_shared(problem: Problem, offsets: FaceOffsets, extent: Tensor) -> Tensor:
    """
    Return the means of the shared variables, (B, 23), see `State`, without a population.

    Given the margins of the input, and the mean extents (B, 3) of `mean_input_extents`.

    """
    shared = extent.new_zeros((len(extent), SHARED))
    shared[:, EXTENT] = extent
    shared[:, GAP] = problem.of_class(*FACE_GAPS) + offsets.of(problem).gap_correction
    shared[:, PIVOT] = extent[:, 0] * problem.of_class('pivot')[:, 0]
    return shared


def mean_input_extents(problem: Problem) -> Tensor:
    """
    Return the mean extents of the input, marginalised observations included, (B, 3) [m].

    Of windows with pinned boxes the mean extents of these.

    """
    pinned = problem.pinned[..., None]
    of_pins = (problem.boxes[..., 3:6] * pinned).sum(1) / pinned.sum(1).clamp(1)
    valid = problem.valid
    total = (problem.boxes[..., 3:6] * valid[..., None]).sum(1)
    total = total + problem.marginalised_extents[:, :3]
    mean = total / (valid.sum(1)[:, None] + problem.marginalised_extents[:, 3:])
    return torch.where(pinned.any(1), of_pins, mean)


def population_factor(evidence: Tensor, given: Tensor, error: Tensor) -> Tensor:
    """
    Return expected over given extents, by the population of tracks (M16), shape (B, 3).

    Parameters
    ----------
    evidence : Tensor, shape (n, 3, 3)
        Evidence of the points of n tracks about their extents, see `Population`.
    given : Tensor, shape (B, 3)
        Mean extents of the input [m].
    error : Tensor, shape (B, 3)
        Their expected error, as part of each.

    Notes
    -----
    Trained detectors shrink extents toward those of the majority, noise spreads them. Tracks with
    evidence about their extents show which, and by how much: a ridge regression of their
    corrections on the distance of all three extents from the medians, in logarithms and in
    proportion to the square of the error, so that low-noise input is left as it is. Objects
    unlike the majority, trucks among cars, are corrected little, and the medians not at all: the
    labelling margin accounts for a common error.

    """
    median, slopes = map(torch.from_numpy, population_slopes(evidence.cpu().numpy()))
    return _factor(median.to(given), slopes.to(given), given, error)


def population_slopes(evidence: Floats) -> tuple[Floats, Floats]:
    """
    Return the regression of `population_factor` on the `evidence` (n, 3, 3) of tracks.

    The median (3,) of the logarithms of extents, and the slopes (3, 3) of the corrections, one row
    for each corrected extent.

    """
    log, correction, weight = evidence.swapaxes(0, 1)  # (n, 3) each
    median = np.sort(log, axis=0)[(len(log) - 1) // 2]
    off = log - median
    similarity = 1 / (1 + np.square(off / POPULATION_RADIUS).sum(1, keepdims=True))
    A = similarity * off
    weighted = weight.T[..., None] * A  # (3, n, 3)
    ridge = np.full((3, 3), CROSS_SLOPE_INFORMATION) - (CROSS_SLOPE_INFORMATION - 1) * np.eye(3)
    curvature = weighted.swapaxes(1, 2) @ A + ridge[:, None] * np.eye(3) / SLOPE_DEVIATION**2
    pull = (similarity * correction).T[:, None] @ weighted  # (3, 1, 3)
    return median, np.linalg.solve(curvature, pull.swapaxes(1, 2))[..., 0]


def _factor(median: Tensor, slopes: Tensor, given: Tensor, error: Tensor) -> Tensor:
    """Return the factors (B, 3) of extents that are `given`, by `population_slopes`."""
    own = given.log() - median
    similarity = 1 / (1 + (own / POPULATION_RADIUS).square().sum(1, keepdim=True))
    return torch.exp(error**2 * (slopes @ (similarity * own)[..., None])[..., 0])


def evidence_of_extents(
    given: Tensor, expected: Expectation, state: State, covariance: Tensor
) -> Tensor:
    """
    Return the evidence of the points alone about the extents (M17), shape (B, 2, 3).

    Corrections of the logarithms, and their weights, as in `Population`.

    Parameters
    ----------
    given : Tensor, shape (B, 3)
        Logarithms of the mean extents of the input.
    expected : Expectation
        Prior of the fit: its part in that is removed.
    state : State
        The fit.
    covariance : Tensor, shape (B, 23, 23)
        Of its shared variables.

    """
    mean = expected.shared[:, EXTENT]
    deviation = expected.deviation[:, EXTENT]
    variance = covariance.diagonal(dim1=1, dim2=2)[:, EXTENT]
    gain = 1 - variance / deviation**2
    power = (deviation / mean) ** 2
    by_points = (state.shared[:, EXTENT] / mean).log() / gain + mean.log()
    is_evidence = (gain > MIN_EXTENT_GAIN) & by_points.isfinite()
    both = torch.stack([(by_points - given) / power, gain * power], 1)
    return torch.where(is_evidence[:, None], both, 0)


class InputModel:
    """
    Labelling margins, noise and population of extents, estimated from the input of a stream.

    Each of `KINDS` has its own: labels of pedestrians have other margins than those of cars. Noise
    is pooled for kinds that were seen in few boxes.

    A labelling margin is the gap between a face of the label and its outermost points. Each track
    gives one value per face: the mean over its observations of the gap, less the one expected of
    its class. The mean of the middle half of all tracks is weighed against a correction of zero
    (M18). Errors of the boxes that exceed the margin do not matter if they have no preferred
    direction. Faces beyond 45 m give the range inset; it is estimated even where the margins are
    set, since a common error of all boxes cancels in the difference.

    Parameters
    ----------
    config : FaceConfig
        Expected insets, and whether margins are estimated.

    """

    def __init__(self, config: FaceConfig) -> None:
        self._estimates_margins = config.learn
        self._occlusion_insets = (config.inset_ends, config.inset_sides, 0.0, 0.0)
        # Of each track of each kind: sums over its face observations, see
        # `add_face_observations`; its last input residuals; its extent evidence.
        self._faces = [dict[str, Floats]() for _ in KINDS]
        self._offsets_of_kinds: list[tuple[Floats, ...] | None] = [None] * len(KINDS)
        self._known_offsets: FaceOffsets | None = None  # of the present sums
        self._residuals = [dict[str, Floats]() for _ in KINDS]
        self._evidence = [dict[str, Floats]() for _ in KINDS]

    def __getstate__(self) -> dict[str, Any]:
        """Return what was observed; margins that follow from it are computed again."""
        nothing: list[None] = [None] * len(KINDS)
        return {**vars(self), '_known_offsets': None, '_offsets_of_kinds': nothing}

    def add_face_observations(
        self,
        track_ids: Sequence[str],
        kind: Tensor,
        observations: FaceObservations,
        new: Tensor,
        offsets: FaceOffsets,
    ) -> None:
        """
        Add face observations at input boxes.

        Parameters
        ----------
        track_ids : sequence of B str
            The tracks.
        kind : Tensor, shape (B,)
            Indices of their kinds among `KINDS`.
        observations : FaceObservations
            Of their windows.
        new : Tensor, shape (B, N)
            Which of them count.
        offsets : FaceOffsets
            What `observations` were made with.

        """
        distance, weight, (occluded, distant), num_points = (
            part.cpu().numpy() for part in observations[1:3] + observations[4:]
        )
        kinds = kind.cpu().numpy()
        gap_correction, occlusion_inset, range_inset = (
            np.broadcast_to(part.cpu().numpy(), (len(KINDS), 6))[kinds][:, None]
            for part in offsets
        )
        occluded = occluded * (occlusion_inset > 0)  # the bottom is observed by the road
        is_visible = occluded < MAX_VISIBLE_SHARE
        is_distant = distant > MIN_DISTANT_SHARE
        has_points = (num_points >= MIN_BOX_POINTS)[..., None]
        # Three quantities: gap, occlusion inset, range inset; all (3, B, N, 6).
        counts = np.stack([
            has_points & is_visible & ~is_distant,
            has_points & (occluded > MIN_OCCLUDED_SHARE),
            is_visible & is_distant,
        ])  # fmt: skip
        counts &= (weight > 0) & (np.abs(distance) < MAX_FACE_DISTANCE)
        counts &= new.cpu().numpy()[..., None]
        values = np.stack([
            0 * occluded, occluded * occlusion_inset, distant * range_inset
        ]) - distance  # fmt: skip
        values[::2] += gap_correction  # an occlusion inset is counted from the present gap
        shares = np.stack([np.ones_like(distance), occluded, distant])
        # (B, 3 quantities, 3 sums: value, count, share; 6 faces)
        sums = np.moveaxis(np.stack([values * counts, counts, shares * counts], 1).sum(3), 2, 0)
        self._known_offsets = None
        for track_id, k, row in zip(track_ids, kinds.tolist(), sums, strict=True):
            self._offsets_of_kinds[k] = None
            _of_track(self._faces[k], track_id, np.zeros((3, 3, 6)))[:] += row

    def add_fits(
        self, track_ids: Sequence[str], kind: Tensor, residuals: Floats, evidence: Floats
    ) -> None:
        """
        Add one fit of each track.

        Parameters
        ----------
        track_ids : sequence of B str
            The tracks.
        kind : Tensor, shape (B,)
            Indices of their kinds among `KINDS`.
        residuals : array, shape (B, 9)
            `input_residuals`, over their expected deviations.
        evidence : array, shape (B, 3, 3)
            Evidence of the extents, see `Population`.

        """
        rows = zip(track_ids, kind.tolist(), residuals, evidence, strict=True)
        for track_id, k, row, extents in rows:
            unknown = np.full((MAX_FITS_PER_TRACK, 9), np.nan)
            known = _of_track(self._residuals[k], track_id, unknown)
            known[:-1] = known[1:].copy()
            known[-1] = row
            _of_track(self._evidence[k], track_id, extents)[:] = extents

    def offsets(self) -> FaceOffsets:
        """Return the labelling margins and insets to expect of each kind."""
        if self._known_offsets is None:
            for k, known in enumerate(self._offsets_of_kinds):
                self._offsets_of_kinds[k] = known or self._offsets(k)
            parts = map(np.stack, zip(*self._offsets_of_kinds, strict=True))
            self._known_offsets = FaceOffsets(*map(torch.from_numpy, parts))
        return self._known_offsets

    def _offsets(self, kind: int) -> tuple[Floats, Floats, Floats]:
        """Return the columns of `FaceOffsets` for one kind, (6,) each."""
        known = np.array(list(self._faces[kind].values())).reshape(-1, 3, 3, 6)
        none = (0.0,) * len(FACE_GROUPS)
        deviations = GAP_DEVIATIONS[KINDS[kind]]
        gaps = _pooled(known[:, 0], none, deviations)
        occlusion_insets = _pooled(
            self._estimates_margins * known[:, 1], self._occlusion_insets, deviations
        )
        known[:, 2, 0] -= gaps * known[:, 2, 1]
        range_insets = _pooled(known[:, 2], none, deviations)
        return self._estimates_margins * gaps, occlusion_insets, range_insets

    def gaps_of_tracks(self, faces: Sequence[int]) -> list[Floats]:
        """Return gap corrections of some `faces` [m], one array per track that has any."""
        return self._means_of_tracks(0, faces)

    def occlusion_insets_of_tracks(self, faces: Sequence[int]) -> list[Floats]:
        """Return occlusion insets of some `faces` [m], one array per track that has any."""
        return self._means_of_tracks(1, faces)

    def noise(self) -> InputNoise:
        """Return the noise of all fits that were added."""
        rows, kind = _flat(self._residuals)
        known = np.array(rows).reshape(-1, MAX_FITS_PER_TRACK, 9)
        return InputNoise.estimate_by_kind(torch.from_numpy(known), kind)

    def population(self) -> Population:
        """Return the evidence of extents of the last fits that were added."""
        rows, kind = _flat(self._evidence)
        return Population(torch.from_numpy(np.array(rows).reshape(-1, 3, 3)), kind)

    def _means_of_tracks(self, quantity: int, faces: Sequence[int]) -> list[Floats]:
        means = []
        for sums in _flat(self._faces)[0]:
            total, count, share = sums[quantity][:, faces]
            is_known = count >= MIN_TRACK_OBSERVATIONS
            if is_known.any():
                means.append(total[is_known] / share[is_known])
        return means


def _pooled(known: Floats, expected: Sequence[float], deviations: Sequence[float]) -> Floats:
    """Weigh the tracks' sums (n, 3, 6) of a quantity against its prior (M18), (6,)."""
    values = np.zeros(6)
    for faces, prior, deviation in zip(FACE_GROUPS, expected, deviations, strict=True):
        total, count, share = known[..., faces].swapaxes(0, 1).reshape(3, -1)
        is_known = count >= MIN_TRACK_OBSERVATIONS
        means = np.sort(total[is_known] / share[is_known])
        values[faces] = _posterior_mean(means, prior, deviation)
    return values


def _flat(known: Sequence[dict[str, Floats]]) -> tuple[list[Floats], Tensor]:
    """Return the arrays of the tracks of all kinds, and their kinds (n,)."""
    counts = torch.tensor([len(tracks) for tracks in known])
    rows = [row for tracks in known for row in tracks.values()]
    return rows, torch.arange(len(known)).repeat_interleave(counts)


def _posterior_mean(means: Floats, prior: float, deviation: float) -> float:
    """Weigh the midmean of sorted `means` against a prior with its deviation (M18)."""
    n = len(means)
    if n < MIN_TRACK_OBSERVATIONS:
        return prior
    middle = means[n // 4 : n - n // 4].mean()
    spread = means[n - 1 - n // 4] - means[n // 4]
    error = MIDMEAN_FACTOR * (QUARTILES_TO_DEVIATION * spread + MIN_GAP_DEVIATION)
    weight = deviation**2 / (deviation**2 + error**2 / n)
    return float(prior + weight * (middle - prior))


def _of_track(known: dict[str, Floats], track_id: str, fresh: Floats) -> Floats:
    """Return the array of a track, `fresh` for a new one; delete the one seen longest ago."""
    found = known.pop(track_id, fresh)
    known[track_id] = found
    if len(known) > MAX_TRACKS:
        del known[next(iter(known))]
    return found
