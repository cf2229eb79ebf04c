"""Pairing of sweeps and box arrays by header stamp; the same live and offline."""

from bisect import insort
from collections import Counter, deque
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


STEPS = 10
"""Last steps between the stamps of sweeps that their period is known from; chosen: a second at
10 Hz."""
FEWEST_STEPS = 3
"""Fewer steps are no period; chosen: one may follow a lost sweep."""
LAGS = 100
"""Sweeps in order after which none is waited for behind a younger one; chosen: 10 s at 10 Hz."""
LAG_MARGIN = 1.5
"""Factor of the largest known lag by which a sweep is waited for; chosen: periods vary by less."""


class Pair(NamedTuple):
    """A box array and its sweep, None where there is none, or it is not known yet."""

    boxes: BoxArray
    sweep: Sweep | None = None
    reason: str = ''
    """Why the boxes are kept, whether or not there is a sweep; empty for others."""
    is_dropped: bool = False
    """Whether the sweep of the boxes was dropped."""
    order_ns: int = 0
    """Stamp by which the array stands among the others that wait [ns]."""


class StampMatcher:
    """
    Pair sweeps with box arrays; pairs are returned in the order of the box arrays' stamps.

    A box array takes the nearest sweep within `AT_ONCE` at once. A sweep within `reach` is taken
    as soon as no later one can be nearer, whichever kind arrives first: when a younger sweep than
    the boxes is known, or when the boxes are in the first half of the shortest step between the
    last sweeps. Once a sweep has come behind a younger one, by no more than the longest of the
    last steps, boxes wait for such a sweep, too, until `LAGS` have come in order. Where the sweeps
    are further behind than boxes are held, as by another clock, boxes wait for none. A sweep may
    be paired with several box arrays. A box array whose sweep was dropped is returned without one.
    At most `queue` sweeps and `queue` box arrays are held. Dropped sweeps are counted in `counts`
    by reason.

    """

    def __init__(self, config: Config, counts: Counter[str]) -> None:
        self._reach_ns = round(config.reach * 1e9)
        self._at_once_ns = min(round(AT_ONCE * 1e9), self._reach_ns)
        self._capacity = config.queue
        self._counts = counts
        self._sweeps: list[Sweep] = []  # ascending by stamp
        self._unpaired: list[Pair] = []  # ascending by stamp
        self._newest_boxes_ns = 0
        self._used_ns: set[int] = set()  # stamps of held sweeps that were paired
        self._newest_ns = -inf  # of all sweeps added, and boxes released
        self._newest_sweep_ns = -inf  # of all sweeps added that were not dropped
        self._lags_ns = deque[float](maxlen=LAGS)  # of sweeps behind a younger one; -1 in order
        self._released_ns = -inf  # boxes up to here wait for no sweep
        self._steps_ns = deque[float](maxlen=STEPS)
        self._oldest_ns = -inf  # sweeps before this one are late

    @property
    def unpaired(self) -> list[BoxArray]:
        """Return the box arrays that wait, in their order."""
        return [one.boxes for one in self._unpaired]

    def add_sweep(self, sweep: Sweep) -> Iterator[Pair]:
        """Add a sweep; return the pairs completed by it, which are taken from here one by one."""
        if sweep.stamp_ns < self._oldest_ns:
            self._counts[Reason.SWEEP_LATE] += 1
        elif any(sweep.stamp_ns == other.stamp_ns for other in self._sweeps):
            self._counts[Reason.SWEEP_DUPLICATE] += 1
        else:
            insort(self._sweeps, sweep, key=lambda item: item.stamp_ns)
        if not sweep.is_dropped:
            lag_ns = self._newest_sweep_ns - sweep.stamp_ns
            is_lag = 0 < lag_ns <= max(self._steps_ns, default=0)
            self._lags_ns.append(lag_ns if is_lag else -1)
            if is_lag:  # a step that the younger sweep hid
                self._steps_ns.append(lag_ns)
            self._newest_sweep_ns = max(self._newest_sweep_ns, sweep.stamp_ns)
        if -inf < self._newest_ns < sweep.stamp_ns:
            self._steps_ns.append(sweep.stamp_ns - self._newest_ns)
        self._newest_ns = max(self._newest_ns, sweep.stamp_ns)
        return self._pop_pairs_of_sweeps()

    def add_boxes(self, boxes: BoxArray, reason: str = '') -> Iterator[Pair]:
        """
        Add a box array; return the pairs completed by it, which are taken from here one by one.

        Parameters
        ----------
        boxes : BoxArray
            In the frame of the sweeps.
        reason : str
            Why it is kept: it then waits for no sweep, but for the arrays before it, and one
            without a stamp stands behind the newest. Empty for boxes to register.

        Returns
        -------
        iterator of Pair
            By their stamps.

        Raises
        ------
        ShapeError
            If a sweep is in another frame than its boxes; raised by the iterator.

        """
        order_ns = boxes.stamp_ns
        if reason and order_ns <= 0:
            order_ns = self._newest_boxes_ns
        elif not reason:
            self._newest_boxes_ns = max(self._newest_boxes_ns, order_ns)
        waiting = Pair(boxes, reason=reason, order_ns=order_ns)
        insort(self._unpaired, waiting, key=lambda one: one.order_ns)
        return self._pop_pairs()

    def release(self, stamp_ns: int) -> Iterator[Pair]:
        """Return the pairs of the box arrays up to a stamp, which wait for no sweep any more."""
        self._newest_ns = max(self._newest_ns, stamp_ns)
        self._released_ns = max(self._released_ns, stamp_ns)
        return self._pop_pairs()

    def flush(self) -> Iterator[Pair]:
        """Yield all box arrays held, paired or not, and discard all sweeps."""
        yield from self._pop_pairs(is_flush=True)
        self._discard_before(self._newest_ns + 1)

    def _pop_pairs_of_sweeps(self) -> Iterator[Pair]:
        """Yield pairs; then discard the oldest sweep if there are too many."""
        yield from self._pop_pairs()
        if len(self._sweeps) > self._capacity:
            self._discard_before(self._sweeps[1].stamp_ns)

    def _pop_pairs(self, is_flush: bool = False) -> Iterator[Pair]:
        """Yield the oldest box arrays as long as no later sweep can be nearer to them."""
        while self._unpaired:
            first = self._unpaired[0]
            if first.reason:
                yield self._unpaired.pop(0)
                continue
            stamp_ns = first.boxes.stamp_ns
            sweep = min(self._sweeps, key=lambda s: abs(s.stamp_ns - stamp_ns), default=None)
            offset_ns = self._reach_ns + 1
            if sweep is not None:
                offset_ns = abs(sweep.stamp_ns - stamp_ns)
            is_decided = offset_ns <= self._at_once_ns or self._is_decided(stamp_ns)
            is_over_capacity = len(self._unpaired) > self._capacity
            if not (is_decided or is_over_capacity or is_flush):
                return
            if offset_ns > self._reach_ns:
                sweep = None
            is_dropped = sweep is not None and sweep.is_dropped
            if sweep is not None:
                self._used_ns.add(sweep.stamp_ns)
            if is_dropped:
                sweep = None
            if sweep is not None:
                _check_frames(sweep, first.boxes)
            yield self._unpaired.pop(0)._replace(sweep=sweep, is_dropped=is_dropped)
            # Boxes of another clock may be far ahead of all sweeps.
            self._discard_before(min(stamp_ns, self._newest_ns) - self._reach_ns)

    def _is_decided(self, stamp_ns: int) -> bool:
        """Return whether no later sweep can be nearer to a stamp, or is waited for."""
        if self._released_ns >= stamp_ns:
            return True
        if self._newest_ns >= stamp_ns:
            return self._newest_ns > stamp_ns + LAG_MARGIN * max(self._lags_ns, default=-1)
        if len(self._steps_ns) < FEWEST_STEPS:
            return False
        behind_ns = stamp_ns - self._newest_ns
        is_nearest = 2 * behind_ns < min(self._steps_ns)
        # At most `queue` box arrays are held, for about as many steps.
        is_apart = behind_ns - self._reach_ns > (self._capacity + 1) * max(self._steps_ns)
        return is_nearest or is_apart

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
