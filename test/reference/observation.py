"""The crop by numpy, oracle of the compiled one."""

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


