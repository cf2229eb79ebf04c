"""Time of a live tick, and of windows over their number, length, points, cores and tracks."""

from __future__ import annotations

from dataclasses import replace
import os
import subprocess
import sys
from time import perf_counter
from typing import Any

from boxreg_ros.config import Config
from boxreg_ros.core import observation as sampling
from boxreg_ros.core.input_model import InputModel
from boxreg_ros.core.method.constants import CONSTANTS
from boxreg_ros.core.observation import MARGIN, observe
from boxreg_ros.core.problem import stack_windows
from boxreg_ros.core.registrar import BoxRegistrar
from boxreg_ros.core.solver import solve
from boxreg_ros.io.transforms import boxes_to_frame, inverse, sweep_to_frame
from boxreg_ros.rotations import matrix_from_rpy
from boxreg_ros.structures import ROLL, Sweep
from measure.speed.streams import (
    cloud_message,
    make_windows,
    shortest,
    SWEEP_PERIOD,
    traffic,
)
from msg_adapters import pointcloud
import numpy as np
from paths import TEST

NO_OPEN3D = 'Open3D is not installed: pip install open3d'


def tick(config: Config, tracks: int, points: int, ticks: int = 40) -> dict[str, float]:
    """
    Return the time of the stages of one live tick [ms], the median of `ticks` full windows.

    ``longest`` is the longest of these ticks, ``first`` the first tick that solves a window,
    ``first full`` the first with full windows.

    """
    registrar, times = BoxRegistrar(config), []
    for stamp, T, cloud, boxes in traffic(tracks, points, config.window + 2 + ticks):
        message = cloud_message(cloud)
        marks = [perf_counter()]
        sweep = replace(pointcloud.from_msg(message), stamp_ns=stamp)
        marks.append(perf_counter())
        sweep, array = sweep_to_frame(sweep, T, 'odom'), boxes_to_frame(boxes, T, 'odom')
        marks.append(perf_counter())
        registrar.add_sweep(sweep)
        ready = registrar.add_boxes(array)
        marks.append(perf_counter())
        [boxes_to_frame(r.boxes, inverse(T), 'lidar') for r in ready]
        marks.append(perf_counter())
        observe(sweep, array.boxes, stamp, config)  # once more alone, to measure its share
        marks.append(perf_counter())
        decode, transform, both, encode, alone = np.diff(marks) * 1e3
        times.append((decode, transform, alone, both - alone, encode))
    middle = np.median(np.array(times)[config.window + 2 :], axis=0)
    stages = ('decode', 'transform', 'crop and sample', 'solve', 'encode')
    result = {k: float(v) for k, v in zip(stages, middle, strict=True)}
    first, full = config.min_observations - 1, config.window - 1
    return {
        **result,
        'total': float(middle.sum()),
        'longest': float(np.sum(times[config.window + 2 :], axis=1).max()),
        'first': float(sum(times[first])),
        'first full': float(sum(times[full])),
    }


def crop(config: Config, tracks: int, points: int) -> dict[str, Any]:
    """
    Return the time to crop all boxes of a sweep [ms]: ours, and box by box.

    All of them only crop; the stages of a tick have the rest of `observe`.

    """
    ((_, _, cloud, boxes),) = traffic(tracks, points, 1)
    rotations = matrix_from_rpy(boxes.boxes[:, ROLL:])
    sweep = Sweep(0, 'lidar', cloud)

    def one_by_one() -> None:
        for box, R in zip(boxes.boxes, rotations, strict=True):
            local = np.abs((cloud - box[:3].astype(np.float32)) @ R.astype(np.float32))
            cloud[(local < box[3:6] / 2 + MARGIN).all(1)]

    def ours() -> None:
        index, owner, _, outside = sampling.crop(sweep, boxes.boxes, MARGIN)
        is_in = outside.max(0) < MARGIN
        cloud.take(index[is_in], 0), owner[is_in]

    result: dict[str, Any] = {
        'ours': 1e3 * shortest(ours),
        'numpy, box by box': 1e3 * shortest(one_by_one),
    }
    try:
        import open3d
    except (ImportError, OSError) as error:
        return {**result, 'Open3D, box by box': None, 'reason': f'{NO_OPEN3D} ({error})'}
    whole = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(cloud.astype(np.float64)))
    turned = [
        open3d.geometry.OrientedBoundingBox(box[:3], R, box[3:6] + 2 * MARGIN)
        for box, R in zip(boxes.boxes, rotations, strict=True)
    ]
    result['Open3D, box by box'] = 1e3 * shortest(lambda: [whole.crop(box) for box in turned])
    return result


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
        model = InputModel(config.faces)
        return solve(problem, config, model, model.inputs(config), is_warm=False)

    return 1e3 * shortest(once)


def cores(config: Config, count: int) -> dict[str, float]:
    """Return the time of `count` windows [ms] in processes pinned to one core and to two."""
    available = sorted(os.sched_getaffinity(0))
    result = {}
    for number in (1, 2):
        if number <= len(available):
            pinned = ','.join(map(str, available[:number]))
            code = f'from {__name__} import pinned; pinned({{{pinned}}}, {count})'
            done = subprocess.run(
                [sys.executable, '-c', code], cwd=TEST, capture_output=True, text=True, check=True
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
