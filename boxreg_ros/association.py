"""Which sweep belongs to which box array, by header stamp; the same online and offline."""

from bisect import insort
from collections import Counter
from typing import NamedTuple

from boxreg_ros.structures import BoxArray, Sweep


class Pair(NamedTuple):
    """A box array and its sweep, or None where no sweep came."""

    boxes: BoxArray
    sweep: Sweep | None


class StampMatcher:
    """
    Pair sweeps with box arrays; pairs leave in the order of their boxes' stamps.

    A box array waits for its sweep until a sweep younger than itself has come, a sweep waits
    until boxes younger than itself have been paired, and neither longer than `capacity` others.

    Parameters
    ----------
    tolerance_ns : int
        Stamps further apart do not belong together [ns].
    capacity : int
        Sweeps, and box arrays, waited with.
    counts : Counter
        Where what is dropped is counted by reason.

    """

    def __init__(self, tolerance_ns: int, capacity: int, counts: Counter[str]) -> None:
        self._tolerance_ns = tolerance_ns
        self._capacity = capacity
        self._counts = counts
        self._sweeps: list[Sweep] = []
        self._boxes: list[BoxArray] = []
        self._newest_sweep_ns: int | None = None

    def add_sweep(self, sweep: Sweep) -> list[Pair]:
        """Take a sweep; return the pairs that are complete now."""
        insort(self._sweeps, sweep, key=lambda item: item.stamp_ns)
        newest = self._newest_sweep_ns
        self._newest_sweep_ns = sweep.stamp_ns if newest is None else max(sweep.stamp_ns, newest)
        pairs = self._complete()
        while len(self._sweeps) > self._capacity:
            self._forget_sweep(0)
        return pairs

    def add_boxes(self, boxes: BoxArray) -> list[Pair]:
        """Take a box array; return the pairs that are complete now."""
        insort(self._boxes, boxes, key=lambda item: item.stamp_ns)
        return self._complete()

    def flush(self) -> list[Pair]:
        """Return what still waits, paired or not, and forget everything."""
        pairs = self._complete(hopeless=True)
        while self._sweeps:
            self._forget_sweep(0)
        return pairs

    def _complete(self, hopeless: bool = False) -> list[Pair]:
        pairs = []
        while self._boxes:
            boxes = self._boxes[0]
            match = self._nearest(boxes.stamp_ns)
            if match is None and not (
                hopeless
                or len(self._boxes) > self._capacity
                or (
                    self._newest_sweep_ns is not None
                    and self._newest_sweep_ns > boxes.stamp_ns + self._tolerance_ns
                )
            ):
                break
            pairs.append(Pair(self._boxes.pop(0), match))
            while self._sweeps and self._sweeps[0].stamp_ns < boxes.stamp_ns - self._tolerance_ns:
                self._forget_sweep(0)
        return pairs

    def _nearest(self, stamp_ns: int) -> Sweep | None:
        distance = [abs(sweep.stamp_ns - stamp_ns) for sweep in self._sweeps]
        if not distance or min(distance) > self._tolerance_ns:
            return None
        return self._sweeps.pop(distance.index(min(distance)))

    def _forget_sweep(self, index: int) -> None:
        self._counts['sweep_without_boxes'] += 1
        del self._sweeps[index]
