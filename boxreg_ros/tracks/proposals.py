"""
Objects that no box covers: clusters of points that stand free on the road for several sweeps.

They are proposals for a person and no labels. In each sweep the points above the road that are in
no box are joined to clusters. Those of the size of a vehicle or a person, with open road around
them, are linked from sweep to sweep. What lasts, and moves or keeps its size, is proposed with one
box, where most of its points are.

"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from boxreg_ros.core.l_shape import closest_heading, completed, span, turned
from boxreg_ros.rotations import matrix_from_rpy, wrap_angle
from boxreg_ros.structures import BOX_EXTENT, Floats, Ints, LENGTH, ROLL, WIDTH, YAW
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

Limits = tuple[float, float]
CLUSTER_RANGE = 50.0
"""Clusters farther away are left out [m]; chosen: few have `MIN_CLUSTER_POINTS`."""
CLUSTER_CELL = 0.3
"""Side of a cell of the grid that points are joined in [m]; chosen: cars park 0.5 m apart."""
ROAD_REACH = 7
"""Cells to each side in which the lowest point is the road: 2 m, half a car."""
CLEARANCE, TOP = 0.3, 4.2
"""Heights above the road of the points of objects [m]; what is higher is no vehicle."""
ROAD_HEIGHT = 0.2
"""Points up to this height are of the road [m]."""
MIN_CLUSTER_POINTS = 15
"""Of a cluster."""
RING = 3
"""Cells around a cluster that have to be open road, but for the nearest ones."""
MIN_OPEN = 2
"""So many of them have points of it."""
OPEN_PART = 0.6
"""Part of the cells around a cluster, of those with points, that are open road."""
YAWS = np.radians(np.arange(0, 90, 3))
"""Headings that are tried [rad]."""
MANY_POINTS = 200
"""Of more points of a cluster about so many are tried."""
BOX_MARGIN = 0.4
"""Points so far outside of a box are of its object [m]."""
MIN_SWEEPS = 8
"""A proposal is seen in so many sweeps; chosen: 0.8 s at 10 Hz."""
MAX_GAP_NS = 5 * 10**8
"""A link of two clusters spans at most so much time [ns]."""
LINK_GATE, LINK_GATE_SPEED = 0.8, 4.0
"""A cluster is nearer to its prediction than this [m] and, before its speed is known, [m/s]."""
MOVED = 1.5
"""What moves has come so far [m], and most of its way straight on."""
STRAIGHT_PART = 0.7
STEADY = 0.25
"""Deviation of the centre and of the sides of what stands, from sweep to sweep [m]."""

SECOND_NS = 10**9
LANE_WIDTH, LANE_LENGTH = 2.5, 40.0
"""Boxes beside a lane line up to this far across and along [m]; chosen: lanes are 2.5 to 3.5 m."""
PARALLEL = 0.94
"""Cosine of the angle between boxes of one lane; chosen: 20 degrees."""

VEHICLE_SIZES = (1.2, 18.0), 3.2, (0.9, TOP)
PERSON_SIZES = (0.2, 1.1), 0.9, (1.2, 2.1)
CYCLIST_SIZES = (1.1, 2.2), 0.9, (1.2, 2.1)
"""Least and most of the longer side, most of the shorter, and least and most height above the
road, of what is seen of an object [m]."""
LONGEST_CAR, HIGHEST_CAR = 6.0, 2.4
"""Longer or higher vehicles are trucks [m]; chosen: vans are 6 m long and 2.4 m high at most."""
LEAST_HEIGHT = 0.7
"""Least height of a box, as part of the usual one; chosen."""
USUAL = {
    'car': (4.5, 1.9, 1.6),
    'truck': (8.0, 2.5, 3.0),
    'pedestrian': (0.7, 0.7, 1.75),
    'bicycle': (1.8, 0.7, 1.75),
}
"""Length, width and height of a box where less is seen [m]; literature: KITTI, nuScenes."""


class Proposal(NamedTuple):
    """An object that no box covers."""

    class_name: str  # by its size
    stamp_ns: int  # of its box, where most of its points are
    box: Floats  # (9,) in the fixed frame [m, rad]
    num_points: int  # in the cluster there
    stamps_ns: Ints  # (N,) of all sweeps with its cluster
    speed: float  # from the first to the last; 0 for what stands [m/s]


class _Cluster(NamedTuple):
    """Points (M, 3) of one sweep, their centre (2,), the height of the road, and the sensor."""

    stamp_ns: int
    points: Floats
    centre: Floats
    sides: Floats
    road: float
    origin: Floats


Chain = list[_Cluster]
"""Clusters of one object, ascending in time."""


class Proposer:
    """Collects the clusters of sweeps; sweeps and boxes are in one fixed frame."""

    def __init__(self) -> None:
        self._open: list[Chain] = []
        self._ended: list[Chain] = []
        self._known = np.zeros((0, 9))  # boxes of known objects of one sweep in each second
        self._known_ns = -SECOND_NS

    def add(
        self, stamp_ns: int, points: NDArray[np.floating], origin: Floats, boxes: Floats
    ) -> None:
        """
        Add a sweep, all in the fixed frame.

        Parameters
        ----------
        stamp_ns : int
            Of the sweep [ns]; larger than in the call before.
        points : array, shape (M, 3)
            Of the sweep [m].
        origin : array, shape (3,)
            Position of the sensor [m].
        boxes : array, shape (n, 9)
            Of the known objects at the stamp [m, rad]: their points are of no proposal.

        """
        if stamp_ns - self._known_ns >= SECOND_NS:
            self._known = np.concatenate([self._known, boxes])
            self._known_ns = stamp_ns
        chains, self._open = self._open, []
        for chain in chains:
            goes_on = 0 < stamp_ns - chain[-1].stamp_ns <= MAX_GAP_NS
            (self._open if goes_on else self._ended).append(chain)
        clusters = _clusters(stamp_ns, points, origin, boxes)
        pairs = sorted(
            (_distance(chain, cluster), i, k)
            for i, chain in enumerate(self._open)
            for k, cluster in enumerate(clusters)
        )
        linked: set[int] = set()
        taken: set[int] = set()
        for distance, i, k in pairs:
            if distance < 1 and i not in linked and k not in taken:
                self._open[i].append(clusters[k])
                linked.add(i)
                taken.add(k)
        self._open += [[cluster] for k, cluster in enumerate(clusters) if k not in taken]

    def proposals(self) -> list[Proposal]:
        """Return all proposals, longest first."""
        chains = [c for c in self._ended + self._open if len(c) >= MIN_SWEEPS]
        found = [one for one in map(_proposal, chains) if one is not None]
        moving = [one.box for one in found if one.speed]
        known = np.concatenate([self._known, np.reshape(moving, (-1, 9))])
        found = [one if one.speed else _headed(one, known) for one in found]
        return sorted(found, key=lambda one: (-len(one.stamps_ns), one.stamp_ns))


def _distance(chain: Chain, cluster: _Cluster) -> float:
    """Return how far a cluster is from the prediction of a chain, relative to the gate."""
    last, before = chain[-1], chain[max(0, len(chain) - 4)]
    seconds = (cluster.stamp_ns - last.stamp_ns) * 1e-9
    expected, gate = last.centre, LINK_GATE
    if before is last:
        gate += LINK_GATE_SPEED * seconds
    else:
        elapsed = (last.stamp_ns - before.stamp_ns) * 1e-9
        expected = last.centre + (last.centre - before.centre) / elapsed * seconds
    return float(np.linalg.norm(cluster.centre - expected)) / gate


def _clusters(
    stamp_ns: int, points: NDArray[np.floating], origin: Floats, boxes: Floats
) -> list[_Cluster]:
    """Return the clusters of a sweep that may be objects."""
    if not len(points):
        return []
    if not np.isfinite(origin).all():
        origin = np.median(points, axis=0)
    near = np.abs(points[:, :2] - origin[:2]).max(1) < CLUSTER_RANGE
    near_points = points[near].astype(np.float64)
    cells = np.floor((near_points[:, :2] - origin[:2] + CLUSTER_RANGE) / CLUSTER_CELL).astype(
        np.int64
    )
    size = int(2 * CLUSTER_RANGE / CLUSTER_CELL) + 1
    lowest = np.full((size, size), np.inf)
    np.minimum.at(lowest, (cells[:, 0], cells[:, 1]), near_points[:, 2])
    road = ndimage.minimum_filter(lowest, 2 * ROAD_REACH + 1)
    height = near_points[:, 2] - road[cells[:, 0], cells[:, 1]]
    is_free = ~_inside(near_points, boxes)
    is_object = is_free & (height > CLEARANCE)
    occupied = np.zeros((size, size), bool)
    occupied[tuple(cells[is_object].T)] = True
    seen = np.isfinite(lowest)
    is_open = seen & (np.where(seen, lowest, 0.0) < road + ROAD_HEIGHT) & ~occupied
    labels, _ = ndimage.label(occupied, np.ones((3, 3)))
    of_point = labels[cells[:, 0], cells[:, 1]] * is_object
    order = np.argsort(of_point, kind='stable')
    numbers, starts = np.unique(of_point[order], return_index=True)
    found = []
    for number, part in zip(numbers, np.split(order, starts[1:]), strict=True):
        if number == 0 or len(part) < MIN_CLUSTER_POINTS:
            continue
        top = float(height[part].max())
        may_be = _may_be_object(np.ptp(near_points[part, :2], axis=0), top)
        if not may_be or not _stands_free(cells[part], is_open, seen):
            continue
        own = near_points[part]
        yaw, low, high = _rectangle(own[:, :2])
        sides = high - low
        if not _may_be_object(sides, top):
            continue
        centre = turned((low + high) / 2, yaw)
        level = float(np.median(road[tuple(cells[part].T)]))
        found.append(_Cluster(stamp_ns, own, centre, np.sort(sides)[::-1], level, origin))
    return found


def _inside(points: Floats, boxes: Floats) -> NDArray[np.bool_]:
    """Return which points (M, 3) are in one of `boxes` (n, 9), or within `BOX_MARGIN`."""
    is_inside = np.zeros(len(points), bool)
    for box, R in zip(boxes, matrix_from_rpy(boxes[:, ROLL:]), strict=True):
        reach = np.hypot(box[LENGTH], box[WIDTH]) / 2 + BOX_MARGIN
        rows = np.flatnonzero((np.abs(points[:, :2] - box[:2]) < reach).all(1))
        half = box[BOX_EXTENT] / 2 + BOX_MARGIN
        is_inside[rows[(np.abs((points[rows] - box[:3]) @ R) < half).all(1)]] = True
    return is_inside


def _fits(sides: Floats, height: float, sizes: tuple[Limits, float, Limits]) -> bool:
    """Return whether what is seen of an object may be one of some sizes."""
    (short, long), wide, (low, high) = sizes
    return bool(short <= max(sides) <= long and min(sides) <= wide and low <= height <= high)


def _may_be_object(sides: Floats, height: float) -> bool:
    return _fits(sides, height, VEHICLE_SIZES) or _fits(sides, height, PERSON_SIZES)


def _stands_free(cells: Ints, is_open: NDArray[np.bool_], seen: NDArray[np.bool_]) -> bool:
    """Return whether the cells around those of a cluster are open road, where they have points."""
    low = np.maximum(cells.min(0) - RING, 0)
    high = cells.max(0) + RING + 1
    window = slice(low[0], high[0]), slice(low[1], high[1])
    own = np.zeros(seen[window].shape, bool)
    own[tuple((cells - low).T)] = True
    ring = ndimage.binary_dilation(own, np.ones((3, 3)), iterations=RING)
    ring &= ~ndimage.binary_dilation(own, np.ones((3, 3)))
    known = ring & seen[window]
    is_open_there = int((known & is_open[window]).sum())
    return is_open_there >= max(MIN_OPEN, OPEN_PART * int(known.sum()))


def _rectangle(points: Floats) -> tuple[float, Floats, Floats]:
    """Return yaw and limits (2,), (2,) of the rectangle whose sides are nearest to points."""
    yaw = closest_heading(points[:: 1 + len(points) // MANY_POINTS], YAWS)
    return yaw, *span(points, yaw)


def _proposal(clusters: Chain) -> Proposal | None:
    """Return what is proposed for a chain; None where it neither moves nor keeps its size."""
    centres = np.array([one.centre for one in clusters])
    stamps_ns = np.array([one.stamp_ns for one in clusters], np.int64)
    travel = centres[-1] - centres[0]
    distance = float(np.linalg.norm(travel))
    steps = np.linalg.norm(np.diff(centres[::3], axis=0), axis=1).sum()
    moves = distance > MOVED and distance > STRAIGHT_PART * steps
    sides = np.array([one.sides for one in clusters])
    if not moves and not _is_steady(centres, sides):
        return None
    best = max(clusters, key=lambda one: len(one.points))
    heading = float(np.arctan2(travel[1], travel[0])) if moves else None
    class_name = _class_of(clusters, moves)
    speed = distance / ((stamps_ns[-1] - stamps_ns[0]) * 1e-9) if moves else 0.0
    box = _box(best, class_name, heading)
    return Proposal(class_name, best.stamp_ns, box, len(best.points), stamps_ns, speed)


def _headed(one: Proposal, known: Floats) -> Proposal:
    """
    Return a proposal that stands, with the heading of the lane it is in.

    That of the nearest box of `known` (n, 9) that is parallel to it, no farther away across than
    `LANE_WIDTH` and along than `LANE_LENGTH`; without one it stays as it is.

    """
    x, y, yaw = one.box[0], one.box[1], one.box[YAW]
    cos, sin = np.cos(yaw), np.sin(yaw)
    along = np.abs(cos * (known[:, 0] - x) + sin * (known[:, 1] - y))
    across = np.abs(cos * (known[:, 1] - y) - sin * (known[:, 0] - x))
    agreement = np.cos(known[:, YAW] - yaw)
    is_near = (along < LANE_LENGTH) & (across < LANE_WIDTH) & (np.abs(agreement) > PARALLEL)
    if not is_near.any():
        return one
    nearest = np.flatnonzero(is_near)[(along + across)[is_near].argmin()]
    if agreement[nearest] > 0:
        return one
    box = one.box.copy()
    box[YAW] = wrap_angle(yaw + np.pi)
    return one._replace(box=box)


def _is_steady(centres: Floats, sides: Floats) -> bool:
    spread = np.diff(centres, axis=0), np.diff(sides, axis=0)
    return all(float(np.median(np.abs(one).max(1))) < STEADY for one in spread)


def _class_of(clusters: Sequence[_Cluster], moves: bool) -> str:
    """Return the class by the sides and the height that are seen most often."""
    sides = np.median([one.sides for one in clusters], axis=0)
    height = float(np.median([one.points[:, 2].max() - one.road for one in clusters]))
    if _fits(sides, height, PERSON_SIZES):
        return 'pedestrian'
    if moves and _fits(sides, height, CYCLIST_SIZES):
        return 'bicycle'
    return 'truck' if sides[0] > LONGEST_CAR or height > HIGHEST_CAR else 'car'


def _box(cluster: _Cluster, class_name: str, heading: float | None) -> Floats:
    """Return the box (9,) of a cluster, extended away from the sensor to its usual size."""
    yaw, low, high = _rectangle(cluster.points[:, :2])
    if heading is not None:
        yaw = heading
    elif (high - low)[1] > (high - low)[0]:
        yaw += np.pi / 2
    *usual, tall = USUAL[class_name]
    centre, sides = completed(cluster.points[:, :2], yaw, cluster.origin[:2], np.array(usual))
    height = max(float(cluster.points[:, 2].max()) - cluster.road, LEAST_HEIGHT * tall)
    return np.array([*centre, cluster.road + height / 2, *sides, height, 0, 0, yaw])
