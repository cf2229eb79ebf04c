"""Time and memory of `boxreg relabel`, in processes of its own."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from itertools import tee
import json
import os
from pathlib import Path
from shutil import disk_usage
import subprocess
import tempfile
from time import perf_counter, sleep

from boxreg_ros.simulation.writer import write_recording
from boxreg_ros.structures import Sweep
from measure.common import BOXREG
from measure.speed.streams import SWEEP_PERIOD, traffic
import numpy as np

BYTES_PER_POINT = 20
"""Size of a point in a recording."""


def relabel(tracks: int, points: int, seconds: float) -> dict[str, float]:
    """
    Return time and memory of `boxreg relabel` on a recording of `seconds` at 10 Hz.

    ``total``: elapsed time [s]; the times of the stages add up to more, since reading and
    solving overlap. ``start``: time until the recording is open [s]. ``faster``: length of the
    recording over ``total``; ``compressed``: the same for a recording packed by zstd. ``rest``:
    part of the total in which nothing is solved. ``memory``: peak of all processes [MB];
    ``memory, shared once``: the same with shared pages counted once, of a run of its own, since
    to count them takes a fifth of the machine. ``short`` and ``long``: peaks for recordings of
    this length and of ten times that, with sweeps of ``few`` points: a fifth of all if the disk
    has no room for more. ``faster, long``, ``rest, long`` and ``cores, long`` (cores that are
    busy on average): of the latter. ``help``: shortest time of three runs with ``--help`` [s].

    """
    command = [*BOXREG, 'relabel']
    result = {'help': min(_seconds([*command, '--help']) for _ in range(3))}
    with tempfile.TemporaryDirectory(prefix='boxreg-') as name:
        path, out = Path(name) / 'drive.mcap', Path(name) / 'out'
        has_room = (
            disk_usage(name).free > 2 * BYTES_PER_POINT * points * 10 * seconds / SWEEP_PERIOD
        )
        few = points if has_room else points // 5
        result['few'] = few
        # The first case is a warm-up, too: first accesses to memory of a virtual machine, and to
        # files, are not to be measured.
        for case, size, length in (
            ('short', few, seconds),
            ('long', few, 10 * seconds),
            ('compressed', points, seconds),
            ('memory', points, seconds),
        ):
            sweeps = round(length / SWEEP_PERIOD)
            write_traffic(path, tracks, size, sweeps, is_compressed=case == 'compressed')
            with path.open('rb') as file:
                os.fsync(file.fileno())  # else the disk still writes while it is read
            run = [*command, str(path), '-o', str(out)]
            before = os.times()
            result[case] = _peak(run)
            cores = _cores(before, os.times())
            spent = json.loads((out / 'summary.json').read_text(encoding='utf-8'))['seconds']
            faster, rest = length / spent['total'], 1 - spent['solve'] / spent['total']
            if case == 'memory':
                result |= {**spent, 'faster': faster, 'rest': rest}
                result['memory, shared once'] = _peak_shared_once(run)
            elif case == 'compressed':
                result[case] = faster
            elif case == 'long':
                result |= {'faster, long': faster, 'rest, long': rest, 'cores, long': cores}
    return result


def write_traffic(
    path: Path, tracks: int, points: int, count: int, is_compressed: bool = False
) -> None:
    """Write a recording of `traffic`."""
    a, b, c, d = tee(traffic(tracks, points, count), 4)
    write_recording(
        path,
        (Sweep(i.stamp_ns, 'lidar', i.points) for i in a),
        (np.zeros(len(i.points)) for i in b),
        (i.boxes for i in c),
        (i.T_fixed_sensor for i in d),
        'odom',
        is_compressed=is_compressed,
    )


def _seconds(command: list[str]) -> float:
    """Return the elapsed time of a command [s]."""
    begin = perf_counter()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return perf_counter() - begin


def _cores(before: os.times_result, after: os.times_result) -> float:
    """Return how many cores were busy on average with the commands run between two times."""
    used = after.children_user + after.children_system
    used -= before.children_user + before.children_system
    return used / (after.elapsed - before.elapsed)


def _peak(command: list[str]) -> float:
    """Run a command; return the sum of the peak memory of its processes [MB]."""
    peaks: Counter[str] = Counter()
    for pids in _running(command):
        peaks |= Counter({pid: _kilobytes(f'/proc/{pid}/status', 'VmHWM:') for pid in pids})
    return peaks.total() / 1024


def _peak_shared_once(command: list[str]) -> float:
    """Run a command; return the peak of the sum of its proportional set sizes [MB]."""
    sizes = [
        sum(_kilobytes(f'/proc/{pid}/smaps_rollup', 'Pss:') for pid in pids)
        for pids in _running(command)
    ]
    return max(sizes) / 1024


def _running(command: list[str]) -> Iterator[list[str]]:
    """Run a command; yield the ids of its processes, again and again until it ends."""
    with tempfile.TemporaryFile('w+') as output:
        process = subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT)
        while process.poll() is None:
            with suppress(OSError):
                children = Path(f'/proc/{process.pid}/task/{process.pid}/children').read_text()
                yield [str(process.pid), *children.split()]
            sleep(0.02)
        if process.returncode:
            output.seek(0)
            raise RuntimeError(f'{" ".join(command)} failed: {output.read()}')


def _kilobytes(file: str, name: str) -> int:
    """Return one value of a file of /proc [kB]; 0 for a process that has ended."""
    with suppress(OSError, IndexError):
        return int(Path(file).read_text().partition(name)[2].split()[0])
    return 0
