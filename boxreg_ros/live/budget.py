"""Budget of a tick: the deadline of the boxes in windows, by the measured time of a window."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection
from dataclasses import dataclass
from functools import partial
from math import inf
from statistics import median
import time

from boxreg_ros.config import Config
from boxreg_ros.core.estimation import estimate_windows
from boxreg_ros.core.input_model import InputModel
from boxreg_ros.core.registrar import GetEstimates
from boxreg_ros.core.window import Estimate, Window

Solve = Callable[[list[Window], Config, InputModel], list[Estimate | None]]
"""Solves windows, see `estimate_windows`."""
PART_OF_PERIOD = 0.8
"""Part of the period of the boxes that is the default deadline; chosen: the rest is for decoding
clouds, and for final boxes and markers, which are published after the early boxes."""
FIRST_PERIOD = 0.1
"""Period until it has been measured [s]; literature: LiDARs of 10 Hz are the most common ones."""
LONGEST_PERIOD = 1.0
"""A longer time between two box arrays is a pause [s]; chosen: the slowest sensors run at 2 Hz."""
TRANSPORT_TIME = 0.004
"""Part of the deadline for the way of boxes to the node and from it to a subscriber [s]. Measured
with 512 boxes on two cores: 1.6 ms in the median, 6 ms in one tick of ten."""
BATCH_OVERHEAD = 25
"""Time of a batch that does not depend on its size, in windows; measured: 2.5 ms beside 0.1 ms a
window."""
RECENT = 10
"""Last batches and box arrays that times are estimated from; chosen: a second at 10 Hz."""
RESERVE_MEMORY = 1.0
"""Overruns of this time are a reserve [s]. Derived: the second largest of ten, at 10 Hz, is
exceeded in one tick of five or six. Measured: with 3 s one tick of fifteen, but on a slow machine
the reserve stays when its cause is gone, and final boxes are given up."""
LARGEST_RESERVE = 0.5
"""Part of the deadline that the reserve may take; chosen: the rest is for solving. A longer
overrun is an interruption of the process, and would be late with any reserve."""


@dataclass(eq=False, repr=False)
class TickBudget:
    """
    Limit the windows that are solved for a box array, so that it is published by its deadline.

    The registrar reads no clock; this object does for it. The time for windows is the deadline
    less the time used by then, for decoding and cropping, less that for the order of the tracks,
    for publishing and for `TRANSPORT_TIME`, less a reserve for overruns. The times of a window,
    and of what is done beside solving, are the medians of `RECENT` ones; windows between the
    ticks have their own, since they are of far objects. The reserve is the second largest overrun
    of the last `RESERVE_MEMORY` seconds, without those that no reserve would hold. So
    interruptions of the process cost the boxes of their own ticks, and none after them.

    Final boxes are given up last: the windows that they need are solved in any case, as long as
    these take no longer than what a batch costs (`BATCH_OVERHEAD`). A batch of their own, after
    the early boxes, would take twice as long, and clouds would be dropped.

    `deadline`, which may change, is the maximum time from complete data to published early boxes
    [s]; negative: `PART_OF_PERIOD` of the measured period of the boxes. `solve` does the same as
    `estimate_windows`, and `clock` is monotonic [s].

    """

    deadline: float
    clock: Callable[[], float] = time.monotonic
    solve: Solve = estimate_windows

    def __post_init__(self) -> None:
        """Begin without a tick."""
        self._since = self.clock()
        self._asked_at = self._since
        self._solving_time: float | None = None  # in the tick at hand [s]
        self._planned_end = inf
        self._other_times = deque[float](maxlen=RECENT)  # from the budget to the end [s]
        self._overruns = deque[tuple[float, float]]()  # when, and by how much [s]
        self._times = deque[float](maxlen=RECENT)  # per window of a tick [s]
        self._spare_times = deque[float](maxlen=RECENT)  # per window between the ticks [s]
        self._is_asked = False  # whether the next batch is that of a tick
        self._arrivals = deque[float](maxlen=RECENT)

    def add_arrival(self, received: float) -> None:
        """Add the time of arrival of a box array (monotonic) [s]."""
        if self._arrivals and received > self._arrivals[-1] + LONGEST_PERIOD:
            self._arrivals.clear()
        self._arrivals.append(received)

    def begin(self, since: float) -> None:
        """Begin a tick whose data are complete since a moment (monotonic) [s]."""
        self._since = since
        self._solving_time = None
        self._is_asked = False
        self._planned_end = inf

    def end(self) -> float | None:
        """
        End a tick, whose early boxes are published: return its time from complete data [s].

        None if it has ended, or if nothing was solved in it.

        """
        if self._solving_time is not None:
            now = self.clock()
            self._other_times.append(now - self._asked_at - self._solving_time)
            self._overruns.append((now, now - self._planned_end))
            self._solving_time = None
            return now - self._since
        return None

    def windows(self, needed: int) -> int:
        """
        Return how many windows may be solved before the early boxes are published, at least one.

        `needed` is the number of windows per box array that refine every final box.

        """
        number = 0
        self._is_asked = True
        self._asked_at = self.clock()
        times = self._times or self._spare_times
        if times:
            planned_end = self._since + self.seconds - TRANSPORT_TIME - self._reserve
            time_left = planned_end - _median(self._other_times) - self._asked_at
            number = int(time_left / _median(times)) - BATCH_OVERHEAD
        least = max(1, min(needed, BATCH_OVERHEAD))
        if number >= least:  # the tick can be in time
            self._planned_end = planned_end
        return max(number, least)

    def spare_windows(self) -> int:
        """
        Return how many windows fit into the part of the period that no deadline covers.

        They are solved and published before the next boxes arrive, unless these are late.

        """
        times = self._spare_times or self._times
        if not times:
            return 0
        spare = (1.0 - PART_OF_PERIOD) * self._period
        until_next = self._arrivals[-1] + self._period - self.clock() if self._arrivals else 0.0
        if until_next > 0:
            spare = min(spare, until_next)
        spare -= _median(self._other_times)
        return int(spare / _median(times)) - BATCH_OVERHEAD

    def submit(self, windows: list[Window], config: Config, model: InputModel) -> GetEstimates:
        """Return a function that calls `solve` with these arguments, and times it."""
        return partial(self._timed, windows, config, model)

    @property
    def seconds(self) -> float:
        """Return the present deadline [s]."""
        return self.deadline if self.deadline >= 0 else PART_OF_PERIOD * self._period

    @property
    def _reserve(self) -> float:
        """Return the second largest of the recent overruns that a reserve can hold [s]."""
        oldest = self.clock() - RESERVE_MEMORY
        while self._overruns and self._overruns[0][0] < oldest:
            self._overruns.popleft()
        most = LARGEST_RESERVE * self.seconds
        held = sorted(overrun for _, overrun in self._overruns if 0 < overrun <= most)
        return held[-2] if len(held) > 1 else 0.0

    @property
    def _period(self) -> float:
        """Return the measured period of the boxes [s]."""
        arrivals = tuple(self._arrivals)  # reports ask for it in another thread
        if len(arrivals) < 2:
            return FIRST_PERIOD
        return (arrivals[-1] - arrivals[0]) / (len(arrivals) - 1)

    def _timed(
        self, windows: list[Window], config: Config, model: InputModel
    ) -> list[Estimate | None]:
        begin = self.clock()
        estimates = self.solve(windows, config, model)
        took = self.clock() - begin
        times = self._spare_times
        if self._is_asked:
            self._is_asked = False
            self._solving_time = took
            times = self._times
        num_solved = sum(estimate is not None for estimate in estimates)
        if num_solved:
            times.append(took / (num_solved + BATCH_OVERHEAD))
        return estimates


def _median(times: Collection[float]) -> float:
    """Return the median of some times, 0 of none."""
    return median(times) if times else 0.0
