"""Windows of observations, and their batches as padded tensors."""

from collections.abc import Sequence
from dataclasses import fields
from typing import NamedTuple

from boxreg_ros.config import ClassConfig, Config
from boxreg_ros.objective import Problem, SHARED
from boxreg_ros.sampling import Observation
from boxreg_ros.structures import Floats, YAW
import numpy as np
import torch

BATCH_VALUES = 3e7  # most point coordinates, or entries of the curvature, solved at once


class Window(NamedTuple):
    """
    Observations of one track, in order.

    Attributes
    ----------
    track_id, class_name : str
        Identity and category.
    observations : sequence of N Observation
        In the order of their stamps.
    fresh : int
        How many of them, the last ones, no window has had before.
    start : array, shape (N - fresh, 9)
        What the window before made of the others; empty where there was none.

    """

    track_id: str
    class_name: str
    observations: Sequence[Observation]
    fresh: int
    start: Floats

    @property
    def is_warm(self) -> bool:
        """Tell whether all but the newest observation have been solved before."""
        return self.fresh == 1 and len(self.start) == len(self.observations) - 1 > 1

    def fresh_part(self) -> 'Window':
        """Return the window of the fresh observations alone."""
        return self._replace(observations=self.observations[-self.fresh :], start=np.zeros((0, 9)))


def batches(windows: Sequence[Window], config: Config) -> list[list[int]]:
    """Return rows of windows to solve together: as warm, about as long, of bounded size."""
    lengths = [len(window.observations) for window in windows]
    rows = [i for i, n in enumerate(lengths) if n >= config.min_observations]
    groups: list[list[int]] = []
    for i in sorted(rows, key=lambda i: (windows[i].is_warm, lengths[i], i)):
        size = max((6 * lengths[i] + SHARED) ** 2, lengths[i] * config.sampling.points * 18)
        is_full = not groups or (len(groups[-1]) + 1) * size > BATCH_VALUES
        if is_full or windows[groups[-1][0]].is_warm != windows[i].is_warm:
            groups.append([])
        groups[-1].append(i)
    return groups


def stack(windows: Sequence[Window], config: Config) -> tuple[Problem, Floats]:
    """Return padded tensors of `windows`, and the points (B, 3) their centres are relative to."""
    B, N = len(windows), max(len(w.observations) for w in windows)
    M = max(1, *(len(o.points) for w in windows for o in w.observations))
    boxes, valid, times = np.zeros((B, N, 9)), np.zeros((B, N), dtype=bool), np.zeros((B, N))
    start, delays = np.zeros((B, N, 9)), np.zeros((B, N, M), dtype=np.float32)
    points, mask = np.zeros((B, N, M, 3), dtype=np.float32), np.zeros((B, N, M), dtype=bool)
    origins, ground = np.zeros((B, N, 3)), np.full((B, N), np.nan)
    for b, window in enumerate(windows):
        n, k = len(window.observations), len(window.start)
        given = np.array([o.box for o in window.observations])
        given[:, YAW] = one_heading(given[:, YAW])
        boxes[b, :n], boxes[b, n:], valid[b, :n] = given, given[-1], True
        start[b], start[b, :k] = boxes[b], window.start
        turns = np.pi * np.array([2, 2, 1])  # a box kept may have come turned around
        start[b, :k, 6:9] += turns * np.round((given[:k, 6:9] - start[b, :k, 6:9]) / turns)
        stamps = np.array([o.stamp_ns for o in window.observations])
        times[b, :n] = (stamps - stamps[0]) * 1e-9
        times[b, n:] = times[b, n - 1] + 0.1 * np.arange(1, N - n + 1)
        for i, o in enumerate(window.observations):
            m = len(o.points)
            points[b, i, :m], delays[b, i, :m], mask[b, i, :m] = o.points, o.delays, True
            origins[b, i], ground[b, i] = o.origin, o.ground
    base = boxes[:, 0, :3].copy()
    boxes[..., :3] -= base[:, None]
    start[..., :3] -= base[:, None]
    kinds = [config.class_config(window.class_name) for window in windows]
    deviations = {
        f.name: torch.tensor([getattr(kind, f.name) for kind in kinds], dtype=torch.float64)
        for f in fields(ClassConfig)
        if f.name != 'names'
    }
    arrays = (boxes, start, valid, times, points, mask, delays, origins, ground)
    names = (f.name for f in fields(Problem) if f.name != 'deviations')
    tensors = {
        name: torch.from_numpy(array).to(config.device)
        for name, array in zip(names, arrays, strict=True)
    }
    deviations = {name: value.to(config.device) for name, value in deviations.items()}
    return Problem(**tensors, deviations=deviations), base


def one_heading(yaw: Floats) -> Floats:
    """Return `yaw` (N,) unwrapped [rad], with the half turns undone that are in the minority."""
    chain = np.unwrap(yaw, period=np.pi)
    turned = np.cos(yaw - chain) < 0
    return chain + np.pi if turned.mean() > 0.5 else chain
