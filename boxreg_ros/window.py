"""Windows of observations, and their batches as padded tensors."""

from collections.abc import Sequence
from dataclasses import fields
from typing import Any, NamedTuple

from boxreg_ros.config import ClassConfig, Config
from boxreg_ros.objective import Problem, SHARED
from boxreg_ros.sampling import Observation
from boxreg_ros.structures import Floats, YAW
import numpy as np
from numpy.typing import NDArray
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
    lengths = np.array([len(w.observations) for w in windows])
    B, N, device = len(windows), lengths.max(), config.device
    every = [o for w in windows for o in w.observations]
    counts = np.array([len(o.points) for o in every])
    valid = np.arange(N) < lengths[:, None]
    mask = np.zeros((B, N, max(1, counts.max())), dtype=bool)
    mask[valid] = np.arange(mask.shape[2]) < counts[:, None]
    boxes, times, ground = np.zeros((B, N, 9)), np.zeros((B, N)), np.full((B, N), np.nan)
    points, origins = np.zeros((*mask.shape, 3), dtype=np.float32), np.zeros((B, N, 3))
    delays = np.zeros(mask.shape, dtype=np.float32)
    boxes[valid], origins[valid] = [o.box for o in every], [o.origin for o in every]
    ground[valid] = [o.ground for o in every]
    begin = np.repeat([w.observations[0].stamp_ns for w in windows], lengths)
    times[valid] = (np.array([o.stamp_ns for o in every]) - begin) * 1e-9
    for b, i, o in zip(*np.nonzero(valid), every, strict=True):
        points[b, i, : len(o.points)], delays[b, i, : len(o.points)] = o.points, o.delays
    row, step, last = np.arange(B)[:, None], np.arange(N), lengths[:, None] - 1
    boxes, times = (part[row, np.minimum(step, last)] for part in (boxes, times))
    times += 0.1 * np.maximum(step - last, 0)
    boxes[..., YAW] = one_heading(boxes[..., YAW], valid)
    start = boxes.copy()
    for b, window in enumerate(windows):
        start[b, : len(window.start)] = window.start
    turns = np.pi * np.array([2, 2, 1])  # a box kept may have come turned around
    start[..., 6:9] += turns * np.round((boxes[..., 6:9] - start[..., 6:9]) / turns)
    base = boxes[:, 0, :3].copy()
    boxes[..., :3] -= base[:, None]
    start[..., :3] -= base[:, None]
    kinds = [config.class_config(window.class_name) for window in windows]
    deviations = {
        f.name: torch.tensor([getattr(k, f.name) for k in kinds], dtype=torch.float64).to(device)
        for f in fields(ClassConfig)
        if f.name != 'names'
    }
    arrays = (boxes, start, valid, times, points, mask, delays, origins, ground)
    parts: list[Any] = [torch.from_numpy(array).to(device) for array in arrays]
    return Problem(*[*parts, deviations]), base


def one_heading(yaw: Floats, valid: NDArray[np.bool_]) -> Floats:
    """Return `yaw` (B, N) unwrapped [rad], with the half turns undone that are in the minority."""
    chain = np.unwrap(yaw, period=np.pi)
    turned = (np.cos(yaw - chain) < 0) & valid
    is_most = turned.sum(1, keepdims=True) > valid.sum(1, keepdims=True) / 2
    return np.where(is_most, chain + np.pi, chain)
