"""
`boxreg bench real`: the accuracy of every method on recordings with known truth.

All methods of a table get the same sweeps and the same boxes, in the same run.

"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
import math
from pathlib import Path
from typing import Any

from boxreg_ros.bench.common import (
    add_json_argument,
    add_scope_arguments,
    class_words,
    in_scope,
    line,
    print_json,
    progress_bar,
)
from boxreg_ros.bench.methods import add_method_argument, Methods, run_methods
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.io.lidars import Lidars
from boxreg_ros.offline.arguments import add_options, values_of
from boxreg_ros.offline.box_scores import groups, Mask, match, Matches, RECALLS, Scores, summarise
from boxreg_ros.offline.drive import Drive
from boxreg_ros.structures import Floats
import numpy as np

RANGE_GROUPS = (0, 20, 40, 80, math.inf)  # [m]
POINT_GROUPS = (0, 30, 100, 300, 1000, math.inf)
MIN_CLASS_BOXES = 20
"""Classes with fewer true boxes have no row of their own."""
MIN_PATH_EXTENT = 2.0
"""Least extent of the path of an object that moves [m]. Chosen: labels of parked cars wander by
.26 m on KITTI, and nothing that drives stays within 2 m."""
PEOPLE = {'all': (0.880, 0.809), '0-30': (0.913, 0.858)}
"""BEV and 3D IoU of people who box objects again with the public labels of Waymo, by range [m].
Literature: Qi et al., Offboard 3D Object Detection from Point Cloud Sequences (3DAL), CVPR 2021,
appendix G, table 13."""
PEOPLE_RANGES = {'all': (0, math.inf), '0-30': (0, 30), '30-50': (30, 50), '50+': (50, math.inf)}
MIN_PAIR_IOU = 0.03
"""Least 3D IoU of a box and a label that are compared by that protocol; of the same table."""
GROUPINGS = {'by_range': 'by range [m]', 'by_points': 'by points'}

Groups = dict[str, dict[str, float]]
"""Mean IoU by the key of a grouping, and by the label of a bin."""
Report = dict[str, Any]
"""What ``--json`` has of a recording: by method its scores, or the reason why it did not run."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `boxreg bench real`."""
    add_scope_arguments(parser)
    add_method_argument(parser)
    add_options(parser, Lidars)
    add_json_argument(parser)


def run(args: argparse.Namespace) -> int:
    """Print the scores of each method, one table per recording."""
    report: dict[str, Report] = {}
    with progress_bar(len(args.data) * len(args.methods), args) as bar:
        for folder in args.data:
            drive = Drive.read(folder, Lidars(**values_of(args, Lidars)))
            methods = run_methods(drive, '3d', args.methods, bar.update)
            report[str(folder)] = measured(drive, methods, args)
            if not args.json:
                bar.clear()
                print_report(folder, report[str(folder)])
    if args.json:
        print_json(report)
    return 0


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
    """Return number, BEV and 3D IoU by range of pairs as `PEOPLE` were compared."""
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


def print_report(folder: Path, report: Report) -> None:
    """Print the tables of one recording."""
    ran = {name: one for name, one in report.items() if not isinstance(one, str)}
    print(f'{folder}: {ran["input"]["boxes"]} true boxes')
    recalls = [f'R@{level}' for level in RECALLS]
    print(line('', ('BEV', '3D', *recalls, 'ATE', 'ASE', 'AOE', 'flips', 'jitter')))
    for name, one in report.items():
        if isinstance(one, str):
            print(line(name, one))
            continue
        errors = [one[error] for error in ('ate', 'ase', 'aoe', 'flips', 'jitter')]
        print(line(name, (one['iou_bev'], one['iou_3d'], *one['recall_3d'], *errors)))
    print_groups(ran, '3D')
    print()
    _print_people(ran)
    _print_differences(ran)
    for class_name, scores in ran['input']['by_class'].items():
        print(line(f'{class_name}: {scores["boxes"]} true boxes with points', ''))
        print(line('', ('BEV', '3D')))
        for name, one in ran.items():
            print(line(name, [one['by_class'][class_name][iou] for iou in ('iou_bev', 'iou_3d')]))
    print()


def _print_people(ran: Report) -> None:
    """Print the agreement with the labels as that of people is published, and theirs."""
    print(f'boxes with a point, pairs above {MIN_PAIR_IOU} IoU, by range [m]')
    for row, (iou, title) in enumerate((('iou_bev', 'BEV'), ('iou_3d', '3D'))):
        print(line(title, list(PEOPLE_RANGES)))
        for name, one in ran.items():
            known = [one['as_people'].get(label, {}).get(iou, math.nan) for label in PEOPLE_RANGES]
            print(line(name, known))
        people = [PEOPLE.get(label, (math.nan, math.nan))[row] for label in PEOPLE_RANGES]
        print(line('people, on Waymo', people))


def _print_differences(ran: Report) -> None:
    """Print IoU and median yaw error of moving objects, and the differences between methods."""
    if 'moving' in ran['input']:
        boxes = ran['input']['moving']['boxes']
        print(line(f'moving: {boxes} boxes', ('BEV', '3D', 'yaw [deg]')))
        for name, one in ran.items():
            print(line(name, [one['moving'][key] for key in ('iou_bev', 'iou_3d', 'yaw_degrees')]))
    for scope in ran['input']['differences']:
        for name, one in ran.items():
            if one['differences'][scope]:
                title = f'{name}, {scope}, minus'
                print(line(title, ('BEV', '+-', '3D', '+-', 'tracks', 'ahead')))
            for other, d in one['differences'][scope].items():
                numbers = [d['iou_bev'], d['iou_bev_error'], d['iou_3d'], d['iou_3d_error']]
                counts = (str(d['tracks']), str(d['tracks_ahead']))
                print(line(other, (*(f'{number:.4f}' for number in numbers), *counts)))
    print()


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


def print_groups(found: Mapping[str, Any], iou: str) -> None:
    """Print the `iou_by_group` that each method has; `iou` names the kind of IoU."""
    for grouping, title in GROUPINGS.items():
        labels = list(dict.fromkeys(key for one in found.values() for key in one[grouping]))
        print(line(f'{iou} {title}', labels))
        for name, one in found.items():
            print(line(name, [one[grouping].get(label, math.nan) for label in labels]))


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
