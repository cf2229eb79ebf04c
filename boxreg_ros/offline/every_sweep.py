"""A box array for every sweep of a recording whose boxes come at fewer stamps."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from math import inf

from boxreg_ros.offline.reader import ReadItem
from boxreg_ros.structures import BoxArray, Floats, Sweep
import numpy as np


def empty_array(stamp_ns: int, frame_id: str) -> BoxArray:
    """Return an array without boxes."""
    return BoxArray(stamp_ns, frame_id, (), (), np.zeros(0), np.zeros((0, 9)))


@dataclass(slots=True)
class Arrivals:
    """Sweeps and box arrays of a part of a recording between two time jumps, as they arrived."""

    # the stamp of each sweep, and box arrays, in the fixed frame
    items: list[int | BoxArray] = field(default_factory=list)

    def add(self, item: Sweep | BoxArray) -> None:
        """Add an item that has a transform."""
        self.items.append(item.stamp_ns if isinstance(item, Sweep) else item)

    @property
    def sweeps_ns(self) -> list[int]:
        """Stamps of the sweeps."""
        return [item for item in self.items if not isinstance(item, BoxArray)]

    @property
    def arrays(self) -> list[BoxArray]:
        """Box arrays."""
        return [item for item in self.items if isinstance(item, BoxArray)]

    def missing_ns(self) -> list[int]:
        """Return the stamps of sweeps without a box array within half a period."""
        sweeps = np.unique(np.array(self.sweeps_ns, np.int64))
        arrays = np.sort(np.array([array.stamp_ns for array in self.arrays], np.int64))
        if len(sweeps) < 2 or not len(arrays):
            return []
        after = np.searchsorted(arrays, sweeps)
        nearest = np.stack([arrays[(after - 1).clip(0)], arrays[after.clip(0, len(arrays) - 1)]])
        away = np.abs(nearest - sweeps).min(0)
        missing: list[int] = sweeps[away > np.median(np.diff(sweeps)) / 2].tolist()
        return missing

    def completed(self, frame_id: str) -> list[BoxArray]:
        """Return the arrays in the order of `with_empty_arrays`, empty ones included."""
        inserter = Inserter([self])
        found: list[BoxArray] = []
        for item in self.items:
            if isinstance(item, BoxArray):
                found.append(item)
            stamp_ns = None if isinstance(item, BoxArray) else item
            found += [empty_array(one, frame_id) for one in inserter.after(stamp_ns, False)]
        return found


class Inserter:
    """Decide where empty arrays are inserted: after their sweep, and after all older arrays."""

    def __init__(self, parts: Sequence[Arrivals]) -> None:
        self._missing = [set(part.missing_ns()) for part in parts]
        self._oldest_to_come = [_oldest_to_come(part.arrays) for part in parts]
        self._part = 0
        self._arrived = 0
        self._waiting: list[int] = []

    def after(self, sweep_ns: int | None, restarts: bool) -> list[int]:
        """Return the stamps of empty arrays after the next item: a sweep, or None for boxes."""
        if restarts:
            self._part += 1
            self._arrived = 0
        if sweep_ns is None:
            self._arrived += 1
        elif sweep_ns in self._missing[self._part]:
            self._missing[self._part].discard(sweep_ns)
            self._waiting.append(sweep_ns)
        oldest = self._oldest_to_come[self._part][self._arrived]
        ready = [stamp_ns for stamp_ns in self._waiting if stamp_ns < oldest]
        self._waiting = [stamp_ns for stamp_ns in self._waiting if stamp_ns >= oldest]
        return sorted(ready)


def _oldest_to_come(arrays: Sequence[BoxArray]) -> list[float]:
    """Return the oldest stamp among the arrays from each on; inf behind the last."""
    oldest: list[float] = [inf]
    for array in reversed(arrays):
        oldest.append(min(oldest[-1], array.stamp_ns))
    return oldest[::-1]


def with_empty_arrays(
    items: Iterable[ReadItem], parts: Sequence[Arrivals], frame_id: str
) -> Iterator[ReadItem]:
    """Yield the items of a recording, and an empty array for each sweep without one."""
    inserter = Inserter(parts)
    poses: dict[int, Floats | None] = {}
    for item in items:
        yield item
        moved = item.moved
        if moved is None:
            continue
        is_sweep = isinstance(moved, Sweep)
        if is_sweep:
            poses[moved.stamp_ns] = item.T_fixed_sensor
        for stamp_ns in inserter.after(moved.stamp_ns if is_sweep else None, item.restarts):
            empty = empty_array(stamp_ns, frame_id)
            pose = poses.pop(stamp_ns)
            yield replace_item(item, empty, pose)


def replace_item(item: ReadItem, array: BoxArray, T_fixed_sensor: Floats | None) -> ReadItem:
    """Return an item with an array of the fixed frame instead."""
    return ReadItem(item.seconds, False, array, array, np.eye(4), T_fixed_sensor, None)
