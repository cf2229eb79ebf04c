"""Every method of a table, run on the same sweeps and the same boxes."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence

from boxreg_ros.bench.baselines import ctra_smoothed, icp, l_shaped, smoothed, smoothed_live
from boxreg_ros.config import Config
from boxreg_ros.core.refine import Track
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.offline.drive import Drive
from boxreg_ros.structures import Floats
import numpy as np

BASELINES: dict[str, tuple[str, Callable[[Track], Floats]]] = {
    'smoothing': ('smoothing only', smoothed),
    'ctra': ('CTRA smoothing', ctra_smoothed),
    'l-shape': ('L-shape per sweep', l_shaped),
    'icp': ('ICP on box points', icp),
}
METHODS = (*BASELINES, 'paper', 'ours')

Methods = dict[str, BoxTable | str]
"""Boxes by the name of their method, or the reason why the method did not run."""


def add_method_argument(parser: argparse.ArgumentParser) -> None:
    """Declare ``--methods``."""
    parser.add_argument(
        '--methods', nargs='+', choices=METHODS, default=METHODS, metavar='METHOD',
        help=f'only some of {", ".join(METHODS)}',
    )  # fmt: skip


def run_methods(
    drive: Drive,
    mode: str = '3d',
    wanted: Sequence[str] = METHODS,
    done: Callable[[], object] = lambda: None,
) -> Methods:
    """Return the boxes of the `wanted` methods, the input first; baselines ignore `mode`."""
    methods: Methods = {'input': BoxTable.from_arrays(drive.boxes)}
    needs_tracks = not BASELINES.keys().isdisjoint(wanted)
    tracks = drive.tracks() if needs_tracks else []
    for method in METHODS:
        if method not in wanted:
            continue
        if method == 'smoothing':
            methods |= _smoothed_live(tracks, drive)
        if method in BASELINES:
            name, baseline = BASELINES[method]
            methods[name] = _run_baseline(baseline, tracks, drive)
        else:
            methods |= _registered(method, mode, drive)
        done()
    return methods


def _smoothed_live(tracks: Sequence[Track], drive: Drive) -> Methods:
    """Return the smoother at the lags of the live node."""
    pairs = [smoothed_live(track, Config().lag) for track in tracks]
    return {
        'smoothing, early': _table(tracks, [newest for newest, _ in pairs], drive),
        'smoothing, final': _table(tracks, [lagged for _, lagged in pairs], drive),
    }


def _run_baseline(
    baseline: Callable[[Track], Floats], tracks: Sequence[Track], drive: Drive
) -> BoxTable | str:
    try:
        boxes = [baseline(track) for track in tracks]
    except ImportError as error:
        return f'skipped: {error.name} is not installed'
    return _table(tracks, boxes, drive)


def _registered(method: str, mode: str, drive: Drive) -> Methods:
    """Return the estimates of our objective, or of the paper's for whole tracks."""
    objective = 'paper' if method == 'paper' else Config().objective
    runs = ('track',) if method == 'paper' else ('final', 'track')
    methods: Methods = {}
    for run in runs:
        config = Config(objective=objective, estimate=run, mode=mode)
        for estimate, boxes in drive.registered(config).items():
            methods[f'{method}, {estimate}'] = boxes
    return methods


def _table(tracks: Sequence[Track], boxes: Sequence[Floats], drive: Drive) -> BoxTable:
    """Return the boxes of tracks, one array (N, 9) for each, as one table."""
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
