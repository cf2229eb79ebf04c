"""A simulated scene in memory: sweeps, noisy boxes, poses of the sensor and the truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.io.transforms import boxes_to_frame, inverse
from boxreg_ros.rotations import matrix_from_rpy, wrap_angle
from boxreg_ros.simulation.noise import Noise
from boxreg_ros.simulation.raycast import Actor
from boxreg_ros.structures import BoxArray, Floats, Ints, LENGTH, ROLL, Sweep, YAW
import numpy as np
from numpy.typing import NDArray

FIXED_FRAME = 'odom'
SENSOR_FRAME = 'lidar'
START_NS = 1_700_000_000 * 10**9  # stamp of the first sweep
RESOLUTION = 1 / 512  # of coordinates: finer than any sensor's, and compressible [m]
MIN_RETURNS = 5  # an object with fewer is not detected


@dataclass(frozen=True, slots=True)
class SimulatedScene:
    """A simulated scene of n sweeps."""

    sweeps: tuple[Sweep, ...]  # in frame ``lidar``, with times
    owners: tuple[Ints, ...]  # (M,) of each point: a row of `actors`, or `raycast.ROAD`
    detections: tuple[BoxArray, ...]  # noisy boxes, in frame ``lidar``
    T_fixed_sensor: Floats  # (n, 4, 4) at the stamps
    truth: BoxTable  # in ``odom``, from first to last return; `num_points` are its own returns
    actors: tuple[Actor, ...]

    def fixed_detections(self) -> list[BoxArray]:
        """Return the noisy boxes in frame ``odom``."""
        pairs = zip(self.detections, self.T_fixed_sensor, strict=True)
        return [boxes_to_frame(boxes, T, FIXED_FRAME) for boxes, T in pairs]


class Scan(NamedTuple):
    """What a sensor sees of a road users in n sweeps, the first three as in `SimulatedScene`."""

    sweeps: Sequence[Sweep]
    owners: Sequence[Ints]
    T_fixed_sensor: Floats
    true_boxes: Floats  # (a, n, 9) of each road user at each sweep, in ``odom``


def make_scene(
    actors: Sequence[Actor],
    scan: Scan,
    noise: Noise,
    miss_probability: float,
    rng: np.random.Generator,
) -> SimulatedScene:
    """
    Return a scene with its truth and its detections.

    Parameters
    ----------
    actors : sequence of Actor, length a
        The road users.
    scan : Scan
        Of them.
    noise : callable
        Makes the noisy boxes of one track, see `noise.Noise`.
    miss_probability : float
        Part of the boxes that are not detected, beside those with too few returns.
    rng : numpy.random.Generator
        Source of all random numbers.

    Returns
    -------
    scene : SimulatedScene
        The truth of an actor is from its first to its last return.

    """
    sweeps, owners, T_fixed_sensor, true_boxes = scan
    returns = np.array([[np.sum(owner == a) for owner in owners] for a in range(len(actors))])
    noisy = np.stack([noise(boxes, T_fixed_sensor[:, :3, 3], rng) for boxes in true_boxes])
    is_detected = (returns >= MIN_RETURNS) & (rng.random(returns.shape) >= miss_probability)
    scores = rng.uniform(0.5, 0.99, returns.shape).round(2)
    most_before = np.maximum.accumulate(returns, axis=1)
    most_after = np.maximum.accumulate(returns[:, ::-1], axis=1)[:, ::-1]
    is_in_sight = (most_before > 0) & (most_after > 0)
    detections = []
    truth = []
    for i, sweep in enumerate(sweeps):
        rows = np.flatnonzero(is_detected[:, i])
        detected = _box_array(sweep.stamp_ns, actors, rows, noisy[:, i], scores[:, i])
        detections.append(boxes_to_frame(detected, inverse(T_fixed_sensor[i]), sweep.frame_id))
        rows = np.flatnonzero(is_in_sight[:, i])
        certain = np.ones(len(actors))
        truth.append(_box_array(sweep.stamp_ns, actors, rows, true_boxes[:, i], certain))
    table = BoxTable.from_arrays(truth, 'truth')
    table = replace(table, num_points=returns.T[is_in_sight.T].astype(np.int64))
    table.boxes[:, YAW] = wrap_angle(table.boxes[:, YAW])
    return SimulatedScene(
        tuple(sweeps), tuple(owners), tuple(detections), T_fixed_sensor, table, tuple(actors)
    )


def _box_array(
    stamp_ns: int, actors: Sequence[Actor], rows: Ints, boxes: Floats, scores: Floats
) -> BoxArray:
    """Return the boxes (a, 9) of some of the actors in the fixed frame."""
    return BoxArray(
        stamp_ns,
        FIXED_FRAME,
        tuple(actors[row].track_id for row in rows),
        tuple(actors[row].class_name for row in rows),
        scores[rows],
        boxes[rows],
    )


def make_sweep(stamp: float, points: Floats, times: Floats, T_fixed_sensor: Floats) -> Sweep:
    """Return points (M, 3) of the fixed frame as a sweep; `stamp` [s] after `START_NS`."""
    local = (points - T_fixed_sensor[:3, 3]) @ T_fixed_sensor[:3, :3]
    local = (np.round(local / RESOLUTION) * RESOLUTION).astype(np.float32)
    return Sweep(START_NS + round(stamp * 1e9), SENSOR_FRAME, local, times)


def boxes_of(actor: Actor, poses: Floats) -> Floats:
    """Return the boxes (n, 9) of an actor at poses (n, 6) x y z roll pitch yaw."""
    extents = np.broadcast_to(actor.extent, (len(poses), 3))
    return np.concatenate([poses[:, :3], extents, poses[:, 3:]], axis=1)


def is_near(points: Floats, box: Floats, margin: float) -> NDArray[np.bool_]:
    """Return which points (M, 3) are inside `box` (9,) grown by `margin` [m] on every side."""
    offsets = np.abs((points - box[:3]) @ matrix_from_rpy(box[ROLL:]))
    return np.asarray((offsets <= box[LENGTH:ROLL] / 2 + margin).all(axis=1))
