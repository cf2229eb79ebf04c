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
    points, source = _near_any(sweep.points, boxes, RING + config.sampling.margin)
    R = rotation_from_rpy(torch.from_numpy(boxes[:, 6:9])).numpy()
    crops = []
    nearest = np.full(len(points), np.inf)
    for box, axes in zip(boxes, R, strict=True):
        reach = float(np.hypot(*box[3:5])) / 2 + RING
        first, last = np.searchsorted(points[:, 0], (box[0] - reach, box[0] + reach))
        index = first + np.flatnonzero(np.abs(points[first:last, 1] - box[1]) < reach)
        offset = points[index] - box[:3]
        x, y, z = (np.abs(offset @ axes) - box[3:6] / 2).T
        aside = np.maximum(x, y)
        depth = np.maximum(aside, z)
        beside = (aside > 0.05) & (aside < RING) & (np.abs(offset[:, 2] + box[5] / 2) < 0.6)
        near = np.flatnonzero(depth < config.sampling.margin)
        crops.append((index[near], offset[near], depth[near], _road(offset[beside, 2])))
        np.minimum.at(nearest, index[near], depth[near])
    observations = []
    for box, (index, offset, depth, ground) in zip(boxes, crops, strict=True):
        floor = (-box[5] / 2 if np.isnan(ground) else ground) + CLEARANCE
        own = np.flatnonzero((depth <= nearest[index]) & (offset[:, 2] > floor))
        kept = own[_thinned(offset[own], config)]
        delays = np.zeros(len(kept))
        if config.sampling.deskew and sweep.times is not None:
            delays = sweep.times[source[index[kept]]]
        observations.append(
            Observation(
                stamp_ns,
                box,
                offset[kept].astype(np.float32),
                delays.astype(np.float32),
                sweep.origin - box[:3],
                ground,
                int((depth <= 0).sum()),
            )
        )
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


def _near_any(points: NDArray[np.floating], boxes: Floats, margin: float) -> tuple[Floats, Ints]:
    """
    Return the points near any box, ascending in x, and their rows in the sweep.

    One pass over the sweep with a look-up table of coarse cells, so that the exact tests that
    follow see the few points that matter.

    """
    reach = np.linalg.norm(boxes[:, 3:5], axis=1) / 2 + margin
    low = (boxes[:, :2] - reach[:, None]).min(0)
    span = (boxes[:, :2] + reach[:, None]).max(0) - low
    cell = max(1.0, float(span.max()) / 1000)
    table = np.zeros((span / cell).astype(int) + 3, dtype=bool)
    for (x, y), r in zip(boxes[:, :2] - low, reach, strict=True):
        a, b, c, d = (np.array([x - r, x + r, y - r, y + r]) / cell).astype(int) + 1
        table[a : b + 1, c : d + 1] = True
    scaled = (points[:, :2] - low.astype(points.dtype)) * np.asarray(1 / cell, points.dtype) + 1
    x, y = (scaled[:, i].clip(0, table.shape[i] - 1).astype(np.int32) for i in (0, 1))
    near = np.flatnonzero(table[x, y])
    near = near[np.argsort(points[near, 0], kind='stable')]
    return points[near].astype(np.float64), near


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
