"""Which sweep belongs to which box array, by header stamp; the same online and offline."""

from bisect import insort
from collections import Counter
from collections.abc import Iterator
from math import inf
from typing import NamedTuple

from boxreg_ros.config import Config
from boxreg_ros.structures import BoxArray, Sweep


class Pair(NamedTuple):
    """A box array and its sweep, or None where no sweep came."""

    boxes: BoxArray
    sweep: Sweep | None


class StampMatcher:
    """
    Pair sweeps with box arrays; pairs leave in the order of their boxes' stamps.

    A sweep within the tolerance is taken at once, one within reach when a sweep younger than the
    boxes has come: then none can be closer, in whatever order the two kinds arrive. One sweep
    may serve several box arrays. The boxes of a sweep that is lost leave alone at once. Neither
    kind waits longer than for `queue` others.

    Parameters
    ----------
    config : Config
        Read are `tolerance`, `reach` and `queue`.
    counts : Counter
        Where what is dropped is counted by reason.

    """

    def __init__(self, config: Config, counts: Counter[str]) -> None:
        self._tolerance_ns = round(config.tolerance * 1e9)
        self._reach_ns = round(max(config.reach, config.tolerance) * 1e9)
        self._capacity, self._counts = config.queue, counts
        self._sweeps, self._boxes, self._used = list[Sweep](), list[BoxArray](), set[int]()
        self._newest_ns = self._oldest_ns = -inf  # sweep that came, sweep that is still of use

    def add_sweep(self, sweep: Sweep) -> list[Pair]:
        """Take a sweep; return the pairs that are complete now."""
        if sweep.stamp_ns < self._oldest_ns:
            self._counts['sweep_late'] += 1
        elif any(sweep.stamp_ns == other.stamp_ns for other in self._sweeps):
            self._counts['sweep_duplicate'] += 1
        else:
            insort(self._sweeps, sweep, key=lambda item: item.stamp_ns)
        self._newest_ns = max(self._newest_ns, sweep.stamp_ns)
        pairs = list(self._complete())
        if len(self._sweeps) > self._capacity:
            self._forget_before(self._sweeps[1].stamp_ns)
        return pairs

    def add_boxes(self, boxes: BoxArray) -> list[Pair]:
        """Take a box array; return the pairs that are complete now."""
        insort(self._boxes, boxes, key=lambda item: item.stamp_ns)
        return list(self._complete())

    def flush(self) -> list[Pair]:
        """Return what still waits, paired or not, and forget all sweeps."""
        pairs = list(self._complete(hopeless=True))
        self._forget_before(self._newest_ns + 1)
        return pairs

    def _complete(self, hopeless: bool = False) -> Iterator[Pair]:
        while self._boxes:
            stamp_ns = self._boxes[0].stamp_ns
            distances = [abs(sweep.stamp_ns - stamp_ns) for sweep in self._sweeps]
            away = min(distances, default=self._reach_ns + 1)
            is_open = away > self._tolerance_ns and self._newest_ns < stamp_ns and not hopeless
            if is_open and len(self._boxes) <= self._capacity:
                break
            near = self._sweeps[distances.index(away)] if away <= self._reach_ns else None
            self._used.update([near.stamp_ns] if near else [])
            yield Pair(self._boxes.pop(0), None if near and near.is_lost else near)
            self._forget_before(stamp_ns - self._reach_ns)

    def _forget_before(self, oldest_ns: float) -> None:
        self._oldest_ns = max(self._oldest_ns, oldest_ns)
        while self._sweeps and self._sweeps[0].stamp_ns < oldest_ns:
            stamp_ns = self._sweeps.pop(0).stamp_ns
            self._counts.update([] if stamp_ns in self._used else ['sweep_without_boxes'])
            self._used.discard(stamp_ns)
