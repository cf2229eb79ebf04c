"""The report of `boxreg bench speed` as text and pictures, and beside an earlier one."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from boxreg_ros.bench.speed.streams import SWEEP_PERIOD
import numpy as np

WANTED = {'faster, long': 15.0, 'start': 1.5, 'help': 0.5, 'memory, shared once': 700.0}
"""Aims of `boxreg relabel`: at least so many times as fast as the recording lasts, at most so many
seconds and MB. Chosen."""


WANTED_TIMES = 150.0
"""Aim of `refine`: so many times faster than the reference. Chosen."""
WANTED_TICKS = {'8': 2.0, '64': 8.0, '512': 50.0}
"""Aim of a tick by number of tracks: at most so many ms. Chosen."""
WANTED_TRACKS = 400
"""Aim: so many tracks held at 10 Hz on two cores. Chosen."""


def text(report: dict[str, Any]) -> str:
    """Return the report of `command.measure` as text."""
    return '\n'.join([
        f'load of the machine {report["load"]:.1f} when it began',
        *_solver_lines(report['solver'], report['windows']),
        *_scaling_lines(report['scaling']),
        *_tick_lines(report),
        _crop_line(report['crop']),
        *_relabel_lines(report['relabel']),
    ])  # fmt: skip


def _scaling_lines(found: dict[str, Any]) -> list[str]:
    """Return the lines of the times by number of windows, observations and points."""
    lines = []
    for name, rows in found.items():
        cells = '   '.join(f'{x}: {y:.2f}' for x, y in rows)
        lines.append(f'ms per window over {name:8s} {cells}')
    rates = '   '.join(f'{x}: {1e3 / y:,.0f}' for x, y in found['windows'])
    lines.append(f'windows per second        {rates}')
    return lines


def _tick_lines(report: dict[str, Any]) -> list[str]:
    """Return the lines of ticks, of tracks that are held, and of cores."""
    tick = report['tick']
    stages = ('decode', 'transform', 'crop and sample', 'solve', 'encode')
    shares = ', '.join(f'{k} {tick[k]:.1f} ({tick[k] / tick["total"]:.0%})' for k in stages)
    lines = [
        f'one tick: {tick["total"]:.1f} ms of {1e3 * SWEEP_PERIOD:.0f}: {shares}',
        f'the first tick of the process that solves: {tick["first"]:.0f} ms, '
        f'that of the first full window: {tick["first full"]:.0f} ms',
    ]
    for tracks, found in report['ticks'].items():
        wanted = f' (wanted: {WANTED_TICKS[tracks]:g})' if tracks in WANTED_TICKS else ''
        lines.append(f'one tick of {tracks} tracks: {found:.1f} ms{wanted}')
    lines.append(
        f'tracks held at {1 / SWEEP_PERIOD:.0f} Hz, none dropped: {report["held tracks"]} '
        f'(wanted: {WANTED_TRACKS})'
    )
    times = ', '.join(f'{name} {ms:.0f} ms' for name, ms in report['cores'].items())
    lines.append(f'{report["most windows"]} windows: {times}')
    return lines


def _crop_line(found: dict[str, Any]) -> str:
    """Return the line of the crop, beside the same by other libraries."""
    ours, by_numpy, by_open3d = (
        found[name] for name in ('ours', 'numpy, box by box', 'Open3D, box by box')
    )
    other = found['reason']
    if by_open3d:
        other = f'with Open3D {by_open3d:.0f} ms ({by_open3d / ours:.0f} times)'
    return (
        f'crop of all boxes: {ours:.1f} ms; box by box with numpy {by_numpy:.0f} ms '
        f'({by_numpy / ours:.0f} times), {other}'
    )


def _relabel_lines(found: dict[str, Any]) -> list[str]:
    """Return the lines of `boxreg relabel`: speed, start and memory."""
    stages = ('read', 'decode', 'transform', 'registrar', 'solve', 'write')
    busy = ', '.join(f'{name} {found[name]:.1f}' for name in stages)
    few = f'{found["few"]:,} points'
    return [
        f'relabel: {found["faster"]:.1f} times faster than the recording lasts '
        f'({found["total"]:.1f} s; {found["compressed"]:.1f} times where it is compressed; busy, '
        f'partly at once: {busy}), all but the solve {found["rest"]:.0%}',
        f'ten times as long, sweeps of {few}: {found["faster, long"]:.1f} times faster '
        f'than it lasts (wanted: {WANTED["faster, long"]:g}), all but the solve '
        f'{found["rest, long"]:.0%}, {found["cores, long"]:.1f} cores busy',
        f'the recording is open after {found["start"]:.2f} s (wanted: {WANTED["start"]:g}); '
        f'relabel --help takes {found["help"]:.2f} s (wanted: {WANTED["help"]:g})',
        f'peak memory of all its processes, shared pages counted once: '
        f'{found["memory, shared once"]:.0f} MB (wanted: {WANTED["memory, shared once"]:g}), in '
        f'each process {found["memory"]:.0f} MB; sweeps of {few} {found["short"]:.0f} MB, ten '
        f'times as long {found["long"]:.0f} MB',
    ]


def _solver_lines(found: dict[str, float], count: int) -> list[str]:
    """Return the lines of the solver and of the reference."""
    lines = ['one window of 10 boxes x 128 points, 3d']
    for name, label, time in (
        ('input', 'input', ''),
        ('reference', 'one fit by torch.optim.LBFGS', f'{found["reference"]:.3f} ms'),
        ('ours', 'the solver alone, cold', f'{found["cold"]:.3f} ms'),
    ):
        lines.append(
            f'  {label:30s} {time:>12s}   IoU {found[f"IoU, {name}"]:.3f}   '
            f'value {found[f"value, {name}"]:.2f}'
        )
    for name, label in (
        ('cold', 'the solver alone, cold'),
        ('warm', 'the solver alone, warm'),
        ('refine, track', f'refine of {count} tracks, each solved once'),
        ('refine', 'the same, solved for every box (final)'),
    ):
        times = found['reference'] / found[name]
        wanted = f' (wanted: {WANTED_TIMES:g})' if name == 'refine, track' else ''
        lines.append(f'  {label:40s} {found[name]:8.3f} ms, {times:5.0f} times faster{wanted}')
    lines.append(
        f'  IoU of ours less that of the reference: '
        f'{found["IoU, ours"] - found["IoU, reference"]:+.3f} +- {found["IoU, error"]:.3f}'
    )
    return lines


def beside(earlier: dict[str, Any], report: dict[str, Any]) -> str:
    """Return all numbers of an earlier report and of this one in columns, with ratios."""
    before = dict(_numbers(earlier))
    lines = [f'{"":44}{"before":>12}{"after":>12}{"ratio":>8}']
    for name, value in _numbers(report):
        if name in before:
            ratio = f'{before[name] / value:8.2f}' if value else f'{"-":>8}'
            lines.append(f'{name:44}{before[name]:12.4g}{value:12.4g}{ratio}')
    return '\n'.join(lines)


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
