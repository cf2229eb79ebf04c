"""`measure speed`: time per tick, per box and per window, and of relabel; ratios of one run."""

from __future__ import annotations

import argparse
import os
from typing import Any

from boxreg_ros.config import Config
from measure.speed.recordings import relabel
from measure.speed.reference import compare
from measure.speed.scaling import cores, crop, held_tracks, scaling, tick

WANTED = {
    'held tracks': 400.0, 'relabel: faster, long': 15.0, 'relabel: start': 1.5,
    'relabel: help': 0.5, 'relabel: memory, shared once': 700.0,
}  # fmt: skip
"""Aims by the name of the number. Chosen."""


ARGUMENTS = {
    '--quick': (False, 'fewer and smaller cases'),
    '--references': (24, 'windows also fitted by torch.optim.LBFGS'),
}


def run(args: argparse.Namespace) -> dict[str, Any]:
    """Return times of relabel [s], all others [ms], memory [MB], and the load when it began."""
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
