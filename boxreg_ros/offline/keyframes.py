"""The first pass over a recording whose boxes are keyframes: follow them through all sweeps."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
import mmap
from tempfile import TemporaryFile
from typing import Any

from boxreg_ros.config import Config
from boxreg_ros.core.follow import End, follow_points, FollowedTrack
from boxreg_ros.core.following.sweeps import ascending
from boxreg_ros.offline.every_sweep import Arrivals
from boxreg_ros.structures import BoxArray, Floats, Sweep
from boxreg_ros.tracks.complete import CompletionPlan
from boxreg_ros.tracks.followed import followed_plan
import numpy as np
from numpy.typing import NDArray

POINT = np.dtype((np.float32, 3))


class SweepStore:
    """
    The points of sweeps in a temporary file: a drive has more of them than fit the memory.

    Attributes
    ----------
    stamps_ns : list of int
        Stamps of the sweeps [ns].
    origin : array, shape (3,)
        Points are stored relative to this place, so that float32 is enough [m].

    """

    def __init__(self) -> None:
        self.stamps_ns: list[int] = []
        self.origin: Floats | None = None
        self._file = TemporaryFile()  # noqa: SIM115  closed with the store
        self._ends = [0]
        self._map: mmap.mmap | None = None

    def add(self, sweep: Sweep) -> None:
        """Add a sweep in the fixed frame that is later than those before."""
        if self.stamps_ns and sweep.stamp_ns <= self.stamps_ns[-1]:
            return
        points = sweep.in_frame().points
        if self.origin is None:
            self.origin = np.round(points[0]).astype(float) if len(points) else np.zeros(3)
        self.stamps_ns.append(sweep.stamp_ns)
        relative = ascending((points - self.origin).astype(np.float32))
        self._file.write(relative.tobytes())
        self._ends.append(self._ends[-1] + len(relative))

    def __len__(self) -> int:
        """Return the number of sweeps."""
        return len(self.stamps_ns)

    def __getitem__(self, row: int, /) -> NDArray[np.float32]:
        """Return the points (M, 3) of a sweep, ascending by x."""
        first, last = self._ends[row], self._ends[row + 1]
        if first == last:
            return np.zeros((0, 3), np.float32)
        if self._map is None:
            self._file.flush()
            self._map = mmap.mmap(self._file.fileno(), 0)
        return np.frombuffer(self._map, POINT, last - first, first * POINT.itemsize)


def keyframes(
    items: Iterable[tuple[Sweep | BoxArray | None, bool]], fixed_frame: str, config: Config
) -> tuple[CompletionPlan, list[Arrivals], list[FollowedTrack]]:
    """
    Follow the boxes of a recording through its sweeps.

    Parameters
    ----------
    items : iterable of (item, restarts)
        Sweeps and boxes in the fixed frame, and whether time went back before them.
    fixed_frame : str
        That frame.
    config : Config
        Classes of the objects.

    Returns
    -------
    plan : CompletionPlan
        What is added, for the arrays of `Arrivals.completed`.
    parts : list of Arrivals
        Of the recording between time jumps.
    tracks : list of FollowedTrack
        Of all parts.

    """
    parts = [Arrivals()]
    stores = [SweepStore()]
    for item, restarts in items:
        if restarts:
            parts.append(Arrivals())
            stores.append(SweepStore())
        if item is None:
            continue
        parts[-1].add(item)
        if isinstance(item, Sweep):
            stores[-1].add(item)
    plan = CompletionPlan([], [])
    tracks: list[FollowedTrack] = []
    for part, store in zip(parts, stores, strict=True):
        found = _followed(part.arrays, store, config)
        plan.append(followed_plan(part.completed(fixed_frame), found))
        tracks += found
    return plan, parts, tracks


def _followed(
    arrays: Sequence[BoxArray], store: SweepStore, config: Config
) -> list[FollowedTrack]:
    """Return the tracks of keyframes, in the fixed frame."""
    if not len(store):
        return []
    assert store.origin is not None
    offset = np.append(store.origin, np.zeros(6))
    seeds = [replace(array, boxes=array.boxes - offset) for array in arrays]
    found = follow_points(np.array(store.stamps_ns, np.int64), store, seeds, config)
    return [replace(track, boxes=track.boxes + offset) for track in found]


def ends_of(tracks: Sequence[FollowedTrack]) -> list[dict[str, Any]]:
    """Return where each track ends and why, for ``summary.json``."""

    def end(one: End) -> dict[str, Any]:
        return {'stamp_ns': one.stamp_ns, 'reason': one.reason}

    return [
        {
            'track_id': track.track_id,
            'boxes': len(track.rows),
            'before': end(track.ends[0]) if track.ends else None,
            'after': end(track.ends[1]) if track.ends else None,
            'problems': list(track.problems),
        }
        for track in tracks
    ]
