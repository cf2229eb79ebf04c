"""
Means and deviations of a batch before its points are used (M15), and evidence beyond them (M17).

By torch; the kernel of a round does the same for one window. docs/method.md, section Input model,
has the formulas.

"""

from typing import NamedTuple

from boxreg_ros.config import KINDS
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
from boxreg_ros.core.face_support import FaceOffsets
from boxreg_ros.core.geometry import FACE_AXIS
from boxreg_ros.core.input_noise import InputNoise, UNKNOWN_NOISE
from boxreg_ros.core.kernels.arrays import ExpectationNumbers, InputArrays
from boxreg_ros.core.margin_spread import (
    GapScatter,
    margin_spread,
    spread_quadrature,
    UNKNOWN_SCATTER,
)
from boxreg_ros.core.population import Population, POPULATION_RADIUS, UNKNOWN_POPULATION
from boxreg_ros.structures import Floats
import numpy as np
import torch
from torch import Tensor

# Constants whose origin is not stated are chosen; `boxreg bench sensitivity` halves and doubles
# each of them.
LARGE_EXTENT = (5.0, 2.0, 2.0)
"""The margins of larger objects differ in proportion to their extent [m]; a large car."""
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
DETECTED = (0, 1, 2, 5, 6, 7, 8)
"""Places of position, yaw and extents among the errors of the input. Detectors set roll and pitch
to zero: their residuals are errors of the fit alone, whose correlation shows no constant ones."""
PIVOT_DEVIATION = 0.25
"""Deviation of the pivot, as part of the length."""
MIN_EXTENT_GAIN = 0.2
"""Smallest part of the information about an extent that points must provide to be evidence."""
PINNED_EXTENT = 0.01
"""Deviation of the extents of a pinned box and of its bias [m, rad]: practically held."""


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
    error : Tensor, shape (B, 15)
        Deviation of the errors of the mean input extents, of the bias and of the labelling
        margins, as in `State`, as far as these errors are known. Those of extents and bias are at
        least `deviation`, which is smaller where extents or poses are held near the input.

    """

    shared: Tensor
    deviation: Tensor
    pose_deviation: Tensor
    widened_deviation: Tensor
    unmodelled_bias: Tensor
    error: Tensor


class InputEstimates(NamedTuple):
    """
    Estimated errors of the input of a stream, as `InputModel` has them.

    Attributes
    ----------
    offsets : FaceOffsets
        Labelling margins and insets.
    noise : InputNoise
        Errors of poses and extents.
    population : Population
        Evidence of the points about extents.
    scatter : GapScatter
        How gaps differ between tracks.

    """

    offsets: FaceOffsets
    noise: InputNoise = UNKNOWN_NOISE
    population: Population = UNKNOWN_POPULATION
    scatter: GapScatter = UNKNOWN_SCATTER

    def arrays(self) -> InputArrays:
        """Return margins, noise and population for the kernels."""
        deviation, correlation, offset, weight = map(_by_kind, self.noise)
        gap_correction, occlusion_inset, range_inset = map(_by_kind, self.offsets)
        median, slopes = self.population.slopes()
        gap_variance, gap_tracks, gap_noise = map(_by_kind, self.scatter)
        return InputArrays(
            deviation, correlation, offset, weight[:, 0], gap_correction, occlusion_inset,
            range_inset, median, slopes, gap_variance, gap_tracks, gap_noise,
        )  # fmt: skip


def _by_kind(part: Tensor) -> Floats:
    """Return values by kind (K, ...), of one row for all kinds if it has no such axis."""
    values = part.numpy()
    if values.ndim == 1:
        values = np.tile(values, (len(KINDS), 1))
    return values.astype(np.float64, copy=False)


def expect(problem: Problem, inputs: InputEstimates) -> Expectation:
    """
    Return the expectation of a batch by the estimated errors of its `inputs` (M15).

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
    usual = problem.of_class(*POSE_ERRORS)
    noise = inputs.noise.of(problem)
    ratio = _deviation_ratio(noise)
    correlation = _correlation(noise)
    slow = _slow_part(problem, correlation)
    constant = _constant_part(noise, ratio)

    # Poses: deviation, widened for its correlation, and bias.
    deviation = usual * ratio
    widening = ((1 + correlation) / (1 - correlation)).sqrt()
    widened = deviation * widening[:, :6]
    bias = usual * usual.new_tensor([1, 1, 1, 1, 1, YAW_BIAS]) * slow[:, :6] * constant

    # Extents: the mean of the input, corrected by the population.
    mean = mean_input_extents(problem)
    part = problem.of_class('extent') * slow[:, 6:] * (2 * constant[:, :3]).clamp(max=1)
    extent = mean * inputs.population.factors(problem, mean, part)

    # Labelling margins: their spread by the settings, and as estimated from gaps.
    size = (mean / mean.new_tensor(LARGE_EXTENT)).clamp(min=1)
    usual_spread = problem.of_class('gap_spread') * (2 - 2 * constant[:, :1]).clamp(1)
    spread = usual_spread * size[:, FACE_AXIS]
    constant_error = bias[:, :3] ** 2 + (mean / size * part / 2) ** 2
    scatter = inputs.scatter.of(problem)
    gap_error = constant_error[:, FACE_AXIS] + scatter.noise * widened[:, FACE_AXIS] ** 2
    similarity = inputs.population.similarity(problem, mean)
    margins = margin_spread(scatter, gap_error, usual_spread.expand_as(spread), similarity)

    # A pinned box has the true extents, and no bias: its pose is that of the object.
    has_pin = problem.pinned.any(1)[:, None]
    extent_deviation = torch.where(has_pin, PINNED_EXTENT, extent * part)
    unmodelled = torch.where(has_pin, bias, 0.0)
    bias = torch.where(has_pin, PINNED_EXTENT, bias)
    shared = shared_without_population(problem, inputs.offsets)
    shared[:, EXTENT] = torch.where(has_pin, mean, extent)
    pivot = mean[:, :1] * PIVOT_DEVIATION
    anchor = torch.ones_like(usual)
    sideslip = problem.of_class('sideslip')
    deviations = torch.cat([extent_deviation, bias, spread, pivot, anchor, sideslip], 1)
    slowest = slow[:, DETECTED].amax(1, keepdim=True)
    input_error = _input_error(problem, noise, widening[:, 6:], slowest)
    input_error = _at_least_prior(problem, input_error, deviations)
    error = torch.cat([input_error, margins * size[:, FACE_AXIS]], 1)
    return Expectation(shared, deviations, deviation, widened, unmodelled, error)


def _deviation_ratio(noise: InputNoise) -> Tensor:
    """Return the deviation of the input poses over the usual one, by its weight, (B, 6)."""
    ratio = noise.deviation[:, :6]
    low_noise = (ratio / LOW_NOISE_RATIO).square().clamp(max=1.0)
    ratio = (ratio * low_noise).clamp(*RATIO_BOUNDS)
    return (1 + noise.weight * (ratio**2 - 1)).sqrt()


def _correlation(noise: InputNoise) -> Tensor:
    """Return the correlation of the errors of consecutive observations, by its weight, (B, 9)."""
    correlation = noise.correlation - TYPICAL_CORRELATION
    return TYPICAL_CORRELATION + noise.weight * correlation


def _slow_part(problem: Problem, correlation: Tensor) -> Tensor:
    """Return the part of the errors that lasts beyond `CORRELATION_INTERVAL`, 0.1 to 1, (B, 9)."""
    valid = problem.valid
    duration = (problem.times * valid).amax(1)
    interval = (duration / (valid.sum(1) - 1).clamp(1))[:, None]
    slow = correlation ** (CORRELATION_INTERVAL / interval) - WHITE_CORRELATION
    return (slow / CORRELATION_SPAN).clamp(0.1, 1.0)


def _constant_part(noise: InputNoise, ratio: Tensor) -> Tensor:
    """Return the largest constant error over the usual error, 0.1 to 2, (B, 6)."""
    filtered = noise.offset[:, [0, 1, 6]].mean(1, keepdim=True)
    filtered = (filtered / FILTERED_OFFSET).square()
    filtered = noise.weight * filtered.clamp(max=MAX_FILTERED_BIAS)
    return torch.cat([ratio[:, :3].maximum(filtered), ratio[:, 3:]], 1).clamp(0.1, 2.0)


def expectation_numbers() -> ExpectationNumbers:
    """Return the constants for the kernel."""
    squares, weights = spread_quadrature()
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
        pivot_deviation=PIVOT_DEVIATION,
        spread_squares=tuple(squares.tolist()),
        spread_weights=tuple(weights.tolist()),
        constant_extent_errors=tuple(CONSTANT_EXTENT_ERRORS[kind] for kind in KINDS),
        estimated_kind=KINDS.index('vehicle'),
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


def shared_without_population(problem: Problem, offsets: FaceOffsets) -> Tensor:
    """
    Return the means of the shared variables, (B, 23), see `State`, without a population.

    The labelling margins follow from `offsets`.

    """
    extent = mean_input_extents(problem)
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
