"""
`measure pair`: CPU seconds of this checkout beside those of another, by turns in one run.

Both get the same arrays and recordings, which this checkout makes, and each works in processes of
its own environment (`.venv` of the checkout). A ratio below 1 means that this one is faster.

"""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path
from statistics import median
import subprocess
import sys
import tempfile
from typing import Any

from boxreg_ros.config import Config
from boxreg_ros.errors import BoxregError
from boxreg_ros.simulation.simulate import simulate
from measure.drives import Drive
from measure.speed.recordings import write_traffic
from measure.speed.streams import make_windows, traffic
import numpy as np
from paths import ROOT

WORK = Path(__file__).parent / 'work.py'
TICK_TRACKS = (8, 64, 512)
TICK_POINTS = 130_000
TICKS = 20
"""Ticks with full windows, after those that fill them."""
WINDOWS = 64
WINDOW_POINTS = 512
"""Most points of a sweep in a window: half as many as cars have that are near, and as many as it
takes for windows in one place to cost the code of 27 November five times those apart."""
APART = 100.0
"""Distance of windows that share no point [m]."""
SEEDS = 1000
SINGLE = dict.fromkeys(('OMP_NUM_THREADS', 'MKL_NUM_THREADS', 'NUMBA_NUM_THREADS'), '1')
CASES = {
    **{f'tick {n}': f'a warm tick of {n} tracks, early and final boxes' for n in TICK_TRACKS},
    'refine apart': f'`refine` of {WINDOWS} windows that share no point',
    'refine together': f'`refine` of {WINDOWS} windows that overlap',
    'follow': f'`follow` from {SEEDS} seeds',
    'relabel': 'CPU of all processes of `boxreg relabel`',
    'compile': 'first compilation: `boxreg compile` with an empty cache',
}
ARGUMENTS = {
    'other': (Path, 'folder of the other checkout, which has an environment `.venv`'),
    '--repeats': (3, 'runs of each, of which the median counts; one of `compile`'),
    '--seconds': (20.0, 'length of the recording that is relabelled'),
    '--only': ([*CASES], 'only some of', {'nargs': '+', 'choices': [*CASES], 'metavar': 'CASE'}),
}


def run(args: argparse.Namespace) -> dict[str, Any]:
    """Return CPU seconds and peak memory [MB] of both checkouts by case, and their ratios."""
    other = args.other.resolve()
    if not _python(other).exists():
        raise BoxregError(
            f'other: expected a checkout with an environment, but there is no {_python(other)}; '
            f'run `make environments` there'
        )
    results = {}
    with tempfile.TemporaryDirectory(prefix='boxreg-') as name:
        folder = Path(name)
        for case in args.only:
            path = _input(case, folder, args.seconds)
            repeats = 1 if case == 'compile' else args.repeats
            runs: dict[str, list[dict[str, float]]] = {'other': [], 'this': []}
            for _ in range(repeats):
                for which, checkout in (('other', other), ('this', ROOT)):
                    runs[which].append(_measured(checkout, case, path, folder))
            results[case] = _compared(runs)
            print(f'{case}: {json.dumps(results[case])}', file=sys.stderr)
            path.unlink(missing_ok=True)
    return results


def _compared(runs: dict[str, list[dict[str, float]]]) -> dict[str, float]:
    """Return the median of each figure of each checkout, and the ratio of this to the other."""
    compared = {}
    for figure in runs['this'][0]:
        other, this = (median(run[figure] for run in runs[which]) for which in ('other', 'this'))
        compared |= {f'{figure}, other': other, f'{figure}, this': this}
        compared[f'{figure}, ratio'] = this / other
    return compared


def _measured(checkout: Path, case: str, path: Path, folder: Path) -> dict[str, float]:
    """Run one case in a process of a checkout's environment; return its figures."""
    with tempfile.TemporaryDirectory(dir=folder) as empty:
        done = subprocess.run(
            [_python(checkout), str(WORK), case, str(path), empty],
            cwd=checkout,
            env=os.environ | SINGLE,
            capture_output=True,
            text=True,
            check=False,
        )
    if done.returncode:
        raise BoxregError(f'{case} failed in {checkout}: {done.stderr.strip()[-2000:]}')
    figures: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    return figures


def _python(checkout: Path) -> Path:
    return checkout / '.venv' / 'bin' / 'python'


def _input(case: str, folder: Path, seconds: float) -> Path:
    """Write what a case works on."""
    kind, _, size = case.partition(' ')
    path = folder / f'{kind}.npz'
    if kind == 'relabel':
        path = folder / 'drive.mcap'
        write_traffic(path, 64, TICK_POINTS, round(seconds * 10))
    elif kind == 'tick':
        np.savez(path, **_stream(int(size)))
    elif kind == 'refine':
        np.savez(path, **_tracks(APART if size == 'apart' else 0.0))
    elif kind == 'follow':
        np.savez(path, **_seeded())
    return path


def _stream(tracks: int) -> dict[str, Any]:
    """Return the sweeps and boxes of a live stream in the fixed frame."""
    instants = list(traffic(tracks, TICK_POINTS, Config().window + 2 + TICKS))
    moved = [i.T_fixed_sensor[:3, 3] for i in instants]
    boxes = np.array([i.boxes.boxes for i in instants])
    boxes[:, :, :3] += np.array(moved)[:, None]
    return {
        'stamps_ns': [i.stamp_ns for i in instants],
        'points': [
            i.points + by.astype(np.float32) for i, by in zip(instants, moved, strict=True)
        ],
        'origins': moved,
        'boxes': boxes,
    }


def _tracks(apart: float) -> dict[str, Any]:
    """Return tracks of one window each, so far apart [m]."""
    config = Config()
    windows, _ = make_windows(WINDOWS, config.window, WINDOW_POINTS, config)
    shifts = np.zeros((WINDOWS, 1, 3))
    shifts[:, 0, 0] = apart * np.arange(WINDOWS)
    rows = [window.observations for window in windows]
    boxes = np.array([[o.box for o in row] for row in rows])
    centers = boxes[:, :, :3].copy()
    boxes[:, :, :3] += shifts
    origins = np.array([[o.table.origins[o.row, 0] for o in row] for row in rows])
    return {
        'stamps_ns': [o.stamp_ns for o in rows[0]],
        'boxes': boxes,
        'origins': origins + centers + shifts,
        'counts': [[len(o.points) for o in row] for row in rows],
        'points': np.concatenate(
            [
                observation.points + center
                for row, places in zip(rows, boxes[:, :, :3], strict=True)
                for observation, center in zip(row, places, strict=True)
            ]
        ),
    }


def _seeded() -> dict[str, Any]:
    """Return a simulated drive, and true boxes of its objects as seeds."""
    drive = Drive.from_scene(simulate('street', 0))
    sweeps = [sweep.in_frame() for sweep in drive.sweeps]
    rows = slice(0, SEEDS)
    return {
        'stamps_ns': [sweep.stamp_ns for sweep in sweeps],
        'counts': [len(sweep.points) for sweep in sweeps],
        'points': np.concatenate([sweep.points for sweep in sweeps]),
        'origins': [sweep.origin for sweep in sweeps],
        'seeds': drive.truth.boxes[rows],
        'seed_stamps_ns': drive.truth.stamps_ns[rows],
        'seed_ids': np.array(drive.truth.track_ids[rows]),
    }
