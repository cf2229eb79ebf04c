"""
Arguments and results of the kernels of one round, as named tuples of arrays and numbers.

Letters of the shapes: B windows, N observations, P points of all observations of a batch. Only the
first `lengths` observations of a window are read; the others are padding.

"""

from typing import Any, NamedTuple


class WindowArrays(NamedTuple):
    """
    Input of a batch of windows, as `boxreg_ros.core.batch.Problem` has it.

    Attributes
    ----------
    boxes : array, shape (B, N, 9)
        Input boxes.
    lengths : array, shape (B,)
        Observations of each window.
    times : array, shape (B, N)
        Time of each observation [s].
    origins, ground : array, shapes (B, N, K, 3) and (B, N)
        Sensor positions and height of the road from the input centre [m]; NaN if unknown.
    points, delays : array, shapes (P, 3) and (P,)
        Points minus the centre of their input box [m], and their measurement times relative to
        the stamp of the box [s].
    first, counts : array, shape (B, N)
        First point of each observation, and their number.
    stride : int
        Every n-th point is used.
    pinned : array, shape (B, N)
        Whether a person has corrected a box.
    marginalised_extents : array, shape (B, 4)
        Sum of the input extents of marginalised observations [m], and the number of these.
    kind : array, shape (B,)
        Kind of the object of each window.

    """

    boxes: Any
    lengths: Any
    times: Any
    origins: Any
    ground: Any
    points: Any
    delays: Any
    first: Any
    counts: Any
    stride: int
    pinned: Any
    marginalised_extents: Any
    kind: Any


class FaceArrays(NamedTuple):
    """Face observations, as `boxreg_ros.core.face_support.FaceObservations` has them."""

    moments: Any
    distance: Any
    weight: Any
    inset: Any
    inset_shares: Any
    num_points: Any


class ExpectedArrays(NamedTuple):
    """Those of one window, as `boxreg_ros.core.expectation.Expectation` has them for a batch."""

    shared: Any
    deviation: Any
    pose_deviation: Any
    widened_deviation: Any
    unmodelled_bias: Any
    error: Any


class InputArrays(NamedTuple):
    """
    Estimated errors of the input of all tracks, one row for each of K kinds of objects.

    Attributes
    ----------
    deviation, correlation, offset : array, shape (K, 9)
        As in `boxreg_ros.core.input_noise.InputNoise`.
    weight : array, shape (K,)
        Of this noise against the settings.
    gap_correction, occlusion_inset, range_inset : array, shape (K, 6)
        As in `boxreg_ros.core.face_support.FaceOffsets` [m].
    median, slopes : array, shapes (K, 3) and (K, 3, 3)
        Of the population of extents (M16); slopes are 0 where there is none.
    gap_variance, gap_tracks, gap_noise : array, shape (K, 6)
        As in `boxreg_ros.core.margin_spread.GapScatter`.

    """

    deviation: Any
    correlation: Any
    offset: Any
    weight: Any
    gap_correction: Any
    occlusion_inset: Any
    range_inset: Any
    median: Any
    slopes: Any
    gap_variance: Any
    gap_tracks: Any
    gap_noise: Any


class ClassArrays(NamedTuple):
    """
    Settings of the class of each window.

    Attributes
    ----------
    acceleration : array, shape (B, 6)
        Deviation of the accelerations along the axes of the body.
    slip : array, shape (B, 2)
        Of the velocity of the pivot along the y and z axes [m/s].
    drift : array, shape (B,)
        Of the step of a parked box [m].
    pose : array, shape (B, 6)
        Of the input poses [m, rad].
    extent : array, shape (B,)
        Of the input extents, as part of each.
    gap_spread, sideslip : array, shape (B,)
        Of labelling margins [m], and of the angle from heading to path [rad].
    shape : array, shape (B,)
        How far the surface is from rigid [m].
    gaps : array, shape (B, 6)
        Expected labelling margins [m].
    pivot : array, shape (B,)
        Distance of the pivot behind the centre, as part of the length.

    """

    acceleration: Any
    slip: Any
    drift: Any
    pose: Any
    extent: Any
    gap_spread: Any
    sideslip: Any
    shape: Any
    gaps: Any
    pivot: Any


class SolutionArrays(NamedTuple):
    """
    State of a batch: the start of a round, and its results.

    Attributes
    ----------
    poses, shared : array, shapes (B, N, 6) and (B, 23)
        Boxes, and the variables that all observations of a window share.
    evidence : array, shape (B, 3, 3)
        Logarithms of the input extents; corrections by the points alone, and their weights.
    posterior : PosteriorArrays
        Of windows that are done.
    prior_state, prior_step, prior_information : array, shapes (B, 35), (B, 35), (B, 35, 35)
        What full windows that are done leave to the next ones; B = 0 if it is not wanted.

    """

    poses: Any
    shared: Any
    evidence: Any
    posterior: Any
    prior_state: Any
    prior_step: Any
    prior_information: Any


class PosteriorArrays(NamedTuple):
    """Covariances and residuals, as `boxreg_ros.core.batch.Posterior` has them."""

    poses: Any
    extents: Any
    face_distances: Any


class InverseArrays(NamedTuple):
    """
    Blocks of the inverse curvature of one window.

    Attributes
    ----------
    poses, border : array, shapes (N, 6, 6) and (N, 6, 23)
        Of each pose: its own, and those with the shared variables.
    corner : array, shape (23, 23)
        Of the shared variables.

    """

    poses: Any
    border: Any
    corner: Any


class PriorArrays(NamedTuple):
    """
    Marginalisation prior (M9) of a batch.

    Attributes
    ----------
    mean, W : array, shapes (B, 35) and (B, 35, 35)
        Minimum and information matrix.

    """

    mean: Any
    W: Any


class TermArrays(NamedTuple):
    """
    Data and weights of all residuals of one window.

    Terms that are left out have weights without rows. Of weights that are diagonal matrices only
    the diagonal is kept.

    Attributes
    ----------
    given, inset, W_faces : array, shapes (N, 6), (N, 6) and (N, 6, 4, 4)
        Faces (M2).
    axes, W_input : array, shapes (N, 3, 3) and (N, 6)
        Input (M3), the deviation from `given` along axes.
    start, wanted, W_shape : array, shapes (N, 6), (N, 6) and (N, 6, 6)
        Rigid shape (M4), the step from `start` along axes.
    times : array, shape (N,)
        Of the motion terms.
    W_acceleration, W_turning : array, shapes (N, 3, 3) and (N, 3)
        (M5): of the position, and of roll, pitch and yaw.
    W_slip, W_zero_motion : array, shapes (N, 2) and (N, 6)
        (M7) and (M6).
    prior_mean, W_prior : array, shapes (35,) and (35, 35)
        Marginalisation prior (M9).
    expected, W_shared : array, shape (23,)
        Shared variables (M8).

    """

    given: Any
    inset: Any
    W_faces: Any
    axes: Any
    W_input: Any
    start: Any
    wanted: Any
    W_shape: Any
    times: Any
    W_acceleration: Any
    W_turning: Any
    W_slip: Any
    W_zero_motion: Any
    prior_mean: Any
    W_prior: Any
    expected: Any
    W_shared: Any


class ArrowheadArrays(NamedTuple):
    """
    A matrix of one window as `arrowhead` keeps it, or its Cholesky factor.

    Attributes
    ----------
    links : array, shape (N + 2, 6, 18)
        Blocks of each pose: upper triangle of its own, and those with the two poses after it. Two
        poses of padding, zero, end the chain.
    border : array, shape (N + 2, 6, 23)
        Blocks of each pose with the shared variables.
    corner : array, shape (23, 23)
        Upper triangle of the block of the shared variables.

    """

    links: Any
    border: Any
    corner: Any


class FaceNumbers(NamedTuple):
    """Constants and settings of `boxreg_ros.core.face_support`; there they are described."""

    outside_margin: float
    edge_margin: float
    max_depth: float
    deepest: float
    min_points: float
    share: float
    strips: int
    strip_axis: tuple[int, ...]
    occluded_weight: float
    softness: float
    edge_lead: tuple[float, ...]
    near_range: float
    range_span: float
    max_range_share: float
    range_half_weight: float
    min_along: float
    is_moving: bool


class WeightNumbers(NamedTuple):
    """Constants and settings of `boxreg_ros.core.weights`; there they are described."""

    input_outlier: float
    motion_outlier: float
    gap_outlier: float
    neighbour_factor: float
    parked_speed: float
    parked_distance: float
    parked_turn: float
    driving_speed: float
    driving_span: int
    driving_reach: int
    face_outlier: float
    face_deviations: tuple[float, ...]
    drift_ratios: tuple[float, ...]
    drift_gate: float
    is_robust: bool
    pin_deviations: tuple[float, ...]


class SearchNumbers(NamedTuple):
    """Constants and settings of `boxreg_ros.core.lbfgs` and `solver`; there they are described."""

    iterations: int
    history: int
    tolerance: float
    sufficient_decrease: float
    min_curvature: float
    step_bounds: tuple[float, ...]
    max_backtracks: int
    settled_step: float
    may_settle: bool
    is_last: bool
    uses_shape: bool


class ShapeNumbers(NamedTuple):
    """Constants of `boxreg_ros.core.rigid_shape`; there they are described."""

    cells: tuple[int, ...]
    margin: float
    flatness: float
    min_cell_points: float
    effective_points: float
    ridge: float
    is_moving: bool


class CovarianceNumbers(NamedTuple):
    """Constants and settings of `boxreg_ros.core.covariance`; there they are described."""

    residual_correlation: float
    max_correlation: float
    half_weight: float
    min_left: float
    min_power: float
    min_weight: float
    min_duration: float
    time_deviation: float
    heading_deviation: float
    correlated_faces: tuple[float, ...]


class ExpectationNumbers(NamedTuple):
    """Constants of `boxreg_ros.core.expectation`; there they are described."""

    low_noise_ratio: float
    ratio_bounds: tuple[float, ...]
    typical_correlation: float
    correlation_interval: float
    white_correlation: float
    correlation_span: float
    filtered_offset: float
    max_filtered_bias: float
    yaw_bias: float
    population_radius: float
    large_extent: tuple[float, ...]
    pinned_extent: float
    pivot_deviation: float
    spread_squares: tuple[float, ...]
    spread_weights: tuple[float, ...]
    constant_extent_errors: tuple[tuple[float, ...], ...]
    estimated_kind: int


class RoundNumbers(NamedTuple):
    """Constants and settings of a round."""

    expectation: ExpectationNumbers
    faces: FaceNumbers
    weights: WeightNumbers
    shape: ShapeNumbers
    search: SearchNumbers
    covariance: CovarianceNumbers
    min_extent_gain: float


class NoiseNumbers(NamedTuple):
    """Constants of `boxreg_ros.core.input_noise`; there they are described."""

    mad_to_deviation: float
    min_observations: int
    iterations: int
    max_correlation: float
    min_left: float
    min_power: float


class ShapeArrays(NamedTuple):
    """
    Boxes as the kernels find points near them.

    Attributes
    ----------
    centers : array, shape (n, 3)
        In the frame of the points [m].
    turn : array, shape (3, 3)
        Rotation from the frame of the points to that of the boxes.
    rotations : array, shape (n, 3, 3)
        From the axes of each box to the frame of the boxes.
    half : array, shape (n, 3)
        Half the extents [m].
    reach : array, shape (n, 3)
        Half the bounding boxes along the axes of the points, with a margin [m].

    """

    centers: Any
    turn: Any
    rotations: Any
    half: Any
    reach: Any


class CropNumbers(NamedTuple):
    """Constants and settings of `boxreg_ros.core.observation`; there they are described."""

    margin: float
    own_margin: float
    ownership_tolerance: float
    clearance: float
    has_road: bool
    road_width: float
    road_gap: float
    road_range: float
    road_quantiles: tuple[float, ...]
    road_flatness: float
    min_road_points: int
