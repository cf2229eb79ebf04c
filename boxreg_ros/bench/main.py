"""
`boxreg bench`: the paper's experiment, recordings with known truth, and speed.

All methods of a table see the same sweeps and the same boxes, in the same run.

"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from importlib import import_module
from itertools import pairwise
import json
import math
from pathlib import Path
import sys
from typing import Any

from boxreg_ros.bench.baselines import icp, l_shaped, smoothed, smoothed_live
from boxreg_ros.bench.scope import add_scope_arguments, in_scope, line
from boxreg_ros.config import Config
from boxreg_ros.core.refine import Track
from boxreg_ros.errors import BoxregError, ConfigError
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.offline.drive import Drive
from boxreg_ros.offline.evaluate import finite, match, Matches, RECALLS, summarise
from boxreg_ros.rotations import matrix_from_rpy
from boxreg_ros.simulation.simulate import simulate
from boxreg_ros.structures import (
    Floats,
    LENGTH,
    ROLL,
    WIDTH,
)
import numpy as np
from tqdm import tqdm

RANGE_BINS = (0, 20, 40, 80, math.inf)  # [m]
POINT_BINS = (0, 30, 100, 300, 1000, math.inf)
PARTS = {'by_range': 'by range [m]', 'by_points': 'by points'}
VARIABLES = ('x', 'y', 'z', 'roll', 'pitch', 'yaw')

# Table I: mean absolute errors [m, rad] and IoU, as published.
PUBLISHED: dict[str, dict[str, tuple[float, ...]]] = {
    '3d': {
        'initial, published': (0.392, 0.124, 0.082, 0.083, 0.1, 0.18, 0.573),
        'refined, published': (0.121, 0.049, 0.012, 0.031, 0.034, 0.053, 0.816),
    },
    'bev': {
        'initial, published': (0.392, 0.124, math.nan, math.nan, math.nan, 0.18, 0.618),
        'refined, published': (0.054, 0.006, math.nan, math.nan, math.nan, 0.032, 0.896),
    },
}
SCENARIOS = {'3d': 'paper', 'bev': 'paper-bev'}

BASELINES: dict[str, tuple[str, Callable[[Track], Floats]]] = {
    'smoothing': ('smoothing only', smoothed),
    'l-shape': ('L-shape per sweep', l_shaped),
    'icp': ('ICP on box points', icp),
}
METHODS = (*BASELINES, 'paper', 'ours')

Methods = dict[str, BoxTable | str]
"""Boxes by the name of their method, or why there are none."""


def run_methods(
    drive: Drive,
    mode: str = '3d',
    wanted: Sequence[str] = METHODS,
    done: Callable[[], object] = lambda: None,
) -> Methods:
    """
    Return what every method makes of the boxes of a drive.

    Parameters
    ----------
    drive : Drive
        What all of them see.
    mode : str
        As `Config.mode`, for the methods that know it.
    wanted : sequence of str
        Some of `METHODS`.
    done : callable
        Called after each of them.

    """
    methods: Methods = {'input': BoxTable.from_arrays(drive.boxes)}
    tracks = drive.tracks() if not BASELINES.keys().isdisjoint(wanted) else []
    for method in METHODS:
        if method not in wanted:
            continue
        if method == 'smoothing':
            live = [smoothed_live(track, Config().lag) for track in tracks]
            for k, estimate in enumerate(('early', 'final')):
                methods[f'smoothing, {estimate}'] = _table(tracks, [b[k] for b in live], drive)
        if method in BASELINES:
            name, baseline = BASELINES[method]
            try:
                methods[name] = _table(tracks, [baseline(track) for track in tracks], drive)
            except ImportError as error:
                methods[name] = f'skipped: {error.name} is not installed'
        else:
            objective = 'paper' if method == 'paper' else Config().objective
            estimates = ('track',) if method == 'paper' else ('final', 'track')
            for estimate in estimates:
                config = Config(objective=objective, estimate=estimate, mode=mode)
                found = drive.registered(config)
                methods |= {f'{method}, {name}': boxes for name, boxes in found.items()}
        done()
    return methods


def bench_paper(args: argparse.Namespace) -> int:
    """Print the paper's Table I beside ours, over several seeds, and draw its two figures."""
    if args.seeds < 1:
        raise ConfigError(f'--seeds: expected 1 or more, got {args.seeds}')
    results: dict[str, dict[str, list[tuple[float, ...] | str]]] = {}
    sights: dict[str, dict[str, list[Floats]]] = {}
    with _progress(args, 2 * args.seeds) as bar:
        for mode, scenario in SCENARIOS.items():
            found = results.setdefault(mode, {})
            for seed in range(args.seeds):
                drive = Drive.from_scene(simulate(scenario, seed, args.steps))
                methods = run_methods(drive, mode, args.methods, bar.update)
                for name, boxes in methods.items():
                    if isinstance(boxes, str):
                        found.setdefault(name, []).append(boxes)
                        continue
                    matches = match(boxes, drive.truth)
                    found.setdefault(name, []).append(paper_row(matches, mode))
                    seen = sights.setdefault(mode, {}).setdefault(name, [])
                    seen.append(sighted(drive, matches, mode))
                if seed == 0:
                    draw_paper(args.output, mode, methods, drive.truth)
    names = (*VARIABLES, 'iou', 'iou_first', 'iou_last')
    means = {
        mode: {name: _mean_row(rows) for name, rows in found.items()}
        for mode, found in results.items()
    }
    parts = {
        mode: {name: by_part(np.concatenate(rows)) for name, rows in found.items()}
        for mode, found in sights.items()
    }
    if args.json:
        report: dict[str, Any] = {m: {**PUBLISHED[m], **rows} for m, rows in means.items()}
        for mode, rows in report.items():
            for name, row in rows.items():
                if not isinstance(row, str):
                    named = dict(zip(names, row, strict=False))
                    rows[name] = named | parts[mode].get(name, {})
        print(json.dumps(finite(report)))
        return 0
    for mode, rows in means.items():
        iou = 'IoU 3D' if mode == '3d' else 'IoU BEV'
        print(line(f'Table I, {mode}', (*VARIABLES, iou, 'first', 'last')))
        for name, row in (PUBLISHED[mode] | rows).items():
            print(line(name, row))
        print_parts(parts[mode], iou)
        print()
    print(
        f'{args.seeds} seeds. Mean absolute errors [m, rad], x and y along and across the '
        f'vehicle; IoU of all, of the first and of the last box. Figures: {args.output}'
    )
    return 0


def paper_row(matches: Matches, mode: str) -> tuple[float, ...]:
    """Return six mean absolute errors [m, rad], and the IoU of all, the first and the last box."""
    errors = np.abs(np.concatenate([matches.translation, matches.rotation], axis=1)).mean(axis=0)
    iou = matches.iou_3d if mode == '3d' else matches.iou_bev
    return (*map(float, errors), float(iou.mean()), float(iou[0]), float(iou[-1]))


def bench_real(args: argparse.Namespace) -> int:
    """Print, for every recording, what each method makes of its boxes."""
    report: dict[str, Any] = {}
    with _progress(args, len(args.data)) as bar:
        for folder in args.data:
            drive = Drive.read(folder)
            methods = run_methods(drive, '3d', args.methods, bar.update)
            found = {
                name: boxes if isinstance(boxes, str) else in_scope(boxes, drive.truth, args)
                for name, boxes in methods.items()
            }
            if not args.json:
                bar.clear()
                print_real(folder, drive, found)
            report[str(folder)] = {
                name: m if isinstance(m, str)
                else asdict(summarise(m)) | by_part(sighted(drive, m, '3d'))
                for name, m in found.items()
            }  # fmt: skip
    if args.json:
        print(json.dumps(finite(report)))
    return 0


def print_real(folder: Path, drive: Drive, found: Mapping[str, Matches | str]) -> None:
    """Print one table of scores, and 3D IoU by range and by number of points."""
    whole = next(m for m in found.values() if not isinstance(m, str))
    print(f'{folder}: {len(whole.rows)} true boxes')
    names = ['BEV', '3D', *(f'R@{level}' for level in RECALLS), 'ATE', 'ASE', 'AOE', 'flips']
    print(line('', (*names, 'jitter')))
    for name, matches in found.items():
        if isinstance(matches, str):
            print(line(name, matches))
            continue
        s = summarise(matches)
        numbers = (s.iou_bev, s.iou_3d, *s.recall_3d, s.ate, s.ase, s.aoe, s.flips, s.jitter)
        print(line(name, numbers))
    print_parts(
        {n: by_part(sighted(drive, m, '3d')) for n, m in found.items() if not isinstance(m, str)},
        '3D',
    )
    print()


def sighted(drive: Drive, matches: Matches, mode: str) -> Floats:
    """Return IoU of the mode (NaN without a prediction), range [m] and points of true boxes."""
    iou = np.where(matches.is_matched, matches.iou_3d if mode == '3d' else matches.iou_bev, np.nan)
    return np.stack([iou, drive.ranges(matches.rows), matches.num_points], axis=1)


def by_part(rows: Floats) -> dict[str, dict[str, float]]:
    """Return mean IoU by range and by number of points, of rows (n, 3) as `sighted` has them."""
    iou, *by = rows[np.isfinite(rows).all(axis=1)].T
    found: dict[str, dict[str, float]] = {}
    for what, values, edges in zip(PARTS, by, (RANGE_BINS, POINT_BINS), strict=True):
        found[what] = {}
        for low, high in pairwise(edges):
            label = f'{low:g}-{high:g}' if math.isfinite(high) else f'{low:g}+'
            mask = (values >= low) & (values < high)
            if mask.any():
                found[what][label] = float(iou[mask].mean())
    return found


def print_parts(found: Mapping[str, Mapping[str, Mapping[str, float]]], iou: str) -> None:
    """Print what `by_part` found of each method."""
    for what, title in PARTS.items():
        labels = list(dict.fromkeys(label for parts in found.values() for label in parts[what]))
        print(line(f'{iou} {title}', labels))
        for name, parts in found.items():
            print(line(name, [parts[what].get(label, math.nan) for label in labels]))


def draw_paper(folder: Path, mode: str, methods: Methods, truth: BoxTable) -> None:
    """Draw trajectory and errors over time as PNG files: truth, input and the last method."""
    try:
        import matplotlib
    except ImportError:
        raise BoxregError('figures need matplotlib: pip install matplotlib') from None
    matplotlib.use('Agg')
    from matplotlib import pyplot

    folder.mkdir(parents=True, exist_ok=True)
    found = [boxes for boxes in methods.values() if isinstance(boxes, BoxTable)]
    shown = {'truth': truth, 'initial': found[0], 'refined': found[-1]}
    colors = {'truth': 'tab:red', 'initial': 'tab:green', 'refined': 'tab:blue'}
    figure, axes = pyplot.subplots(figsize=(7, 9))
    for name, boxes in shown.items():
        for i, box in enumerate(boxes.boxes[::5]):
            outline = _footprint(box)
            axes.plot(*outline.T, color=colors[name], lw=0.9, label=name if i == 0 else None)
    axes.set(aspect='equal', xlabel='x [m]', ylabel='y [m]', title=f'every fifth box, {mode}')
    axes.legend()
    figure.savefig(folder / f'paper_{mode}_trajectory.png', dpi=150, bbox_inches='tight')
    pyplot.close(figure)

    figure, panels = pyplot.subplots(3, 2, figsize=(11, 8), sharex=True)
    for name in ('initial', 'refined'):
        matches = match(shown[name], truth)
        seconds = (truth.stamps_ns - truth.stamps_ns[0]) / 1e9
        errors = np.concatenate([matches.translation, matches.rotation], axis=1)
        for variable, panel, values in zip(VARIABLES, panels.T.flat, errors.T, strict=True):
            panel.plot(seconds, values, color=colors[name], lw=0.9, label=name)
            panel.set_ylabel(f'{variable} [{"m" if variable in "xyz" else "rad"}]')
            panel.axhline(0, color='gray', lw=0.5)
    panels[0, 0].legend()
    for panel in panels[-1]:
        panel.set_xlabel('time [s]')
    figure.savefig(folder / f'paper_{mode}_errors.png', dpi=150, bbox_inches='tight')
    pyplot.close(figure)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what `run` reads."""
    kinds = parser.add_subparsers(
        dest='kind', required=True, metavar='{paper,real,ablation,speed,node}'
    )
    paper = kinds.add_parser('paper', help="the paper's experiment: its Table I and two figures")
    paper.add_argument(
        '--seeds', type=int, default=3, metavar='N', help='repetitions (default: 3)'
    )
    paper.add_argument(
        '--steps', type=int, metavar='N', help='boxes per repetition (default: all 100)'
    )
    paper.add_argument(
        '-o', '--output', type=Path, default=Path('out/bench'), metavar='DIR',
        help='where the figures go (default: out/bench)',
    )  # fmt: skip
    real = kinds.add_parser('real', help='recordings with known truth')
    add_scope_arguments(real)
    for kind in (paper, real):
        kind.add_argument(
            '--methods', nargs='+', choices=METHODS, default=METHODS, metavar='METHOD',
            help=f'only some of {", ".join(METHODS)}',
        )  # fmt: skip
        kind.add_argument('--json', action='store_true', help='print one JSON object')
    speed = kinds.add_parser('speed', help='time per tick, per box and per window')
    import_module('boxreg_ros.bench.speed').add_arguments(speed)
    ablation = kinds.add_parser('ablation', help='what each ingredient is worth')
    import_module('boxreg_ros.bench.ablation').add_arguments(ablation)
    node = kinds.add_parser('node', help='the live node under load, over DDS')
    import_module('boxreg_ros.bench.node').add_arguments(node)


def run(args: argparse.Namespace) -> int:
    """Run one kind of bench and print its table."""
    if args.kind in ('ablation', 'speed', 'node'):
        return int(import_module(f'boxreg_ros.bench.{args.kind}').run(args))
    return bench_paper(args) if args.kind == 'paper' else bench_real(args)


def _table(tracks: Sequence[Track], boxes: Sequence[Floats], drive: Drive) -> BoxTable:
    total = sum(len(track.boxes) for track in tracks)
    return BoxTable(
        np.concatenate([np.zeros(0, np.int64), *(track.stamps_ns for track in tracks)]),
        drive.truth.frame_id,
        tuple(track.track_id for track in tracks for _ in track.boxes),
        tuple(track.class_name for track in tracks for _ in track.boxes),
        np.ones(total),
        np.concatenate([np.zeros((0, 9)), *boxes]),
        ('baseline',) * total,
        np.zeros(total, np.int64),
    )


def _footprint(box: Floats) -> Floats:
    """Return the outline (6, 2) of a box from above, with a stroke forward."""
    corners = np.array([[1, 0], [1, 1], [-1, 1], [-1, -1], [1, -1], [1, 0], [1.4, 0]])
    R = matrix_from_rpy(box[ROLL:])[:2, :2]
    outline: Floats = corners * box[[LENGTH, WIDTH]] / 2 @ R.T + box[:2]
    return outline


def _mean_row(found: Sequence[tuple[float, ...] | str]) -> tuple[float, ...] | str:
    rows = [row for row in found if not isinstance(row, str)]
    return tuple(np.mean(rows, axis=0).tolist()) if rows else str(found[0])


def _progress(args: argparse.Namespace, total: int) -> Any:
    total *= len(args.methods)
    return tqdm(total=total, leave=False, disable=not sys.stderr.isatty() or args.json)
