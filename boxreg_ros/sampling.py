"""From a sweep to what each box sees of it: crop, ownership, road, farthest point sampling."""

from typing import NamedTuple

from boxreg_ros.config import Config
from boxreg_ros.geometry import rotation_from_rpy
from boxreg_ros.structures import Floats, Ints, Sweep
import numpy as np
from numpy.typing import NDArray
import torch
from torch import Tensor

RING = 1.0  # how far beside a box the road is looked for [m]
CLEARANCE = 0.2  # what is lower above the road may be road [m]


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
    that a neighbour's bumper is no evidence. Points lower than the road beside the box plus a
    clearance are left out, and the road's height is kept instead.

    """
    around = _around(sweep.points, boxes, max(RING, config.sampling.margin))
    R = rotation_from_rpy(torch.from_numpy(boxes[:, 6:9])).numpy()
    crops = []
    nearest = np.full(len(sweep.points), np.inf)
    for box, axes, index in zip(boxes, R, around, strict=True):
        offset = sweep.points[index].astype(np.float64) - box[:3]
        x, y, z = (np.abs(offset @ axes) - box[3:6] / 2).T
        aside = np.maximum(x, y)
        depth = np.maximum(aside, z)
        beside = (aside > 0.05) & (aside < RING) & (np.abs(offset[:, 2] + box[5] / 2) < 0.6)
        near = np.flatnonzero(depth < config.sampling.margin)
        near = near[np.argsort(offset[near, 0], kind='stable')]
        crops.append((index[near], offset[near], depth[near], _road(offset[beside, 2])))
        nearest[index[near]] = np.minimum(nearest[index[near]], depth[near])
    observations = []
    for box, (index, offset, depth, ground) in zip(boxes, crops, strict=True):
        floor = (-box[5] / 2 if np.isnan(ground) else ground) + CLEARANCE
        own = np.flatnonzero((depth <= nearest[index]) & (offset[:, 2] > floor))
        kept = own[_thinned(offset[own], config)]
        near, late = offset[kept].astype(np.float32), np.zeros(len(kept), dtype=np.float32)
        if config.sampling.deskew and sweep.times is not None:
            late = sweep.times[index[kept]].astype(np.float32)
        inside, origin = int((depth <= 0).sum()), sweep.origin - box[:3]
        observations.append(Observation(stamp_ns, box, near, late, origin, ground, inside))
    return observations


def _road(heights: Floats) -> float:
    """Return the height of the road among what is beside a box; NaN if that is not flat [m]."""
    if len(heights) < 5:
        return np.nan
    low, road, high = np.sort(heights)[(len(heights) * np.array([0.1, 0.3, 0.6])).astype(int)]
    return float(road) if high - low < 0.15 else np.nan  # no wall, kerb or vehicle


def _thinned(points: Floats, config: Config) -> Ints:
    """Return which of `points` (M, 3) to keep: farthest ones for the paper, else every n-th."""
    count = config.sampling.points
    if config.objective != 'paper' or len(points) <= count:
        return np.arange(0, len(points), max(1, -(-len(points) // count)))
    mask = torch.ones(len(points), dtype=torch.bool)
    return farthest_point_sample(torch.from_numpy(points), mask, count).numpy()


def _around(points: NDArray[np.floating], boxes: Floats, margin: float) -> list[Ints]:
    """Return the points in the upright square `margin` around the footprint of each box."""
    reach = np.hypot(boxes[:, 3], boxes[:, 4])[:, None] / 2 + margin
    low, high = boxes[:, :2] - reach, boxes[:, :2] + reach
    least, cell = low.min(0), max(1.0, (high.max(0) - low.min(0)).max() / 250)
    nx, ny = ((high.max(0) - least) / cell).astype(int) + 3  # with a rim for what is outside
    x, y = (
        ((points[:, i] - float(least[i])) * float(1 / cell) + 1).clip(0, n - 1).astype(np.uint16)
        for i, n in enumerate((nx, ny))
    )
    cells = x * np.uint16(ny) + y  # numbers of 16 bits are sorted by counting
    order = np.argsort(cells, kind='stable')
    ends = np.cumsum(np.bincount(cells, minlength=nx * ny))
    first, last = (((edge - least) / cell).astype(int) + 1 for edge in (low, high))
    found = []
    for box, r, (a, b), (c, d) in zip(boxes, reach, first, last, strict=True):
        rows = np.arange(a, c + 1) * ny
        parts = zip(ends[rows + b - 1], ends[rows + d], strict=True)
        near = np.sort(np.concatenate([order[i:j] for i, j in parts]))
        found.append(near[(np.abs(points[near, :2] - box[:2]) < r).all(1)])
    return found


def farthest_point_sample(points: Tensor, mask: Tensor, count: int) -> Tensor:
    """
    Choose `count` points that cover the cloud, for all clouds of a batch at once.

    Parameters
    ----------
    points : Tensor, shape (..., M, 3)
        Clouds [m]; padding may hold any finite value.
    mask : Tensor, shape (..., M)
        True where a point is real.
    count : int
        Points to choose, at most M.

    Returns
    -------
    index : Tensor, shape (..., count)
        The first is the one farthest from the mean, each next one farthest from all before;
        padding comes last, where a cloud has fewer points than that.

    """
    weight = mask.to(points.dtype)
    mean = (points * weight[..., None]).sum(-2) / weight.sum(-1, keepdim=True).clamp(min=1)
    distance = torch.where(mask, (points - mean[..., None, :]).square().sum(-1), -2.0)
    picks = []
    for step in range(count):
        pick = distance.argmax(-1, keepdim=True)
        center = points.gather(-2, pick[..., None].expand(*pick.shape, 3))
        fresh = (points - center).square().sum(-1)
        distance = torch.where(mask, fresh if step == 0 else distance.minimum(fresh), -2.0)
        picks.append(pick)
        distance = distance.scatter(-1, pick, -3.0)  # once is enough: minima stay below
    return torch.cat(picks, -1)
