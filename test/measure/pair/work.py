"""
``work.py CASE INPUT FOLDER``: do one case of `measure pair` and print its figures as JSON.

It runs in the environment of either checkout and uses only what the package offers its users.
``cpu`` is in seconds: of one tick or call, the median, else of the process and its children.
``memory`` is the largest of a process [MB].

"""

from collections.abc import Callable, Mapping
import json
import os
from pathlib import Path
import resource
from statistics import median
import subprocess
import sys
from time import process_time
from typing import Any

import numpy as np

REPEATS = 5
"""Calls that are timed in one process, after one that loads the kernels."""


def main(case: str, path: Path, folder: Path) -> dict[str, float]:
    """Return the figures of a case."""
    if case in ('relabel', 'compile'):
        return _command(case, path, folder)
    from boxreg_ros.allocation import collect_rarely, keep_freed_memory
    import torch

    collect_rarely()  # as the commands and the node do
    keep_freed_memory()
    torch.set_num_threads(1)
    with np.load(path) as arrays:
        work = {'tick': _tick, 'refine': _refine, 'follow': _follow}[case.partition(' ')[0]]
        cpu = work(arrays)
    return {'cpu': cpu, 'memory': _peak()}


def _command(case: str, path: Path, folder: Path) -> dict[str, float]:
    command = [sys.executable, '-m', 'boxreg_ros.cli', case]
    environment = dict(os.environ)
    if case == 'relabel':
        command += [str(path), '-o', str(folder / 'out')]
    else:
        environment['NUMBA_CACHE_DIR'] = str(folder)
    subprocess.run(command, env=environment, check=True, stdout=subprocess.DEVNULL)
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return {
        'cpu': used.ru_utime + used.ru_stime,
        'memory': used.ru_maxrss / 1024,
    }


def _peak() -> float:
    """Return the peak of this process [MB]; `getrusage` has that of its parent, if larger."""
    lines = Path('/proc/self/status').read_text(encoding='ascii').splitlines()
    (peak,) = (line.split()[1] for line in lines if line.startswith('VmHWM:'))
    return int(peak) / 1024


def _tick(arrays: Mapping[str, Any]) -> float:
    from boxreg_ros import BoxArray, BoxRegistrar, Config, Sweep

    config = Config(estimate='final').updated({'solver.threads': 1})
    registrar, times = BoxRegistrar(config), []
    stamps, boxes = arrays['stamps_ns'].tolist(), arrays['boxes']
    number = boxes.shape[1]
    names = tuple(map(str, range(number))), ('car',) * number, np.ones(number)
    points, origins = arrays['points'], arrays['origins']
    for i, stamp in enumerate(stamps):
        sweep = Sweep(stamp, 'odom', points[i], origin=origins[i])
        array = BoxArray(stamp, 'odom', *names, boxes[i])
        begin = process_time()
        registrar.add_sweep(sweep)
        registrar.add_boxes(array)
        times.append(process_time() - begin)
    return median(times[config.window + 2 :])


def _refine(arrays: Mapping[str, Any]) -> float:
    from boxreg_ros import refine, Track

    points = _split(arrays)
    length = arrays['counts'].shape[1]
    stamps = arrays['stamps_ns']
    tracks = [
        Track(str(i), 'car', stamps, boxes, points[i * length : (i + 1) * length], origins)
        for i, (boxes, origins) in enumerate(zip(arrays['boxes'], arrays['origins'], strict=True))
    ]
    return _median_cpu(lambda: refine(tracks))


def _follow(arrays: Mapping[str, Any]) -> float:
    from boxreg_ros import BoxArray, follow

    seeds = []
    of_stamp = arrays['seed_stamps_ns']
    for stamp in np.unique(of_stamp):
        rows = np.flatnonzero(of_stamp == stamp)
        ids = tuple(arrays['seed_ids'][rows].tolist())
        known = ('car',) * len(rows), np.ones(len(rows))
        seeds.append(BoxArray(int(stamp), 'odom', ids, *known, arrays['seeds'][rows]))
    points = _split(arrays)
    stamps, origins = arrays['stamps_ns'], arrays['origins']
    return _median_cpu(lambda: follow(stamps, points, seeds, sensor_origins=origins))


def _split(arrays: Mapping[str, Any]) -> list[Any]:
    ends = np.cumsum(arrays['counts'].ravel())
    return np.split(arrays['points'], ends[:-1])


def _median_cpu(function: Callable[[], object]) -> float:
    function()
    times = []
    for _ in range(REPEATS):
        begin = process_time()
        function()
        times.append(process_time() - begin)
    return median(times)


if __name__ == '__main__':
    print(json.dumps(main(sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3]))))
