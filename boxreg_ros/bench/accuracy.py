"""
`boxreg bench real`: the accuracy of every method on recordings with known truth.

All methods of a table get the same sweeps and the same boxes, in the same run.

"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import asdict
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
from boxreg_ros.bench.differences import Difference, differences
from boxreg_ros.bench.methods import add_method_argument, run_methods
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
"""
Least extent of the path of an object that moves [m].

Chosen: labels of parked cars wander by .26 m on KITTI, and nothing that drives stays within 2 m.

"""
PEOPLE = {'all': (0.880, 0.809), '0-30': (0.913, 0.858)}
"""
BEV and 3D IoU of people who box objects again with the public labels of Waymo, by range [m].

Literature: Qi et al., Offboard 3D Object Detection from Point Cloud Sequences (3DAL), CVPR 2021,
appendix G, table 13.

"""
PEOPLE_RANGES = {'all': (0, math.inf), '0-30': (0, 30), '30-50': (30, 50), '50+': (50, math.inf)}
MIN_PAIR_IOU = 0.03
"""Least 3D IoU of a box and a label that are compared by that protocol; of the same table."""
GROUPINGS = {'by_range': 'by range [m]', 'by_points': 'by points'}

Groups = dict[str, dict[str, float]]
"""Mean IoU by the key of a grouping, and by the label of a bin."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `boxreg bench real`."""
    add_scope_arguments(parser)
    add_method_argument(parser)
    add_options(parser, Lidars)
    add_json_argument(parser)


def run(args: argparse.Namespace) -> int:
    """Print the scores of each method, one table per recording."""
    report: dict[str, Any] = {}
    with progress_bar(len(args.data) * len(args.methods), args) as bar:
        for folder in args.data:
            drive = Drive.read(folder, Lidars(**values_of(args, Lidars)))
            methods = run_methods(drive, '3d', args.methods, bar.update)
            found = {
                name: boxes if isinstance(boxes, str) else in_scope(boxes, drive.truth, args)
                for name, boxes in methods.items()
            }
            by_people = {
                name: as_by_people(drive, match(boxes, drive.truth, 1, class_words(args)))
                for name, boxes in methods.items()
                if not isinstance(boxes, str)
            }
            classes = {
                name: scores_by_class(boxes, drive.truth)
                for name, boxes in methods.items()
                if not isinstance(boxes, str)
            }
            if not args.json:
                bar.clear()
                print_tables(folder, drive, found)
                print_people(by_people)
                print_differences(drive.truth, found)
                print_classes(classes)
            report[str(folder)] = {
                name: matches
                if isinstance(matches, str)
                else _scores(drive, matches)
                | _compared(name, found, drive.truth)
                | {'by_class': _plain(classes[name]), 'as_people': by_people[name]}
                for name, matches in found.items()
            }
    if args.json:
        print_json(report)
    return 0


def scores_by_class(boxes: BoxTable, truth: BoxTable) -> dict[str, Scores]:
    """Return the scores of every class of true boxes with points, and enough of them."""
    by_class = groups(match(boxes, truth, min_points=1))['by_class']
    return {name: scores for name, scores in by_class.items() if scores.boxes >= MIN_CLASS_BOXES}


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
                'boxes': int(mask.sum()),
                'iou_bev': float(bev),
                'iou_3d': float(whole),
            }
    return found


def print_people(found: Mapping[str, Mapping[str, Mapping[str, float]]]) -> None:
    """Print the agreement with the labels as that of people is published, and theirs."""
    print(f'boxes with a point, pairs above {MIN_PAIR_IOU} IoU, by range [m]')
    for row, (iou, title) in enumerate((('iou_bev', 'BEV'), ('iou_3d', '3D'))):
        print(line(title, list(PEOPLE_RANGES)))
        for name, scores in found.items():
            known = [
                scores[label][iou] if label in scores else math.nan for label in PEOPLE_RANGES
            ]
            print(line(name, known))
        people = [PEOPLE.get(label, (math.nan, math.nan))[row] for label in PEOPLE_RANGES]
        print(line('people, on Waymo', people))


def _scores(drive: Drive, matches: Matches) -> dict[str, Any]:
    by_group = iou_by_group(iou_and_group_values(drive, matches, '3d'))
    return asdict(summarise(matches)) | by_group


def _compared(name: str, found: Mapping[str, Matches | str], truth: BoxTable) -> dict[str, Any]:
    """Return the differences to other methods by scope, and the scores of moving objects."""
    measured = _measured(found)
    scopes = scopes_of(measured[name], truth)
    report: dict[str, Any] = {
        'differences': {
            scope: {
                other: asdict(difference)
                for other, difference in differences(name, measured, truth, mask).items()
            }
            for scope, mask in scopes.items()
        }
    }
    if 'moving' in scopes:
        s = summarise(measured[name], scopes['moving'])
        yaw = math.degrees(s.aoe_median)
        report['moving'] = {
            'boxes': s.boxes, 'iou_bev': s.iou_bev, 'iou_3d': s.iou_3d, 'yaw_degrees': yaw
        }  # fmt: skip
    return report


def scopes_of(matches: Matches, truth: BoxTable) -> dict[str, Mask]:
    """Return which of the n true boxes count: all, and those of moving objects if there are."""
    _, codes = np.unique(np.array(truth.track_ids, str), return_inverse=True)
    extents = [np.ptp(truth.boxes[codes == code, :2], axis=0) for code in np.unique(codes)]
    moves = np.linalg.norm(extents, axis=1) >= MIN_PATH_EXTENT
    moving: Mask = moves[codes[matches.rows]]
    whole = np.ones(len(moving), bool)
    return {'all': whole, 'moving': moving} if moving.any() else {'all': whole}


def _measured(found: Mapping[str, Matches | str]) -> dict[str, Matches]:
    return {name: m for name, m in found.items() if not isinstance(m, str)}


def print_differences(truth: BoxTable, found: Mapping[str, Matches | str]) -> None:
    """Print IoU and median yaw error of moving objects, and the differences between methods."""
    measured = _measured(found)
    scopes = scopes_of(measured['input'], truth)
    if 'moving' in scopes:
        moving = scopes['moving']
        print(line(f'moving: {moving.sum()} boxes', ('BEV', '3D', 'yaw [deg]')))
        for name, matches in measured.items():
            s = summarise(matches, moving)
            print(line(name, (s.iou_bev, s.iou_3d, math.degrees(s.aoe_median))))
    for scope, mask in scopes.items():
        for name in measured:
            found_differences = differences(name, measured, truth, mask)
            if found_differences:
                print_comparison(f'{name}, {scope}, minus', found_differences)
    print()


def print_comparison(title: str, found: Mapping[str, Difference]) -> None:
    """Print the differences of one method, one line for each method that it is compared with."""
    print(line(title, ('BEV', '+-', '3D', '+-', 'tracks', 'ahead')))
    for other, d in found.items():
        numbers = (d.iou_bev, d.iou_bev_error, d.iou_3d, d.iou_3d_error)
        counts = (str(d.tracks), str(d.tracks_ahead))
        print(line(other, (*(f'{number:.4f}' for number in numbers), *counts)))


def _plain(classes: Mapping[str, Scores]) -> dict[str, dict[str, float]]:
    return {
        name: {'boxes': s.boxes, 'iou_bev': s.iou_bev, 'iou_3d': s.iou_3d}
        for name, s in classes.items()
    }


def print_classes(found: Mapping[str, Mapping[str, Scores]]) -> None:
    """Print one table of BEV and 3D IoU for each class, of all its true boxes with points."""
    for class_name, scores in found['input'].items():
        print(line(f'{class_name}: {scores.boxes} true boxes with points', ''))
        print(line('', ('BEV', '3D')))
        for name, classes in found.items():
            print(line(name, (classes[class_name].iou_bev, classes[class_name].iou_3d)))
    print()


def print_tables(folder: Path, drive: Drive, found: Mapping[str, Matches | str]) -> None:
    """Print one table of scores, and 3D IoU by range and by number of points."""
    measured = _measured(found)
    count = len(measured['input'].rows)
    print(f'{folder}: {count} true boxes')
    recalls = [f'R@{level}' for level in RECALLS]
    print(line('', ('BEV', '3D', *recalls, 'ATE', 'ASE', 'AOE', 'flips', 'jitter')))
    for name, matches in found.items():
        if isinstance(matches, str):
            print(line(name, matches))
            continue
        s = summarise(matches)
        numbers = (s.iou_bev, s.iou_3d, *s.recall_3d, s.ate, s.ase, s.aoe, s.flips, s.jitter)
        print(line(name, numbers))
    by_group = {
        name: iou_by_group(iou_and_group_values(drive, matches, '3d'))
        for name, matches in measured.items()
    }
    print_groups(by_group, '3D')
    print()


def iou_and_group_values(drive: Drive, matches: Matches, mode: str) -> Floats:
    """
    Return (n, 3): for each true box its IoU, range [m] and number of points, to group by.

    The IoU of `mode` is NaN without a prediction.

    """
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


def print_groups(found: Mapping[str, Groups], iou: str) -> None:
    """Print the `iou_by_group` of each method; `iou` names the kind of IoU."""
    for grouping, title in GROUPINGS.items():
        labels = list(dict.fromkeys(key for one in found.values() for key in one[grouping]))
        print(line(f'{iou} {title}', labels))
        for name, one in found.items():
            print(line(name, [one[grouping].get(label, math.nan) for label in labels]))
