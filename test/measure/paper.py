"""`measure paper`: the paper's Table I beside ours, over several seeds, and two figures."""

from __future__ import annotations

import argparse
from dataclasses import replace
import math
from pathlib import Path
from typing import Any

from boxreg_ros.config import Config
from boxreg_ros.errors import BoxregError, ConfigError
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.offline.box_scores import match, Matches
from boxreg_ros.rotations import matrix_from_rpy
from boxreg_ros.simulation.simulate import simulate
from boxreg_ros.structures import Floats, LENGTH, ROLL, WIDTH
from measure.drives import Drive
from measure.methods import METHOD_OPTION, Methods, run_methods
from measure.real import iou_and_group_values, iou_by_group
import numpy as np

VARIABLES = ('x', 'y', 'z', 'roll', 'pitch', 'yaw')
ERROR_COLUMNS = (*VARIABLES, 'iou', 'iou_first', 'iou_last', 'iou_full')

# Table I of the paper: mean absolute errors [m, rad] and mean IoU.
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
PAPER_SCENARIOS = {'3d': 'paper', 'bev': 'paper-bev'}


class ModeResult:
    """
    Rows of one mode, collected over the seeds, per method.

    `rows` has one `error_row` per seed, or the reason why the method did not run, `group_values`
    one `iou_and_group_values` (n, 3).

    """

    def __init__(self) -> None:
        self.rows: dict[str, list[tuple[float, ...] | str]] = {}
        self.group_values: dict[str, list[Floats]] = {}

    def add(self, drive: Drive, methods: Methods, mode: str) -> None:
        """Add the boxes of one seed."""
        for name, boxes in methods.items():
            rows = self.rows.setdefault(name, [])
            if isinstance(boxes, str):
                rows.append(boxes)
                continue
            matches = match(boxes, drive.truth)
            rows.append(error_row(matches, mode))
            values = iou_and_group_values(drive, matches, mode)
            self.group_values.setdefault(name, []).append(values)

    def means(self) -> dict[str, tuple[float, ...] | str]:
        """Return per method the mean row over the seeds."""
        means: dict[str, tuple[float, ...] | str] = {}
        for name, found in self.rows.items():
            rows = [row for row in found if not isinstance(row, str)]
            means[name] = tuple(np.mean(rows, axis=0).tolist()) if rows else str(found[0])
        return means

    def groups(self) -> dict[str, dict[str, dict[str, float]]]:
        """Return per method the mean IoU by range and by number of points, of all seeds."""
        return {
            name: iou_by_group(np.concatenate(values))
            for name, values in self.group_values.items()
        }


ARGUMENTS = {
    '--seeds': (3, 'repetitions'),
    '--steps': (int, 'boxes per repetition (default: all 100)'),
    '--output': (Path('out/paper'), 'folder for the figures', {'metavar': 'DIR'}),
    '--methods': METHOD_OPTION,
}


def run(args: argparse.Namespace) -> dict[str, Any]:
    """Return Table I and draw the two figures, which need matplotlib."""
    if args.seeds < 1:
        raise ConfigError(f'--seeds: expected 1 or more, got {args.seeds}')
    results: dict[str, ModeResult] = {}
    for mode, scenario in PAPER_SCENARIOS.items():
        results[mode] = ModeResult()
        for seed in range(args.seeds):
            drive = Drive.from_scene(simulate(scenario, seed, args.steps))
            methods = run_methods(drive, mode, args.methods)
            results[mode].add(drive, methods, mode)
            if 'ours' in args.methods:
                results[mode].add(drive, _with_held_extents(drive, mode), mode)
                results[mode].add(drive, _of_short_tracks(drive, mode), mode)
            if seed == 0:
                draw_figures(args.output, mode, methods, drive.truth)
    return {mode: _report(mode, result) for mode, result in results.items()}


def _with_held_extents(drive: Drive, mode: str) -> Methods:
    """Return our estimates with the extents of the input, which the paper does not change."""
    methods: Methods = {}
    for run in ('final', 'track'):
        config = Config(estimate=run, mode=mode, extent='fixed')
        for estimate, boxes in drive.registered(config).items():
            methods[f'held extents, {estimate}'] = boxes
    return methods


def _of_short_tracks(drive: Drive, mode: str) -> Methods:
    """Return our estimates of tracks as long as a window, into which the drive is cut."""
    length = Config().window
    arrays = [
        replace(array, track_ids=tuple(f'{name}/{row // length}' for name in array.track_ids))
        for row, array in enumerate(drive.boxes)
    ]
    short = replace(drive, boxes=tuple(arrays))
    methods: Methods = {}
    for name, extent in (('short tracks', 'track'), ('held extents, short tracks', 'fixed')):
        boxes = short.registered(Config(mode=mode, extent=extent))['track']
        ids = tuple(track_id.partition('/')[0] for track_id in boxes.track_ids)
        methods[name] = replace(boxes, track_ids=ids)
    return methods


def _report(mode: str, result: ModeResult) -> dict[str, Any]:
    """Return the rows of one mode."""
    groups = result.groups()
    report: dict[str, Any] = {}
    for name, row in (PUBLISHED[mode] | result.means()).items():
        if isinstance(row, str):
            report[name] = row
        else:
            report[name] = dict(zip(ERROR_COLUMNS, row, strict=False)) | groups.get(name, {})
    return report


def error_row(matches: Matches, mode: str) -> tuple[float, ...]:
    """
    Return six mean absolute errors [m, rad], and four IoU.

    Mean of all boxes, of the first one, of the last one, and mean of the boxes from the first full
    window on, NaN without any: before that the noise of the input is hardly known.

    """
    errors = np.abs(np.concatenate([matches.translation, matches.rotation], axis=1)).mean(axis=0)
    iou = matches.iou_3d if mode == '3d' else matches.iou_bev
    full = iou[Config().window :]
    mean_full = float(full.mean()) if len(full) else math.nan
    return (*map(float, errors), float(iou.mean()), float(iou[0]), float(iou[-1]), mean_full)


def draw_figures(folder: Path, mode: str, methods: Methods, truth: BoxTable) -> None:
    """Draw trajectory and errors over time of truth, input and the last method as PNG files."""
    try:
        import matplotlib
    except ImportError:
        raise BoxregError('figures need matplotlib: pip install matplotlib') from None
    matplotlib.use('Agg')

    folder.mkdir(parents=True, exist_ok=True)
    found = [boxes for boxes in methods.values() if isinstance(boxes, BoxTable)]
    shown = {'truth': truth, 'initial': found[0], 'refined': found[-1]}
    colors = {'truth': 'tab:red', 'initial': 'tab:green', 'refined': 'tab:blue'}
    _draw_trajectory(folder / f'paper_{mode}_trajectory.png', mode, shown, colors)
    _draw_errors(folder / f'paper_{mode}_errors.png', shown, colors)


def _draw_trajectory(
    path: Path, mode: str, shown: dict[str, BoxTable], colors: dict[str, str]
) -> None:
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(7, 9))
    for name, boxes in shown.items():
        for i, box in enumerate(boxes.boxes[::5]):
            label = name if i == 0 else None
            axes.plot(*_outline(box).T, color=colors[name], lw=0.9, label=label)
    axes.set(aspect='equal', xlabel='x [m]', ylabel='y [m]', title=f'every fifth box, {mode}')
    axes.legend()
    figure.savefig(path, dpi=150, bbox_inches='tight')
    pyplot.close(figure)


def _draw_errors(path: Path, shown: dict[str, BoxTable], colors: dict[str, str]) -> None:
    from matplotlib import pyplot

    truth = shown['truth']
    seconds = (truth.stamps_ns - truth.stamps_ns[0]) / 1e9
    figure, panels = pyplot.subplots(3, 2, figsize=(11, 8), sharex=True)
    for name in ('initial', 'refined'):
        matches = match(shown[name], truth)
        errors = np.concatenate([matches.translation, matches.rotation], axis=1)
        for variable, panel, values in zip(VARIABLES, panels.T.flat, errors.T, strict=True):
            panel.plot(seconds, values, color=colors[name], lw=0.9, label=name)
            panel.set_ylabel(f'{variable} [{"m" if variable in "xyz" else "rad"}]')
            panel.axhline(0, color='gray', lw=0.5)
    panels[0, 0].legend()
    for panel in panels[-1]:
        panel.set_xlabel('time [s]')
    figure.savefig(path, dpi=150, bbox_inches='tight')
    pyplot.close(figure)


def _outline(box: Floats) -> Floats:
    """Return the outline (7, 2) of a box from above, with a stroke that points forward."""
    corners = np.array([[1, 0], [1, 1], [-1, 1], [-1, -1], [1, -1], [1, 0], [1.4, 0]])
    R = matrix_from_rpy(box[ROLL:])[:2, :2]
    outline: Floats = corners * box[[LENGTH, WIDTH]] / 2 @ R.T + box[:2]
    return outline
