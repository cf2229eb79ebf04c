"""
`measure kills`: boxes that a recording of labels loses when a process is killed.

The node records labels and clouds from the publisher of `measure node`. After a random time
the recorder, or the node itself, gets SIGKILL; `boxreg recover` then completes the segment.
Boxes are lost if they were published before that and are in no segment.

"""

import argparse
from contextlib import ExitStack
import os
from pathlib import Path
import signal
import subprocess
from tempfile import TemporaryDirectory
import time
from typing import NamedTuple

from boxreg_ros.bench.common import BOXREG
from boxreg_ros.errors import BoxregError
from measure.node import (
    children_of,
    COMPLETION_TIME,
    node_command,
    observer,
    process,
    publisher_command,
    recording_parameters,
    set_environment,
)
from measure.recorded import RecordedLabels
import numpy as np

VICTIMS = ('recorder', 'node')
RATE = 10.0  # of the sensor [Hz]
STARTING_TIME = 120.0  # until the first final boxes [s]
RUNNING_TIMES = (0.0, 5.0)  # bounds of the time from the first final boxes to the signal [s]


class LostArrays(NamedTuple):
    """Numbers of box arrays that were published before a kill, as final or as early, and lost."""

    final: int
    early: int


ARGUMENTS = {
    '--kills': (10, 'of each process'),
    '--tracks': (64, ''),
    '--points': (130000, 'per sweep'),
    '--record': ('openlabel,sustechpoints', 'formats', {'metavar': 'FORMAT,...'}),
}


def run(args):
    """Return the loss of each kind when a process is killed."""
    rng = np.random.default_rng(0)
    report = {'load before': os.getloadavg()[0]}
    for victim in VICTIMS:
        losses = [_killed(args, victim, rng.uniform(*RUNNING_TIMES)) for _ in range(args.kills)]
        for kind, counts in zip(LostArrays._fields, zip(*losses, strict=True), strict=True):
            name = f'{victim} killed: {kind} boxes lost'
            report[f'{name}, mean [s]'] = float(np.mean(counts)) / RATE
            report[f'{name}, most [s]'] = max(counts) / RATE
    return report


def _killed(args, victim, seconds):
    """Kill a process some time after the first final boxes; return the boxes lost."""
    scope = argparse.Namespace(
        tracks=args.tracks, points=args.points, rate=RATE, delay=0.05,
        seconds=STARTING_TIME + RUNNING_TIMES[1],
    )  # fmt: skip
    set_environment('large')
    with ExitStack() as stack:
        folder = Path(stack.enter_context(TemporaryDirectory()))
        arrivals = stack.enter_context(observer())
        parameters = recording_parameters(args.record, folder / 'labels')
        node = stack.enter_context(process(node_command(parameters), folder / 'node.log'))
        stack.enter_context(process(publisher_command(scope, folder / 'sent'), folder / 'log'))
        _wait_for_finals(arrivals, folder / 'node.log')
        time.sleep(seconds)
        published = {name: set(arrivals[name]) for name in LostArrays._fields}
        (recorder,) = children_of(node.pid)
        os.kill(recorder if victim == 'recorder' else node.pid, signal.SIGKILL)
        node.send_signal(signal.SIGINT)
        node.wait(timeout=30.0)
        labels = RecordedLabels(folder / 'labels', np.inf, args.points)
        _recover(labels, folder / 'labels')
        return LostArrays(*(len(published[name] - labels.stamps) for name in LostArrays._fields))


def _wait_for_finals(arrivals, log):
    """Wait for the first final boxes."""
    end = time.monotonic() + STARTING_TIME
    while not arrivals['final']:
        if time.monotonic() > end:
            raise BoxregError(
                f'expected final boxes within {STARTING_TIME:.0f} s, got none: {log.read_text()}'
            )
        time.sleep(0.01)


def _recover(labels, folder):
    """Recover cut-off segments, as soon as no recorder uses the folder; count the labels."""
    end = time.monotonic() + COMPLETION_TIME
    while labels.has_open_segment:
        done = subprocess.run([*BOXREG, 'recover', folder], capture_output=True, text=True)
        if done.returncode and time.monotonic() > end:
            raise BoxregError(done.stderr)
    labels.update()
