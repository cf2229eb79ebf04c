"""
What the kernels of one round take and write, as named tuples of arrays and numbers.

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


class FaceArrays(NamedTuple):
    """Face observations, as `boxreg_ros.core.face_support.FaceObservations` has them."""

    moments: Any
    distance: Any
    weight: Any
    inset: Any
    inset_shares: Any
    num_points: Any


class ExpectedArrays(NamedTuple):
    """Means and deviations, as `boxreg_ros.core.input_model.Expectation` has them."""

    shared: Any
    deviation: Any
    pose_deviation: Any
    widened_deviation: Any


class ClassDeviations(NamedTuple):
    """
    Deviations of the class of each window.

    Attributes
    ----------
    faces : array, shape (B, 6)
        Of one observation of each face [m].
    acceleration : array, shape (B, 6)
        Of the accelerations along the axes of the body.
    slip : array, shape (B, 2)
        Of the velocity of the pivot along the y and z axes [m/s].
    zero_motion : array, shape (B, 6)
        Of the steps of a parked box [m, rad].
    heading : array, shape (B,)
        Of the input yaw [rad].

    """

    faces: Any
    acceleration: Any
    slip: Any
    zero_motion: Any
    heading: Any


class TermArrays(NamedTuple):
    """
    Data and weights of all residuals of one round.

    Terms that are left out have weights without rows. The weights are matrices, as in
    `boxreg_ros.core.terms.Term`.

    Attributes
    ----------
    given, inset, W_faces : array, shapes (B, N, 6), (B, N, 6) and (B, N, 6, 4, 4)
        Faces (M2).
    input_pose, axes, W_input : array, shapes (B, N, 6), (B, N, 3, 3) and (B, N, 6, 6)
        Input (M3).
    shape_start, shape_axes, wanted, W_shape : array
        Rigid shape (M4): (B, N, 6), (B, N, 3, 3), (B, N, 6) and (B, N, 6, 6).
    times : array, shape (B, N)
        Of the motion terms.
    W_acceleration, W_slip, W_zero_motion : array
        (M5), (M7) and (M6): (B, N - 2, 6, 6), (B, N - 1, 2, 2) and (B, N - 1, 6, 6).
    prior_mean, W_prior : array, shapes (B, 34) and (B, 34, 34)
        Marginalisation prior (M9).
    expected, W_shared : array, shapes (B, 22) and (B, 22, 22)
        Shared variables (M8).

    """

    given: Any
    inset: Any
    W_faces: Any
    input_pose: Any
    axes: Any
    W_input: Any
    shape_start: Any
    shape_axes: Any
    wanted: Any
    W_shape: Any
    times: Any
    W_acceleration: Any
    W_slip: Any
    W_zero_motion: Any
    prior_mean: Any
    W_prior: Any
    expected: Any
    W_shared: Any


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
    is_robust: bool


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
