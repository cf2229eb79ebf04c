"""The command line of `boxreg bench speed`. Every ratio is of times from one run."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
import json
import os
from pathlib import Path
from typing import Any

from boxreg_ros.bench.common import print_json
from boxreg_ros.bench.speed.recordings import relabel
from boxreg_ros.bench.speed.reference import compare
from boxreg_ros.bench.speed.scaling import cores, crop, held_tracks, scaling, tick
from boxreg_ros.config import Config
import numpy as np

WANTED = {
    'ticks: 8': 2.0, 'ticks: 64': 8.0, 'ticks: 512': 50.0, 'held tracks': 400.0,
    'solver: times faster': 150.0, 'relabel: faster, long': 15.0, 'relabel: start': 1.5,
    'relabel: help': 0.5, 'relabel: memory, shared once': 700.0,
}  # fmt: skip
"""Aims by the name of the number. Chosen."""
UNITS_OF_SPEED = 'times of relabel in s, all others in ms; memory in MB; load when it began'


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
    earlier = {}
    if args.baseline:
        earlier = json.loads(args.baseline.read_text(encoding='utf-8'))['results']
    print(text(report, earlier))
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


def text(report: dict[str, Any], earlier: dict[str, Any]) -> str:
    """Return all numbers of a report beside their aims and those of an earlier one, in columns."""
    before = dict(_numbers(earlier))
    lines = [f'{"":44}{"measured":>12}{"wanted":>8}{"before":>12}{"ratio":>8}']
    for name, value in _numbers(report):
        wanted = f'{WANTED[name]:g}' if name in WANTED else ''
        cells = f'{value:12.4g}{wanted:>8}'
        if name in before:
            ratio = f'{before[name] / value:.2f}' if value else '-'
            cells += f'{before[name]:12.4g}{ratio:>8}'
        lines.append(f'{name:44}{cells}')
    reason = report['crop'].get('reason')
    return '\n'.join([*lines, UNITS_OF_SPEED, *filter(None, [reason])])


def _numbers(value: Any, name: str = '') -> Iterator[tuple[str, float]]:
    """Yield the name and value of every number in a report."""
    if isinstance(value, dict):
        for key, part in value.items():
            yield from _numbers(part, f'{name}: {key}' if name else str(key))
    elif isinstance(value, list):
        for key, part in value:
            yield from _numbers(part, f'{name}: {key}')
    elif isinstance(value, int | float):
        yield name, float(value)


def draw_scaling(table: dict[str, list[tuple[int, float]]], path: Path) -> Path:
    """Draw the time per window and return the path of the picture."""
    import matplotlib

    matplotlib.use('Agg')
    from matplotlib import pyplot

    figure, panels = pyplot.subplots(
        1, len(table), figsize=(4 * len(table), 3.6), sharey=True, squeeze=False,
        layout='constrained',
    )  # fmt: skip
    for panel, (name, rows) in zip(panels[0], table.items(), strict=True):
        x, y = np.array(rows).T
        panel.loglog(x, y, 'o-')
        panel.set_xlabel(
            {'length': 'boxes per window', 'points': 'points per box'}.get(name, name)
        )
        panel.set_xticks(x, [f'{value:g}' for value in x])
        panel.set_xticks([], minor=True)
        panel.grid(which='both', alpha=0.3)
    panels[0, 0].set_ylabel('ms per window')
    figure.savefig(path, dpi=120)
    return path
