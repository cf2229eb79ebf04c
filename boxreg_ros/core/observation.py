"""From a sweep to what each box sees of it: crop, ownership, road, farthest point sampling."""

from itertools import pairwise
from typing import NamedTuple

from boxreg_ros.config import Config
from boxreg_ros.rotations import matrix_from_rpy
from boxreg_ros.structures import Floats, Ints, ROLL, Sweep
import numpy as np
from numpy.typing import NDArray

Pairs = tuple[Ints, Ints, Floats, Floats]
RING = 1.0  # how far beside a box the road is looked for [m]
CLEARANCE = 0.2  # what is lower above the road may be road [m]
EITHER = 0.2  # deeper in one of two boxes by less, a point may be of either [m]


class Observation(NamedTuple):
    """
    One track at one stamp; everything is relative to the centre of its input box.

    Attributes
    ----------
    stamp_ns : int
        Stamp of the box [ns].
    box : array, shape (9,)
        Input box in the fixed frame.
    points : array, shape (M, 3)
        Returns near the box, above the road, minus its centre; axes of the fixed frame [m].
    delays : array, shape (M,)
        When each was measured, relative to the stamp [s]; 0 unless `deskew` asks for it.
    origin : array, shape (3,)
        Sensor minus centre [m]; NaN where unknown.
    ground : float
        Height of the road beside the box minus z of the centre [m]; NaN where none is seen.
    num_points : int
        Sweep points inside the input box.

    """

    stamp_ns: int
    box: Floats
    points: NDArray[np.float32]
    delays: NDArray[np.float32]
    origin: Floats
    ground: float
    num_points: int


def observe(sweep: Sweep, boxes: Floats, stamp_ns: int, config: Config) -> list[Observation]:
    """
    Return what `boxes` (n, 9) see of `sweep`, one observation each.

    A point near several boxes belongs to the one it is deepest inside of (or least outside), so
    that a neighbour's bumper is no evidence, and to those it is nearly as deep inside of: two
    boxes of one object do not take each other's points away. Points lower than the road beside
    the box plus a clearance are left out, and the road's height is kept instead.

    All boxes are seen at once, as pairs of a point and a box.

    """
    centers, half, n = boxes[:, :3], boxes[:, 3:6] / 2, len(boxes)
    index, owner, offset, outside = crop(sweep.points, boxes, max(RING, config.sampling.margin))
    aside, depth = outside[:2].max(0), outside.max(0)
    up = matrix_from_rpy(boxes[:, ROLL:])[:, :, 2]  # on a slope, too
    height = (offset * up.T.take(owner, 1)).sum(0) + half[:, 2].take(owner)  # above the bottom
    beside = np.flatnonzero((aside > 0.05) & (depth < RING) & (np.abs(height) < 0.6))
    corner = np.hypot(half[:, 0], half[:, 1]) + RING  # the ring ends at an upright square
    beside = beside[np.abs(offset[:2].take(beside, 1)).max(0) < corner.take(owner.take(beside))]
    road = np.full(n, np.nan)
    if config.ingredients.road:
        road = _road(height.take(beside), owner.take(beside), n)
    nearest = np.full(len(sweep.points), np.inf)
    np.minimum.at(nearest, index, depth)
    is_own = depth < config.sampling.margin
    if config.ingredients.point_ownership:
        is_own &= depth <= nearest.take(index) + EITHER
    own = np.flatnonzero(is_own & (height > (np.nan_to_num(road) + CLEARANCE).take(owner)))
    inside = np.bincount(owner.take(np.flatnonzero(depth <= 0)), minlength=n).tolist()
    owner, x = owner.take(own), offset[0].take(own)
    rows = _by_x(index.take(own), owner, x / np.abs(x).max(initial=1.0), n)
    kept = [_thinned(rows[part], sweep.points, config) for part in _parts(owner, n)]
    rows, owner = np.concatenate(kept), np.repeat(np.arange(n), [len(part) for part in kept])
    near = (sweep.points.T.take(rows, 1) - centers.T.take(owner, 1)).T.astype(np.float32)
    times = sweep.times if config.sampling.deskew else None
    late = (np.zeros(len(rows)) if times is None else times[rows]).astype(np.float32)
    ground = ((road - half[:, 2]) / up[:, 2].clip(0.1)).tolist()  # along z of the frame
    origin, parts = sweep.origin - centers, _parts(owner, n)
    columns = boxes, [near[p] for p in parts], [late[p] for p in parts], origin, ground, inside
    return [Observation(stamp_ns, *row) for row in zip(*columns, strict=True)]


def crop(points: NDArray[np.floating], boxes: Floats, margin: float) -> Pairs:
    """
    Return all pairs of a point and a box (n, 9) within `margin` of each other, and some more [m].

    The row of the point (P,) and that of the box (P,), ascending; the point minus the centre of
    the box (3, P), and how far outside of its faces it is, along its axes (3, P).

    """
    R, half = matrix_from_rpy(boxes[:, ROLL:]), boxes[:, 3:6] / 2
    reach = (np.abs(R) @ (half + margin)[..., None])[..., 0]
    index, owner = _pairs(points, boxes[:, :2], reach[:, :2])
    offset = points.T.take(index, 1).astype(np.float64) - boxes[:, :3].T.take(owner, 1)
    outside = np.empty_like(offset)
    for axes, part in zip(R, _parts(owner, len(boxes)), strict=True):
        np.matmul(axes.T, offset[:, part], out=outside[:, part])
    np.subtract(np.abs(outside, out=outside), half.T.take(owner, 1), out=outside)
    return index, owner, offset, outside


def _pairs(points: NDArray[np.floating], centers: Floats, reach: Floats) -> tuple[Ints, Ints]:
    """
    Return point and box of all pairs that are within `reach` (n, 2) of each other, and of more.

    The ground plane is a raster of 1 m whose 16-bit numbers run on from one row of cells to the
    next, and start again after the last: no scene is too wide for it. What is as far off as to
    share a number with a box is left for the caller to tell, like what is in the rim of a cell.
    Points and edges are both cut to whole metres, which changes no order: none gets lost.

    """
    low = (centers - reach).astype(int)
    nx, ny = ((centers + reach).astype(int) - low + 1).T
    nx, ny = np.clip(nx + (ny - 1) // 256, 1, 256), np.clip(ny, 1, 256)  # long rows: as several
    owner = np.repeat(np.arange(len(centers)), nx)  # of each row of cells of a box
    start, length = (_runs(low[:, 0], nx) * 256 + low[owner, 1]) % 2**16, ny[owner]
    is_touched = np.bincount(_runs(start, length) % 2**16, minlength=2**16) > 0
    x, y = (points[:, i].clip(-1e9, 1e9).astype(np.int32).astype(np.uint16) for i in (0, 1))
    cells = x * np.uint16(256) + y
    near = np.flatnonzero(is_touched.take(cells))
    near = near.take(np.argsort(cells.take(near), kind='stable'))  # of 16 bits: by counting
    cells = np.add.outer([0, 2**16], cells.take(near)).ravel()  # for rows that start again
    first, last = np.searchsorted(cells, [start, start + length])
    return near.take(_runs(first, last - first), mode='wrap'), np.repeat(owner, last - first)


def _runs(first: Ints, counts: Ints) -> Ints:
    """Return `counts[0]` numbers from `first[0]` on, then `counts[1]` from `first[1]` on ..."""
    return np.repeat(first - np.cumsum(counts) + counts, counts) + np.arange(counts.sum())


def _parts(owner: Ints, n: int) -> list[slice]:
    """Return where in `owner`, ascending, each of `n` boxes is."""
    return [slice(a, b) for a, b in pairwise(np.searchsorted(owner, np.arange(n + 1)).tolist())]


def _road(heights: Floats, owner: Ints, n: int) -> Floats:
    """
    Return the height of the road beside each of `n` boxes; NaN where that is not flat [m].

    `heights` (P,) are between -1 and 1, above the bottoms of the boxes `owner` (P,).

    """
    levels = np.append(np.sort(2.0 * owner + heights), np.nan)  # box after box
    counts = np.bincount(owner, minlength=n)
    first = np.cumsum(counts) - counts
    low, road, high = (levels[first + (part * counts).astype(int)] for part in (0.1, 0.3, 0.6))
    # A wall, a kerb or a vehicle is not flat.
    return np.where((counts >= 5) & (high - low < 0.15), road - 2.0 * np.arange(n), np.nan)


def _by_x(rows: Ints, owner: Ints, x: Floats, n: int) -> Ints:
    """
    Return `rows` of the sweep by `owner` (one of `n`), then `x` (-1 to 1), then row.

    All three make one number: sorting numbers is several times faster than finding their order,
    and no two are equal, so that every machine sorts them alike.

    """
    bits = int(rows.max(initial=0)).bit_length()
    place = (owner + 0.5 + x / 4) * 2.0 ** (62 - bits - n.bit_length())
    return np.sort(place.astype(np.int64) << bits | rows) & ((1 << bits) - 1)


def _thinned(rows: Ints, points: NDArray[np.floating], config: Config) -> Ints:
    """Return the `rows` of `points` to keep: farthest ones for the paper, else every n-th."""
    if config.objective != 'paper' or len(rows) <= config.sampling.points:
        return rows[:: max(1, -(-len(rows) // config.sampling.points))]
    return rows[farthest_point_sample(points[rows].astype(np.float64), config.sampling.points)]


def farthest_point_sample(points: Floats, count: int) -> Ints:
    """
    Choose `count` of `points` (M, 3), at most M, that cover the cloud; return their rows.

    The first is the one farthest from the mean, each next one farthest from all before.

    """
    gaps, picks = np.square(points - points.mean(0)).sum(1), np.empty(count, dtype=int)
    for step in range(count):
        picks[step] = gaps.argmax()
        gaps = np.minimum(gaps if step else np.inf, np.square(points - points[picks[step]]).sum(1))
        gaps[picks[step]] = -1.0  # once is enough: minima stay below
    return picks
