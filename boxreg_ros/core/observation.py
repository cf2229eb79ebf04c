"""Observations of boxes in a sweep: crop, ownership, height of the road, sampling."""

from collections.abc import Sequence
from typing import NamedTuple

from boxreg_ros.config import Config
from boxreg_ros.core.field_of_view import FieldOfView
from boxreg_ros.core.method import crop as crop_kernels
from boxreg_ros.core.method.rings import ring_heights
from boxreg_ros.core.tables import numbered
from boxreg_ros.rotations import matrix_from_rpy
from boxreg_ros.structures import Floats, Ints, ROLL, Sweep
import numpy as np
from numpy.typing import NDArray

NEARBY = 1.0
"""How far beside a box its road, its time and its points are looked for [m]; chosen: a lane has
about as much free."""
MARGIN = 0.6
"""Points up to this far outside of a box may be of its object [m]; chosen: four deviations of the
error of an input box."""
SIDE_NOISE = 0.05
"""Points up to so far outside of a box may be on its sides: it holds them, and they are not of the
road beside it [m]; chosen."""
ROAD_HEIGHT_RANGE = 0.6
"""Road points are less above or below the bottom of a box [m]; chosen: far above its noise."""
ROAD_QUANTILES = (0.1, 0.3, 0.6)
"""Low, representative and high part of the heights beside a box; chosen."""
ROAD_FLATNESS = 0.15
"""Most the high part is above the low one [m]; chosen: a kerb, a wall or a vehicle is higher."""
GOOD_POINTS = 5
"""Fewer points are no evidence of an object, or of the road beside it; chosen: clutter."""
GROUND_CLEARANCE = 0.2
"""Points less than this above the road may be of the road [m]; chosen: below most bumpers."""
UNKNOWN_TOP = 1e3
"""Height of the ring above an object in the highest one [m]. Derived: any that gives its top no
weight."""
LEAST_UP = 0.1
"""Least vertical part of the z axis of a box; chosen: a box that lies on its side has no road."""
MIN_SENSOR_PART = 0.1
"""Least part of the points of an object by a sensor that sees it; chosen: fewer are stray."""
FACE_TOLERANCE = 0.2
"""Points this far outside of a face may be on it, and points of two boxes that are deeper in one
by less are of both; boxes that move less until they are seen have no time [m]. Chosen: the error
of an input or predicted box. Of simulated boxes of known time that move by 0.2 to 0.3 m, 84 to
100 % vote for it; with 0.1 to 0.2 m some sets vote for the other."""


NO_TURN = np.eye(3)
"""The rotation of points that are in the frame of the sweep."""


class Crop(NamedTuple):
    """Pairs of a point and a box that are near each other, ascending by box."""

    row: Ints
    """(P,), of the point in its sweep."""
    owner: Ints
    """(P,), row of the box."""
    offset: Floats
    """(3, P), point minus the centre of the box, axes of the fixed frame [m]."""
    outside: Floats
    """(3, P), distance outside of the faces, along the axes of the box; negative inside [m]."""


class Observations(NamedTuple):
    """Observations of n boxes, one row each: their points, relative to the centre of the box."""

    stamps_ns: Ints
    """(n,), of the boxes [ns]."""
    boxes: Floats
    """(n, 9), input boxes in the fixed frame."""
    points: NDArray[np.float32]
    """(P, 3), points near each box and above the road, minus its centre; axes of the fixed
    frame [m]. The points of one box follow those of the box before."""
    delays: NDArray[np.float32]
    """(P,), time of each point relative to the stamp [s]; 0 without `sampling.deskew`."""
    counts: Ints
    """(n,), points of each box."""
    origins: Floats
    """(n, K, 3), each sensor that sees the object minus centre [m]; NaN where unknown. The last
    repeats."""
    ground: Floats
    """(n,), height of the road beside the box minus z of the centre [m]; NaN where not found."""
    ring_heights: Floats
    """(n,), height between two rings of the LiDAR at the object [m]; 0 where unknown,
    `UNKNOWN_TOP` where no ring passes above."""
    num_points: Ints
    """(n,), sweep points inside the input box."""
    sights: Floats
    """(n,), median of the delays [s]: when the sweep saw the object."""
    is_pinned: NDArray[np.bool_]
    """(n,), whether a person has corrected the box."""

    @classmethod
    def without_points(cls, stamps_ns: Ints, boxes: Floats, origins: Floats) -> 'Observations':
        """Return those of boxes (n, 9) without points, seen from `origins` (n, K, 3)."""
        n = len(boxes)
        return cls(
            stamps_ns=stamps_ns,
            boxes=boxes,
            points=np.zeros((0, 3), np.float32),
            delays=np.zeros(0, np.float32),
            counts=np.zeros(n, int),
            origins=origins,
            ground=np.full(n, np.nan),
            ring_heights=np.zeros(n),
            num_points=np.zeros(n, int),
            sights=np.zeros(n),
            is_pinned=np.zeros(n, bool),
        )

    @property
    def first(self) -> Ints:
        """First of the points of each box, (n,)."""
        first: Ints = np.cumsum(self.counts) - self.counts
        return first

    @classmethod
    def concatenated(cls, tables: Sequence['Observations']) -> 'Observations':
        """Return the rows of some tables, one after the other; of one table, no copy."""
        most = max(table.origins.shape[1] for table in tables)
        if any(table.origins.shape[1] < most for table in tables):
            tables = [
                table._replace(origins=_repeat_last(table.origins, most)) for table in tables
            ]
        if len(tables) == 1:
            return tables[0]
        return cls(*map(np.concatenate, zip(*tables, strict=True)))

    @classmethod
    def gathered(cls, items: Sequence[tuple['Observations', int]]) -> tuple['Observations', Ints]:
        """
        Return one table with some rows of some tables, and where each of them is in it (n,).

        A table that is used by half is not copied row by row: it has further rows.

        """
        tables, number, rows = numbered(items)
        for k, used in enumerate(np.bincount(number).tolist()):
            if 2 * used < len(tables[k].boxes):
                places = (number == k).nonzero()[0]
                tables[k] = tables[k].take(rows[places])
                rows[places] = np.arange(used)
        lengths = np.array([len(table.boxes) for table in tables])
        first = np.cumsum(lengths) - lengths
        return cls.concatenated(tables), rows + first[number]

    def take(self, rows: Ints) -> 'Observations':
        """Return some of the rows (n,), in their order."""
        points = _runs(self.first[rows], self.counts[rows])
        rows_of = {name: points if name in ('points', 'delays') else rows for name in self._fields}
        return Observations(*(getattr(self, name).take(own, 0) for name, own in rows_of.items()))

    def relative_to(self, boxes: Floats, shifts: Floats) -> 'Observations':
        """Return these for other `boxes` (n, 9), whose centres are `-shifts` (n, 3) away [m]."""
        if not shifts.any():
            return self._replace(boxes=boxes)  # of objects that did not move: no copy
        of_points = np.repeat(shifts.astype(np.float32), self.counts, axis=0)
        return self._replace(
            boxes=boxes,
            points=self.points + of_points,
            origins=self.origins + shifts[:, None],
            ground=self.ground + shifts[:, 2],
        )


class Observation(NamedTuple):
    """One row of `Observations`, which describe its properties."""

    table: Observations
    row: int

    @property
    def _points(self) -> slice:
        first = int(self.table.counts[: self.row].sum())
        return slice(first, first + int(self.table.counts[self.row]))

    @property
    def stamp_ns(self) -> int:
        """Stamp of the box [ns]."""
        return int(self.table.stamps_ns.item(self.row))

    @property
    def box(self) -> Floats:
        """Input box in the fixed frame, (9,)."""
        box: Floats = self.table.boxes[self.row]
        return box

    @property
    def points(self) -> NDArray[np.float32]:
        """Points minus the centre of the box, (M, 3) [m]."""
        return self.table.points[self._points]

    @property
    def delays(self) -> NDArray[np.float32]:
        """Time of each point relative to the stamp, (M,) [s]."""
        return self.table.delays[self._points]


def observe(
    sweep: Sweep,
    boxes: Floats,
    stamp_ns: int,
    config: Config,
    view: FieldOfView | None = None,
) -> Observations:
    """
    Return the observations of boxes in a sweep.

    A point near several boxes belongs to the box it is deepest inside of, or least outside. It
    also belongs to boxes it is nearly as deep inside of: two boxes of one object do not take
    points from each other (M10a). Points less than `GROUND_CLEARANCE` above the road beside the
    box are left out; the height of the road is kept.

    Parameters
    ----------
    sweep : Sweep
        In the fixed frame; its points may be in their own, see `Sweep.T_frame_points` [m].
    boxes : array, shape (n, 9)
        Valid boxes in the fixed frame, at the stamp of the sweep [m, rad].
    stamp_ns : int
        Of the observations [ns].
    config : Config
        `sampling`, `ingredients` and `objective` are used.
    view : FieldOfView, optional
        Of the LiDAR, known from the sweeps before; without it all tops are in view.

    Returns
    -------
    observations : Observations
        One row per box, in their order; none is pinned.

    """
    n = len(boxes)
    numbers = crop_numbers(config)
    shapes = shapes_of(sweep, boxes, numbers.margin)
    columns = np.ascontiguousarray(sweep.points.T)
    near = crop_kernels.near_points(columns, shapes)
    row, owner, road, num_inside = crop_kernels.own_points(near, shapes, numbers)
    kept, most = (row, owner), config.sampling.points
    if config.objective == 'paper':
        kept = _farthest(row, owner, sweep, n, most)
    rows, points, counts = crop_kernels.thinned(columns, shapes, *kept, most)
    delays = np.zeros(len(rows), np.float32)
    sights = np.zeros(n)
    if config.sampling.deskew and sweep.times is not None:
        delays = sweep.times[rows].astype(np.float32)
        sights = _medians(delays, counts)
    up = shapes.rotations[:, 2, 2]  # of the z axis of each box, in the fixed frame
    ground = (road - boxes[:, 5] / 2) / up.clip(LEAST_UP)  # along z of the fixed frame
    origins = _origins(sweep, rows, counts, boxes[:, :3])
    heights = ring_heights(points, counts, origins)
    if view is not None:
        (origin,), _ = _among_points(sweep, sweep.origin[None])
        is_hidden = view.hidden_tops(
            sweep, origin, shapes.centers, boxes[:, 3:6], row, owner, heights
        )
        heights[is_hidden] = UNKNOWN_TOP
    return Observations(
        stamps_ns=np.full(n, stamp_ns, np.int64),
        boxes=boxes,
        points=points,
        delays=delays,
        counts=counts,
        origins=origins,
        ground=ground,
        ring_heights=heights,
        num_points=num_inside,
        sights=sights,
        is_pinned=np.zeros(n, bool),
    )


def _origins(sweep: Sweep, rows: Ints, counts: Ints, centers: Floats) -> Floats:
    """
    Return the sensors that see each of n objects, minus its centre, (n, K, 3) [m].

    These are the sensors with `MIN_SENSOR_PART` of its points, `counts` (n,) of the `rows` of the
    sweep; all of them for an object without points. The last repeats.

    """
    if sweep.origins is None or sweep.sensors is None:
        origin: Floats = (sweep.origin - centers)[:, None]
        return origin
    n, S = len(centers), len(sweep.origins)
    owner = np.repeat(np.arange(n), counts)
    by_sensor = np.bincount(owner * S + sweep.sensors[rows], minlength=n * S).reshape(n, S)
    sees = by_sensor >= MIN_SENSOR_PART * by_sensor.sum(1, keepdims=True)
    number = sees.sum(1, keepdims=True)
    first_seeing = np.argsort(~sees, axis=1, kind='stable')
    place = np.minimum(np.arange(number.max(initial=1)), number - 1)  # (n, K)
    sensors = np.take_along_axis(first_seeing, place, axis=1)
    origins: Floats = sweep.origins[sensors] - centers[:, None]
    return origins


def _repeat_last(origins: Floats, count: int) -> Floats:
    """Return origins (n, k, 3) as (n, count, 3), the last repeated."""
    return origins[:, np.minimum(np.arange(count), origins.shape[1] - 1)]


def _medians(values: NDArray[np.float32], counts: Ints) -> Floats:
    """Return the median of each of n successive parts of values (P,); 0 for an empty part."""
    is_value = np.arange(counts.max(initial=1)) < counts[:, None]
    ordered = np.full(is_value.shape, np.inf, values.dtype)  # (n, most values of a part)
    ordered[is_value] = values
    ordered.sort(axis=1)
    rows = np.arange(len(counts))
    medians = (ordered[rows, (counts - 1) // 2] + ordered[rows, counts // 2]) / 2
    return np.where(counts > 0, medians, 0.0)


def crop_numbers(config: Config) -> crop_kernels.CropNumbers:
    """Return what the kernels need to know to find points and the road."""
    return crop_kernels.CropNumbers(
        margin=NEARBY,
        own_margin=MARGIN,
        ownership_tolerance=FACE_TOLERANCE if config.ingredients.point_ownership else np.inf,
        clearance=GROUND_CLEARANCE,
        has_road=config.ingredients.road,
        road_width=NEARBY,
        road_gap=SIDE_NOISE,
        road_range=ROAD_HEIGHT_RANGE,
        road_quantiles=ROAD_QUANTILES,
        road_flatness=ROAD_FLATNESS,
        min_road_points=GOOD_POINTS,
    )


def _among_points(sweep: Sweep, centers: Floats) -> tuple[Floats, Floats]:
    """
    Return `centers` (n, 3) in the frame of the points, and the rotation of that frame, (3, 3).

    The rotation maps offsets from the frame of the points to that of the sweep. Boxes are brought
    to the points, since they are fewer.

    """
    if sweep.T_frame_points is None:
        return centers.copy(), NO_TURN.copy()
    R, t = sweep.T_frame_points[:3, :3], sweep.T_frame_points[:3, 3]
    return (centers - t) @ R, R.copy()


def shapes_of(sweep: Sweep, boxes: Floats, margin: float) -> crop_kernels.Shapes:
    """Return `boxes` (n, 9) for the kernels that find the points within `margin` of them."""
    centers, turn = _among_points(sweep, boxes[:, :3])
    R = matrix_from_rpy(boxes[:, ROLL:])  # (n, 3, 3)
    half = boxes[:, 3:6] / 2
    reach = (np.abs(turn.T @ R) @ (half + margin)[..., None])[..., 0]
    return crop_kernels.Shapes(centers, turn, R, half, reach)


def crop(sweep: Sweep, boxes: Floats, margin: float) -> Crop:
    """
    Return all pairs of a point and a box that are near each other.

    Parameters
    ----------
    sweep : Sweep
        In the frame of the boxes; its points may be in their own, see `Sweep.T_frame_points` [m].
    boxes : array, shape (n, 9)
        Valid boxes [m, rad].
    margin : float
        Largest distance of a point outside of a face [m].

    Returns
    -------
    pairs : Crop
        Ascending by box, then by the row of the point.

    """
    shapes = shapes_of(sweep, boxes, margin)
    near = crop_kernels.near_points(np.ascontiguousarray(sweep.points.T), shapes)
    row, owner, offset, outside = crop_kernels.crop(near, shapes, margin)
    order = np.lexsort((row, owner))
    return Crop(row[order], owner[order], offset[order].T, outside[order].T)


def _farthest(row: Ints, owner: Ints, sweep: Sweep, n: int, most: int) -> tuple[Ints, Ints]:
    """Return those of the pairs of n boxes that are kept for the paper: farthest points; (P,)."""
    counts = np.bincount(owner, minlength=n)
    first = np.cumsum(counts) - counts
    is_kept = np.ones(len(row), bool)
    for box in np.flatnonzero(counts > most):
        part = slice(first[box], first[box] + counts[box])
        picks = farthest_point_sample(sweep.points[row[part]].astype(np.float64), most)
        is_kept[part] = False
        is_kept[first[box] + picks] = True
    return row[is_kept], owner[is_kept]


def _runs(first: Ints, counts: Ints) -> Ints:
    """Return `counts[0]` numbers from `first[0]` on, then `counts[1]` from `first[1]` on ..."""
    return np.repeat(first - np.cumsum(counts) + counts, counts) + np.arange(counts.sum())


def farthest_point_sample(points: Floats, count: int) -> Ints:
    """
    Return rows of points that cover a cloud.

    Parameters
    ----------
    points : array, shape (M, 3)
        Finite points [m].
    count : int
        How many to choose, 1 to M.

    Returns
    -------
    rows : array, shape (count,)
        Different ones. The first is farthest from the mean, each next one farthest from all
        before.

    """
    gaps = np.square(points - points.mean(0)).sum(1)
    picks = np.empty(count, dtype=int)
    for step in range(count):
        picks[step] = gaps.argmax()
        to_pick = np.square(points - points[picks[step]]).sum(1)
        gaps = np.minimum(gaps, to_pick) if step else to_pick
        gaps[picks[step]] = -1.0  # below any distance, so that no point is picked twice
    return picks
