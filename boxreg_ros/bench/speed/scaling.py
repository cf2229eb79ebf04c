"""Time over the number of windows, their length, points, cores and tracks."""

from __future__ import annotations

import os
import subprocess
import sys

from boxreg_ros.bench.speed.stages import tick
from boxreg_ros.bench.speed.streams import make_windows, shortest, SWEEP_PERIOD
from boxreg_ros.config import Config
from boxreg_ros.core.input_model import InputModel
from boxreg_ros.core.method.constants import CONSTANTS
from boxreg_ros.core.problem import stack_windows
from boxreg_ros.core.solver import solve

BISECTIONS = 4
"""Steps of the search for the most tracks: it is found within 6 %. Chosen."""
PROBED_TICKS = 20
"""Ticks of each step of the search, of which none may exceed the period. Chosen."""


def scaling(config: Config, quick: bool) -> dict[str, list[tuple[int, float]]]:
    """Return the time per window [ms] over number of windows, their length, and points per box."""
    counts, lengths, points = [1, 8, 64, 512], [5, 10, 20, 40, 80], [128, 512, 2048, 4096]
    if quick:
        counts, lengths, points = [1, 8], [5, 10], [128, 512]
    cases = {
        'windows': [(n, n, config.window, 128) for n in counts],
        'length': [(n, 16, n, 128) for n in lengths],
        'points': [(n, 16, config.window, n) for n in points],
    }
    return {
        name: [(x, _milliseconds(count, n, most, config) / count) for x, count, n, most in rows]
        for name, rows in cases.items()
    }


def _milliseconds(count: int, length: int, points: int, config: Config) -> float:
    """Return the time to solve `count` cold windows [ms]; 64 of them differ."""
    windows, _ = make_windows(min(count, 64), length, points, config)
    windows = (windows * -(-count // len(windows)))[:count]
    problem, _ = stack_windows(windows, config, CONSTANTS.prior_decay)

    def once() -> object:
        return solve(problem, config, InputModel(config.faces), is_warm=False)

    return 1e3 * shortest(once, config)


def cores(config: Config, count: int) -> dict[str, float]:
    """Return the time of `count` windows [ms] in processes pinned to one core and to two."""
    available = sorted(os.sched_getaffinity(0))
    result = {}
    for number in (1, 2):
        if number <= len(available):
            pinned = ','.join(map(str, available[:number]))
            code = f'from {__name__} import pinned; pinned({{{pinned}}}, {count})'
            done = subprocess.run(
                [sys.executable, '-c', code], capture_output=True, text=True, check=True
            )
            result[f'{number} cores'] = float(done.stdout)
    return result


def pinned(available: set[int], count: int) -> None:
    """Print the time of `count` cold windows [ms] on the cores `available` of this process."""
    os.sched_setaffinity(0, available)
    config = Config(estimate='final').updated({'solver.threads': len(available)})
    print(_milliseconds(count, config.window, 128, config))


def held_tracks(config: Config, points: int, most: int) -> int:
    """Return the most tracks, up to `most`, of which no tick takes longer than the period."""

    def is_held(tracks: int) -> bool:
        return tick(config, tracks, points, PROBED_TICKS)['longest'] < 1e3 * SWEEP_PERIOD

    low = 1
    while 2 * low <= most and is_held(2 * low):
        low *= 2
    if 2 * low > most:
        return low
    high = 2 * low
    for _ in range(BISECTIONS):
        middle = (low + high) // 2
        if middle == low:
            break
        low, high = (middle, high) if is_held(middle) else (low, middle)
    return low
