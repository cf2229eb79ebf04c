"""Windows of observations, and their batches as padded tensors."""

from collections.abc import Sequence
from dataclasses import astuple
from typing import Any, NamedTuple

from boxreg_ros.config import Config
from boxreg_ros.core.batch import PRIOR_SIZE, Problem, SHARED
from boxreg_ros.core.observation import Observation
from boxreg_ros.structures import Floats, ROLL, YAW
import numpy as np
from numpy.typing import NDArray
import torch

FADING = 0.97  # of what is remembered, from stamp to stamp: no model holds forever
NOTHING = (
    np.full(PRIOR_SIZE, np.nan), np.zeros(PRIOR_SIZE), np.zeros((PRIOR_SIZE, PRIOR_SIZE)),
    np.zeros(4),
)  # fmt: skip
ANGLES = [3, 4, 5, 9, 10, 11]  # of the two poses that are remembered
AWAY = 1e6  # where points are that are not real: near no box [m]
TELLING = 30  # observations of a track tell as much of its labels as many more
REVERSE = 6.0  # nothing reverses faster [m/s]
BATCH_VALUES = 3e7  # most point coordinates, or entries of the curvature, solved at once


class Memory(NamedTuple):
    """
    What observations that have left a window still tell about those in it: a quadratic form.

    Attributes
    ----------
    base : array, shape (3,)
        What all positions of the track are relative to from now on [m].
    state, step : array, shape (34,)
        Poses of the two oldest observations and what is shared, when the last one left, and how
        far from there the form is least.
    information : array, shape (34, 34)
        Its curvature.
    seen : array, shape (4,)
        Sum of the input extents that have left, and their number.

    """

    base: Floats
    state: Floats
    step: Floats
    information: Floats
    seen: Floats


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
    memory : Memory or None
        What has left.

    """

    track_id: str
    class_name: str
    observations: Sequence[Observation]
    fresh: int
    start: Floats
    memory: Memory | None = None

    @property
    def is_warm(self) -> bool:
        """Tell whether all but the newest observation have been solved before."""
        return self.fresh == 1 and len(self.start) == len(self.observations) - 1 > 1

    def fresh_part(self) -> 'Window':
        """Return the window of what is fresh, of very many an even part, but for the newest."""
        last = len(self.observations) - 1
        part = slice(max(0, last - self.fresh), last, 1 + self.fresh // TELLING)
        return Window(*self[:2], self.observations[part], self.fresh, self.start[part])


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
    points, origins = np.full((*mask.shape, 3), AWAY, dtype=np.float32), np.zeros((B, N, 3))
    delays = np.zeros(mask.shape, dtype=np.float32)
    boxes[valid] = np.concatenate([o.box for o in every]).reshape(-1, 9)
    origins[valid] = np.concatenate([o.origin for o in every]).reshape(-1, 3)
    ground[valid] = [o.ground for o in every]
    begin = np.repeat([w.observations[0].stamp_ns for w in windows], lengths)
    times[valid] = (np.array([o.stamp_ns for o in every]) - begin) * 1e-9
    for axis, values in enumerate(np.concatenate([o.points for o in every]).T):
        points[..., axis][mask] = values  # all three at once would take six times as long
    delays[mask] = np.concatenate([o.delays for o in every])
    row, step, last = np.arange(B)[:, None], np.arange(N), lengths[:, None] - 1
    boxes, times = (part[row, np.minimum(step, last)] for part in (boxes, times))
    times += 0.1 * np.maximum(step - last, 0)
    known = zip(*(w.memory or (w.observations[0].box[:3], *NOTHING) for w in windows), strict=True)
    base, state, move, information, seen = (np.array(part) for part in known)
    yaw = np.unwrap(boxes[..., YAW])
    if config.ingredients.heading_sign:
        yaw = one_heading(boxes, times, valid, state[:, 5])
    tilt = boxes[..., ROLL:YAW] * np.sign(np.cos(yaw - boxes[..., YAW]))[..., None]
    boxes[..., ROLL:YAW] = (tilt + np.pi) % (2 * np.pi) - np.pi
    boxes[..., YAW] = yaw
    start = boxes.copy()
    for b, window in enumerate(windows):
        start[b, : len(window.start)] = window.start
    turns = np.pi * np.array([2, 2, 1])  # a box kept may have come turned around
    start[..., 6:9] += turns * np.round((boxes[..., 6:9] - start[..., 6:9]) / turns)
    boxes[..., :3] -= base[:, None]
    start[..., :3] -= base[:, None]
    turns = np.rint((start[:, [0, 1 % N], 6:9].reshape(B, 6) - state[:, ANGLES]) / np.pi)
    recalled = state + move
    recalled[:, ANGLES] += np.pi * turns
    information *= FADING * (turns % 2 == 0).all(1)[:, None, None]
    rows = {k: astuple(config.class_config(k))[1:] for k in {w.class_name for w in windows}}
    numbers = np.array([rows[window.class_name] for window in windows], dtype=np.float64)
    arrays: list[Any] = [boxes, start, valid, times, points, mask, delays, origins, ground]
    arrays += [np.nan_to_num(recalled), information, seen, numbers]
    return Problem(*(torch.from_numpy(array).to(device) for array in arrays)), base


def one_heading(boxes: Floats, times: Floats, valid: NDArray[np.bool_], known: Floats) -> Floats:
    """
    Return the yaw (B, N) of `boxes` (B, N, 9), unwrapped [rad], half turns undone.

    Those are undone that are in the minority; where the heading of the first is `known` (B,),
    not NaN, three quarters must say otherwise. What is faster than anything reverses moves
    forward, whatever its boxes say; `times` (B, N) [s]. A box that is turned by a quarter does
    not take those after it along.

    """
    chain, near = boxes[..., YAW].copy(), boxes[:, 0, YAW]
    for now in chain.T[1:]:
        off = (now - near + np.pi / 2) % np.pi - np.pi / 2
        now[:], near = near + off, near + off * 2 / 3
    turned = ((np.cos(boxes[..., YAW] - chain) < 0) & valid).sum(1) / valid.sum(1)
    limit = np.where(np.cos(known - chain[:, 0]) < 0, 0.25, np.where(np.isnan(known), 0.5, 0.75))
    dx, dy = np.moveaxis(np.diff(boxes[..., :2], axis=1, prepend=boxes[:, :1, :2]), 2, 0)
    along = (dx * np.cos(chain) + dy * np.sin(chain)) / np.diff(times, prepend=-1.0)
    speed = np.sort(np.where(valid, along, np.inf))[np.arange(len(boxes)), (valid.sum(1) - 1) // 2]
    turned = np.where(np.abs(speed) > REVERSE, speed < 0, turned > limit)
    return np.where(turned[:, None], chain + np.pi, chain)
