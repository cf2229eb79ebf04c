"""Clocks of streams of messages, compared by when their messages were received."""

from __future__ import annotations

from collections.abc import Sequence

from boxreg_ros.io.stamp_join import nearest_rows
import numpy as np

MIN_CLOCK_OFFSET = 0.4
"""
Smallest offset between two clocks that is reported [s].

Chosen: a cloud is complete and on its way for 0.1 to 0.3 s, and publishers of TF put their stamps
0.1 s ahead; NTP that has just started, GPS and TAI are off by more.

"""
MAX_SCATTER = 0.2
"""Median deviation of an offset that is constant [s]; chosen: load delays some of the messages."""
MIN_PAIRS = 5
"""Pairs of messages that the offset of two clocks needs; chosen."""
SPACING_NS = 10**8
"""Messages of a stream that are nearer to each other are left out [ns]."""
CAPACITY = 200
"""Messages of a stream that are compared: the first 20 s at 10 Hz."""
PAIR_NS = 10**9
"""Largest difference of the receive times of a pair [ns]; a stream of 1 Hz has one."""
COPY_NS = 10**6
"""
Difference of stamps of which one is a copy of the other [ns].

Derived: other programs cut stamps to milliseconds at most; of stamps of another clock one in 50
is as near to one of clouds at 10 Hz.

"""
HALF_HOUR = 1800.0
"""Time zones differ by multiples of it [s]."""
KNOWN_OFFSETS = {37.0: 'TAI and UTC', 18.0: 'GPS time and UTC', 19.0: 'TAI and GPS time'} | {
    HALF_HOUR * count: 'two time zones' for count in range(1, 53)
}
"""Offsets of clocks that are known exactly [s], and between which they are."""
NEAR_KNOWN = 0.3
"""Largest difference from an offset that is known [s]: the delay of a message."""
MAX_DELAY = 0.6
"""Longest delay of a message after the one that it copies the stamp of [s]; chosen."""


class ReceiveTimes:
    """
    Receive times and stamps of the first messages of one stream.

    Receive times may be of any clock that does not jump; it is the same for streams that are
    compared.

    """

    def __init__(self) -> None:
        self.received_ns: list[int] = []
        self.delays_ns: list[int] = []
        """Receive times less stamps."""

    @property
    def stamps_ns(self) -> list[int]:
        """Return the stamps."""
        pairs = zip(self.received_ns, self.delays_ns, strict=True)
        return [received_ns - delay_ns for received_ns, delay_ns in pairs]

    def add(self, received_ns: int, stamp_ns: int) -> None:
        """Add a message, unless it follows the one before it at once, or there are enough."""
        if len(self.received_ns) >= CAPACITY or stamp_ns <= 0:
            return
        if self.received_ns and received_ns - self.received_ns[-1] < SPACING_NS:
            return
        self.received_ns.append(received_ns)
        self.delays_ns.append(received_ns - stamp_ns)


def clock_offset(first: ReceiveTimes, second: ReceiveTimes) -> float | None:
    """
    Return the offset between the clocks of two streams.

    The messages that were received about the same time are compared, so that both streams may be
    played faster or slower.

    Parameters
    ----------
    first, second : ReceiveTimes
        Times of receipt and stamps of some messages of each stream.

    Returns
    -------
    offset : float or None
        To be added to stamps of the second stream to get those of the first clock [s]. None if too
        few messages were received together, or the offset is not constant.

    """
    if not (first.received_ns and second.received_ns):
        return None
    ours_ns, theirs_ns = np.array(first.received_ns), np.array(second.received_ns)
    rows = nearest_rows(theirs_ns, ours_ns)
    is_near = np.abs(ours_ns[rows] - theirs_ns) <= PAIR_NS
    delays_ns = np.array(second.delays_ns) - np.array(first.delays_ns)[rows]
    offsets = delays_ns[is_near] * 1e-9
    if len(offsets) < MIN_PAIRS:
        return None
    offset = float(np.median(offsets))
    if np.median(np.abs(offsets - offset)) > MAX_SCATTER:
        return None
    return offset


def likely_offset(offset: float) -> tuple[float, str]:
    """Return the offset of two clocks that a measured one [s] is of, and their names if known."""
    for seconds, names in KNOWN_OFFSETS.items():
        if abs(abs(offset) - seconds) < NEAR_KNOWN:
            return float(np.copysign(seconds, offset)), names
    return round(offset, 2), ''


def copied_offset(offset: float, stamps_ns: Sequence[int], of_ns: Sequence[int]) -> float:
    """
    Return the offset of two clocks by which stamps of the one are copies of those of the other.

    Parameters
    ----------
    offset : float
        By when messages were received [s]: the delay of the copying ones is part of it.
    stamps_ns, of_ns : sequence of int
        Stamps of the copying messages by their clock, and of the copied ones by the other [ns].

    Returns
    -------
    offset : float
        That of most copies, of equal ones the nearest to `offset`, which is returned, rounded,
        where most are no copies [s].

    """
    apart = np.subtract.outer(of_ns, stamps_ns).ravel() / COPY_NS
    late = offset * 1e9 / COPY_NS - apart
    is_near = (late <= MAX_DELAY * 1e9 / COPY_NS) & (-late <= SPACING_NS / COPY_NS)
    found, counts = np.unique(np.round(apart[is_near]), return_counts=True)
    if counts.max(initial=0) < len(stamps_ns) / 2:
        return round(offset, 2)
    best = found[counts > 0.9 * counts.max()] * COPY_NS * 1e-9
    return float(best[np.abs(best - offset).argmin()])


def seconds_text(seconds: float) -> str:
    """Return seconds with up to three decimals and all digits before, as options take them."""
    return f'{seconds:.3f}'.rstrip('0').rstrip('.')
