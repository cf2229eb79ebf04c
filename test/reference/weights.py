"""
The weights of all residuals in one round: expected deviations and robust functions.

docs/method.md, section Weights, has the formulas (M19) to (M25).

"""

from math import inf

from boxreg_ros.config import Config, FaceConfig
from boxreg_ros.core import terms
from boxreg_ros.core.batch import ACCELERATIONS, BIAS, EXTENT, GAP, Problem, State
from boxreg_ros.core.expectation import Expectation
from boxreg_ros.core.face_support import BOTTOM, FaceObservations
from boxreg_ros.core.geometry import FACE_AXIS, rotation_from_rpy
from boxreg_ros.core.kernels.arrays import WeightNumbers
from boxreg_ros.core.terms import Term
from boxreg_ros.structures import YAW
import torch
from torch import Tensor
from torch.nn.functional import pad

# Constants whose origin is not stated are chosen; `boxreg bench sensitivity` halves and doubles
# each of them.
INPUT_OUTLIER = 3.0
"""Deviation at which an input pose has weight 1/2, in standard deviations."""
MOTION_OUTLIER = 3.0
"""Deviation at which a motion residual has weight 1/4, in standard deviations."""
GAP_OUTLIER = 2.0
"""Deviation at which the prior of a labelling margin has weight 1/2, in standard deviations."""
PIN_DEVIATIONS = (0.02, 0.02, 0.02, 0.005, 0.005, 0.005)
"""Deviations of a pinned pose x y z [m] and roll pitch yaw [rad]; a person corrects that well."""
NEIGHBOUR_FACTOR = 3.0
"""Deviation from neighbours over error of the input. Derived roughly: white noise of deviation s
makes an extrapolation from two neighbours err by sqrt(1 + 4 + 1) s = 2.4 s."""

# An object is parked if it is slower, moves less and turns less than this over its window.
PARKED_SPEED = 0.3
"""Largest mean speed [m/s]."""
PARKED_DISTANCE = 0.7
"""Largest distance moved [m]."""
PARKED_TURN = 3.0
"""Largest turn, in errors of the input yaw."""
DRIVING_SPEED = 1.0
"""A parked object drives where the medians of five boxes before and after move faster [m/s]."""
DRIVING_SPAN = 5
"""Boxes in these medians."""
DRIVING_REACH = 4
"""Steps before and after one where the object drives that are not held at rest either."""
DRIFT_RATIOS = (1.0, 1.0, 0.5, 0.15, 0.15, 0.15)
"""Deviation of the steps of a parked box in x y z [m] and roll pitch yaw [rad], over `drift`."""
DRIFT_GATE = 6.9
"""The input of a parked object shows a velocity if its square is this many times what the noise
explains. Derived: half the 99.9 % quantile of chi-square with 2 degrees of freedom, whose mean is
2."""


def weigh(
    problem: Problem,
    state: State,
    observations: FaceObservations,
    expected: Expectation,
    config: Config,
) -> list[Term]:
    """
    Return the terms of one round, weighted by deviations and robust functions.

    Parameters
    ----------
    problem : Problem
        B windows.
    state : State
        Boxes at the start of the round.
    observations : FaceObservations
        The outermost points of their faces.
    expected : Expectation
        Means and deviations of input and shared variables.
    config : Config
        Settings.

    Returns
    -------
    terms : list of Term
        Faces (M2), input (M3), acceleration (M5), zero motion (M6), slip (M7), shared variables
        (M8) and marginalisation prior (M9).

    """
    valid = problem.valid.to(state.pose)
    axes = rotation_from_rpy(state.pose[..., 3:])
    given = problem.pose
    off_track = neighbour_deviation(problem, axes)
    face_weight = _face_weights(problem, observations, off_track, valid, config)
    at_input = terms.input_pose(state, given, axes)
    input_weight = _input_weights(at_input.residual[:, :, 0], off_track, valid, expected, config)
    input_weight = _with_pins(input_weight, problem, expected)
    shared_weight = _shared_weights(state, observations, face_weight, expected, config)
    to_body = at_input.by_pose[:, :, 0]  # (B, N, 6, 6)
    slip_weight = problem.of_class('slip', 'climb')[:, None] ** -2 * valid[:, 1:, None]
    return [
        Term(
            terms.faces,
            observations.moments * face_weight[..., None, None],
            (given, observations.inset),
        ),
        Term(terms.input_pose, _diagonal(input_weight), (given, axes)),
        Term(
            terms.acceleration,
            _acceleration_weights(problem, to_body, valid)[:, :, None],
            (problem.times,),
        ),
        Term(terms.slip, _diagonal(slip_weight), (problem.times,)),
        Term(terms.zero_motion, _diagonal(_zero_motion_weights(problem, expected))),
        Term(terms.shared_prior, _diagonal(shared_weight[:, None]), (expected.shared,)),
        Term(
            terms.marginalisation_prior,
            prior_information(problem, config)[:, None, None],
            (problem.prior_mean[:, None],),
        ),
    ]


def prior_information(problem: Problem, config: Config) -> Tensor:
    """Return the information of the marginalisation prior (B, 35, 35), 0 where it is off."""
    if config.ingredients.marginalisation:
        return problem.prior_information
    return torch.zeros_like(problem.prior_information)


def weight_numbers(config: Config, is_smooth: bool) -> WeightNumbers:
    """
    Return constants and settings for the kernel.

    With `is_smooth` the motion terms are robust, as by `robustify_motion`.

    """
    ingredients = config.ingredients
    return WeightNumbers(
        input_outlier=INPUT_OUTLIER if ingredients.robust_weights else inf,
        motion_outlier=MOTION_OUTLIER,
        gap_outlier=GAP_OUTLIER if ingredients.robust_weights else inf,
        neighbour_factor=NEIGHBOUR_FACTOR,
        parked_speed=PARKED_SPEED,
        parked_distance=PARKED_DISTANCE,
        parked_turn=PARKED_TURN,
        driving_speed=DRIVING_SPEED,
        driving_span=DRIVING_SPAN,
        driving_reach=DRIVING_REACH,
        face_outlier=config.faces.outlier,
        face_deviations=_rigid_face_deviations(config.faces),
        drift_ratios=DRIFT_RATIOS,
        drift_gate=DRIFT_GATE,
        is_robust=is_smooth and ingredients.robust_motion,
        pin_deviations=PIN_DEVIATIONS,
    )


def robustify_motion(term: Term, state: State) -> Term:
    """
    Return a motion `term` down-weighted where `state` is far off it (M24) [for Eq. 6 and 7].

    Without this, objects that brake hard, swerve or drift would be moved off their points, whose
    faces then are down-weighted as outliers. The weight (B, n, 1, R, R) falls with the Mahalanobis
    norm of the residual (B, n, 1, R), as the square of Cauchy's. A stencil is down-weighted no
    more than the two before it: the newest boxes are nearly as noisy as their input.

    """
    r = term.linearise(state).residual[:, :, 0, :, None]
    squared = (r.mT @ term.weight[:, :, 0] @ r)[..., None] / MOTION_OUTLIER**2
    squared[:, 2:] = squared[:, 2:].minimum(squared[:, 1:-1]).minimum(squared[:, :-2])
    return term._replace(weight=term.weight / (1 + squared) ** 2)


def neighbour_deviation(problem: Problem, axes: Tensor) -> Tensor:
    """
    Return the deviation of each input pose from the track of its neighbours (M19), (B, N, 6).

    It is the smallest deviation from three predictions of constant velocity: by the two poses
    before, the two after, and one on each side, along `axes` [m, rad]. An outlier deviates from
    all three, each of its neighbours from two at most. Division by `NEIGHBOUR_FACTOR` makes the
    value for noise alone no larger than the noise.

    """
    time = problem.times.where(problem.valid, torch.nan)[..., None]
    own = torch.cat([problem.pose, time], 2)
    # (B, N, 7, 5): two before, the pose itself, two after; NaN outside the window.
    five = pad(own.mT, (2, 2), value=torch.nan).unfold(2, 5, 1).transpose(1, 2)
    a, b, here = five[..., [0, 1, 3]], five[..., [1, 3, 4]], five[..., 2:3]
    off = here - a - (b - a) * (here - a)[..., 6:, :] / (b - a)[..., 6:, :]
    off = torch.cat([axes.mT @ off[..., :3, :], off[..., 3:6, :]], 2).abs()
    least = off.nan_to_num(torch.inf).amin(3).nan_to_num(posinf=0.0)
    return least / NEIGHBOUR_FACTOR


def _input_rates(problem: Problem) -> tuple[Tensor, Tensor]:
    """
    Return the slopes of x, y and yaw of the input over time, by linear regression.

    Returns
    -------
    rate : Tensor, shape (B, 3)
        [m/s, rad/s].
    power : Tensor, shape (B,)
        Sum of squares of the times about their mean [s^2].

    """
    valid = problem.valid.to(problem.times)
    t = problem.times
    centred = (t - (t * valid).sum(1, keepdim=True) / valid.sum(1, keepdim=True)) * valid
    power = (centred * t).sum(1)
    x_y_yaw = problem.boxes[..., [0, 1, YAW]]
    return (centred[..., None] * x_y_yaw).sum(1) / power[:, None], power


def parked_steps(problem: Problem, yaw_deviation: Tensor) -> Tensor:
    """
    Return 1 for the steps (B, N - 1) of parked objects, else 0 (M25).

    `yaw_deviation` (B,) is the estimated error of the input yaw [rad]: noise alone is no turn. An
    object that is parked over most of its window may brake or drive off at an end: those steps,
    and `DRIVING_REACH` more around them, are 0.

    """
    valid = problem.valid.to(problem.times)
    t = problem.times
    rate, _ = _input_rates(problem)
    duration = (t * valid).amax(1)
    speed = rate[:, :2].square().sum(1).sqrt()

    where = torch.cat([problem.boxes[..., :2], t[..., None]], 2)
    where = torch.where(problem.valid[..., None], where, torch.nan)
    from_median = (where - where.nanmedian(1, keepdim=True).values)[..., :2].norm(dim=2)
    moved = torch.maximum(speed * duration, 2 * from_median.nanmedian(1).values)
    turned = rate[:, 2].abs() * duration
    turned = turned / yaw_deviation.maximum(problem.of_class('heading')[:, 0])
    is_parked = (speed < PARKED_SPEED) & (moved < PARKED_DISTANCE) & (turned < PARKED_TURN)

    # (B, 3, N + 6): running medians of x, y and time; NaN outside the window.
    padded = pad(where.mT, (DRIVING_SPAN, DRIVING_SPAN), value=torch.nan)
    medians: Tensor = padded.unfold(2, DRIVING_SPAN, 1).median(3).values
    step = medians[..., DRIVING_SPAN + 1 : -1] - medians[..., 1 : -DRIVING_SPAN - 1]
    drives = (step[:, :2].norm(dim=1) > DRIVING_SPEED * step[:, 2]).to(t)
    near_drive = torch.max_pool1d(drives, 2 * DRIVING_REACH + 1, 1, DRIVING_REACH)
    return valid[:, 1:] * is_parked[:, None] * near_drive.eq(0)


def _face_weights(
    problem: Problem,
    observations: FaceObservations,
    off_track: Tensor,
    valid: Tensor,
    config: Config,
) -> Tensor:
    """
    Return the weights of the faces (M20), shape (B, N, 6) [1/m^2].

    A face is down-weighted by the square of Cauchy's weight, once of the distance of its points,
    and once of the distance of the input box from its track [m]: the points of a box far off its
    track belong to another object.

    """
    settings = config.faces
    deviation = face_deviations(problem, config)
    robust = 1 / (1 + (observations.distance / settings.outlier) ** 2) ** 2
    same_object = valid / (1 + off_track[..., :2].square().sum(2) ** 2) ** 2
    return observations.weight * robust * same_object[..., None] / deviation[:, None] ** 2


def _input_weights(
    residual: Tensor, off_track: Tensor, valid: Tensor, expected: Expectation, config: Config
) -> Tensor:
    """
    Return the weights of the input poses (M21), shape (B, N, 6).

    They are Cauchy's, of the sum of `residual` (B, N, 6) and `off_track` (B, N, 6).

    """
    outlier = INPUT_OUTLIER if config.ingredients.robust_weights else inf
    off = (residual.abs() + off_track) / expected.pose_deviation[:, None]
    inverse_variance = valid[..., None] / expected.widened_deviation[:, None] ** 2
    return inverse_variance / (1 + (off / outlier) ** 2)


def _with_pins(weight: Tensor, problem: Problem, expected: Expectation) -> Tensor:
    """
    Return the weights of the input poses (B, N, 6) of windows with pinned boxes (M21a).

    A pinned pose has the deviation `PIN_DEVIATIONS`. The bias of the others is not estimated
    there but part of their noise. n independent errors of variance s^2 + n b^2 provide as much
    information about a constant offset as n errors of variance s^2 with a common bias of
    deviation b, and s^2 as much about changes: the factor of b^2 is the geometric mean of n and 1.

    """
    has_pin = problem.pinned.any(1)
    if not has_pin.any():
        return weight
    count = problem.valid.sum(1)[:, None]
    variance = expected.widened_deviation**2
    factor = variance / (variance + count.sqrt() * expected.unmodelled_bias**2)
    weight = torch.where(has_pin[:, None, None], weight * factor[:, None], weight)
    pin_weight = weight.new_tensor(PIN_DEVIATIONS) ** -2
    return torch.where(problem.pinned[..., None], pin_weight, weight)


def _shared_weights(
    state: State,
    observations: FaceObservations,
    face_weight: Tensor,
    expected: Expectation,
    config: Config,
) -> Tensor:
    """
    Return the weights of the shared variables (M22), shape (B, 23).

    The deviation of a labelling margin is widened where the margin is far off the expected one, or
    the points of a face are far off where they are expected: points of a load, or of a branch
    above, must not raise the estimated roof.

    """
    outlier = GAP_OUTLIER if config.ingredients.robust_weights else inf
    deviation = expected.deviation
    spread = deviation[:, GAP]
    # Points and the face of the input are apart by margin, bias and half the error of the extent.
    face_variance = deviation[:, BIAS][:, :3] ** 2 + (deviation[:, EXTENT] / 2) ** 2
    variance = spread**2 + face_variance[:, FACE_AXIS]
    total = face_weight.sum(1)
    mean_distance = (observations.distance * face_weight).sum(1) / total.clamp(min=1e-9)
    gap_off = (state.shared - expected.shared)[:, GAP] ** 2 / spread**2
    squared = gap_off.maximum(mean_distance**2 / variance)
    gap = spread * (1 + squared / outlier**2).sqrt()
    return torch.cat([deviation[:, : GAP.start], gap, deviation[:, GAP.stop :]], 1) ** -2


def _acceleration_weights(problem: Problem, to_body: Tensor, valid: Tensor) -> Tensor:
    """
    Return the weights of the accelerations (M23), shape (B, N - 2, 6, 6), in the fixed frame.

    Their deviations are along body axes: `to_body` (B, N, 6, 6).

    """
    information = problem.of_class(*ACCELERATIONS) ** -2
    to_fixed = to_body.mT
    weight = (to_fixed * information[:, None, None]) @ to_fixed.mT
    return weight[:, 1:-1] * valid[:, 2:, None, None]


def _zero_motion_weights(problem: Problem, expected: Expectation) -> Tensor:
    """
    Return the weights of the steps of parked objects (M25), shape (B, N - 1, 6).

    Where the fixed frame drifts, or labels in it, parked objects have a velocity. If it shows, its
    square is that of the input less the part that the noise of the input explains.

    """
    yaw_deviation = expected.pose_deviation[:, 5]
    deviation = problem.of_class('drift') * yaw_deviation.new_tensor(DRIFT_RATIOS)
    rate, power = _input_rates(problem)
    noise = expected.widened_deviation[:, :2].square().sum(1) / power
    squared_speed = rate[:, :2].square().sum(1)
    squared_speed = torch.where(squared_speed > DRIFT_GATE * noise, squared_speed - noise, 0.0)
    variance = (deviation**2)[:, None].repeat(1, problem.length - 1, 1)
    variance[..., :2] += (squared_speed[:, None] * problem.times.diff(dim=1) ** 2)[..., None]
    return parked_steps(problem, yaw_deviation)[..., None] / variance


def face_deviations(problem: Problem, config: Config) -> Tensor:
    """
    Return the deviation of one observation of each face, shape (B, 6) [m].

    Outermost points of non-rigid parts, such as legs and arms, deviate by `shape` or more from
    the faces; the road does not.

    """
    shape = problem.of_class('shape')
    deviation = shape.maximum(shape.new_tensor(_rigid_face_deviations(config.faces)))
    deviation[:, BOTTOM] = config.faces.bottom
    return deviation


def _rigid_face_deviations(faces: FaceConfig) -> tuple[float, ...]:
    """Return the deviation of one observation of each face of a rigid object [m]."""
    return faces.ends, faces.ends, faces.sides, faces.sides, faces.top, faces.bottom


def _diagonal(weight: Tensor) -> Tensor:
    """Return diagonal weight matrices (B, n, 1, R, R) of `weight` (B, n, R)."""
    return torch.diag_embed(weight)[:, :, None]
