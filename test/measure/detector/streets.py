"""
Random streets for the detector: no two are alike, and much in them has no label.

The scenarios of `boxreg simulate` have one layout each, which a network would learn by heart, and
road users alone. Here rows of parked vehicles, traffic, people, the width of the road and the
LiDAR are drawn, and buildings, poles, hedges and bins stand beside the road.

"""

from collections.abc import Callable, Iterator

from boxreg_ros.simulation.noise import detector_noise
from boxreg_ros.simulation.raycast import (
    Actor,
    body,
    box_planes,
    Motion,
    revolution,
    Sensor,
    SWEEP_PERIOD,
    to_matrix,
)
from boxreg_ros.simulation.scenarios import (
    ActorPlan,
    constant,
    drive,
    EXTENTS,
    PITCH_AMPLITUDE,
    STREET_SENSOR,
    zero,
)
from boxreg_ros.simulation.scene import boxes_of, make_scene, make_sweep, Scan, SimulatedScene
import numpy as np

LIDARS = (
    STREET_SENSOR,
    Sensor(np.radians(np.linspace(-30.7, 10.7, 32)), columns=900),
    Sensor(np.radians(np.linspace(-24.8, 2, 56)), columns=800),
)
"""Coarse, wide and dense; drives take them by turns."""
CLASS_OF = {'suv': 'car', 'van': 'car'}
"""Class of the shapes that do not have their own."""
VEHICLES = (['car', 'suv', 'van', 'truck'], (0.42, 0.22, 0.14, 0.22))
"""Shapes of vehicles and how often each is drawn; chosen."""
SPREAD = 0.12
"""Half of the range of each extent about that of `EXTENTS`, as part of it: .88 to 1.12; chosen."""
REACH = (-35.0, 75.0)
"""x of the first and of the last object along the road [m]."""
CLUTTER = 'clutter'
"""Class of what has no label."""

Rng = np.random.Generator


def random_street(
    seed: int, sweeps: int, noise: Callable = detector_noise, miss_probability: float = 0.068
) -> SimulatedScene:
    """Return a street that depends on its arguments only; its boxes have errors by `noise`."""
    rng = np.random.default_rng(seed)
    lane = rng.uniform(3.0, 3.8)
    speed = rng.uniform(0, 9)
    labelled = [
        _actor(str(i + 1), plan, sweeps, rng)
        for i, plan in enumerate(_road_users(lane, speed, rng))
    ]
    actors = [*labelled, *_clutter(lane, rng)]
    parts = [
        [box_planes(actor.extent)] if actor.shape == CLUTTER else body(actor.shape, actor.extent)
        for actor in actors
    ]
    ego = drive(sweeps * SWEEP_PERIOD, (4, -lane / 2, 0), constant(speed), zero)
    ego.poses[:, 2] = rng.uniform(1.6, 2.2)
    ego.poses[:, 4] = PITCH_AMPLITUDE * np.sin(2 * ego.times)
    stamps = np.arange(sweeps) * SWEEP_PERIOD
    T_fixed_sensor = to_matrix(ego.at(stamps))
    sensor = LIDARS[seed % len(LIDARS)]
    scans = [revolution(actors, parts, ego, sensor, stamp, rng) for stamp in stamps]
    clouds = [
        make_sweep(stamp, points, times, T)
        for stamp, (points, times, _), T in zip(stamps, scans, T_fixed_sensor, strict=True)
    ]
    owners = [owner for _, _, owner in scans]
    boxes = np.stack([boxes_of(actor, actor.motion.at(stamps)) for actor in labelled])
    of_boxes = np.random.default_rng([seed, 1])  # the same clouds with any noise
    scan = Scan(clouds, owners, T_fixed_sensor, boxes)
    return make_scene(labelled, scan, noise, miss_probability, of_boxes)


def _road_users(lane: float, speed: float, rng: Rng) -> Iterator[ActorPlan]:
    """Yield parked rows, traffic in both directions, a car that crosses, and people."""
    crossing = rng.uniform(15, 45)
    for side in (-1, 1):
        yield from _parked(side, lane, crossing, rng)
    for x in _places(rng, 14, 35):
        if abs(x - 4) > 12:  # not where the sensor is
            yield _vehicle((x, -lane / 2, 0), speed * rng.uniform(0.9, 1.1), rng)
    oncoming = rng.uniform(3, 12)
    for x in _places(rng, 14, 40):
        yield _vehicle((x, lane / 2, np.pi), oncoming, rng)
    side = rng.choice([-1, 1])
    turn = rng.uniform(-0.35, 0.35)
    yield _vehicle((crossing, side * 22, -side * np.pi / 2), rng.uniform(2, 6), rng, turn)
    for _ in range(rng.integers(3, 9)):
        y = rng.choice([-1, 1]) * (lane + rng.uniform(2.6, 6))
        yaw = rng.choice([0, np.pi / 2, np.pi, -np.pi / 2], p=(0.4, 0.1, 0.4, 0.1))
        place = (rng.uniform(0, 45), y, yaw + rng.normal(0, 0.2))
        walk = constant(rng.uniform(0.5, 1.8))
        yield ActorPlan('pedestrian', 'pedestrian', place, walk, constant(rng.normal(0, 0.1)))
    for _ in range(rng.integers(2, 6)):
        side = rng.choice([-1, 1])
        place = (rng.uniform(-15, 50), side * (lane - 0.6), np.pi * (side > 0))
        yield ActorPlan('cyclist', 'cyclist', place, constant(rng.uniform(2.5, 6)), zero)


def _parked(side: int, lane: float, crossing: float, rng: Rng) -> Iterator[ActorPlan]:
    """Yield a parked row, along the road or across it, with gaps."""
    is_across = rng.random() < 0.25
    occupied = rng.uniform(0.3, 0.95)
    x = REACH[0]
    while x < REACH[1]:
        shape = _shape(rng)
        length, width, _ = EXTENTS[shape]
        along, across = (width, length) if is_across else (length, width)
        x += along / 2 + rng.uniform(0.5, 1.5)
        is_free = rng.random() < occupied and abs(x - crossing) > 6
        if is_free and not (is_across and shape == 'truck'):
            y = side * (lane + 0.3 + across / 2) + rng.normal(0, 0.1)
            yaw = np.pi * (side > 0) + np.pi / 2 * is_across + np.pi * (rng.random() < 0.15)
            place = (x, y, yaw + rng.normal(0, 0.03))
            yield ActorPlan(CLASS_OF.get(shape, shape), shape, place, zero, zero)
        x += along / 2


def _places(rng: Rng, least: float, most: float) -> Iterator[float]:
    """Yield x of objects along the road, with distances from `least` to `most` [m]."""
    x = REACH[0] + rng.uniform(0, most)
    while x < REACH[1]:
        yield x
        x += rng.uniform(least, most)


def _shape(rng: Rng) -> str:
    shapes, weights = VEHICLES
    return str(rng.choice(shapes, p=weights))


def _vehicle(
    place: tuple[float, float, float], speed: float, rng: Rng, turn: float = 0.0
) -> ActorPlan:
    shape = _shape(rng)
    return ActorPlan(CLASS_OF.get(shape, shape), shape, place, constant(speed), constant(turn))


def _actor(track_id: str, plan: ActorPlan, sweeps: int, rng: Rng) -> Actor:
    """Return a road user with a random size on its path; its rear axle as in the scenarios."""
    extent = np.array(EXTENTS[plan.shape]) * rng.uniform(1 - SPREAD, 1 + SPREAD, 3)
    axle = 0.25 * extent[0] if plan.class_name in ('car', 'truck') else 0.0
    motion = drive(sweeps * SWEEP_PERIOD, plan.place, plan.speed, plan.yaw_rate, axle)
    motion.poses[:, 2] = extent[2] / 2
    return Actor(track_id, plan.class_name, plan.shape, extent, motion)


def _clutter(lane: float, rng: Rng) -> Iterator[Actor]:
    """Yield buildings, poles, hedges and bins beside the road, as boxes."""
    kinds = {  # least and greatest distance to the row of parked cars, and extents [m]
        'building': (20, 30, (7, 12), (8, 20), (0.3, 6), (2, 8)),
        'pole': (12, 30, (5.2, 5.6), (0.15, 0.4), (0.15, 0.4), (2.5, 6)),
        'hedge': (10, 40, (5.2, 7), (0.5, 3), (0.4, 1.0), (0.5, 1.6)),
    }
    for side in (-1, 1):
        for least, most, offset, *ranges in kinds.values():
            for x in _places(rng, least, most):
                extent = np.array([rng.uniform(*limits) for limits in ranges])
                y = side * (lane + rng.uniform(*offset) + extent[1] / 2)
                pose = np.array([[x, y, extent[2] / 2, 0, 0, rng.normal(0, 0.05)]])
                yield Actor('', CLUTTER, CLUTTER, extent, Motion(np.zeros(1), pose))
