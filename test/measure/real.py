"""
`measure real`: the accuracy of every method on recordings with known truth.

All methods of a table get the same sweeps and the same boxes, in the same run.

"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
import math
from typing import Any

from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.io.lidars import Lidars
from boxreg_ros.offline.arguments import add_options, values_of
from boxreg_ros.offline.box_scores import groups, Mask, match, Matches, Scores, summarise
from boxreg_ros.structures import Floats
from measure import RECORDINGS
from measure.common import class_words, in_scope, SCOPE
from measure.drives import Drive
from measure.methods import METHOD_OPTION, Methods, run_methods
import numpy as np

RANGE_GROUPS = (0, 20, 40, 80, math.inf)  # [m]
POINT_GROUPS = (0, 30, 100, 300, 1000, math.inf)
MIN_CLASS_BOXES = 20
"""Classes with fewer true boxes have no row of their own."""
MIN_PATH_EXTENT = 2.0
"""Least extent of the path of an object that moves [m]. Chosen: labels of parked cars wander by
.26 m on KITTI, and nothing that drives stays within 2 m."""
PEOPLE_RANGES = {'all': (0, math.inf), '0-30': (0, 30), '30-50': (30, 50), '50+': (50, math.inf)}
MIN_PAIR_IOU = 0.03
"""Least 3D IoU of a box and a label that are compared as two labels of people are. Literature: Qi
et al., Offboard 3D Object Detection from Point Cloud Sequences, CVPR 2021, appendix G, table
13."""
GROUPINGS = ('by_range', 'by_points')

Groups = dict[str, dict[str, float]]
"""Mean IoU by the key of a grouping, and by the label of a bin."""
Report = dict[str, Any]
"""What ``--json`` has of a recording: by method its scores, or the reason why it did not run."""


ARGUMENTS = {
    'data': RECORDINGS,
    **SCOPE,
    '--methods': METHOD_OPTION,
    '--lidars': lambda parser: add_options(parser, Lidars),
}


def run(args: argparse.Namespace) -> dict[str, Report]:
    """Return the scores of each method on each recording."""
    report: dict[str, Report] = {}
    for folder in args.data:
        drive = Drive.read(folder, Lidars(**values_of(args, Lidars)))
        report[str(folder)] = measured(drive, run_methods(drive, '3d', args.methods), args)
    return report


def measured(drive: Drive, methods: Methods, args: argparse.Namespace) -> Report:
    """Return the scores of each method, or why it did not run."""
    truth = drive.truth
    ran = {name: boxes for name, boxes in methods.items() if isinstance(boxes, BoxTable)}
    found = {name: in_scope(boxes, truth, args) for name, boxes in ran.items()}
    report: Report = {}
    for name, boxes in methods.items():
        if isinstance(boxes, str):
            report[name] = boxes
            continue
        scopes = scopes_of(found[name], truth)
        report[name] = {
            **asdict(summarise(found[name])),
            **iou_by_group(iou_and_group_values(drive, found[name], '3d')),
            'differences': {
                scope: {k: asdict(d) for k, d in differences(name, found, truth, mask).items()}
                for scope, mask in scopes.items()
            },
            'by_class': scores_by_class(boxes, truth),
            'as_people': as_by_people(drive, match(boxes, truth, 1, class_words(args))),
        }
        if 'moving' in scopes:
            s = summarise(found[name], scopes['moving'])
            yaw = math.degrees(s.aoe_median)
            report[name]['moving'] = {**_iou(s), 'yaw_degrees': yaw}
    return report


def _iou(scores: Scores) -> dict[str, float]:
    return {'boxes': scores.boxes, 'iou_bev': scores.iou_bev, 'iou_3d': scores.iou_3d}


def scores_by_class(boxes: BoxTable, truth: BoxTable) -> dict[str, dict[str, float]]:
    """Return the IoU of every class of true boxes with points, and enough of them."""
    by_class = groups(match(boxes, truth, min_points=1))['by_class']
    return {name: _iou(s) for name, s in by_class.items() if s.boxes >= MIN_CLASS_BOXES}


def as_by_people(drive: Drive, matches: Matches) -> dict[str, dict[str, float]]:
    """Return number, BEV and 3D IoU by range of pairs as labels of people are compared."""
    ranges = drive.ranges(matches.rows)
    is_pair = matches.is_matched & (matches.iou_3d > MIN_PAIR_IOU)
    found = {}
    for label, (low, high) in PEOPLE_RANGES.items():
        mask = is_pair & (ranges >= low) & (ranges < high)
        if mask.any():
            bev, whole = matches.iou_bev[mask].mean(), matches.iou_3d[mask].mean()
            found[label] = {
                'boxes': int(mask.sum()), 'iou_bev': float(bev), 'iou_3d': float(whole)
            }  # fmt: skip
    return found


def scopes_of(matches: Matches, truth: BoxTable) -> dict[str, Mask]:
    """Return which of the n true boxes count: all, and those of moving objects if there are."""
    _, codes = np.unique(np.array(truth.track_ids, str), return_inverse=True)
    extents = [np.ptp(truth.boxes[codes == code, :2], axis=0) for code in np.unique(codes)]
    moves = np.linalg.norm(extents, axis=1) >= MIN_PATH_EXTENT
    moving: Mask = moves[codes[matches.rows]]
    whole = np.ones(len(moving), bool)
    return {'all': whole, 'moving': moving} if moving.any() else {'all': whole}


def iou_and_group_values(drive: Drive, matches: Matches, mode: str) -> Floats:
    """Return (n, 3): IoU, NaN without prediction, range [m] and points of each true box."""
    iou = matches.iou_3d if mode == '3d' else matches.iou_bev
    iou = np.where(matches.is_matched, iou, np.nan)
    return np.stack([iou, drive.ranges(matches.rows), matches.num_points], axis=1)


def iou_by_group(rows: Floats) -> Groups:
    """Return mean IoU by range and by number of points, of the `iou_and_group_values` (n, 3)."""
    iou, *columns = rows[np.isfinite(rows).all(axis=1)].T
    by_group: Groups = {}
    for grouping, values, edges in zip(
        GROUPINGS, columns, (RANGE_GROUPS, POINT_GROUPS), strict=True
    ):
        by_group[grouping] = {}
        for low, high in pairwise(edges):
            label = f'{low:g}-{high:g}' if math.isfinite(high) else f'{low:g}+'
            mask = (values >= low) & (values < high)
            if mask.any():
                by_group[grouping][label] = float(iou[mask].mean())
    return by_group


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
