"""Batches of windows as padded tensors."""

from collections.abc import Sequence
from functools import partial
from typing import Any

from boxreg_ros.config import Config, KINDS
from boxreg_ros.core.batch import (
    numbers_of,
    PADDING_PERIOD,
    PRIOR_SIZE,
    Problem,
    Returns,
    SHARED,
)
from boxreg_ros.core.observation import Observations
from boxreg_ros.core.tables import joined
from boxreg_ros.core.track_window import MarginalisationPrior, Window
from boxreg_ros.structures import Floats, Ints, ROLL, YAW
import numpy as np
from numpy.typing import NDArray
import torch
from torch import Tensor

PRIOR_DECAY = 0.97
"""
Factor on the information of the marginalisation prior, per observation; chosen.

An error model that is constant over a track holds for a limited time: 0.97 halves the information
after 23 observations.

"""
MAX_REVERSE_SPEED = 6.0
"""A faster object moves forward [m/s]; chosen: no road vehicle reverses at 22 km/h."""
KNOWN_FLIP_SHARE = 0.75
"""
Share of contrary headings above which a known heading sign is changed; chosen.

Without a known sign the majority decides: a share of 0.5.

"""
MAX_BATCH_VALUES = 3e7
"""Most point coordinates, or entries of the Hessian, in a batch; derived: 240 MB as float64."""
VALUES_PER_POINT = 18
"""Values held per point while a batch is solved; estimated from the temporary tensors."""
PRIOR_ANGLES = [3, 4, 5, 9, 10, 11]
"""Angles among the variables of the marginalisation prior: of its two poses."""


NO_PRIOR = (
    np.full(PRIOR_SIZE, np.nan),
    np.zeros(PRIOR_SIZE),
    np.zeros((PRIOR_SIZE, PRIOR_SIZE)),
    np.zeros(4),
)
"""State, step, information and extents of a prior without information."""


def group_windows(windows: Sequence[Window], config: Config) -> list[list[int]]:
    """
    Return groups of rows of `windows` to solve together.

    A group is either all warm or all cold, of similar lengths, and within `MAX_BATCH_VALUES`.
    Windows shorter than `min_observations` are in no group.

    """
    lengths = [len(window.observations) for window in windows]
    rows = [row for row, length in enumerate(lengths) if length >= config.min_observations]
    rows.sort(key=lambda row: (windows[row].is_warm, lengths[row], row))
    groups: list[list[int]] = []
    for row in rows:
        length = lengths[row]
        hessian = (6 * length + SHARED) ** 2
        points = length * config.sampling.points * VALUES_PER_POINT
        is_full = not groups or (len(groups[-1]) + 1) * max(hessian, points) > MAX_BATCH_VALUES
        if is_full or windows[groups[-1][0]].is_warm != windows[row].is_warm:
            groups.append([])
        groups[-1].append(row)
    return groups


def stack_windows(windows: Sequence[Window], config: Config) -> tuple[Problem, Floats]:
    """
    Stack windows to padded tensors, see `Problem`.

    Parameters
    ----------
    windows : sequence of B Window
        Each with at least one observation.
    config : Config
        Settings.

    Returns
    -------
    problem : Problem
        Positions are relative to `base`.
    base : array, shape (B, 3)
        One origin per window in the fixed frame [m].

    """
    lengths = np.array([len(window.observations) for window in windows])
    valid = np.arange(lengths.max()) < lengths[:, None]  # (B, N)
    tables, rows = joined([item for window in windows for item in window.observations])
    seen = Observations.concatenated(tables)
    if 2 * len(rows) < len(seen.boxes):  # of another group: their points are not held twice
        seen, rows = seen.take(rows), np.arange(len(rows))
    boxes, times, origins, ground = _stack_observations(seen, rows, valid)
    priors = [w.prior or _no_prior(w.observations[0].box[:3]) for w in windows]
    base, state, step, information, extents = (
        np.array(part) for part in zip(*priors, strict=True)
    )
    pinned = np.zeros(valid.shape, bool)
    pinned[valid] = seen.is_pinned[rows]
    if config.ingredients.heading_sign:
        boxes[..., ROLL:] = _resolved_angles(boxes, times, valid, pinned, state[:, 5])
    else:
        boxes[..., YAW] = np.unwrap(boxes[..., YAW])
    start = _starting_boxes(windows, boxes)
    boxes[..., :3] -= base[:, None]
    start[..., :3] -= base[:, None]
    minimum, is_usable = _prior_minimum(start, state, step)
    information *= PRIOR_DECAY * is_usable[:, None, None]
    first, counts = np.zeros((2, *valid.shape), np.int64)
    first[valid] = seen.first[rows]
    counts[valid] = seen.counts[rows]
    class_numbers, kind = _of_classes(windows, config)
    on_device = partial(_tensor, device=config.device)
    problem = Problem(
        boxes=on_device(boxes),
        start=on_device(start),
        valid=on_device(valid),
        times=on_device(times),
        returns=_returns(seen, int(counts.max()), config),
        first=on_device(first),
        counts=on_device(counts),
        origins=on_device(origins),
        ground=on_device(ground),
        prior_mean=on_device(np.nan_to_num(minimum)),
        prior_information=on_device(information),
        marginalised_extents=on_device(extents),
        class_numbers=on_device(class_numbers),
        kind=on_device(kind),
        pinned=on_device(pinned),
    )
    return problem, base


def _no_prior(base: Floats) -> MarginalisationPrior:
    """Return a prior without information, NaN as its linearisation point."""
    return MarginalisationPrior(base, *NO_PRIOR)


def _tensor(array: NDArray[Any], device: str) -> Tensor:
    return torch.from_numpy(array).to(device)


def _stack_observations(
    seen: Observations, rows: Ints, valid: NDArray[np.bool_]
) -> tuple[Floats, Floats, Floats, Floats]:
    """
    Return input boxes, times, sensor origins and ground heights of `rows`, padded.

    Shapes (B, N, 9), (B, N), (B, N, K, 3) and (B, N). Padding repeats the last box of a window, at
    later times, and the last sensor of an observation.

    """
    B, N = valid.shape
    lengths = valid.sum(1)
    begin = np.cumsum(lengths) - lengths
    column = np.arange(N)
    last = lengths[:, None] - 1
    padded = rows[begin[:, None] + np.minimum(column, last)]  # (B, N), the last row repeats
    origins = np.zeros((B, N, *seen.origins.shape[1:]))
    origins[valid] = seen.origins[rows]
    ground = np.full((B, N), np.nan)
    ground[valid] = seen.ground[rows]
    stamps_ns = seen.stamps_ns[padded]
    times = (stamps_ns - stamps_ns[:, :1]) * 1e-9 + PADDING_PERIOD * np.maximum(column - last, 0)
    return seen.boxes[padded], times, origins, ground


def _returns(seen: Observations, width: int, config: Config) -> Returns:
    """Return the points of all observations, with delays relative to the time of their box."""
    delays = seen.delays
    if config.sampling.box_time == 'sight' and seen.sights.any():
        delays = delays - np.repeat(seen.sights.astype(np.float32), seen.counts)
    return Returns(
        _tensor(seen.points, config.device),
        _tensor(delays, config.device),
        is_moving=bool(delays.any()),
        width=max(1, width),
    )


def _resolved_angles(
    boxes: Floats,
    times: Floats,
    valid: NDArray[np.bool_],
    pinned: NDArray[np.bool_],
    known_yaw: Floats,
) -> Floats:
    """
    Return roll, pitch and yaw (B, N, 3) of `boxes` (B, N, 9) with 180° flips corrected.

    A pinned box decides on the heading of its window.

    """
    yaw = resolve_headings(boxes, times, valid, known_yaw)
    is_contrary = np.any(pinned & (np.cos(yaw - boxes[..., YAW]) < 0), axis=1, keepdims=True)
    yaw = np.where(is_contrary, yaw + np.pi, yaw)
    # A half turn about the z axis of the box changes the signs of roll and pitch.
    is_same = np.sign(np.cos(yaw - boxes[..., YAW]))
    tilt = boxes[..., ROLL:YAW] * is_same[..., None]
    return np.concatenate([(tilt + np.pi) % (2 * np.pi) - np.pi, yaw[..., None]], axis=-1)


def _starting_boxes(windows: Sequence[Window], boxes: Floats) -> Floats:
    """Return where the search starts (B, N, 9): earlier estimates, else the input `boxes`."""
    start = boxes.copy()
    lengths = np.array([len(window.start) for window in windows])
    is_known = np.arange(boxes.shape[1]) < lengths[:, None]
    start[is_known] = np.concatenate([window.start for window in windows])
    # Whole turns, and half turns of yaw: a kept box is returned with the heading of its input.
    period = np.pi * np.array([2, 2, 1])
    start[..., ROLL:] += period * np.round((boxes[..., ROLL:] - start[..., ROLL:]) / period)
    return start


def _prior_minimum(start: Floats, state: Floats, step: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """
    Return the minimum of each prior (B, 35), and which priors fit the present headings (B,).

    Angles are moved by half turns to those of `start` (B, N, 9). A prior that an odd number of
    them is needed for holds for the other heading sign.

    """
    B, N = start.shape[:2]
    angles = start[:, [0, 1 % N], ROLL:].reshape(B, len(PRIOR_ANGLES))
    half_turns = np.rint((angles - state[:, PRIOR_ANGLES]) / np.pi)
    minimum = state + step
    minimum[:, PRIOR_ANGLES] += np.pi * half_turns
    return minimum, np.asarray((half_turns % 2 == 0).all(1))


def _of_classes(windows: Sequence[Window], config: Config) -> tuple[Floats, Ints]:
    """Return numbers of the `ClassConfig` (B, C) and kind (B,) of each window, see `Problem`."""
    kinds = {name: config.kind(name) for name in {window.class_name for window in windows}}
    kind = np.array([KINDS.index(kinds[window.class_name]) for window in windows])
    numbers = np.array([numbers_of(getattr(config, name)) for name in KINDS], dtype=np.float64)
    return numbers[kind], kind


def resolve_headings(
    boxes: Floats, times: Floats, valid: NDArray[np.bool_], known_yaw: Floats
) -> Floats:
    """
    Return unwrapped yaw angles with one heading sign per window, 180° flips corrected.

    The majority of a window decides on the sign; against a known sign, three quarters. An object
    faster than `MAX_REVERSE_SPEED` heads where it moves. A single heading that is off by a
    quarter turn does not affect those after it.

    Parameters
    ----------
    boxes : array, shape (B, N, 9)
        Input boxes [m, rad].
    times : array, shape (B, N)
        Increasing [s].
    valid : array, shape (B, N)
        False for padding.
    known_yaw : array, shape (B,)
        Heading of the first box as estimated before [rad]; NaN where unknown.

    Returns
    -------
    yaw : array, shape (B, N)
        Each within a whole number of half turns of the input [rad].

    """
    input_yaw = boxes[..., YAW]
    chain = input_yaw.copy()
    if chain.shape[1] == 1:
        return chain  # nothing contradicts a single heading
    trend = boxes[:, 0, YAW]
    for column in range(1, chain.shape[1]):
        change = (chain[:, column] - trend + np.pi / 2) % np.pi - np.pi / 2
        chain[:, column] = trend + change
        trend = trend + change * 2 / 3  # an outlier of a quarter turn moves it by 60° only
    is_contrary = (np.cos(input_yaw - chain) < 0) & valid
    share = is_contrary.sum(1) / valid.sum(1)
    limit = np.where(np.isnan(known_yaw), 0.5, KNOWN_FLIP_SHARE)
    limit = np.where(np.cos(known_yaw - chain[:, 0]) < 0, 1 - KNOWN_FLIP_SHARE, limit)
    speed = _median_forward_speed(boxes, times, valid, chain)
    is_flipped = np.where(np.abs(speed) > MAX_REVERSE_SPEED, speed < 0, share > limit)
    return np.where(is_flipped[:, None], chain + np.pi, chain)


def _median_forward_speed(
    boxes: Floats, times: Floats, valid: NDArray[np.bool_], yaw: Floats
) -> Floats:
    """Return the median speed of the centres along `yaw` (B, N), shape (B,) [m/s]."""
    dx, dy = np.moveaxis(np.diff(boxes[..., :2], axis=1, prepend=boxes[:, :1, :2]), 2, 0)
    along = (dx * np.cos(yaw) + dy * np.sin(yaw)) / np.diff(times, prepend=-1.0)
    ascending = np.sort(np.where(valid, along, np.inf))
    return np.asarray(ascending[np.arange(len(boxes)), (valid.sum(1) - 1) // 2])
