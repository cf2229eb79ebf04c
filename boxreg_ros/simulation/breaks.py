"""Break the tracks of a detector on purpose: missed boxes, gaps, changed ids and ghosts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from boxreg_ros.errors import ConfigError
from boxreg_ros.rotations import matrix_from_rpy
from boxreg_ros.structures import (
    BOX_CENTER,
    BOX_EXTENT,
    BoxArray,
    concatenated,
    Floats,
    ROLL,
    X,
    Y,
    YAW,
)
import numpy as np
from numpy.typing import NDArray

BREAK_MISS_PROBABILITY = 0.08
"""Part of the boxes that are missing beside the gaps; literature: PointRCNN misses 6.8 %."""
SWEEPS_PER_GAP = 60
"""A track has one gap in so many sweeps on average; chosen."""
GAP_SWEEPS = (3, 8)
"""Least and greatest length of a gap; chosen: 0.3 to 0.8 s at 10 Hz."""
ID_CHANGE_PROBABILITY = 0.5
"""Part of the gaps after which the id is another one; chosen."""

GHOST_PREFIX = 'ghost'
"""Beginning of the ids of ghosts."""
GHOST_SWEEPS = (1, 3)
"""Least and greatest lifetime of a ghost; chosen: trackers confirm a track after three boxes."""
GHOST_RANGE = (5.0, 40.0)
"""Least and greatest horizontal distance of a ghost to the sensor [m]; chosen."""
DUPLICATE_PROBABILITY = 0.2
"""Part of the ghosts that are a second box of an object; chosen."""
GHOST_JITTER = 0.15
"""Standard deviation of the steps of a ghost, and of a second box from the first [m]; chosen."""

Misses = Callable[[str, Sequence[int], np.random.Generator], NDArray[np.bool_]]
"""Takes a track and the rows of its n arrays; says in which of them it is missed, (n,)."""


def independent_misses(
    _: str, arrays: Sequence[int], rng: np.random.Generator
) -> NDArray[np.bool_]:
    """Return misses of a track that do not depend on each other, nor on where it is."""
    return rng.random(len(arrays)) < BREAK_MISS_PROBABILITY


@dataclass(frozen=True, slots=True)
class _Ghost:
    """A box without an object; `source` is the track that it duplicates, if any."""

    track_id: str
    class_name: str
    box: Floats
    first: int
    last: int
    source: str


def break_tracks(
    arrays: Sequence[BoxArray],
    rng: np.random.Generator,
    ghosts: float = 0.0,
    origins: Floats | None = None,
    misses: Misses = independent_misses,
) -> list[BoxArray]:
    """
    Return box arrays with missed boxes, gaps, changed ids and ghosts.

    Parameters
    ----------
    arrays : sequence of BoxArray
        One per sweep, in the order of stamps, in one fixed frame.
    rng : numpy.random.Generator
        Source of all random numbers.
    ghosts : float
        Mean number of boxes per sweep that belong to no object.
    origins : array, shape (n, 3), or None
        Positions of the sensor in the fixed frame at each of the n arrays [m]; needed for ghosts.
    misses : callable
        See `Misses`; by default they do not depend on each other.

    Returns
    -------
    arrays : list of BoxArray
        One for each of the input. The boxes that are left have exactly the input poses and
        extents.

    Raises
    ------
    ConfigError
        If `ghosts` is negative, or needs `origins` that are not given.

    """
    if ghosts < 0 or (ghosts and origins is None):
        raise ConfigError(f'ghosts: expected 0 or more, and origins, got {ghosts:g}')
    sweeps_of: dict[str, list[int]] = {}
    for sweep, array in enumerate(arrays):
        for track_id in array.track_ids:
            sweeps_of.setdefault(track_id, []).append(sweep)
    new_id: dict[tuple[int, str], str] = {}  # of the boxes that are left, by sweep and old id
    for track_id, sweeps in sweeps_of.items():
        names = _broken_names(track_id, len(sweeps), rng)
        is_missed = misses(track_id, sweeps, rng)
        for sweep, name, is_gone in zip(sweeps, names, is_missed, strict=True):
            if name and not is_gone:
                new_id[sweep, track_id] = name
    broken = [_renamed(array, sweep, new_id) for sweep, array in enumerate(arrays)]
    if ghosts and origins is not None:
        return _haunted(arrays, broken, origins, ghosts, rng)
    return broken


def _broken_names(track_id: str, count: int, rng: np.random.Generator) -> list[str]:
    """Return the id of each of `count` boxes of a track after breaking it; '' in a gap."""
    names = [track_id] * count
    part = 0
    box = 1 + round(rng.exponential(SWEEPS_PER_GAP))
    while box < count - 1:
        length = int(rng.integers(GAP_SWEEPS[0], GAP_SWEEPS[1], endpoint=True))
        end = min(box + length, count)
        names[box:end] = [''] * (end - box)
        if rng.random() < ID_CHANGE_PROBABILITY:
            part += 1
        suffix = f'_{part}' if part else ''
        names[end:] = [track_id + suffix] * (count - end)
        box = end + 1 + round(rng.exponential(SWEEPS_PER_GAP))
    return names


def _renamed(array: BoxArray, sweep: int, new_id: dict[tuple[int, str], str]) -> BoxArray:
    """Return the boxes of a sweep that are left, with their new ids."""
    names = [new_id.get((sweep, track_id), '') for track_id in array.track_ids]
    rows = [row for row, name in enumerate(names) if name]
    return replace(array, track_ids=tuple(names)).take(rows)


def _haunted(
    arrays: Sequence[BoxArray],
    broken: Sequence[BoxArray],
    origins: Floats,
    ghosts: float,
    rng: np.random.Generator,
) -> list[BoxArray]:
    """Return the broken arrays with ghosts behind their boxes."""
    mean_lifetime = sum(GHOST_SWEEPS) / 2
    found: list[_Ghost] = []
    for sweep, array in enumerate(arrays):
        for _ in range(rng.poisson(ghosts / mean_lifetime)):
            if len(array.track_ids):
                found.append(
                    _ghost(f'{GHOST_PREFIX}{len(found)}', array, sweep, origins[sweep], rng)
                )
    haunted = []
    for sweep, array in enumerate(broken):
        alive = [ghost for ghost in found if ghost.first <= sweep <= ghost.last]
        haunted.append(_with_ghosts(array, arrays[sweep], alive, rng))
    return haunted


def _ghost(
    track_id: str, array: BoxArray, sweep: int, origin: Floats, rng: np.random.Generator
) -> _Ghost:
    """Return a ghost with the class, extents and height of one of the boxes of an array."""
    row = int(rng.integers(len(array.track_ids)))
    box = array.boxes[row].copy()
    source = ''
    if rng.random() < DUPLICATE_PROBABILITY:
        source = array.track_ids[row]
    else:
        bearing = rng.uniform(-np.pi, np.pi)
        distance = rng.uniform(*GHOST_RANGE)
        box[X] = origin[0] + distance * np.cos(bearing)
        box[Y] = origin[1] + distance * np.sin(bearing)
        box[YAW] = rng.uniform(-np.pi, np.pi)
    last = sweep + int(rng.integers(GHOST_SWEEPS[0], GHOST_SWEEPS[1], endpoint=True)) - 1
    return _Ghost(track_id, array.class_names[row], box, sweep, last, source)


def _with_ghosts(
    array: BoxArray, original: BoxArray, ghosts: Sequence[_Ghost], rng: np.random.Generator
) -> BoxArray:
    """Return an array with the ghosts of its sweep; duplicates follow the `original` box."""
    boxes = []
    for ghost in ghosts:
        box = ghost.box.copy()
        if ghost.source in original.track_ids:
            box = original.boxes[original.track_ids.index(ghost.source)].copy()
            box[BOX_EXTENT] *= rng.uniform(0.8, 1.2, 3)
        box[BOX_CENTER] += matrix_from_rpy(box[ROLL:]) @ rng.normal(0, GHOST_JITTER, 3)
        boxes.append(box)
    own = BoxArray(
        array.stamp_ns,
        array.frame_id,
        tuple(ghost.track_id for ghost in ghosts),
        tuple(ghost.class_name for ghost in ghosts),
        rng.uniform(0.5, 0.99, len(boxes)).round(2),
        np.array(boxes).reshape(-1, 9),
    )
    return concatenated([array, own])
