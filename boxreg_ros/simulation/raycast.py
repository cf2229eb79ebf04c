"""
Ray casting of a spinning sensor against road users, whose bodies are convex parts.

A part is the intersection of its side view, its top view and its front view, so a ray meets it
where it has entered all of the half-spaces. Views are polygons in units of the extent: x and y
from -0.5 to 0.5, z from 0 (road) to 1 (roof), counter-clockwise.

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from boxreg_ros.rotations import matrix_from_rpy, wrap_angle
from boxreg_ros.structures import Floats, Ints, on_lines
import numpy as np
from numpy.typing import NDArray

SWEEP_PERIOD = 0.1  # of a revolution [s]
ROAD = -1  # owner of returns from the road

View = list[tuple[float, float]]


def _top(half: View) -> View:
    """Return a top view (x, y) from its right half, rear to front."""
    return half + [(x, -y) for x, y in reversed(half)]


def _front(half: View) -> View:
    """Return a front view (y, z) from its left half, bottom to top."""
    return half + [(-y, z) for y, z in reversed(half)]


def _wheel(x: float, radius_x: float, radius_z: float) -> tuple[View, View, View]:
    turns = np.arange(8) * np.pi / 4 + np.pi / 8
    scale = 1 / np.cos(np.pi / 8)  # the flat of the octagon is on the road
    side = [
        (x + scale * radius_x * np.cos(a), radius_z + scale * radius_z * np.sin(a)) for a in turns
    ]
    return side, _top([(-0.5, -0.47), (0.5, -0.47)]), RECTANGLE


ROUNDED = _top([
    (-0.5, -0.34), (-0.46, -0.46), (-0.36, -0.5), (0.3, -0.5), (0.43, -0.45), (0.5, -0.28),
])  # fmt: skip
SQUARE = _top([(-0.5, -0.5), (0.5, -0.5)])
RECTANGLE = _front([(0.5, 0.0), (0.5, 1.0)])
TAPERED = _front([(0.44, 0.0), (0.5, 0.45), (0.35, 1.0)])
OVAL = _top([(-0.5, -0.2), (-0.2, -0.5), (0.2, -0.5), (0.5, -0.2)])

BODIES: dict[str, list[tuple[View, View, View]]] = {
    'car': [
        ([(-0.49, 0.2), (-0.4, 0.14), (0.42, 0.14), (0.49, 0.2), (0.5, 0.36), (0.45, 0.48),
          (0.22, 0.58), (-0.44, 0.64), (-0.5, 0.5)], ROUNDED, RECTANGLE),
        ([(-0.45, 0.5), (0.26, 0.5), (0.06, 0.94), (-0.03, 1.0), (-0.18, 1.0), (-0.3, 0.94)],
         ROUNDED, TAPERED),
        _wheel(0.31, 0.07, 0.21), _wheel(-0.3, 0.07, 0.21),
    ],
    'suv': [
        ([(-0.5, 0.24), (-0.4, 0.15), (0.43, 0.15), (0.5, 0.24), (0.5, 0.42), (0.45, 0.54),
          (0.2, 0.62), (-0.48, 0.64), (-0.5, 0.55)], ROUNDED, RECTANGLE),
        ([(-0.49, 0.5), (0.25, 0.5), (0.1, 0.93), (0.0, 1.0), (-0.36, 1.0), (-0.43, 0.96)],
         ROUNDED, TAPERED),
        _wheel(0.3, 0.078, 0.21), _wheel(-0.3, 0.078, 0.21),
    ],
    'van': [
        ([(-0.5, 0.2), (-0.42, 0.1), (0.44, 0.1), (0.5, 0.17), (0.5, 0.42), (0.4, 0.75),
          (0.24, 1.0), (-0.46, 1.0), (-0.5, 0.94)], ROUNDED,
         _front([(0.47, 0.0), (0.5, 0.3), (0.5, 0.5), (0.43, 1.0)])),
        _wheel(0.32, 0.065, 0.165), _wheel(-0.29, 0.065, 0.165),
    ],
    'truck': [
        ([(-0.5, 0.3), (0.26, 0.3), (0.26, 1.0), (-0.5, 1.0)], SQUARE, RECTANGLE),
        ([(-0.48, 0.16), (0.4, 0.16), (0.4, 0.3), (-0.48, 0.3)],
         SQUARE, _front([(0.4, 0.0), (0.4, 1.0)])),
        ([(0.29, 0.12), (0.49, 0.12), (0.5, 0.2), (0.5, 0.42), (0.47, 0.78), (0.42, 0.84),
          (0.29, 0.84)], SQUARE, _front([(0.48, 0.0), (0.48, 1.0)])),
        _wheel(0.36, 0.062, 0.15), _wheel(-0.3, 0.062, 0.15),
    ],
    'tractor': [
        ([(0.12, 0.12), (0.49, 0.12), (0.5, 0.2), (0.5, 0.5), (0.46, 0.9), (0.4, 1.0),
          (0.12, 1.0)], SQUARE, RECTANGLE),
        ([(-0.5, 0.2), (0.12, 0.2), (0.12, 0.32), (-0.5, 0.32)],
         SQUARE, _front([(0.2, 0.0), (0.2, 1.0)])),
        _wheel(0.3, 0.085, 0.16), _wheel(-0.25, 0.085, 0.16),
    ],
    'trailer': [
        ([(-0.5, 0.28), (0.5, 0.28), (0.5, 1.0), (-0.5, 1.0)], SQUARE, RECTANGLE),
        _wheel(-0.3, 0.06, 0.14), _wheel(-0.15, 0.06, 0.14),
    ],
    'pedestrian': [
        ([(-0.3, 0.0), (0.3, 0.0), (0.2, 0.52), (-0.2, 0.52)],
         OVAL, _front([(0.25, 0.0), (0.3, 0.52)])),
        ([(-0.25, 0.45), (0.25, 0.45), (0.5, 0.6), (0.3, 0.85), (-0.3, 0.85), (-0.5, 0.6)],
         OVAL, RECTANGLE),
        ([(-0.28, 0.85), (0.28, 0.85), (0.28, 1.0), (-0.28, 1.0)],
         OVAL, _front([(0.2, 0.0), (0.2, 1.0)])),
    ],
    'cyclist': [
        ([(-0.5, 0.17), (-0.4, 0.0), (0.4, 0.0), (0.5, 0.17), (0.4, 0.36), (-0.4, 0.36)], SQUARE,
         _front([(0.06, 0.0), (0.06, 1.0)])),
        ([(-0.2, 0.15), (0.12, 0.15), (0.08, 0.6), (-0.15, 0.6)],
         OVAL, _front([(0.35, 0.0), (0.35, 1.0)])),
        ([(-0.2, 0.52), (0.1, 0.55), (0.25, 0.62), (0.12, 0.86), (0.0, 0.86)], SQUARE, RECTANGLE),
        ([(-0.02, 0.84), (0.13, 0.84), (0.13, 1.0), (-0.02, 1.0)],
         SQUARE, _front([(0.17, 0.0), (0.17, 1.0)])),
    ],
}  # fmt: skip


def box_planes(extent: Floats) -> Floats:
    """Return the half-spaces (6, 4) of a box of `extent` (3,) [m], in its own frame."""
    return np.column_stack([np.concatenate([np.eye(3), -np.eye(3)]), np.tile(extent / 2, 2)])


def body(shape: str, extent: Floats) -> list[Floats]:
    """
    Return the convex parts of a body.

    Parameters
    ----------
    shape : str
        A name of `BODIES`.
    extent : array, shape (3,)
        Length, width and height of the whole body [m].

    Returns
    -------
    parts : list of array, shape (P, 4)
        Half-spaces n.x <= d as rows of the outward normal n and d [m], from the centre of the box.

    """
    length, width, height = extent
    scales = {(0, 2): (length, height), (0, 1): (length, width), (1, 2): (width, height)}
    parts = []
    for views in BODIES[shape]:
        planes = []
        for view, axes in zip(views, [(0, 2), (0, 1), (1, 2)], strict=True):
            corners = np.array(view) - [0.0, 0.5 * (axes[1] == 2)]  # z from the centre
            corners *= scales[axes]
            edges = np.roll(corners, -1, axis=0) - corners
            normals = np.stack([edges[:, 1], -edges[:, 0]], axis=1)
            normals /= np.linalg.norm(normals, axis=1, keepdims=True)
            rows = np.zeros((len(view), 4))
            rows[:, axes] = normals
            rows[:, 3] = (normals * corners).sum(axis=1)
            planes.append(rows)
        parts.append(np.concatenate(planes))
    return parts


def cast(parts: list[Floats], origins: NDArray[Any], directions: Floats) -> Floats:
    """
    Return the distance at which rays enter a body.

    Parameters
    ----------
    parts : list of array, shape (P, 4)
        Half-spaces of its convex parts, as of `body`.
    origins, directions : array, shape (R, 3)
        In the frame of the body [m]; directions of length 1.

    Returns
    -------
    distance : array, shape (R,)
        To the first of the parts [m]; inf for a ray that hits none, or begins inside.

    """
    nearest = np.full(len(origins), np.inf)
    for planes in parts:
        clearance = planes[:, 3] - origins @ planes[:, :3].T  # (R, P), negative outside
        speed = directions @ planes[:, :3].T
        with np.errstate(divide='ignore', invalid='ignore'):
            crossing = clearance / speed
        entry = np.where(speed < 0, crossing, -np.inf).max(axis=1)
        leave = np.where(speed > 0, crossing, np.inf).min(axis=1)
        is_beside = ((speed == 0) & (clearance < 0)).any(axis=1)
        hit = (entry < leave) & (entry > 0) & ~is_beside
        nearest[hit] = np.minimum(nearest[hit], entry[hit])
    return nearest


@dataclass(frozen=True, slots=True)
class Motion:
    """A pose over time: poses (G, 6) x y z roll pitch yaw [m, rad] at `times` (G,) [s]."""

    times: NDArray[Any]
    poses: NDArray[Any]

    def at(self, times: NDArray[Any]) -> Floats:
        """Return poses (n, 6) at `times` (n,) [s], by linear interpolation."""
        return on_lines(self.times, self.poses, times)


@dataclass(frozen=True, slots=True)
class Actor:
    """One road user: `shape` is one of `raycast.BODIES`, `extent` (3,) its true box [m]."""

    track_id: str
    class_name: str
    shape: str
    extent: Floats
    motion: Motion


@dataclass(frozen=True, slots=True)
class Sensor:
    """
    A spinning LiDAR: beam elevations [rad], columns per revolution, reach and noise [m].

    A revolution begins and ends behind; its stamp is after the part `stamp_at` of it.

    """

    elevations: Floats
    columns: int
    reach: float = 70.0
    noise: float = 0.02
    dropout: float = 0.03
    stamp_at: float = 0.5


def revolution(
    actors: Sequence[Actor],
    parts: Sequence[list[Floats]],
    ego: Motion,
    sensor: Sensor,
    stamp: float,
    rng: np.random.Generator,
) -> tuple[Floats, Floats, Ints]:
    """
    Return the first hits of one revolution of a sensor above a flat road at z = 0.

    Parameters
    ----------
    actors : sequence of Actor
        The road users.
    parts : sequence of list of array, shape (P, 4)
        Those of the body of each actor, as of `body`.
    ego : Motion
        Of the sensor, in the fixed frame.
    sensor : Sensor
        Its beams, reach and noise.
    stamp : float
        Of the revolution, in the time of the motions [s]; where in it, see `Sensor`.
    rng : numpy.random.Generator
        Of the noise and the lost points.

    Returns
    -------
    points : array, shape (M, 3)
        In the fixed frame [m].
    times : array, shape (M,)
        Of each ray relative to the stamp [s].
    owner : array, shape (M,)
        Row of the actor that it hit, or `ROAD`.

    """
    columns = sensor.columns
    phase = (np.arange(columns) + 0.5) / columns - 0.5
    azimuth = 2 * np.pi * phase
    times = SWEEP_PERIOD * (phase + 0.5 - sensor.stamp_at)
    poses = ego.at(stamp + times)
    rays = _rays(sensor, azimuth, poses)
    origins = poses[:, :3]
    with np.errstate(divide='ignore'):
        ranges = np.where(rays[..., 2] < 0, -origins[:, None, 2] / rays[..., 2], np.inf)
    owner = np.full(ranges.shape, ROAD)
    for index, actor in enumerate(actors):
        near = _near(actor, sensor, azimuth, poses, stamp + times)
        if near is None:
            continue
        cols, rows = near
        T_body_fixed = np.linalg.inv(to_matrix(actor.motion.at(stamp + times[cols])))
        R = T_body_fixed[:, :3, :3]
        start = np.einsum('cij,cj->ci', R, origins[cols]) + T_body_fixed[:, :3, 3]
        start = np.repeat(start, len(rows), axis=0)
        ahead = np.einsum('cij,cbj->cbi', R, rays[np.ix_(cols, rows)]).reshape(-1, 3)
        found = cast([box_planes(actor.extent)], start, ahead)
        inside = np.isfinite(found)
        found[inside] = cast(parts[index], start[inside], ahead[inside])
        found = found.reshape(len(cols), len(rows))
        window = np.ix_(cols, rows)
        closer = found < ranges[window]
        ranges[window] = np.where(closer, found, ranges[window])
        owner[window] = np.where(closer, index, owner[window])
    kept = (ranges < sensor.reach) & (rng.random(ranges.shape) >= sensor.dropout)
    ranges = ranges + rng.normal(0, sensor.noise, ranges.shape)
    column = np.nonzero(kept)[0]
    points = origins[column] + ranges[kept][:, None] * rays[kept]
    return points, times[column], owner[kept]


def _rays(sensor: Sensor, azimuth: Floats, poses: Floats) -> Floats:
    """Return unit vectors of the rays in the fixed frame, (columns, beams, xyz)."""
    flat = np.cos(sensor.elevations)
    rise = np.sin(sensor.elevations)
    rays = np.stack(
        [
            np.cos(azimuth)[:, None] * flat,
            np.sin(azimuth)[:, None] * flat,
            np.broadcast_to(rise, (len(azimuth), len(rise))),
        ],
        axis=2,
    )
    return np.asarray(np.einsum('cij,cbj->cbi', to_matrix(poses)[:, :3, :3], rays))


def _near(
    actor: Actor, sensor: Sensor, azimuth: Floats, poses: Floats, times: Floats
) -> tuple[Ints, Ints] | None:
    """
    Return columns and beams whose rays can meet an actor; None if it is out of reach.

    They meet the sphere around its body, which is wider for the motion of actor and sensor.

    """
    middle = len(azimuth) // 2
    first, center, last = actor.motion.at(times[[0, middle, -1]])[:, :3]
    offset = center - poses[middle, :3]
    distance = np.hypot(*offset[:2])
    moved = (np.linalg.norm(last - first) + np.linalg.norm(poses[-1] - poses[0])) / 2
    radius = np.linalg.norm(actor.extent) / 2 + np.maximum(1.0, moved)
    if distance - radius > sensor.reach:
        return None
    half = np.arcsin(radius / distance) if distance > radius else np.pi
    bearing = np.arctan2(offset[1], offset[0]) - poses[middle, 5]
    height = np.arctan2(offset[2], distance)
    columns = np.flatnonzero(np.abs(wrap_angle(azimuth - bearing)) <= half)
    beams = np.flatnonzero(np.abs(sensor.elevations - height) <= half + 0.02)
    return columns, beams


def to_matrix(poses: Floats) -> Floats:
    """Return transforms (n, 4, 4) of poses (n, 6) x y z roll pitch yaw."""
    T = np.tile(np.eye(4), (len(poses), 1, 1))
    T[:, :3, :3] = matrix_from_rpy(poses[:, 3:])
    T[:, :3, 3] = poses[:, :3]
    return T
