"""
Every method of a table, run on the same sweeps and the same boxes.

The baselines, two smoothers, a rectangle fit per sweep and ICP, take a track and return one box
(N, 9) per observation, without access to the truth. They are standard methods with tuned
parameters, and nothing else uses them.

"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

from boxreg_ros.config import Config
from boxreg_ros.core.refine import Track
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.rotations import matrix_from_rpy, rpy_from_matrix, wrap_angle
from boxreg_ros.structures import (
    BOX_EXTENT,
    Floats,
    HEIGHT,
    Ints,
    LENGTH,
    PITCH,
    ROLL,
    WIDTH,
    X,
    Y,
    YAW,
)
from measure.drives import Drive
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solveh_banded
from scipy.optimize import least_squares
from scipy.sparse import csr_array, eye, kron, vstack

# Smoother: standard deviations.
POSITION_DEVIATION = 0.3  # of the centre of an input box [m]
ANGLE_DEVIATION = 0.2  # of its roll, pitch and yaw [rad]
ACCELERATION = 1.2  # in the plane [m/s^2], half of it in z
ANGULAR_ACCELERATION = 0.4  # of yaw [rad/s^2], half of it of roll and pitch
MIN_TRAVEL = 0.15  # a track whose ends are closer than this is parked [m]
REWEIGHTINGS = 5  # iterations of the robust fit

# Smoother of constant turn rate and acceleration: deviation of x, y [m], yaw [rad], speed [m/s],
# turn rate [rad/s] and acceleration [m/s^2] from the prediction, per root of a second; that of its
# authors, who weigh each squared residual by ten times the rate of the boxes.
CTRA_DEVIATION = 0.32
CTRA_OUTLIER = 2.0  # deviations of the input at which its weight is 1/2

# Rectangle fit and ICP: which points are used.
SCAN_MARGIN = 0.4  # points this far outside the box are used [m]
ROAD_CLEARANCE = 0.3  # points lower than this above the bottom are not [m]
MIN_SCAN_POINTS = 20  # with fewer the box is returned unchanged
MIN_GAP = 0.03  # gaps below this count as this in the closeness criterion [m]
FACE_SPACING = 0.1  # of the points on the faces that ICP aligns to [m]
ICP_DISTANCE = 0.5  # largest distance of two matched points [m]
ICP_ITERATIONS = 30
ASSUMED_SENSOR_HEIGHT = 2.0  # of the assumed sensor above a box, if its position is unknown [m]


def smoothed(track: Track) -> Floats:
    """
    Return the boxes smoothed over time, without using the points.

    Each pose coordinate follows a constant-velocity model with white acceleration and robust
    weights: the maximum a posteriori estimate, as of a Rauch-Tung-Striebel smoother, solved at
    once. Flips are corrected by majority, extents are the median of the track, and a parked
    object gets one pose.

    """
    return _smooth(track.stamps_ns, track.boxes)


def smoothed_live(track: Track, lag: int) -> tuple[Floats, Floats]:
    """Return the early and the final estimate of each box by `smoothed`."""
    newest = track.boxes.copy()
    lagged = track.boxes.copy()
    for count in range(1, len(newest) + 1):
        found = _smooth(track.stamps_ns[:count], track.boxes[:count])
        newest[count - 1] = found[-1]
        lagged[max(0, count - 1 - lag) : count] = found[-1 - lag :]
    return newest, lagged


def _smooth(stamps_ns: Ints, given: Floats) -> Floats:
    boxes = given.copy()
    boxes[:, BOX_EXTENT] = np.median(boxes[:, BOX_EXTENT], axis=0)
    boxes[:, YAW] = _without_flips(boxes[:, YAW])
    times = (stamps_ns - stamps_ns[0]) / 1e9
    columns = [0, 1, 2, ROLL, PITCH, YAW]
    deviations = [POSITION_DEVIATION] * 3 + [ANGLE_DEVIATION] * 3
    accelerations = [ACCELERATION, ACCELERATION, ACCELERATION / 2]
    accelerations += [ANGULAR_ACCELERATION / 2, ANGULAR_ACCELERATION / 2, ANGULAR_ACCELERATION]
    for column, deviation, change in zip(columns, deviations, accelerations, strict=True):
        values = np.unwrap(boxes[:, column]) if column >= ROLL else boxes[:, column]
        boxes[:, column] = _map_estimate(times, values, deviation, change)
    if _is_parked(given):
        boxes[:, :2] = np.median(given[:, :2], axis=0)
        boxes[:, YAW] = np.median(np.unwrap(_without_flips(given[:, YAW])))
    return boxes


def ctra_smoothed(track: Track) -> Floats:
    """
    Return the boxes of `smoothed`, those of a moving object on a path of smooth turn rate.

    Constant turn rate and acceleration (CTRA): speed, turn rate and acceleration are states of
    each box beside x, y and yaw, and the heading is that of the path. The residuals are those of
    the motion model of Justo Miro et al., Correcting and Quantifying Systematic Errors in 3D Box
    Annotations for Autonomous Driving, 2026.

    """
    boxes = smoothed(track)
    if len(boxes) < 3 or _is_parked(track.boxes):
        return boxes
    times = (track.stamps_ns - track.stamps_ns[0]) / 1e9
    place = boxes[:, [X, Y, YAW]]
    place[:, 2] = np.unwrap(place[:, 2])
    turned = wrap_angle(2 * (track.boxes[:, YAW] - place[:, 2])) / 2  # without half turns
    given = np.column_stack([track.boxes[:, X], track.boxes[:, Y], place[:, 2] + turned])
    fit = least_squares(
        _ctra_residuals,
        _ctra_start(times, place).ravel(),
        jac_sparsity=_ctra_sparsity(len(boxes)),
        x_scale='jac',
        args=(times, given),
    )
    boxes[:, [X, Y, YAW]] = fit.x.reshape(-1, 6)[:, :3]
    boxes[:, YAW] = wrap_angle(boxes[:, YAW])
    return boxes


def _ctra_start(times: Floats, place: Floats) -> Floats:
    """Return states (N, 6) of constant speed between `place` (N, 3): x, y and yaw."""
    rates = np.gradient(place, times, axis=0)
    speed = rates[:, 0] * np.cos(place[:, 2]) + rates[:, 1] * np.sin(place[:, 2])
    return np.column_stack([place, speed, rates[:, 2], np.gradient(speed, times)])


def _ctra_residuals(states: Floats, times: Floats, given: Floats) -> Floats:
    """Return the residuals of the input `given` (N, 3), robust, and of the N - 1 predictions."""
    x, y, yaw, speed, turn_rate, acceleration = states.reshape(-1, 6).T
    of_input = np.column_stack([x, y, yaw]) - given
    of_input /= [POSITION_DEVIATION, POSITION_DEVIATION, ANGLE_DEVIATION]
    squared = np.square(of_input / CTRA_OUTLIER)
    robust = of_input * np.sqrt(np.log1p(squared) / np.maximum(squared, 1e-12))  # Cauchy's
    seconds = np.diff(times)
    middle = (yaw + turn_rate * np.append(seconds, 0) / 2)[:-1]  # heading of the chord
    chord = speed[:-1] * seconds + acceleration[:-1] * seconds**2 / 2
    of_motion = np.column_stack(
        [
            np.diff(x) - chord * np.cos(middle),
            np.diff(y) - chord * np.sin(middle),
            np.diff(yaw) - turn_rate[:-1] * seconds,
            np.diff(speed) - acceleration[:-1] * seconds,
            np.diff(turn_rate),
            np.diff(acceleration),
        ]
    )
    of_motion /= CTRA_DEVIATION * np.sqrt(seconds)[:, None]
    return np.concatenate([robust.ravel(), of_motion.ravel()])


def _ctra_sparsity(n: int) -> Any:
    """Return which of the residuals of `_ctra_residuals` depend on which of the 6 n states."""
    own = kron(eye(n), csr_array(np.eye(3, 6)))
    steps = kron(eye(n - 1, n) + eye(n - 1, n, k=1), np.ones((6, 6)))
    return vstack([own, steps])


def _is_parked(boxes: Floats) -> bool:
    """Return whether the median centres of the first and the last third nearly coincide."""
    third = -(-len(boxes) // 3)
    first = np.median(boxes[:third, :2], axis=0)
    last = np.median(boxes[-third:, :2], axis=0)
    return bool(np.linalg.norm(last - first) < MIN_TRAVEL)


def _without_flips(yaw: Floats) -> Floats:
    """Return yaw angles (N,) of which none is turned by pi against the majority [rad]."""
    axis = np.unwrap(yaw, period=np.pi)
    is_turned = np.cos(yaw - axis) < 0
    corrected: Floats = axis + np.pi * (is_turned.mean() > 0.5)
    return corrected


def _map_estimate(times: Floats, values: Floats, deviation: float, change: float) -> Floats:
    """
    Return the maximum a posteriori estimate (N,) by reweighted least squares at times (N,) [s].

    The standard deviations are those of a value and of its second derivative.

    """
    n = len(values)
    if n < 3:
        return values
    steps = np.diff(times)
    before = 1 / steps[:-1]
    after = 1 / steps[1:]
    second = np.array([before, -before - after, after])  # (3, N - 2) second differences
    second /= change * np.sqrt((steps[:-1] + steps[1:]) / 2)
    stiffness = np.zeros((3, n))  # diagonals of their normal equations, upper form
    for i in range(3):
        for j in range(i, 3):
            stiffness[2 + i - j, j : n - 2 + j] += second[i] * second[j]
    result: NDArray[Any] = values
    weights = np.ones(n)
    for _ in range(REWEIGHTINGS):
        information = weights / deviation**2
        system = stiffness + [[0.0], [0.0], [1.0]] * information
        result = solveh_banded(system, information * values)
        weights = 1 / (1 + ((values - result) / (2 * deviation)) ** 2)  # Cauchy
    return result


def l_shaped(track: Track) -> Floats:
    """
    Return rectangles fitted to the points of each sweep alone.

    Yaw is found by search-based rectangle fitting with the closeness criterion: the angle at
    which most points are near an edge of their bounding rectangle. The rectangle gets the extents
    of the input and is placed at the corner nearest to the sensor. z, roll and pitch are
    unchanged, and so are boxes with fewer than `MIN_SCAN_POINTS` points.

    """
    boxes = track.boxes.copy()
    for i, box, points in _scanned(track, boxes):
        flat = points[:, :2] - box[:2]
        angle = _closest_angle(flat)
        box[YAW] += wrap_angle(4 * (angle - box[YAW])) / 4  # the nearest of four directions
        sensor = _sensor_origin(track, i)[:2] - box[:2]
        box[:2] += _center_at_near_corner(flat, sensor, box)
    return boxes


def _closest_angle(flat: Floats) -> float:
    """Return the angle in [0, 90) degrees with the largest closeness of points (M, 2) [rad]."""
    angles = np.radians(np.arange(90.0))
    axes = np.stack([np.cos(angles), np.sin(angles)], axis=1)  # (90, 2)
    normals = np.stack([-axes[:, 1], axes[:, 0]], axis=1)
    gaps = []
    for directions in (axes, normals):
        along = flat @ directions.T  # (M, 90)
        gaps.append(np.minimum(along.max(axis=0) - along, along - along.min(axis=0)))
    closeness = (1 / np.maximum(np.minimum(*gaps), MIN_GAP)).sum(axis=0)
    return float(angles[np.argmax(closeness)])


def _center_at_near_corner(flat: Floats, sensor: Floats, box: Floats) -> Floats:
    """Return the centre (2,) of a box whose sides near the sensor (2,) touch points (M, 2)."""
    forward = np.array([np.cos(box[YAW]), np.sin(box[YAW])])
    left = np.array([-forward[1], forward[0]])
    center = np.zeros(2)
    for axis, extent in ((forward, box[LENGTH]), (left, box[WIDTH])):
        along = flat @ axis
        is_front = sensor @ axis > 0
        middle = along.max() - extent / 2 if is_front else along.min() + extent / 2
        center += middle * axis
    return center


def icp(track: Track) -> Floats:
    """
    Return boxes aligned by ICP of the points to points sampled on the visible faces.

    Only x, y and yaw of the transform are used: a vehicle does not fill its box, so points on
    its slopes bias z, roll and pitch. Raises ImportError without small_gicp.

    """
    import small_gicp

    boxes = track.boxes.copy()
    for i, box, points in _scanned(track, boxes):
        R = matrix_from_rpy(box[ROLL:])
        local = (points - box[:3]) @ R
        sensor = R.T @ (_sensor_origin(track, i) - box[:3])
        faces = small_gicp.PointCloud(_face_points(box[BOX_EXTENT], sensor))
        T_box_points = small_gicp.align(
            faces,
            small_gicp.PointCloud(local),
            small_gicp.KdTree(faces),
            registration_type='ICP',
            max_correspondence_distance=ICP_DISTANCE,
            max_iterations=ICP_ITERATIONS,
        ).T_target_source
        is_finite = np.isfinite(T_box_points).all()
        if not is_finite or np.abs(T_box_points[:3, 3]).max() > 2 * SCAN_MARGIN:
            continue  # diverged
        turned = R @ T_box_points[:3, :3].T
        box[:2] -= (turned @ T_box_points[:3, 3])[:2]
        box[YAW] = rpy_from_matrix(turned)[2]
    return boxes


def _face_points(extent: Floats, sensor: Floats) -> Floats:
    """Return points (S, 3) on the faces that `sensor` (3,) can see, all in the box frame."""
    grids = [
        np.linspace(-size / 2, size / 2, max(2, round(size / FACE_SPACING))) for size in extent
    ]
    faces = []
    for axis in range(3):
        if abs(sensor[axis]) <= extent[axis] / 2:
            continue
        fixed = list(grids)
        fixed[axis] = np.array([np.sign(sensor[axis]) * extent[axis] / 2])
        faces.append(np.stack(np.meshgrid(*fixed, indexing='ij'), axis=-1).reshape(-1, 3))
    return np.concatenate(faces) if faces else np.zeros((0, 3))


def _scanned(track: Track, boxes: Floats) -> Iterator[tuple[int, Floats, Floats]]:
    """Yield row, box and points (M, 3) near the box and above the road, where there are enough."""
    for i, (box, points) in enumerate(zip(boxes, track.points, strict=True)):
        offsets = (points - box[:3]) @ matrix_from_rpy(box[ROLL:])
        is_near = (np.abs(offsets) < box[BOX_EXTENT] / 2 + SCAN_MARGIN).all(axis=1)
        is_body = is_near & (offsets[:, 2] > ROAD_CLEARANCE - box[HEIGHT] / 2)
        if is_body.sum() >= MIN_SCAN_POINTS:
            yield i, box, points[is_body]


def _sensor_origin(track: Track, i: int) -> Floats:
    """Return the position of the sensor (3,), or a point above the box if it is unknown."""
    if track.sensor_origins is None:
        return track.boxes[i, :3] + [0.0, 0.0, ASSUMED_SENSOR_HEIGHT]
    origin: Floats = track.sensor_origins[i]
    return origin


BASELINES: dict[str, tuple[str, Callable[[Track], Floats]]] = {
    'smoothing': ('smoothing only', smoothed),
    'ctra': ('CTRA smoothing', ctra_smoothed),
    'l-shape': ('L-shape per sweep', l_shaped),
    'icp': ('ICP on box points', icp),
}
METHODS = (*BASELINES, 'paper', 'ours')
METHOD_OPTION = ([*METHODS], 'only some of', {'nargs': '+', 'choices': METHODS})

Methods = dict[str, BoxTable | str]
"""Boxes by the name of their method, or the reason why the method did not run."""


def run_methods(drive: Drive, mode: str = '3d', wanted: Sequence[str] = METHODS) -> Methods:
    """Return the boxes of the `wanted` methods, the input first; baselines ignore `mode`."""
    methods: Methods = {'input': BoxTable.from_arrays(drive.boxes)}
    needs_tracks = not BASELINES.keys().isdisjoint(wanted)
    tracks = drive.tracks() if needs_tracks else []
    for method in METHODS:
        if method not in wanted:
            continue
        if method == 'smoothing':
            methods |= _smoothed_live(tracks, drive)
        if method in BASELINES:
            name, baseline = BASELINES[method]
            methods[name] = _run_baseline(baseline, tracks, drive)
        else:
            methods |= _registered(method, mode, drive)
    return methods


def _smoothed_live(tracks: Sequence[Track], drive: Drive) -> Methods:
    """Return the smoother at the lags of the live node."""
    pairs = [smoothed_live(track, Config().lag) for track in tracks]
    return {
        'smoothing, early': _table(tracks, [newest for newest, _ in pairs], drive),
        'smoothing, final': _table(tracks, [lagged for _, lagged in pairs], drive),
    }


def _run_baseline(
    baseline: Callable[[Track], Floats], tracks: Sequence[Track], drive: Drive
) -> BoxTable | str:
    try:
        boxes = [baseline(track) for track in tracks]
    except ImportError as error:
        return f'skipped: {error.name} is not installed'
    return _table(tracks, boxes, drive)


def _registered(method: str, mode: str, drive: Drive) -> Methods:
    """Return the estimates of our objective, or of the paper's for whole tracks."""
    objective = 'paper' if method == 'paper' else Config().objective
    runs = ('track',) if method == 'paper' else ('final', 'track')
    methods: Methods = {}
    for run in runs:
        config = Config(objective=objective, estimate=run, mode=mode)
        for estimate, boxes in drive.registered(config).items():
            methods[f'{method}, {estimate}'] = boxes
    return methods


def _table(tracks: Sequence[Track], boxes: Sequence[Floats], drive: Drive) -> BoxTable:
    """Return the boxes of tracks, one array (N, 9) for each, as one table."""
    total = sum(len(track.boxes) for track in tracks)
    return BoxTable(
        np.concatenate([np.zeros(0, np.int64), *(track.stamps_ns for track in tracks)]),
        drive.truth.frame_id,
        tuple(track.track_id for track in tracks for _ in track.boxes),
        tuple(track.class_name for track in tracks for _ in track.boxes),
        np.ones(total),
        np.concatenate([np.zeros((0, 9)), *boxes]),
        ('baseline',) * total,
        np.zeros(total, np.int64),
    )
