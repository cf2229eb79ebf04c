"""Pairing of sweeps and box arrays by header stamp; the same live and offline."""

from bisect import insort
from collections import Counter
from collections.abc import Iterator
from math import inf
from typing import NamedTuple

from boxreg_ros.config import Config
from boxreg_ros.errors import ShapeError
from boxreg_ros.reasons import Reason
from boxreg_ros.structures import BoxArray, Sweep

AT_ONCE = 0.02
"""Boxes take a sweep this near in time without waiting for a nearer one [s]. Chosen: a fifth of
the period of a LiDAR."""


class Pair(NamedTuple):
    """A box array and its sweep, None where there is none."""

    boxes: BoxArray
    sweep: Sweep | None


class StampMatcher:
    """
    Pair sweeps with box arrays; pairs are returned in the order of the box arrays' stamps.

    A box array takes the nearest sweep within `AT_ONCE` at once. A sweep within `reach` is taken
    as soon as a younger sweep than the boxes is known: no later one can be nearer, whichever kind
    arrives first. A sweep may be paired with several box arrays. A box array whose sweep was
    dropped is returned without one. At most `queue` sweeps and `queue` box arrays are held.
    Dropped sweeps are counted in `counts` by reason.

    """

    def __init__(self, config: Config, counts: Counter[str]) -> None:
        self._reach_ns = round(config.reach * 1e9)
        self._at_once_ns = min(round(AT_ONCE * 1e9), self._reach_ns)
        self._capacity = config.queue
        self._counts = counts
        self._sweeps: list[Sweep] = []  # ascending by stamp
        self._boxes: list[BoxArray] = []  # ascending by stamp
        self._used_ns: set[int] = set()  # stamps of held sweeps that were paired
        self._newest_ns = -inf  # of all sweeps added
        self._oldest_ns = -inf  # sweeps before this one are late

    def add_sweep(self, sweep: Sweep) -> list[Pair]:
        """Add a sweep; return the pairs completed by it."""
        if sweep.stamp_ns < self._oldest_ns:
            self._counts[Reason.SWEEP_LATE] += 1
        elif any(sweep.stamp_ns == other.stamp_ns for other in self._sweeps):
            self._counts[Reason.SWEEP_DUPLICATE] += 1
        else:
            insort(self._sweeps, sweep, key=lambda item: item.stamp_ns)
        self._newest_ns = max(self._newest_ns, sweep.stamp_ns)
        pairs = list(self._pop_pairs())
        if len(self._sweeps) > self._capacity:
            self._discard_before(self._sweeps[1].stamp_ns)
        return pairs

    def add_boxes(self, boxes: BoxArray) -> list[Pair]:
        """Add a box array; return the pairs completed by it."""
        insort(self._boxes, boxes, key=lambda item: item.stamp_ns)
        return list(self._pop_pairs())

    def flush(self) -> list[Pair]:
        """Return all box arrays held, paired or not, and discard all sweeps."""
        pairs = list(self._pop_pairs(is_flush=True))
        self._discard_before(self._newest_ns + 1)
        return pairs

    def _pop_pairs(self, is_flush: bool = False) -> Iterator[Pair]:
        """Yield the oldest box arrays as long as no later sweep can be nearer to them."""
        while self._boxes:
            stamp_ns = self._boxes[0].stamp_ns
            sweep = min(self._sweeps, key=lambda s: abs(s.stamp_ns - stamp_ns), default=None)
            offset_ns = self._reach_ns + 1
            if sweep is not None:
                offset_ns = abs(sweep.stamp_ns - stamp_ns)
            is_decided = offset_ns <= self._at_once_ns or self._newest_ns >= stamp_ns
            is_over_capacity = len(self._boxes) > self._capacity
            if not (is_decided or is_over_capacity or is_flush):
                return
            if offset_ns > self._reach_ns:
                sweep = None
            if sweep is not None:
                self._used_ns.add(sweep.stamp_ns)
                if sweep.is_dropped:
                    sweep = None
                else:
                    _check_frames(sweep, self._boxes[0])
            yield Pair(self._boxes.pop(0), sweep)
            self._discard_before(stamp_ns - self._reach_ns)

    def _discard_before(self, oldest_ns: float) -> None:
        """Discard older sweeps; count those that were paired with no box array."""
        self._oldest_ns = max(self._oldest_ns, oldest_ns)
        while self._sweeps and self._sweeps[0].stamp_ns < oldest_ns:
            stamp_ns = self._sweeps.pop(0).stamp_ns
            if stamp_ns not in self._used_ns:
                self._counts[Reason.SWEEP_WITHOUT_BOXES] += 1
            self._used_ns.discard(stamp_ns)


def _check_frames(sweep: Sweep, boxes: BoxArray) -> None:
    """Raise ShapeError if a sweep is in another frame than its boxes; '' is any frame."""
    if sweep.frame_id != boxes.frame_id and sweep.frame_id and boxes.frame_id:
        raise ShapeError(
            f'sweep at {sweep.stamp_ns} ns: expected the frame of its boxes, {boxes.frame_id!r}, '
            f'got {sweep.frame_id!r}; bring both into one fixed frame'
        )
