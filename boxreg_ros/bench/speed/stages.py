"""Stages of one live tick, and the crop beside that of other libraries."""

from __future__ import annotations

from dataclasses import replace
from time import perf_counter
from typing import Any

from boxreg_ros.bench.speed.streams import cloud_message, shortest, traffic
from boxreg_ros.config import Config
from boxreg_ros.core import observation as sampling
from boxreg_ros.core.observation import MARGIN, observe
from boxreg_ros.core.registrar import BoxRegistrar
from boxreg_ros.io.transforms import boxes_to_frame, inverse, sweep_to_frame
from boxreg_ros.rotations import matrix_from_rpy
from boxreg_ros.structures import ROLL, Sweep
from msg_adapters import pointcloud
import numpy as np

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
        'ours': 1e3 * shortest(ours, config),
        'numpy, box by box': 1e3 * shortest(one_by_one, config),
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
    result['Open3D, box by box'] = 1e3 * shortest(
        lambda: [whole.crop(box) for box in turned], config
    )
    return result
