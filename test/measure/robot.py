"""
`measure robot`: the live node at the rates of a robot, as a table.

Each row is a run of `measure node`; with both cores taken, as many processes as there are cores
compute beside it, without a priority. With `--real-time` all others have that of `chrt -r 1`, as
drivers of robots do, which needs the right to it. The machine has to be quiet: run it alone.

"""

import argparse
from contextlib import ExitStack
import os
import subprocess
import sys

from measure.node import measure

ROWS = {
    '17 boxes, 100,000 points': (17, 100_000, 0.0, 0.0, False),
    'the same, TF and odometry at 200 Hz': (17, 100_000, 200.0, 0.0, False),
    'the same, /clock at 1 kHz': (17, 100_000, 200.0, 1000.0, False),
    '68 boxes, 100,000 points': (68, 100_000, 0.0, 0.0, False),
    '254 boxes, 156,000 points': (254, 156_000, 0.0, 0.0, False),
    'all cores taken, 17 boxes': (17, 100_000, 0.0, 0.0, True),
}
"""Tracks, points, rates of TF with odometry and of /clock [Hz], and whether cores are taken."""
ARGUMENTS = {
    '--seconds': (25.0, 'seconds of data of each row'),
    '--real-time': (False, 'with real-time priority'),
}


def run(args):
    """Return the figures of each row."""
    if args.real_time:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))  # inherited by processes
    found = {}
    for name, row in ROWS.items():
        print(name, file=sys.stderr)
        found[name] = _measured(args, *row)
    return found


def _measured(args, tracks, points, motion, clock, is_busy):
    """Return the figures of a row."""
    settings = ['use_sim_time:=true'] if clock else []
    scope = argparse.Namespace(
        tracks=tracks, points=points, rate=10.0, seconds=args.seconds, delay=0.05,
        motion=motion, clock=clock, transport='large', set=settings,
    )  # fmt: skip
    with ExitStack() as stack:
        if is_busy:
            for _ in range(os.cpu_count() or 1):
                other = subprocess.Popen([sys.executable, '-c', 'while True: pass'])
                os.sched_setscheduler(other.pid, os.SCHED_OTHER, os.sched_param(0))
                stack.callback(other.wait)
                stack.callback(other.kill)
        report = measure(scope)
    counts = report['counters']
    early = sum(counts.get(f'early_{name}', 0) for name in ('refined', 'budget', 'kept'))
    nan = float('nan')
    return {
        'p50 [ms]': report.get('latency p50 [ms]', nan),
        'p99 [ms]': report.get('latency p99 [ms]', nan),
        'early refined [%]': 100 * counts.get('early_refined', 0) / max(1, early),
        'clouds dropped [%]': 10 * counts.get('points_queue_full', 0) / args.seconds,
        'cores': report['cores used'],
        'load': report['load before, during'],
    }
