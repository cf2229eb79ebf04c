"""Observations of boxes in a sweep: crop, ownership, height of the road, sampling."""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

from boxreg_ros.config import Config
from boxreg_ros.core.kernels import load
from boxreg_ros.core.kernels.arrays import CropNumbers, ShapeArrays
from boxreg_ros.core.tables import column
from boxreg_ros.rotations import matrix_from_rpy
from boxreg_ros.structures import Floats, Ints, ROLL, Sweep, YAW
import numpy as np
from numpy.typing import NDArray

ROAD_SEARCH_WIDTH = 1.0
"""How far beside a box the road is searched [m]; chosen: a lane has about as much free."""
ROAD_SIDE_GAP = 0.05
"""Road points are at least so far beside a box [m]; chosen: excludes points on its sides."""
ROAD_HEIGHT_RANGE = 0.6
"""Road points are less above or below the bottom of a box [m]; chosen: far above its noise."""
ROAD_QUANTILES = (0.1, 0.3, 0.6)
"""Low, representative and high part of the heights beside a box; chosen."""
ROAD_FLATNESS = 0.15
"""Most the high part is above the low one [m]; chosen: a kerb, a wall or a vehicle is higher."""
MIN_ROAD_POINTS = 5
"""Fewer points beside a box give no road height; chosen."""
GROUND_CLEARANCE = 0.2
"""Points less than this above the road may be of the road [m]; chosen: below most bumpers."""
MIN_SENSOR_PART = 0.1
"""Least part of the points of an object by a sensor that sees it; chosen: fewer are stray."""
OWNERSHIP_TOLERANCE = 0.2
"""A point less deep in one of two boxes, by less than this, belongs to both [m]; chosen."""


class Crop(NamedTuple):
    """
    Pairs of a point and a box that are near each other, ascending by box.

    Attributes
    ----------
    row, owner : array, shape (P,)
        Row of the point in its sweep, and of the box.
    offset : array, shape (3, P)
        Point minus the centre of the box, axes of the fixed frame [m].
    outside : array, shape (3, P)
        Distance outside of the faces, along the axes of the box; negative inside [m].

    """

    row: Ints
    owner: Ints
    offset: Floats
    outside: Floats


class Observations(NamedTuple):
    """
    Observations of n boxes, one row each: their points, relative to the centre of the box.

    Attributes
    ----------
    stamps_ns : array, shape (n,)
        Stamps of the boxes [ns].
    boxes : array, shape (n, 9)
        Input boxes in the fixed frame.
    points : array, shape (P, 3)
        Points near each box and above the road, minus its centre; axes of the fixed frame [m]. The
        points of one box follow those of the box before.
    delays : array, shape (P,)
        Time of each point relative to the stamp [s]; 0 without `sampling.deskew`.
    counts : array, shape (n,)
        Points of each box.
    origins : array, shape (n, K, 3)
        Each sensor that sees the object minus centre [m]; NaN where unknown. The last repeats.
    ground : array, shape (n,)
        Height of the road beside the box minus z of the centre [m]; NaN where not found.
    num_points : array, shape (n,)
        Sweep points inside the input box.
    sights : array, shape (n,)
        Median of the delays [s]: when the sweep saw the object.
    is_pinned : array, shape (n,)
        Whether a person has corrected the box.

    """

    stamps_ns: Ints
    boxes: Floats
    points: NDArray[np.float32]
    delays: NDArray[np.float32]
    counts: Ints
    origins: Floats
    ground: Floats
    num_points: Ints
    sights: Floats
    is_pinned: NDArray[np.bool_]

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
        return cls(*(column(tables, name) for name in cls._fields))

    def take(self, rows: Ints) -> 'Observations':
        """Return some of the rows (n,), in their order."""
        counts = self.counts[rows]
        points = _runs(self.first[rows], counts)
        return Observations(
            stamps_ns=self.stamps_ns[rows],
            boxes=self.boxes[rows],
            points=self.points[points],
            delays=self.delays[points],
            counts=counts,
            origins=self.origins[rows],
            ground=self.ground[rows],
            num_points=self.num_points[rows],
            sights=self.sights[rows],
            is_pinned=self.is_pinned[rows],
        )

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

    @property
    def origins(self) -> Floats:
        """Sensors that see the object minus centre, (K, 3) [m]; the last repeats."""
        origins: Floats = self.table.origins[self.row]
        return origins

    @property
    def ground(self) -> float:
        """Height of the road minus z of the centre [m]; NaN where not found."""
        return float(self.table.ground[self.row])

    @property
    def num_points(self) -> int:
        """Sweep points inside the box."""
        return int(self.table.num_points.item(self.row))

    @property
    def sight(self) -> float:
        """When the sweep saw the object, relative to the stamp [s]."""
        return float(self.table.sights.item(self.row))


def observe(sweep: Sweep, boxes: Floats, stamp_ns: int, config: Config) -> Observations:
    """
    Return the observations of boxes in a sweep.

    A point near several boxes belongs to the box it is deepest inside of, or least outside, so
    that a neighbour's bumper is no evidence. It also belongs to boxes it is nearly as deep inside
    of: two boxes of one object do not take points from each other. Points less than
    `GROUND_CLEARANCE` above the road beside the box are left out; the height of the road is kept.

    Parameters
    ----------
    sweep : Sweep
        In the fixed frame; its points may be in their own, see `Sweep.T_frame_points`.
    boxes : array, shape (n, 9)
        Valid boxes in the fixed frame, at the stamp of the sweep.
    stamp_ns : int
        Stamp of the observations [ns].
    config : Config
        Settings.

    Returns
    -------
    observations : Observations
        One row for each of `boxes`; none is pinned.

    """
    n = len(boxes)
    centers = boxes[:, :3]
    find = own_points if load() is not None else own_points_numpy
    own = find(sweep, boxes, config)
    rows, owner = _thinned(own, sweep, n, config)

    points = _offsets(sweep, centers, rows, owner).T.astype(np.float32, 'C')
    counts = np.bincount(owner, minlength=n)
    delays = np.zeros(len(rows), np.float32)
    sights = np.zeros(n)
    if config.sampling.deskew and sweep.times is not None:
        delays = sweep.times[rows].astype(np.float32)
        sights = _medians(delays, counts)
    up = np.cos(boxes[:, ROLL:YAW]).prod(1)  # of the z axis of each box, in the fixed frame
    ground = (own.road - boxes[:, 5] / 2) / up.clip(0.1)  # along z of the fixed frame
    return Observations(
        stamps_ns=np.full(n, stamp_ns, np.int64),
        boxes=boxes,
        points=points,
        delays=delays,
        counts=counts,
        origins=_origins(sweep, rows, owner, centers),
        ground=ground,
        num_points=own.num_inside,
        sights=sights,
        is_pinned=np.zeros(n, bool),
    )


def _offsets(sweep: Sweep, centers: Floats, rows: Ints, owner: Ints) -> Floats:
    """Return points minus the `centers` (n, 3) of their boxes, axes of the sweep, (3, P) [m]."""
    at_points, turn = _among_points(sweep, centers)
    offset = sweep.points.T.take(rows, 1) - at_points.T.take(owner, 1)
    if sweep.T_frame_points is None:
        return offset
    x, y, z = offset
    return np.stack([a * x + b * y + c * z for a, b, c in turn])


def _origins(sweep: Sweep, rows: Ints, owner: Ints, centers: Floats) -> Floats:
    """
    Return the sensors that see each of n objects, minus its centre, (n, K, 3) [m].

    These are the sensors with `MIN_SENSOR_PART` of its points, which are `rows` of the sweep; all
    of them for an object without points. The last repeats.

    """
    if sweep.origins is None or sweep.sensors is None:
        origin: Floats = (sweep.origin - centers)[:, None]
        return origin
    n, S = len(centers), len(sweep.origins)
    counts = np.bincount(owner * S + sweep.sensors[rows], minlength=n * S).reshape(n, S)
    sees = counts >= MIN_SENSOR_PART * counts.sum(1, keepdims=True)
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


class OwnPoints(NamedTuple):
    """
    The points that belong to each of n boxes, as P pairs, and the road beside them.

    Attributes
    ----------
    row, owner : array, shape (P,)
        Row of the point in its sweep, and of the box. Ascending by box, then by the x coordinate
        of the point.
    road : array, shape (n,)
        Height of the road above the bottom of each box, along its z axis [m]; NaN if unknown.
    num_inside : array, shape (n,)
        Sweep points inside each box.

    """

    row: Ints
    owner: Ints
    road: Floats
    num_inside: Ints


def own_points(sweep: Sweep, boxes: Floats, config: Config) -> OwnPoints:
    """Return the points that belong to each box of `boxes` (n, 9), by the kernel."""
    kernels = load()
    assert kernels is not None
    numbers = CropNumbers(
        margin=max(ROAD_SEARCH_WIDTH, config.sampling.margin),
        own_margin=config.sampling.margin,
        ownership_tolerance=OWNERSHIP_TOLERANCE if config.ingredients.point_ownership else np.inf,
        clearance=GROUND_CLEARANCE,
        has_road=config.ingredients.road,
        road_width=ROAD_SEARCH_WIDTH,
        road_gap=ROAD_SIDE_GAP,
        road_range=ROAD_HEIGHT_RANGE,
        road_quantiles=ROAD_QUANTILES,
        road_flatness=ROAD_FLATNESS,
        min_road_points=MIN_ROAD_POINTS,
    )
    columns = np.ascontiguousarray(sweep.points.T)
    shapes = _shapes(sweep, boxes, numbers.margin)
    return OwnPoints(*kernels.crop.own_points(columns, shapes, numbers))


def own_points_numpy(sweep: Sweep, boxes: Floats, config: Config) -> OwnPoints:
    """Return the same as `own_points`, by numpy."""
    n = len(boxes)
    half = boxes[:, 3:6] / 2
    near = crop_numpy(sweep, boxes, max(ROAD_SEARCH_WIDTH, config.sampling.margin))
    depth = near.outside.max(0)  # of the face the point is least inside of, (P,)
    up = matrix_from_rpy(boxes[:, ROLL:])[:, :, 2]
    # Above the bottom of the box, along its z axis: also valid on a slope. (P,)
    height = (near.offset * up.T.take(near.owner, 1)).sum(0) + half[:, 2].take(near.owner)
    road = np.full(n, np.nan)
    if config.ingredients.road:
        road = _road_heights(near, height, depth, half)
    is_own = depth < config.sampling.margin
    if config.ingredients.point_ownership:
        is_own &= depth <= _least_depth(near, depth, len(sweep.points)) + OWNERSHIP_TOLERANCE
    is_own &= height > (np.nan_to_num(road) + GROUND_CLEARANCE).take(near.owner)
    own = np.flatnonzero(is_own)
    own = own[np.argsort(near.row[own], kind='stable')]  # ascending by point, as the kernel has it
    own = own[_order_by_x(near.owner[own], near.offset[0, own], n)]
    num_inside = np.bincount(near.owner.take(np.flatnonzero(depth <= 0)), minlength=n)
    return OwnPoints(near.row[own], near.owner[own], road, num_inside)


def _among_points(sweep: Sweep, centers: Floats) -> tuple[Floats, Floats]:
    """
    Return `centers` (n, 3) in the frame of the points, and the rotation of that frame, (3, 3).

    The rotation maps offsets from the frame of the points to that of the sweep. Boxes are brought
    to the points, since they are fewer.

    """
    if sweep.T_frame_points is None:
        return centers.copy(), np.eye(3)
    R, t = sweep.T_frame_points[:3, :3], sweep.T_frame_points[:3, 3]
    return (centers - t) @ R, R.copy()


def _shapes(sweep: Sweep, boxes: Floats, margin: float) -> ShapeArrays:
    """Return `boxes` (n, 9) for the kernels that find the points within `margin` of them."""
    centers, turn = _among_points(sweep, boxes[:, :3])
    R = matrix_from_rpy(boxes[:, ROLL:])  # (n, 3, 3)
    half = boxes[:, 3:6] / 2
    reach = (np.abs(turn.T @ R) @ (half + margin)[..., None])[..., 0]
    return ShapeArrays(centers, turn, R, half, reach)


def crop(sweep: Sweep, boxes: Floats, margin: float) -> Crop:
    """
    Return all pairs of a point and a box within `margin` of each other.

    Without numba some pairs that are farther apart are returned, too.

    Parameters
    ----------
    sweep : Sweep
        In the frame of the boxes.
    boxes : array, shape (n, 9)
        Valid boxes.
    margin : float
        Distance from the faces of the box [m].

    Returns
    -------
    near : Crop
        The pairs.

    """
    kernels = load()
    if kernels is None:
        return crop_numpy(sweep, boxes, margin)
    columns = np.ascontiguousarray(sweep.points.T)
    row, owner, offset, outside = kernels.crop.crop(columns, _shapes(sweep, boxes, margin), margin)
    order = np.argsort(owner, kind='stable')
    return Crop(row[order], owner[order], offset[order].T, outside[order].T)


def crop_numpy(sweep: Sweep, boxes: Floats, margin: float) -> Crop:
    """Return the same as `crop`, and some more pairs, by numpy."""
    shapes = _shapes(sweep, boxes, margin)
    index, owner = _pairs(sweep.points, shapes.centers[:, :2], shapes.reach[:, :2])
    offset = _offsets(sweep, boxes[:, :3], index, owner)
    outside = np.empty_like(offset)
    for axes, part in zip(shapes.rotations, _slices(owner, len(boxes)), strict=True):
        np.matmul(axes.T, offset[:, part], out=outside[:, part])
    np.subtract(np.abs(outside, out=outside), shapes.half.T.take(owner, 1), out=outside)
    return Crop(index, owner, offset, outside)


def _least_depth(near: Crop, depth: Floats, num_points: int) -> Floats:
    """Return for each pair the least `depth` (P,) of all pairs of its point, (P,) [m]."""
    least = np.full(num_points, np.inf)
    np.minimum.at(least, near.row, depth)
    return least.take(near.row)


def _thinned(own: OwnPoints, sweep: Sweep, n: int, config: Config) -> tuple[Ints, Ints]:
    """
    Return sweep row and box of the points of n boxes that are kept, ascending by box; (P,) each.

    Farthest points for the paper, else every n-th.

    """
    most = config.sampling.points
    counts = np.bincount(own.owner, minlength=n)
    first = np.cumsum(counts) - counts
    if config.objective == 'paper':
        is_kept = np.ones(len(own.row), bool)
        for box in np.flatnonzero(counts > most):
            part = slice(first[box], first[box] + counts[box])
            picks = farthest_point_sample(sweep.points[own.row[part]].astype(np.float64), most)
            is_kept[part] = False
            is_kept[first[box] + picks] = True
        place = np.flatnonzero(is_kept)
    else:
        stride = np.maximum(1, -(-counts // most))
        kept = -(-counts // stride)
        step = _runs(np.zeros(n, int), kept)  # 0, 1, 2 ... of each box
        place = np.repeat(first, kept) + step * np.repeat(stride, kept)
    return own.row[place], own.owner[place]


def _pairs(points: NDArray[np.floating], centers: Floats, reach: Floats) -> tuple[Ints, Ints]:
    """
    Return point and box of all pairs within `reach` (n, 2) along x and y, and of some more.

    The ground plane is a raster of 1 m cells. The 16-bit number of a cell is 256 x + y, modulo
    2^16, for any x and y: no scene is too wide. Pairs of cells that share a number although they
    are far apart, and pairs in the rim of a cell, are left to the caller to reject. Points and
    box edges are both truncated to whole metres, which keeps their order: no pair is lost.

    """
    low = (centers - reach).astype(int)
    nx, ny = ((centers + reach).astype(int) - low + 1).T
    nx = np.clip(nx + (ny - 1) // 256, 1, 256)  # more than 256 cells along y: several rows
    ny = np.clip(ny, 1, 256)
    owner = np.repeat(np.arange(len(centers)), nx)  # of each row of cells of a box
    start = (_runs(low[:, 0], nx) * 256 + low[owner, 1]) % 2**16
    length = ny[owner]
    is_touched = np.bincount(_runs(start, length) % 2**16, minlength=2**16) > 0
    x, y = (points[:, i].clip(-1e9, 1e9).astype(np.int32).astype(np.uint16) for i in (0, 1))
    cells = x * np.uint16(256) + y
    near = np.flatnonzero(is_touched.take(cells))
    near = near.take(np.argsort(cells.take(near), kind='stable'))  # 16 bits: a radix sort
    cells = np.add.outer([0, 2**16], cells.take(near)).ravel()  # twice: rows may wrap around
    first, last = np.searchsorted(cells, [start, start + length])
    return near.take(_runs(first, last - first), mode='wrap'), np.repeat(owner, last - first)


def _runs(first: Ints, counts: Ints) -> Ints:
    """Return `counts[0]` numbers from `first[0]` on, then `counts[1]` from `first[1]` on ..."""
    return np.repeat(first - np.cumsum(counts) + counts, counts) + np.arange(counts.sum())


def _slices(owner: Ints, n: int) -> list[slice]:
    """Return the slice of each of `n` boxes in `owner`, ascending."""
    ends = np.searchsorted(owner, np.arange(n + 1)).tolist()
    return [slice(first, last) for first, last in pairwise(ends)]


def _road_heights(near: Crop, height: Floats, depth: Floats, half: Floats) -> Floats:
    """
    Return the height of the road beside each of n boxes, (n,); NaN where not found [m].

    The points beside a box lie in a ring around it, within an upright square.

    Parameters
    ----------
    near : Crop
        P pairs of a point and a box.
    height : array, shape (P,)
        Height of the point above the bottom of the box, along its z axis [m].
    depth : array, shape (P,)
        Distance outside of the box [m].
    half : array, shape (n, 3)
        Half the extents of the boxes [m].

    """
    aside = near.outside[:2].max(0)
    is_beside = (aside > ROAD_SIDE_GAP) & (depth < ROAD_SEARCH_WIDTH)
    beside = np.flatnonzero(is_beside & (np.abs(height) < ROAD_HEIGHT_RANGE))
    half_square = np.hypot(half[:, 0], half[:, 1]) + ROAD_SEARCH_WIDTH
    distance = np.abs(near.offset[:2].take(beside, 1)).max(0)
    beside = beside[distance < half_square.take(near.owner.take(beside))]
    return _flat_heights(height.take(beside), near.owner.take(beside), len(half))


def _flat_heights(heights: Floats, owner: Ints, n: int) -> Floats:
    """
    Return the representative height of each of `n` boxes, (n,) [m]; NaN where not flat.

    `heights` (P,) are between -1 and 1 m, above the bottoms of the boxes `owner` (P,).

    """
    # Boxes are 2 m apart, heights within 2 m: one sort orders by box, then by height.
    levels = np.append(np.sort(2.0 * owner + heights), np.nan)
    counts = np.bincount(owner, minlength=n)
    first = np.cumsum(counts) - counts
    low, road, high = (levels[first + (part * counts).astype(int)] for part in ROAD_QUANTILES)
    is_road = (counts >= MIN_ROAD_POINTS) & (high - low < ROAD_FLATNESS)
    return np.where(is_road, road - 2.0 * np.arange(n), np.nan)


def _order_by_x(owner: Ints, x: Floats, n: int) -> Ints:
    """
    Return the order of P pairs by `owner`, one of `n`, then by `x`, (P,).

    Both are packed into 32 bits. Two stable sorts by 16 bits each, which numpy does by radix, take
    half the time of one by comparisons. Values closer than 2^-23 of the largest one, with 64
    boxes, may count as equal and keep their order: every machine sorts them alike.

    """
    x = x / np.abs(x).max(initial=1.0)
    place = ((owner + 0.5 + x / 4) * 2.0 ** (32 - n.bit_length())).astype(np.uint32)
    order = np.argsort(place.astype(np.uint16), kind='stable')
    order = order[np.argsort((place >> 16).astype(np.uint16)[order], kind='stable')]
    return np.asarray(order)


def farthest_point_sample(points: Floats, count: int) -> Ints:
    """
    Return the rows of `count` points that cover a cloud.

    The first one is farthest from the mean, each next one farthest from all before.

    Parameters
    ----------
    points : array, shape (M, 3)
        The cloud [m].
    count : int
        At most M.

    Returns
    -------
    rows : array, shape (count,)
        All different.

    """
    gaps = np.square(points - points.mean(0)).sum(1)
    picks = np.empty(count, dtype=int)
    for step in range(count):
        picks[step] = gaps.argmax()
        to_pick = np.square(points - points[picks[step]]).sum(1)
        gaps = np.minimum(gaps, to_pick) if step else to_pick
        gaps[picks[step]] = -1.0  # below any distance, so that no point is picked twice
    return picks
