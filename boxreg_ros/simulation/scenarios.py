"""
The scenarios of `boxreg simulate`.

A street, a highway, articulated trucks in curves, rows of parked cars, and the paper's experiment.

"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

from boxreg_ros.rotations import matrix_from_rpy
from boxreg_ros.simulation.noise import detector_noise, table_one_noise
from boxreg_ros.simulation.raycast import (
    Actor,
    body,
    Motion,
    revolution,
    ROAD,
    Sensor,
    SWEEP_PERIOD,
    to_matrix,
)
from boxreg_ros.simulation.scene import (
    boxes_of,
    is_near,
    make_scene,
    make_sweep,
    Scan,
    SimulatedScene,
)
from boxreg_ros.structures import Floats, LENGTH, ROLL, YAW
import numpy as np
from numpy.typing import NDArray

EXTENTS = {
    'car': (4.4, 1.8, 1.5), 'suv': (4.7, 1.92, 1.72), 'van': (5.4, 2.0, 2.3),
    'truck': (7.8, 2.45, 3.1), 'trailer': (8.0, 2.5, 3.4),
    'tractor': (5.6, 2.45, 3.2),
    'pedestrian': (0.6, 0.65, 1.75), 'cyclist': (1.75, 0.6, 1.75),
}  # fmt: skip
"""Length, width and height of each shape [m]."""
ROAD_MARGIN = 1.6  # road points further than this from every box are left out [m]
MISS_PROBABILITY = 0.068  # part of the boxes that the detector misses
INTEGRATION_STEP = 0.01  # of a motion [s]

STREET_SWEEPS = 50
SENSOR_HEIGHT = 1.8  # in the street [m]
STREET_SENSOR = Sensor(np.radians(np.linspace(-22, 3, 34)), columns=640)
PITCH_AMPLITUDE = 0.006  # of the vehicle that carries the sensor [rad]

HIGHWAY_SWEEPS = 40
HIGHWAY_SPEED = 30.0  # of the vehicle that carries the sensor [m/s]
TRAILER_DISTANCE = 9.1  # of the centre of a trailer behind that of its truck [m]

PAPER_STEPS = 100  # T of Eq. 10
PAPER_SPEED = 5.0  # [m/s]

Rate = Callable[[Floats], NDArray[Any]]
"""A speed [m/s] or a yaw rate [rad/s] at times (G,) [s]."""
StartPose = tuple[float, float, float]
"""x, y [m] and yaw [rad]."""


class ActorPlan(NamedTuple):
    """One road user of the street: class, shape, place at time 0, speed and yaw rate."""

    class_name: str
    shape: str
    place: StartPose
    speed: Rate
    yaw_rate: Rate


def zero(times: Floats) -> Floats:
    """Return the rate of a parked object or of a straight path."""
    return np.zeros_like(times)


def constant(value: float) -> Rate:
    """Return a constant rate."""
    return lambda times: value + 0 * times


TRAFFIC = (
    ActorPlan('car', 'car', (28, -1.8, 0), lambda t: 7 - 2 * np.sin(t), zero),
    ActorPlan('car', 'suv', (62, 1.6, np.pi), constant(9), zero),
    ActorPlan('truck', 'truck', (74, 1.9, np.pi), constant(7), zero),
    # Turns into a side street.
    ActorPlan(
        'car', 'car', (16, -1.8, 0), lambda t: np.maximum(6 - t, 4.2),
        lambda t: -0.6 * (np.abs(t - 3.1) < 1.3),
    ),
    # Backs out of a parking space.
    ActorPlan(
        'car', 'suv', (37, 11.5, np.pi / 2), lambda t: -1.3 * (t > 0.8),
        lambda t: 0.25 * (t > 2),
    ),
    ActorPlan(
        'cyclist', 'cyclist', (47, 3.4, np.pi), constant(4.5), lambda t: 0.06 * np.sin(2 * t)
    ),
    ActorPlan('pedestrian', 'pedestrian', (22, 7.2, np.pi), constant(1.3), zero),
    ActorPlan('pedestrian', 'pedestrian', (15, -6.9, 0), constant(1.5), lambda t: 0.1 * np.cos(t)),
)  # fmt: skip
PARKED_ROW = (
    ('car', 7, -4.6), ('van', 13.2, -4.7), ('suv', 19, -4.6), ('car', 24.7, -4.7),
    ('car', 41, -4.6), ('truck', 49, -4.9), ('suv', 57, -4.6), ('car', 11, 4.9),
    ('suv', 17, 4.9), ('van', 23.5, 5.0), ('car', 30, 4.8), ('car', 45.5, 4.9),
    ('car', 52, 4.8), ('van', 58.5, 5.0),
)  # fmt: skip
"""Shape, x and y [m] of the parked rows."""


def street(rng: np.random.Generator, sweeps: int | None) -> SimulatedScene:
    """Return a street with parked rows and traffic in both directions."""
    count = sweeps or STREET_SWEEPS
    return _along_the_street(street_actors(rng, count), count, rng)


def _along_the_street(
    actors: Sequence[Actor], count: int, rng: np.random.Generator
) -> SimulatedScene:
    """Return what a car sees that drives along the street."""
    ego = drive(count * SWEEP_PERIOD, (4, -1.75, 0), constant(6), zero)
    ego.poses[:, 2] = SENSOR_HEIGHT
    ego.poses[:, 4] = PITCH_AMPLITUDE * np.sin(2 * ego.times)
    return _with_detections(actors, _scanned(actors, ego, STREET_SENSOR, count, rng), rng)


def street_actors(rng: np.random.Generator, count: int) -> list[Actor]:
    """Return the parked rows and the traffic of the street for `count` sweeps."""
    plans = list(TRAFFIC)
    for shape, x, y in PARKED_ROW:
        place = (
            x + rng.normal(0, 0.2),
            y + rng.normal(0, 0.1),
            np.pi * (y > 0) + rng.normal(0, 0.03),
        )
        plans.append(ActorPlan('car' if shape == 'suv' else shape, shape, place, zero, zero))
    return [_actor(str(i + 1), plan, count, rng) for i, plan in enumerate(plans)]


HIGHWAY = (
    ('car', 'car', 22, 0.0, 1.0), ('car', 'suv', 48, 0.0, 0.97), ('car', 'car', -18, 0.0, 1.02),
    ('car', 'suv', -25, 3.6, 1.25), ('car', 'car', 12, 3.6, 1.33), ('van', 'van', 35, 3.6, 1.1),
    ('truck', 'truck', 30, -3.6, 0.83), ('trailer', 'trailer', 30, -3.6, 0.83),
    ('truck', 'truck', -6, -3.6, 0.85), ('trailer', 'trailer', -6, -3.6, 0.85),
    ('car', 'car', 55, 11.0, -1.1), ('car', 'suv', 80, 14.6, -1.2),
    ('truck', 'truck', 95, 11.0, -0.85), ('trailer', 'trailer', 95, 11.0, -0.85),
)  # fmt: skip
"""Class, shape, x and y [m] and speed over that of the sensor; a trailer follows its truck."""


def highway(
    rng: np.random.Generator,
    sweeps: int | None,
    at_sight: bool = False,
    speed: float = HIGHWAY_SPEED,
) -> SimulatedScene:
    """
    Return a highway: every vehicle moves by metres while the sensor turns.

    With `at_sight` a box is where the vehicle was when the sensor saw it, and not where it was
    at the stamp. `speed` is that of the vehicle that carries the sensor [m/s]; the others drive
    0.83 to 1.33 times as fast.

    """
    count = sweeps or HIGHWAY_SWEEPS
    actors = []
    for i, (class_name, shape, x, y, ratio) in enumerate(HIGHWAY):
        behind = TRAILER_DISTANCE * np.sign(ratio) if class_name == 'trailer' else 0.0
        place = (x - behind, y, np.pi * (ratio < 0))
        plan = ActorPlan(class_name, shape, place, constant(abs(ratio) * speed), zero)
        actors.append(_actor(str(i + 1), plan, count, rng))
    ego = drive(count * SWEEP_PERIOD, (0, 0, 0), constant(speed), zero)
    ego.poses[:, 2] = SENSOR_HEIGHT
    sensor = replace(STREET_SENSOR, stamp_at=1.0)
    return _with_detections(actors, _scanned(actors, ego, sensor, count, rng, at_sight), rng)


CURVES = (
    (10, 11, 0.0, 5.5, 0.30), (48, -1, np.pi, 4.5, -0.32), (24, -17, 0.0, 6.0, -0.28),
    (-14, -12, 0.0, 4.5, -0.30), (-10, 6, np.pi / 2, 4.0, 0.36), (36, -11, np.pi, 5.0, 0.30),
)  # fmt: skip
"""Of each tractor: x, y and yaw, speed, and yaw rate after a second [m, rad, s]."""
CARS_BESIDE = (
    ('car', 2, -8, 0.0, 0.0), ('suv', 8, -8, 0.0, 0.0), ('van', 14, -7.9, 0.0, 0.0),
    ('car', 6, 5.5, 0.1, 0.0), ('suv', 31, -7, np.pi, 0.0), ('car', 12, 2, 0.0, 4.0),
)  # fmt: skip
"""Shape, x, y and yaw, and speed of the cars among them."""
KINGPIN = (-0.25, 0.4)
"""Place of the joint ahead of the centre of tractor and trailer, as part of their lengths."""
TRAILER_AXLE = 0.225
"""Distance of the axle of a trailer behind its centre, as part of its length."""


def articulated(rng: np.random.Generator, sweeps: int | None, is_joined: bool) -> SimulatedScene:
    """
    Return tractors with a trailer in curves, and a few cars.

    With `is_joined` one box is around each tractor and its trailer: it heads from the rear of the
    trailer to the front of the tractor, and its extents change in a curve. Else each has its own.

    """
    count = sweeps or STREET_SWEEPS
    plans = [
        ActorPlan('car', shape, (x, y, yaw), constant(speed), zero)
        for shape, x, y, yaw, speed in CARS_BESIDE
    ]
    cars = [_actor(str(i + 1), plan, count, rng) for i, plan in enumerate(plans)]
    tractors: list[Actor] = []
    for x, y, yaw, speed, turn in CURVES:
        turning = _after_a_second(turn)
        plan = ActorPlan('truck', 'tractor', (x, y, yaw), constant(speed), turning)
        tractors.append(_actor(str(len(cars) + len(tractors) + 1), plan, count, rng))
    trailers = [_trailer(f'{tractor.track_id}b', tractor, rng) for tractor in tractors]
    ego = drive(count * SWEEP_PERIOD, (0, -1.75, 0), constant(3), zero)
    ego.poses[:, 2] = SENSOR_HEIGHT
    parts = (*cars, *tractors, *trailers)
    scan = _scanned(parts, ego, STREET_SENSOR, count, rng)
    if is_joined:
        scan = _joined(scan, len(cars), len(tractors))
    return _with_detections(parts[: len(scan.true_boxes)], scan, rng)


def _after_a_second(rate: float) -> Rate:
    return lambda times: rate * (times > 1)


def _trailer(track_id: str, tractor: Actor, rng: np.random.Generator) -> Actor:
    """Return the trailer of a tractor, whose axle does not slip sideways."""
    extent = np.array(EXTENTS['trailer']) * rng.uniform(0.95, 1.05, 3)
    times, poses = tractor.motion.times, tractor.motion.poses
    heading = np.stack([np.cos(poses[:, 5]), np.sin(poses[:, 5])], axis=1)
    joint = poses[:, :2] + KINGPIN[0] * tractor.extent[0] * heading
    to_axle = (KINGPIN[1] + TRAILER_AXLE) * extent[0]
    yaw = poses[:, 5].copy()
    for i, step in enumerate(np.diff(joint, axis=0)):
        across = np.cos(yaw[i]) * step[1] - np.sin(yaw[i]) * step[0]
        yaw[i + 1] = yaw[i] + across / to_axle
    heading = np.stack([np.cos(yaw), np.sin(yaw)], axis=1)
    center = joint - KINGPIN[1] * extent[0] * heading
    flat = np.zeros_like(times)
    up = flat + extent[2] / 2
    motion = Motion(times, np.stack([*center.T, up, flat, flat, yaw], axis=1))
    return Actor(track_id, 'trailer', 'trailer', extent, motion)


def _joined(scan: Scan, first: int, count: int) -> Scan:
    """Return a scan with one box around each tractor, from row `first` on, and its trailer."""
    owners = [np.where(owner >= first + count, owner - count, owner) for owner in scan.owners]
    boxes = scan.true_boxes[:-count].copy()
    for row in range(first, first + count):
        boxes[row] = _box_around(scan.true_boxes[row], scan.true_boxes[row + count])
    return scan._replace(true_boxes=boxes, owners=owners)


def _box_around(tractors: Floats, trailers: Floats) -> Floats:
    """Return the boxes (n, 9) on the road around tractors and trailers (n, 9)."""
    both = np.stack([tractors, trailers])  # (2, n, 9)
    heading = np.stack([np.cos(both[..., YAW]), np.sin(both[..., YAW])], axis=-1)
    half = both[..., LENGTH:ROLL] / 2
    ends = both[..., :2] + heading * half[..., :1] * np.array([1, -1])[:, None, None]
    front, rear = ends
    yaw = np.arctan2(*(front - rear).T[::-1])
    turn = np.abs(both[..., YAW] - yaw)
    along, across = np.abs(np.cos(turn)), np.abs(np.sin(turn))
    reach = np.stack([along, across], -1) * half[..., :1]
    reach += np.stack([across, along], -1) * half[..., 1:2]
    axes = matrix_from_rpy(np.outer(yaw, [0, 0, 1]))[:, :2, :2]  # columns are the box axes
    center = np.einsum('nji,bnj->bni', axes, both[..., :2])
    low, high = (center - reach).min(0), (center + reach).max(0)
    height = 2 * half[..., 2].max(0)
    place = np.einsum('nij,nj->ni', axes, (low + high) / 2)
    flat = np.zeros_like(yaw)
    return np.column_stack([place, height / 2, high - low, height, flat, flat, np.unwrap(yaw)])


BUMPER_GAP = 0.2
"""Between parked cars [m]."""
ROWS = ((-4.6, 0.0), (4.8, np.pi))
"""y and yaw of the rows of parked cars [m, rad]."""
SHAPES_OF_A_ROW = ('car', 'suv', 'van', 'car', 'suv', 'car', 'car', 'suv')


def parked(rng: np.random.Generator, sweeps: int | None) -> SimulatedScene:
    """Return two rows of cars that are parked bumper to bumper."""
    count = sweeps or STREET_SWEEPS
    actors: list[Actor] = []
    for y, yaw in ROWS:
        rear = 2.0
        for shape in SHAPES_OF_A_ROW:
            place = (0, y + rng.normal(0, 0.1), yaw + rng.normal(0, 0.02))
            plan = ActorPlan('van' if shape == 'van' else 'car', shape, place, zero, zero)
            actor = _actor(str(len(actors) + 1), plan, count, rng)
            actor.motion.poses[:, 0] += rear + actor.extent[0] / 2
            rear += actor.extent[0] + BUMPER_GAP
            actors.append(actor)
    return _along_the_street(actors, count, rng)


def _actor(track_id: str, plan: ActorPlan, count: int, rng: np.random.Generator) -> Actor:
    """Return a road user with a random size, on its path for `count` sweeps."""
    extent = np.array(EXTENTS[plan.shape]) * rng.uniform(0.95, 1.05, 3)
    is_vehicle = plan.class_name in ('car', 'van', 'truck', 'trailer')
    axle = 0.25 * extent[0] if is_vehicle else 0.0
    motion = drive(count * SWEEP_PERIOD, plan.place, plan.speed, plan.yaw_rate, axle)
    motion.poses[:, 2] = extent[2] / 2
    return Actor(track_id, plan.class_name, plan.shape, extent, motion)


def drive(
    duration: float, start: StartPose, speed: Rate, yaw_rate: Rate, axle: float = 0.0
) -> Motion:
    """
    Return the motion of a body on a plane whose rear axle does not slip sideways.

    Parameters
    ----------
    duration : float
        From time 0 on [s]; the motion is known for one sweep more at both ends.
    start : tuple of 3 float
        x, y and yaw of the centre at time 0 [m, rad].
    speed, yaw_rate : callable
        Of the rear axle along the heading [m/s], and of the yaw [rad/s]: (G,) at times (G,) [s].
    axle : float
        Distance of the rear axle behind the centre [m].

    Returns
    -------
    motion : Motion
        Of the centre; z, roll and pitch are 0.

    """
    times = np.arange(-SWEEP_PERIOD, duration + SWEEP_PERIOD, INTEGRATION_STEP)
    yaw = np.cumsum(yaw_rate(times)) * INTEGRATION_STEP
    yaw += start[2] - np.interp(0, times, yaw)
    heading = np.stack([np.cos(yaw), np.sin(yaw)], axis=1)
    path = np.cumsum(speed(times)[:, None] * heading, axis=0) * INTEGRATION_STEP
    center = path + axle * heading
    center += start[:2] - np.array([np.interp(0, times, column) for column in center.T])
    flat = np.zeros_like(times)
    return Motion(times, np.stack([center[:, 0], center[:, 1], flat, flat, flat, yaw], axis=1))


def _with_detections(
    actors: Sequence[Actor], scan: Scan, rng: np.random.Generator
) -> SimulatedScene:
    """Return a scene with boxes as a detector reports them."""
    return make_scene(actors, scan, detector_noise, MISS_PROBABILITY, rng)


def _scanned(
    actors: Sequence[Actor],
    ego: Motion,
    sensor: Sensor,
    count: int,
    rng: np.random.Generator,
    at_sight: bool = False,
) -> Scan:
    """Return what `count` revolutions of a sensor on `ego` see; `at_sight` as of `highway`."""
    parts = [body(actor.shape, actor.extent) for actor in actors]
    stamps = np.arange(count) * SWEEP_PERIOD
    T_fixed_sensor = to_matrix(ego.at(stamps))
    # (actors, sweeps, 9)
    true_boxes = np.stack([boxes_of(actor, actor.motion.at(stamps)) for actor in actors])
    sweeps = []
    owners = []
    for i, stamp in enumerate(stamps):
        points, times, owner = revolution(actors, parts, ego, sensor, stamp, rng)
        kept = owner != ROAD
        for box in true_boxes[:, i]:
            kept |= is_near(points, box, ROAD_MARGIN)
        sweeps.append(make_sweep(stamp, points[kept], times[kept], T_fixed_sensor[i]))
        owners.append(owner[kept])
        if at_sight:
            for row in np.unique(owner[owner != ROAD]):
                seen = actors[row].motion.at(stamp + times[owner == row].mean(keepdims=True))
                true_boxes[row, i] = boxes_of(actors[row], seen)[0]
    return Scan(sweeps, owners, T_fixed_sensor, true_boxes)


def paper(rng: np.random.Generator, sweeps: int | None, is_flat: bool) -> SimulatedScene:
    """
    Return the paper's experiment: an SUV, scanned from its side, on the path of Eq. 10.

    Notes
    -----
    Eq. 10 moves along x only, while Eq. 7 asks the vehicle to move along its heading and the
    figures show a curve: we move it along its heading. T, v and the time step are not published:
    100 steps of 0.1 s at 5 m/s. The cloud is one scan, the same at every step except for the
    areas occluded at random, so the sensor moves along on the vehicle's right. The error of x in
    Table I is three times that of y: we read them as along and across the vehicle, which also
    gives the IoU of its initial boxes.

    """
    count = sweeps or PAPER_STEPS
    extent = np.array(EXTENTS['suv'])
    poses = _paper_poses(count, extent[2], is_flat)
    stamps = np.arange(count) * SWEEP_PERIOD
    suv = Actor('1', 'car', 'suv', extent, Motion(stamps, poses))

    beside = Motion(np.zeros(1), np.array([[1.5, -7.0, 1.5, 0, 0, np.pi / 2]]))
    parked = replace(suv, motion=Motion(np.zeros(1), poses[:1] * [0, 0, 1, 0, 0, 0]))
    sensor = Sensor(np.radians(np.linspace(-25, 15, 80)), columns=1800, noise=0.01, dropout=0.0)
    scan, _, owner = revolution([parked], [body('suv', extent)], beside, sensor, 0.0, rng)
    scan = scan[owner != ROAD] - parked.motion.poses[0, :3]
    T_box_sensor = to_matrix(beside.poses - parked.motion.poses)[0]
    visible = [scan[~_occluded(scan, extent, rng)] for _ in stamps]
    clouds = [
        make_sweep(stamp, points, np.zeros(len(points)), T_box_sensor)
        for stamp, points in zip(stamps, visible, strict=True)
    ]
    owners = [np.zeros(len(points), np.int64) for points in visible]
    true_boxes = boxes_of(suv, poses)[None]  # (1, sweeps, 9)
    T_fixed_sensor = to_matrix(poses) @ T_box_sensor
    noise = table_one_noise(is_flat)
    seen = Scan(clouds, owners, T_fixed_sensor, true_boxes)
    return make_scene([suv], seen, noise, 0.0, rng)


def _paper_poses(count: int, height: float, is_flat: bool) -> Floats:
    """Return the poses (n, 6) of Eq. 10; `is_flat` leaves roll and pitch at 0."""
    T = PAPER_STEPS
    phase = 2 * np.pi * np.arange(1, count) / T
    rates = np.zeros((count, 3))  # of roll, pitch and yaw per step
    rates[1:, 0] = np.sign(np.cos(phase)) * np.pi / (6 * T)
    rates[1:, 1] = np.sign(np.cos(phase)) * np.pi / (3 * T)
    rates[1:, 2] = np.sign(np.sin(phase)) * 2 * np.pi / T
    rates[:, :2] *= not is_flat
    angles = np.cumsum(rates, axis=0)
    heading = matrix_from_rpy(angles)[:, :, 0]
    center = np.array([0, 0, height / 2]) + np.cumsum(heading, axis=0) * PAPER_SPEED * SWEEP_PERIOD
    return np.concatenate([center, angles], axis=1)


def _occluded(points: Floats, extent: Floats, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Return which points (M, 3) are behind one of up to two random blocks."""
    occluded = np.zeros(len(points), bool)
    for _ in range(rng.integers(0, 3)):
        size = rng.uniform(0.1, 0.5) * extent[0]
        start = rng.uniform(-0.5 * extent[0], 0.5 * extent[0] - size)
        top = rng.uniform(-0.2, 0.5) * extent[2]
        is_within = np.abs(points[:, 0] - start - size / 2) < size / 2
        occluded |= is_within & (points[:, 2] < top)
    return occluded


SCENARIOS: dict[str, Callable[[np.random.Generator, int | None], SimulatedScene]] = {
    'street': street,
    'highway': lambda rng, sweeps: highway(rng, sweeps),
    'highway-sight': lambda rng, sweeps: highway(rng, sweeps, at_sight=True),
    'articulated': lambda rng, sweeps: articulated(rng, sweeps, is_joined=True),
    'articulated-parts': lambda rng, sweeps: articulated(rng, sweeps, is_joined=False),
    'parked': parked,
    'paper': lambda rng, sweeps: paper(rng, sweeps, is_flat=False),
    'paper-bev': lambda rng, sweeps: paper(rng, sweeps, is_flat=True),
}
