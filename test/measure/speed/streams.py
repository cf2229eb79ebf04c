"""Synthetic windows and streams that are measured, and how time is taken."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from time import perf_counter
from types import SimpleNamespace
from typing import NamedTuple

from boxreg_ros.config import Config
from boxreg_ros.core.observation import Observation, observe
from boxreg_ros.core.window import Window
from boxreg_ros.simulation.simulate import simulate
from boxreg_ros.structures import BoxArray, Floats, Sweep
from measure.drives import tracks_of
import numpy as np
from numpy.typing import NDArray
import torch

SWEEP_PERIOD = 0.1
"""Period of the sensor of a live stream [s]."""
SPEED = 4.0
"""Speed of all traffic, the sensor included [m/s]."""
POINTS_PER_CAR = 300
"""Returns on a car, fewer where the cars would take more than half of a sweep."""


class Instant(NamedTuple):
    """One revolution among traffic that moves as the sensor does, in the sensor's frame."""

    stamp_ns: int
    T_fixed_sensor: Floats
    points: NDArray[np.float32]
    boxes: BoxArray


def traffic(tracks: int, points: int, count: int) -> Iterator[Instant]:
    """Yield `count` sweeps of `points` returns on `tracks` cars and the road, with noisy boxes."""
    rng = np.random.default_rng(0)
    side = int(np.ceil(np.sqrt(tracks)))
    grid = np.stack(np.meshgrid(np.arange(side), np.arange(side)), -1).reshape(-1, 2)[:tracks]
    true = np.zeros((tracks, 9))
    true[:, :2] = (grid - side / 2) * 9.0 + 3.0
    true[:, 2:6] = 0.0, 4.5, 1.9, 1.6
    surface = _surface(min(POINTS_PER_CAR, points // (2 * tracks)), true[0], rng)
    road = rng.uniform(-60, 60, (points - tracks * len(surface), 3)) * [1, 1, 0.0] - [0, 0, 0.8]
    cloud = np.concatenate([*(surface + box[:3] for box in true), road]).astype(np.float32)
    names = tuple(str(i) for i in range(tracks)), ('car',) * tracks, np.ones(tracks)
    for i in range(count):
        stamp, T = i * round(SWEEP_PERIOD * 1e9), np.eye(4)
        T[0, 3] = SPEED * SWEEP_PERIOD * i
        noise = rng.standard_normal(cloud.shape, dtype=np.float32) * np.float32(0.01)
        boxes = true + rng.normal(0, 1, true.shape) * [0.1, 0.1, 0.05, *[0.1] * 3, 0, 0, 0.03]
        yield Instant(stamp, T, cloud + noise, BoxArray(stamp, 'lidar', *names, boxes))


def make_windows(
    count: int, length: int, points: int, config: Config
) -> tuple[list[Window], list[Floats]]:
    """Return windows of the paper's experiment, of different seeds, and their true boxes."""
    config = config.updated({'sampling.points': points})
    windows: list[Window] = []
    truth: list[Floats] = []
    for seed in range(count):
        scene = simulate('paper', seed % 8)
        (track,) = tracks_of(scene)
        first = (seed // 8 * length) % (101 - length)
        rows = range(first, first + length)
        observations = []
        for i in rows:
            assert track.sensor_origins is not None
            repeat = track.points[i][np.arange(max(points, 1)) % len(track.points[i])]
            sweep = Sweep(int(track.stamps_ns[i]), '', repeat, None, track.sensor_origins[i])
            seen = observe(sweep, track.boxes[i : i + 1], sweep.stamp_ns, config)
            observations.append(Observation(seen, 0))
        windows.append(Window(str(seed), 'car', observations, length, np.zeros((0, 9))))
        truth.append(scene.truth.boxes[first : first + length])
    return windows, truth


def cloud_message(points: NDArray[np.floating]) -> SimpleNamespace:
    """Return a PointCloud2 as decoded, with an intensity beside x y z."""
    data = np.zeros((len(points), 4), dtype='<f4')
    data[:, :3] = points
    names = ('x', 'y', 'z', 'intensity')
    fields = [
        SimpleNamespace(name=n, offset=4 * i, datatype=7, count=1) for i, n in enumerate(names)
    ]
    stamp = SimpleNamespace(sec=0, nanosec=0)
    return SimpleNamespace(
        header=SimpleNamespace(stamp=stamp, frame_id='lidar'), height=1, width=len(points),
        fields=fields, is_bigendian=False, point_step=16, row_step=16 * len(points),
        data=data.view(np.uint8).reshape(-1), is_dense=True,
    )  # fmt: skip


def shortest(function: Callable[[], object], repeats: int = 3) -> float:
    """Return the shortest of several times, after one for warming up [s]."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    function()
    best = np.inf
    for _ in range(repeats):
        begin = perf_counter()
        function()
        best = min(best, perf_counter() - begin)
    torch.set_num_threads(before)
    return float(best)


def _surface(count: int, box: Floats, rng: np.random.Generator) -> Floats:
    """Return points on the faces of a box at the origin that a sensor behind and left sees."""
    points = rng.uniform(-0.5, 0.5, (count, 3)) * box[3:6]
    face = np.arange(count) % 3
    points[np.arange(count), face] = np.array([-0.5, 0.5, 0.5])[face] * box[3:6][face]
    return points
