"""The command line of `boxreg bench speed`. Every ratio is of times from one run."""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path
from typing import Any

from boxreg_ros.bench.common import print_json
from boxreg_ros.bench.speed.recordings import relabel
from boxreg_ros.bench.speed.reference import compare
from boxreg_ros.bench.speed.report import beside, draw_scaling, text
from boxreg_ros.bench.speed.scaling import cores, crop, held_tracks, scaling, tick
from boxreg_ros.config import Config


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `boxreg bench speed`."""
    parser.add_argument('--json', action='store_true', help='print one JSON object')
    parser.add_argument('-o', '--out', type=Path, help='folder for the picture of the scaling')
    parser.add_argument('--quick', action='store_true', help='fewer and smaller cases')
    parser.add_argument(
        '--references', type=int, default=24, metavar='N',
        help='windows also fitted by torch.optim.LBFGS (default: %(default)s)',
    )  # fmt: skip
    parser.add_argument(
        '--baseline', type=Path, metavar='FILE',
        help='output of an earlier run with --json, to print beside this one',
    )  # fmt: skip


def run(args: argparse.Namespace) -> int:
    """Measure and print."""
    report = measure(args)
    if args.out:
        args.out.mkdir(parents=True, exist_ok=True)
        report['plot'] = str(draw_scaling(report['scaling'], args.out / 'speed.png'))
    if args.json:
        print_json(report)
        return 0
    print(text(report))
    if args.baseline:
        earlier = json.loads(args.baseline.read_text(encoding='utf-8'))
        print(beside(earlier['results'], report))
    return 0


def measure(args: argparse.Namespace) -> dict[str, Any]:
    """Return the report, with the load of the machine when it began."""
    config = Config(estimate='final')
    count, tracks, points = (8, 8, 20_000) if args.quick else (64, 64, 130_000)
    sizes, most_windows, most_tracks = [8, 64, 512], 512, 2048
    if args.quick:
        sizes, most_windows, most_tracks = [2, 8], 8, 8
    load = os.getloadavg()[0]
    first = tick(config, tracks, points)  # its first tick is that of the process
    return {
        'load': load,
        'windows': count,
        'most windows': most_windows,
        'tick': first,
        'ticks': {str(n): tick(config, n, points)['total'] for n in sizes},
        'held tracks': held_tracks(config, points, most_tracks),
        'crop': crop(config, tracks, points),
        'solver': compare(config, count, 2 if args.quick else args.references),
        'scaling': scaling(config, args.quick),
        'cores': cores(config, most_windows),
        'relabel': relabel(tracks, points, 3.0 if args.quick else 20.0),
    }
