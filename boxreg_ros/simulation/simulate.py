"""
`boxreg simulate`: streets and the paper's experiment, scanned, with noisy boxes and their truth.

Everything follows from the scenario and one seed. The fixed frame is ``odom``, the sensor's is
``lidar``. Points are free of the sensor's own motion, as if all were measured at the stamp; what
moves was measured where it was when its ray left, and the times say when.

"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from boxreg_ros.core.refine import Track
from boxreg_ros.errors import ConfigError
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.io.transforms import boxes_to_frame, inverse
from boxreg_ros.rotations import matrix_from_rpy, wrap_angle
from boxreg_ros.simulation.raycast import (
    Actor,
    body,
    Motion,
    PERIOD,
    revolution,
    ROAD,
    Sensor,
    to_matrix,
)
from boxreg_ros.simulation.recorder import write_recording
from boxreg_ros.structures import (
    BoxArray,
    Floats,
    Ints,
    LENGTH,
    ROLL,
    Sweep,
    YAW,
)
import numpy as np
from numpy.typing import NDArray

START_NS = 1_700_000_000 * 10**9
LATTICE = 512  # coordinates are multiples of 1 / LATTICE m: finer than any sensor's, and compress
ROAD_MARGIN = 1.6  # [m], road farther than this from every box is left out
MISSED = 0.068  # part of the boxes that a detector overlooks
LEAST_POINTS = 5  # what has fewer returns is not detected

# Errors of a published detector: constant over a track, changing within it, and how much of the
# changing part is left after 0.1 s; longitudinal, lateral, z [m], yaw [rad], l, w, h [m].
BETWEEN = np.array([0.101, 0.040, 0.047, 0.0166, 0.217, 0.083, 0.071])
WITHIN = np.array([0.139, 0.068, 0.059, 0.0319, 0.176, 0.030, 0.052])
CORRELATION = np.array([0.70, 0.53, 0.71, 0.50, 0.77, 0.94, 0.84])
COUPLING = 0.57  # of the centre along the heading with the length
FLIPPED = 0.024

# Mean absolute errors of Table I: x y z roll pitch yaw [m, rad].
TABLE_ONE = np.array([0.392, 0.124, 0.082, 0.083, 0.1, 0.18])

EXTENTS = {
    'car': (4.4, 1.8, 1.5), 'suv': (4.7, 1.92, 1.72), 'van': (5.4, 2.0, 2.3),
    'truck': (7.8, 2.45, 3.1), 'pedestrian': (0.6, 0.65, 1.75), 'cyclist': (1.75, 0.6, 1.75),
}  # fmt: skip

Noise = Callable[[Floats, Floats, np.random.Generator], Floats]
Rate = Callable[[Floats], NDArray[Any]]
Place = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Scene:
    """
    What was simulated, in memory.

    Attributes
    ----------
    sweeps : tuple of n Sweep
        In frame ``lidar``, with times.
    owners : tuple of n arrays, shape (M,)
        Whom every point comes from: a row of `actors`, or `raycast.ROAD`.
    detections : tuple of n BoxArray
        Noisy boxes, in frame ``lidar``.
    T_fixed_sensor : array, shape (n, 4, 4)
        At the stamps.
    truth : BoxTable
        True boxes in frame ``odom``, from the first to the last sight of each actor;
        `num_points` counts its own returns.
    actors : tuple of Actor
        Who takes part.

    """

    sweeps: tuple[Sweep, ...]
    owners: tuple[Ints, ...]
    detections: tuple[BoxArray, ...]
    T_fixed_sensor: Floats
    truth: BoxTable
    actors: tuple[Actor, ...]

    def fixed_detections(self) -> list[BoxArray]:
        """Return the noisy boxes in frame ``odom``."""
        pairs = zip(self.detections, self.T_fixed_sensor, strict=True)
        return [boxes_to_frame(boxes, T, 'odom') for boxes, T in pairs]

    def tracks(self, margin: float = 1.5) -> list[Track]:
        """Return the noisy boxes as tracks, with the points within `margin` [m] of each."""
        rows: dict[str, list[tuple[int, int]]] = {}
        arrays = self.fixed_detections()
        for i, array in enumerate(arrays):
            for j, track_id in enumerate(array.track_ids):
                rows.setdefault(track_id, []).append((i, j))
        points = [
            sweep.points @ T[:3, :3].T + T[:3, 3]
            for sweep, T in zip(self.sweeps, self.T_fixed_sensor, strict=True)
        ]
        tracks = []
        for track_id, places in rows.items():
            i, j = places[0]
            boxes = np.array([arrays[i].boxes[j] for i, j in places])
            near = [
                points[i][_is_near(points[i], box, margin)]
                for (i, _), box in zip(places, boxes, strict=True)
            ]
            tracks.append(
                Track(
                    track_id,
                    arrays[i].class_names[j],
                    np.array([arrays[i].stamp_ns for i, _ in places]),
                    boxes,
                    near,
                    np.array([self.T_fixed_sensor[i, :3, 3] for i, _ in places]),
                    np.array([arrays[i].scores[j] for i, j in places]),
                )
            )
        return tracks


def simulate(scenario: str = 'street', seed: int = 0, sweeps: int | None = None) -> Scene:
    """
    Return a scene that depends on its arguments only.

    Parameters
    ----------
    scenario : str
        One of `SCENARIOS`.
    seed : int
        Of every random choice.
    sweeps : int, optional
        How many, one every 0.1 s; by default as many as the scenario has.

    Raises
    ------
    ConfigError
        For an unknown scenario, fewer than one sweep, or a seed below 0.

    """
    if scenario not in SCENARIOS:
        raise ConfigError(f'scenario: expected one of {", ".join(SCENARIOS)}, got {scenario!r}')
    if sweeps is not None and sweeps < 1:
        raise ConfigError(f'sweeps: expected 1 or more, got {sweeps}')
    if seed < 0:
        raise ConfigError(f'seed: expected 0 or more, got {seed}')
    return SCENARIOS[scenario](np.random.default_rng(seed), sweeps)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what `run` reads."""
    parser.add_argument(
        '-o', '--output', type=Path, required=True, metavar='RECORDING.mcap', help='what to write'
    )
    parser.add_argument(
        '--truth', type=Path, metavar='TRUTH.csv',
        help='where the true boxes go (default: beside the recording, as NAME_truth.csv)',
    )  # fmt: skip
    parser.add_argument('--scenario', choices=list(SCENARIOS), default='street')
    parser.add_argument('--seed', type=int, default=0, metavar='N')
    parser.add_argument(
        '--sweeps', type=int, metavar='N', help='how many (default: as the scenario has)'
    )


def run(args: argparse.Namespace) -> int:
    """Write a recording and its truth, and say what is in them."""
    truth = args.truth or args.output.with_name(f'{args.output.stem}_truth.csv')
    if truth.resolve() == args.output.resolve():
        raise ConfigError(
            f'--truth {str(truth)!r}: expected a file beside the recording, got the recording '
            f'itself; choose another'
        )
    scene = simulate(args.scenario, args.seed, args.sweeps)
    intensities = [np.where(o == ROAD, 10, 40 + 13 * o % 60) for o in scene.owners]
    write_recording(
        args.output, scene.sweeps, intensities, scene.detections, scene.T_fixed_sensor, 'odom',
        is_compressed=True,
    )  # fmt: skip
    scene.truth.write(truth)
    print(
        f'{args.output}: {len(scene.sweeps)} sweeps, '
        f'{sum(len(sweep.points) for sweep in scene.sweeps)} points, '
        f'{sum(len(boxes.track_ids) for boxes in scene.detections)} boxes of '
        f'{len(scene.actors)} objects; {len(scene.truth.boxes)} true boxes in {truth}'
    )
    return 0


def _street(rng: np.random.Generator, sweeps: int | None) -> Scene:
    """Return a street: parked rows, traffic both ways, one turns in, one backs out of a slot."""
    count = sweeps or 50
    still: Rate = np.zeros_like
    plan: list[tuple[str, str, Place, Rate, Rate]] = [
        ('car', 'car', (28, -1.8, 0), lambda t: 7 - 2 * np.sin(t), still),
        ('car', 'suv', (62, 1.6, np.pi), lambda t: 9 + 0 * t, still),
        ('truck', 'truck', (74, 1.9, np.pi), lambda t: 7 + 0 * t, still),
        ('car', 'car', (16, -1.8, 0), lambda t: np.maximum(6 - t, 4.2),
         lambda t: -0.6 * (np.abs(t - 3.1) < 1.3)),
        ('car', 'suv', (37, 11.5, np.pi / 2), lambda t: -1.3 * (t > 0.8),
         lambda t: 0.25 * (t > 2)),
        ('cyclist', 'cyclist', (47, 3.4, np.pi), lambda t: 4.5 + 0 * t,
         lambda t: 0.06 * np.sin(2 * t)),
        ('pedestrian', 'pedestrian', (22, 7.2, np.pi), lambda t: 1.3 + 0 * t, still),
        ('pedestrian', 'pedestrian', (15, -6.9, 0), lambda t: 1.5 + 0 * t,
         lambda t: 0.1 * np.cos(t)),
    ]  # fmt: skip
    for shape, x, y in (
        ('car', 7, -4.6), ('van', 13.2, -4.7), ('suv', 19, -4.6), ('car', 24.7, -4.7),
        ('car', 41, -4.6), ('truck', 49, -4.9), ('suv', 57, -4.6), ('car', 11, 4.9),
        ('suv', 17, 4.9), ('van', 23.5, 5.0), ('car', 30, 4.8), ('car', 45.5, 4.9),
        ('car', 52, 4.8), ('van', 58.5, 5.0),
    ):  # fmt: skip
        place = (
            x + rng.normal(0, 0.2),
            y + rng.normal(0, 0.1),
            np.pi * (y > 0) + rng.normal(0, 0.03),
        )
        plan.append(('car' if shape == 'suv' else shape, shape, place, still, still))
    actors = []
    for i, (class_name, shape, place, rate, turn) in enumerate(plan):
        extent = np.array(EXTENTS[shape]) * rng.uniform(0.95, 1.05, 3)
        axle = 0.25 * extent[0] if class_name in ('car', 'van', 'truck') else 0.0
        motion = _drive(count * PERIOD, place, rate, turn, axle)
        motion.poses[:, 2] = extent[2] / 2
        actors.append(Actor(str(i + 1), class_name, shape, extent, motion))
    ego = _drive(count * PERIOD, (4, -1.75, 0), lambda t: 6 + 0 * t, still)
    ego.poses[:, 2] = 1.8
    ego.poses[:, 4] = 0.006 * np.sin(2 * ego.times)  # the vehicle that carries the sensor nods
    sensor = Sensor(np.radians(np.linspace(-22, 3, 34)), columns=640)
    return _scan(actors, ego, sensor, count, rng)


def _drive(length: float, start: Place, speed: Rate, turn: Rate, axle: float = 0.0) -> Motion:
    """
    Return the motion of a body on a plane, whose rear axle never slips sideways.

    Parameters
    ----------
    length : float
        Time it lasts [s].
    start : tuple of float
        x, y and yaw of the centre at time 0 [m, rad].
    speed, turn : callable
        Along the heading [m/s] and of the heading [rad/s], at times (G,) [s].
    axle : float
        Rear axle behind the centre [m].

    """
    step = 0.01
    times = np.arange(-PERIOD, length + PERIOD, step)
    yaw = np.cumsum(turn(times)) * step
    yaw += start[2] - np.interp(0, times, yaw)
    heading = np.stack([np.cos(yaw), np.sin(yaw)], axis=1)
    center = np.cumsum(speed(times)[:, None] * heading, axis=0) * step + axle * heading
    center += start[:2] - np.array([np.interp(0, times, column) for column in center.T])
    zero = np.zeros_like(times)
    return Motion(times, np.stack([center[:, 0], center[:, 1], zero, zero, zero, yaw], axis=1))


def _scan(
    actors: Sequence[Actor], ego: Motion, sensor: Sensor, count: int, rng: np.random.Generator
) -> Scene:
    """Return `count` revolutions of a sensor that rides on `ego`."""
    parts = [body(actor.shape, actor.extent) for actor in actors]
    stamps = np.arange(count) * PERIOD
    T_fixed_sensor = to_matrix(ego.at(stamps))
    true_boxes = np.stack([_boxes(actor, actor.motion.at(stamps)) for actor in actors])
    sweeps, owners = [], []
    for i, stamp in enumerate(stamps):
        points, times, owner = revolution(actors, parts, ego, sensor, stamp, rng)
        kept = owner != ROAD
        for box in true_boxes[:, i]:
            kept |= _is_near(points, box, ROAD_MARGIN)
        sweeps.append(_sweep(stamp, points[kept], times[kept], T_fixed_sensor[i]))
        owners.append(owner[kept])
    return _scene(actors, true_boxes, sweeps, owners, T_fixed_sensor, detector_noise, MISSED, rng)


def detector_noise(boxes: Floats, origins: Floats, rng: np.random.Generator) -> Floats:
    """
    Return the true boxes (n, 9) of one track as a detector at `origins` (n, 3) gives them.

    An error is a constant of its track plus an autoregressive, heavy-tailed part. The end
    turned to the sensor is known best: a wrong length moves the other end. A few are flipped.

    """
    n = len(boxes)
    errors = np.empty((n, 7))
    state = rng.standard_t(4, 7)
    for i in range(n):
        state = CORRELATION * state + np.sqrt(1 - CORRELATION**2) * rng.standard_t(4, 7)
        errors[i] = state
    errors *= WITHIN / np.sqrt(2)  # the variance of Student's t with 4 degrees of freedom is 2
    errors += rng.normal(size=7) * BETWEEN
    errors[:, :3] *= min(1.0, boxes[0, LENGTH] / 4)  # people are not 0.2 m off
    extent = boxes[:, LENGTH:ROLL]
    grown = np.clip(errors[:, 4:], -0.4 * extent, 0.4 * extent)
    R = matrix_from_rpy(boxes[:, ROLL:])
    toward = ((origins - boxes[:, :3]) * R[:, :, 0]).sum(axis=1) / boxes[:, LENGTH]
    shift = errors[:, :3].copy()
    shift[:, 0] *= np.sqrt(1 - COUPLING**2)
    shift[:, 0] -= COUPLING * WITHIN[0] / WITHIN[4] * np.clip(toward, -1, 1) * grown[:, 0]
    noisy = boxes.copy()
    noisy[:, :3] += (R @ shift[..., None])[..., 0]
    noisy[:, LENGTH:ROLL] += grown
    noisy[:, YAW] += errors[:, 3] + np.pi * (rng.random(n) < FLIPPED)
    return noisy


def _paper(rng: np.random.Generator, sweeps: int | None, is_flat: bool) -> Scene:
    """
    Return the paper's experiment: an SUV, scanned from its side, on the path of Eq. 10.

    Notes
    -----
    Eq. 10 moves along x only, while Eq. 7 wants the vehicle to move where it heads and the
    figures show a curve: we move it along its heading. T, v and the time step have no published
    values: 100 steps of 0.1 s at 5 m/s. The cloud is one scan, the same at every step but for
    the areas hidden at random, so the sensor rides along on the vehicle's right. Table I's x is
    three times worse than its y: we read its errors of x and y as along and across the vehicle,
    which also gives the IoU of its initial boxes.

    """
    count, T = sweeps or 100, 100
    turned = 2 * np.pi * np.arange(1, count) / T
    rates = np.zeros((count, 3))
    rates[1:, 0] = np.sign(np.cos(turned)) * np.pi / (6 * T)
    rates[1:, 1] = np.sign(np.cos(turned)) * np.pi / (3 * T)
    rates[1:, 2] = np.sign(np.sin(turned)) * 2 * np.pi / T
    rates[:, :2] *= not is_flat
    angles = np.cumsum(rates, axis=0)
    heading = matrix_from_rpy(angles)[:, :, 0]
    extent = np.array(EXTENTS['suv'])
    center = np.array([0, 0, extent[2] / 2]) + np.cumsum(heading, axis=0) * 5.0 * PERIOD
    stamps = np.arange(count) * PERIOD
    poses = np.concatenate([center, angles], axis=1)
    suv = Actor('1', 'car', 'suv', extent, Motion(stamps, poses))

    beside = Motion(np.zeros(1), np.array([[1.5, -7.0, 1.5, 0, 0, np.pi / 2]]))
    parked = replace(suv, motion=Motion(np.zeros(1), poses[:1] * [0, 0, 1, 0, 0, 0]))
    sensor = Sensor(np.radians(np.linspace(-25, 15, 80)), columns=1800, noise=0.01, dropout=0.0)
    scan, _, owner = revolution([parked], [body('suv', extent)], beside, sensor, 0.0, rng)
    scan = scan[owner != ROAD] - parked.motion.poses[0, :3]
    T_box_sensor = to_matrix(beside.poses - parked.motion.poses)[0]
    seen = [scan[~_hidden(scan, extent, rng)] for _ in stamps]
    sweeps_ = [
        _sweep(stamp, points, np.zeros(len(points)), T_box_sensor)
        for stamp, points in zip(stamps, seen, strict=True)
    ]
    owners = [np.zeros(len(points), np.int64) for points in seen]
    free = np.array([1, 1, 0, 0, 0, 1] if is_flat else [1] * 6)

    def noise(boxes: Floats, _: Floats, rng: np.random.Generator) -> Floats:
        mean_to_deviation = np.sqrt(np.pi / 2)
        errors = rng.normal(size=(len(boxes), 6)) * TABLE_ONE * mean_to_deviation * free
        noisy = boxes.copy()
        noisy[:, :3] += (matrix_from_rpy(boxes[:, ROLL:]) @ errors[:, :3, None])[..., 0]
        noisy[:, ROLL:] += errors[:, 3:]
        return noisy

    boxes = _boxes(suv, poses)[None]
    return _scene([suv], boxes, sweeps_, owners, to_matrix(poses) @ T_box_sensor, noise, 0.0, rng)


def _hidden(points: Floats, extent: Floats, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Return which points something before the vehicle hides: up to two random blocks."""
    hidden = np.zeros(len(points), bool)
    for _ in range(rng.integers(0, 3)):
        size = rng.uniform(0.1, 0.5) * extent[0]
        start = rng.uniform(-0.5 * extent[0], 0.5 * extent[0] - size)
        top = rng.uniform(-0.2, 0.5) * extent[2]
        hidden |= (np.abs(points[:, 0] - start - size / 2) < size / 2) & (points[:, 2] < top)
    return hidden


SCENARIOS: dict[str, Callable[[np.random.Generator, int | None], Scene]] = {
    'street': _street,
    'paper': lambda rng, sweeps: _paper(rng, sweeps, is_flat=False),
    'paper-bev': lambda rng, sweeps: _paper(rng, sweeps, is_flat=True),
}


def _scene(
    actors: Sequence[Actor],
    true_boxes: Floats,
    sweeps: Sequence[Sweep],
    owners: Sequence[Ints],
    T_fixed_sensor: Floats,
    noise: Noise,
    missed: float,
    rng: np.random.Generator,
) -> Scene:
    """Return the scene with its truth and with what a detector makes of `true_boxes` (a, n, 9)."""
    returns = np.array([[np.sum(owner == a) for owner in owners] for a in range(len(actors))])
    noisy = np.stack([noise(boxes, T_fixed_sensor[:, :3, 3], rng) for boxes in true_boxes])
    found = (returns >= LEAST_POINTS) & (rng.random(returns.shape) >= missed)
    scores = rng.uniform(0.5, 0.99, returns.shape).round(2)
    before = np.maximum.accumulate(returns, axis=1)
    after = np.maximum.accumulate(returns[:, ::-1], axis=1)[:, ::-1]
    in_sight = (before > 0) & (after > 0)
    detections, truth = [], []
    for i, sweep in enumerate(sweeps):

        def boxes_at(rows: Ints, boxes: Floats, scores: Floats, i: int = i) -> BoxArray:
            return BoxArray(
                sweeps[i].stamp_ns,
                'odom',
                tuple(actors[row].track_id for row in rows),
                tuple(actors[row].class_name for row in rows),
                scores[rows],
                boxes[rows],
            )

        detected = boxes_at(np.flatnonzero(found[:, i]), noisy[:, i], scores[:, i])
        detections.append(boxes_to_frame(detected, inverse(T_fixed_sensor[i]), sweep.frame_id))
        rows = np.flatnonzero(in_sight[:, i])
        truth.append(boxes_at(rows, true_boxes[:, i], np.ones(len(actors))))
    table = BoxTable.from_arrays(truth, 'truth')
    table = replace(table, num_points=returns.T[in_sight.T].astype(np.int64))
    table.boxes[:, YAW] = wrap_angle(table.boxes[:, YAW])
    return Scene(
        tuple(sweeps), tuple(owners), tuple(detections), T_fixed_sensor, table, tuple(actors)
    )


def _sweep(stamp: float, points: Floats, times: Floats, T_fixed_sensor: Floats) -> Sweep:
    local = (points - T_fixed_sensor[:3, 3]) @ T_fixed_sensor[:3, :3]
    local = (np.round(local * LATTICE) / LATTICE).astype(np.float32)
    return Sweep(START_NS + round(stamp * 1e9), 'lidar', local, times)


def _boxes(actor: Actor, poses: Floats) -> Floats:
    extents = np.broadcast_to(actor.extent, (len(poses), 3))
    return np.concatenate([poses[:, :3], extents, poses[:, 3:]], axis=1)


def _is_near(points: Floats, box: Floats, margin: float) -> NDArray[np.bool_]:
    """Return which points (M, 3) are inside `box` (9,) grown by `margin` [m] on every side."""
    offsets = np.abs((points - box[:3]) @ matrix_from_rpy(box[ROLL:]))
    return np.asarray((offsets <= box[LENGTH:ROLL] / 2 + margin).all(axis=1))
