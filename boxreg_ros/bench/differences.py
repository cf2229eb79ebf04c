"""
Differences of two methods on the same true boxes, with standard errors over tracks.

The boxes of a track share its errors: a recording with many boxes of few tracks decides little.

"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
import math

from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.offline.box_scores import Mask, Matches
from boxreg_ros.structures import Floats
import numpy as np

REFERENCE_METHODS = {
    'ours, early': ('input', 'smoothing, early'),
    'ours, final': ('input', 'smoothing, final'),
    'ours, track': ('input', 'smoothing only', 'CTRA smoothing', 'ours, final'),
}
"""Methods that each estimate must not lose to."""


@dataclass(frozen=True, slots=True)
class Difference:
    """Mean IoU of one method minus that of another, over the true boxes that both have."""

    boxes: int
    iou_bev: float
    iou_bev_error: float  # standard error by `clustered_error`
    iou_3d: float
    iou_3d_error: float
    tracks: int
    tracks_ahead: int  # of which the mean BEV IoU by the first method is not lower


@dataclass(frozen=True, slots=True)
class PairedBoxes:
    """True boxes that two methods have."""

    tracks: tuple[str, ...]  # n, the id of the track of each
    iou_bev: Floats  # (n,) by the first method minus that by the second
    iou_3d: Floats

    @classmethod
    def pooled(cls, parts: Mapping[str, PairedBoxes]) -> PairedBoxes:
        """Return the boxes of several drives, whose names become part of the ids."""
        return cls(
            tuple(f'{name}/{track}' for name, part in parts.items() for track in part.tracks),
            np.concatenate([part.iou_bev for part in parts.values()]),
            np.concatenate([part.iou_3d for part in parts.values()]),
        )

    def difference(self) -> Difference:
        """Return the mean differences with their standard errors."""
        sums = _sums_by_cluster(self.iou_bev, self.tracks)
        return Difference(
            boxes=len(self.tracks),
            iou_bev=_mean(self.iou_bev),
            iou_bev_error=clustered_error(self.iou_bev, self.tracks),
            iou_3d=_mean(self.iou_3d),
            iou_3d_error=clustered_error(self.iou_3d, self.tracks),
            tracks=len(sums),
            tracks_ahead=int((sums >= 0).sum()),
        )


def differences(
    method: str, found: Mapping[str, Matches], truth: BoxTable, scope: Mask
) -> dict[str, Difference]:
    """
    Return the differences of a method to its `REFERENCE_METHODS`.

    `found` has the matches by method, all of the same n true boxes, of which `scope` (n,) count.

    """
    return {
        other: paired(found[method], found[other], truth, scope).difference()
        for other in REFERENCE_METHODS.get(method, ())
        if other in found
    }


def paired(first: Matches, second: Matches, truth: BoxTable, scope: Mask) -> PairedBoxes:
    """Return the true boxes in `scope` (n,) that two methods have, of n true boxes."""
    both = scope & first.is_matched & second.is_matched
    return PairedBoxes(
        tuple(truth.track_ids[row] for row in first.rows[both]),
        (first.iou_bev - second.iou_bev)[both],
        (first.iou_3d - second.iou_3d)[both],
    )


def clustered_error(values: Floats, clusters: Sequence[str]) -> float:
    """
    Return the standard error of the mean of `values` (n,) whose errors `clusters` share.

    The cluster-robust one: sqrt(G / (G - 1) * sum of squares of the sums s_g) / n, with the
    deviations from the mean summed over each of G clusters. NaN for fewer than two.

    """
    count = len(set(clusters))
    if count < 2:
        return math.nan
    sums = _sums_by_cluster(values - values.mean(), clusters)
    return math.sqrt(count / (count - 1) * float(np.square(sums).sum())) / len(values)


def _sums_by_cluster(values: Floats, clusters: Sequence[str]) -> Floats:
    _, codes = np.unique(np.array(clusters, str), return_inverse=True)
    return np.bincount(codes, values).astype(np.float64)


def _mean(values: Floats) -> float:
    return float(values.mean()) if len(values) else math.nan
