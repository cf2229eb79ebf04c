"""
What the registration is measured against: a smoother, a per-sweep rectangle fit, and ICP.

Each takes a track and returns boxes (N, 9) for its stamps; none knows the truth. They are the
plain methods of the field, tuned in good faith and kept short: nothing else uses them.

"""

from __future__ import annotations

from typing import Any

from boxreg_ros.core.metrics import EXTENT
from boxreg_ros.core.refine import Track
from boxreg_ros.rotations import matrix_from_rpy, rpy_from_matrix, wrap_angle
from boxreg_ros.structures import Floats, Ints, LENGTH, PITCH, ROLL, WIDTH, YAW
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solveh_banded

POSITION, HEADING = 0.3, 0.2  # expected errors of an input box [m, rad]
ACCELERATION, TURNING = 1.2, 0.4  # expected changes of motion [m/s^2, rad/s^2]
PARKED = 0.15  # [m], what ends nearer to its start than this does not move
MARGIN, CLEARANCE, LEAST_POINTS = 0.4, 0.3, 20


def smoothed(track: Track) -> Floats:
    """
    Return the track smoothed without a look at its points.

    A constant-velocity model with white acceleration per coordinate, robust to outliers: the
    maximum a posteriori solution, which is what a Rauch-Tung-Striebel smoother computes, solved at
    once. Flips are undone by majority, extents are the track's median, a parked object has one
    pose.

    """
    return _smooth(track.stamps_ns, track.boxes)


def smoothed_live(track: Track, lag: int) -> tuple[Floats, Floats]:
    """Return each box as `smoothed` has it when it is the newest, and `lag` boxes later."""
    newest, lagged = track.boxes.copy(), track.boxes.copy()
    for count in range(1, len(newest) + 1):
        found = _smooth(track.stamps_ns[:count], track.boxes[:count])
        newest[count - 1] = found[-1]
        lagged[max(0, count - 1 - lag) : count] = found[-1 - lag :]
    return newest, lagged


def _smooth(stamps_ns: Ints, given: Floats) -> Floats:
    """Do what `smoothed` says."""
    boxes = given.copy()
    boxes[:, EXTENT] = np.median(boxes[:, EXTENT], axis=0)
    boxes[:, YAW] = _without_flips(boxes[:, YAW])
    times = (stamps_ns - stamps_ns[0]) / 1e9
    expected = [POSITION] * 3 + [HEADING] * 3
    changes = [ACCELERATION] * 2 + [ACCELERATION / 2, TURNING / 2, TURNING / 2, TURNING]
    columns = [0, 1, 2, ROLL, PITCH, YAW]
    for column, error, change in zip(columns, expected, changes, strict=True):
        values = np.unwrap(boxes[:, column]) if column >= ROLL else boxes[:, column]
        boxes[:, column] = _map_estimate(times, values, error, change)
    third = -(-len(times) // 3)
    first, last = (
        np.median(given[part, :2], axis=0) for part in (slice(third), slice(-third, None))
    )
    if np.linalg.norm(last - first) < PARKED:
        boxes[:, :2] = np.median(given[:, :2], axis=0)
        boxes[:, YAW] = np.median(np.unwrap(_without_flips(given[:, YAW])))
    return boxes


def _without_flips(yaw: Floats) -> Floats:
    """Return headings of which none is turned against the majority [rad]."""
    axis = np.unwrap(yaw, period=np.pi)
    turned = np.cos(yaw - axis) < 0
    kept: Floats = axis + np.pi * (turned.mean() > 0.5)
    return kept


def _map_estimate(times: Floats, values: Floats, error: float, change: float) -> Floats:
    """Return the most probable course of `values` (N,), by reweighted least squares."""
    n = len(values)
    if n < 3:
        return values
    steps = np.diff(times)
    before, after = 1 / steps[:-1], 1 / steps[1:]
    second = np.array([before, -before - after, after])  # differences, a row of three for each
    second /= change * np.sqrt((steps[:-1] + steps[1:]) / 2)
    stiffness = np.zeros((3, n))  # their squares: diagonals, upper form
    for i in range(3):
        for j in range(i, 3):
            stiffness[2 + i - j, j : n - 2 + j] += second[i] * second[j]
    result: NDArray[Any] = values
    weights = np.ones(n)
    for _ in range(5):
        pull = weights / error**2
        result = solveh_banded(stiffness + [[0.0], [0.0], [1.0]] * pull, pull * values)
        weights = 1 / (1 + ((values - result) / (2 * error)) ** 2)  # Cauchy
    return result


def l_shaped(track: Track) -> Floats:
    """
    Return rectangles fitted to each sweep alone, heading by search.

    The heading is the one whose axes the points keep closest to (search-based rectangle fitting
    with the closeness criterion); the rectangle is put at the corner nearest to the sensor, with
    the extents of the input. z, roll and pitch stay, and so do boxes with too few points.

    """
    boxes = track.boxes.copy()
    angles = np.radians(np.arange(90.0))
    axes = np.stack([np.cos(angles), np.sin(angles)], axis=1)  # (90, 2)
    normals = np.stack([-axes[:, 1], axes[:, 0]], axis=1)
    for i, box in enumerate(boxes):
        points = _body_points(track, i)
        if len(points) < LEAST_POINTS:
            continue
        flat = points[:, :2] - box[:2]
        gaps = []
        for directions in (axes, normals):
            along = flat @ directions.T  # (M, 90)
            gaps.append(np.minimum(along.max(axis=0) - along, along - along.min(axis=0)))
        closeness = (1 / np.maximum(np.minimum(*gaps), 0.03)).sum(axis=0)
        turn = wrap_angle(4 * (angles[np.argmax(closeness)] - box[YAW])) / 4  # nearest of the four
        box[YAW] += turn
        forward = np.array([np.cos(box[YAW]), np.sin(box[YAW])])
        center = np.zeros(2)
        sensor = _sensor(track, i)[:2] - box[:2]
        for axis, extent in (
            (forward, box[LENGTH]),
            (np.array([-forward[1], forward[0]]), box[WIDTH]),
        ):
            along = flat @ axis
            near = along.max() - extent / 2 if sensor @ axis > 0 else along.min() + extent / 2
            center += near * axis
        box[:2] += center
    return boxes


def icp(track: Track) -> Floats:
    """
    Return boxes moved so that the points lie on points sampled from the faces, by ICP.

    Of the motion found x, y and yaw are used: a body does not fill its box, so that points on
    slopes pull z, roll and pitch far off.

    Raises
    ------
    ImportError
        Without small_gicp.

    """
    import small_gicp

    boxes = track.boxes.copy()
    for i, box in enumerate(boxes):
        points = _body_points(track, i)
        if len(points) < LEAST_POINTS:
            continue
        R = matrix_from_rpy(box[ROLL:])
        local = (points - box[:3]) @ R
        sensor = R.T @ (_sensor(track, i) - box[:3])
        faces = small_gicp.PointCloud(_surface(box[EXTENT], sensor))
        T_box_points = small_gicp.align(
            faces,
            small_gicp.PointCloud(local),
            small_gicp.KdTree(faces),
            registration_type='ICP',
            max_correspondence_distance=0.5,
            max_iterations=30,
        ).T_target_source
        if not np.isfinite(T_box_points).all() or np.abs(T_box_points[:3, 3]).max() > MARGIN * 2:
            continue
        turned = R @ T_box_points[:3, :3].T
        box[:2] -= (turned @ T_box_points[:3, 3])[:2]
        box[YAW] = rpy_from_matrix(turned)[2]
    return boxes


def _surface(extent: Floats, sensor: Floats, spacing: float = 0.1) -> Floats:
    """Return points (S, 3) on the faces of a box turned to `sensor` (3,), in the box frame."""
    grids = [np.linspace(-size / 2, size / 2, max(2, round(size / spacing))) for size in extent]
    faces = []
    for axis in range(3):
        if abs(sensor[axis]) > extent[axis] / 2:
            fixed = [
                grids[k] if k != axis else np.array([np.sign(sensor[axis]) * extent[axis] / 2])
                for k in range(3)
            ]
            faces.append(np.stack(np.meshgrid(*fixed, indexing='ij'), axis=-1).reshape(-1, 3))
    return np.concatenate(faces) if faces else np.zeros((0, 3))


def _body_points(track: Track, i: int) -> Floats:
    """Return the points (M, 3) of observation `i` near its box and above the road."""
    box, points = track.boxes[i], track.points[i]
    offsets = (points - box[:3]) @ matrix_from_rpy(box[ROLL:])
    kept = (np.abs(offsets) < box[EXTENT] / 2 + MARGIN).all(axis=1)
    body: Floats = points[kept & (offsets[:, 2] > CLEARANCE - box[5] / 2)]
    return body


def _sensor(track: Track, i: int) -> Floats:
    """Return where the sensor was (3,), or above the box where that is not known."""
    if track.sensor_origins is None:
        return track.boxes[i, :3] + [0.0, 0.0, 2.0]
    origin: Floats = track.sensor_origins[i]
    return origin
