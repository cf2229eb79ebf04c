"""Stamps that go back, or far ahead: a recording in a loop, a simulation reset, a wrong clock."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Generic, TypeVar

from boxreg_ros.structures import BoxArray, Sweep

_T = TypeVar('_T')

TIME_JUMP = 1.0
"""
A stamp this far before the newest is a time jump [s].

Longer than any message is late on its way, shorter than a recording that is played in a loop.

"""
SAME_TIME = 10.0
"""Stamps ahead that differ by less confirm each other [s]; chosen: longer than the pauses of a
stream after a gap, shorter than any wrong clock."""
PERIODS_AHEAD = 10
"""A stamp is ahead by so many periods of its stream, and more; chosen: in a stream of 10 Hz that
is as long as `TIME_JUMP`."""


@dataclass(eq=False, slots=True)
class StreamClock:
    """Newest stamp of a stream, when it was received, and the last step between two stamps."""

    newest_ns: int | None = None
    received_ns: int | None = None
    step_ns: int = 0

    def note(self, stamp_ns: int, received_ns: int | None) -> None:
        """Take note of a stamp that is used [ns]."""
        if self.newest_ns is None or stamp_ns > self.newest_ns:
            self.step_ns = 0 if self.newest_ns is None else stamp_ns - self.newest_ns
            self.newest_ns = stamp_ns
            self.received_ns = received_ns

    def is_old(self, stamp_ns: int) -> bool:
        """Return whether a stamp is so old that time may have gone back [ns]."""
        return self.newest_ns is not None and stamp_ns < self.newest_ns - round(TIME_JUMP * 1e9)

    def is_ahead(self, stamp_ns: int, received_ns: int | None) -> bool:
        """Return whether neither the period nor the time of receipt explains a stamp [ns]."""
        if self.newest_ns is None or not self.step_ns:
            return False
        ahead_ns = stamp_ns - self.newest_ns - PERIODS_AHEAD * self.step_ns
        if received_ns is not None and self.received_ns is not None:
            ahead_ns -= max(0, received_ns - self.received_ns)
        return ahead_ns > round(TIME_JUMP * 1e9)


@dataclass(frozen=True, eq=False, slots=True)
class Held(Generic[_T]):
    """An item whose stamp is not confirmed yet."""

    item: _T
    stream: str
    stamp_ns: int
    received_ns: int | None
    is_ahead: bool
    """Whether it is ahead of its stream; else behind."""

    def confirms(self, other: Held[_T]) -> bool:
        """Return whether time has jumped to the stamps of both."""
        if self.is_ahead != other.is_ahead:
            return False
        return not self.is_ahead or is_near(self.stamp_ns, other.stamp_ns)


@dataclass(slots=True)
class Confirmed(Generic[_T]):
    """What follows from one more item."""

    items: list[_T] = field(default_factory=list)
    """To process now, in order."""
    has_jumped: bool = False
    """Whether time went back before them."""
    ahead: list[_T] = field(default_factory=list)
    """Not to be used: their stamps are in the future of all others."""


class JumpConfirmation(Generic[_T]):
    """
    Detect that time goes back, and stamps that are ahead of all others.

    An item whose stamp is old, or ahead of its stream, is held until a second one confirms it:
    two old stamps in a row of one stream, or of two streams, are a time jump, and two ahead are a
    gap. The next stamp of its stream that fits those before refutes it: an old item was late,
    and one ahead has a wrong stamp. So a single wrong stamp changes nothing of the others, and the
    first items after a jump are not late.

    """

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Forget all stamps and the items that wait for a second one."""
        self._clocks: dict[str, StreamClock] = {}
        self.held: list[Held[_T]] = []
        """The items that wait for a second one, in order of arrival."""

    def add(
        self, item: _T, content: Sweep | BoxArray, received_ns: int | None = None
    ) -> Confirmed[_T]:
        """
        Return the items to process now, those not to be used, and whether time went back.

        Parameters
        ----------
        item
            What the caller wants back for the `content`, which has a stamp.
        content : Sweep or BoxArray
            As received.
        received_ns : int or None
            When it was received [ns]; a pause of the stream explains a step of the stamps.

        """
        stream = _stream_of(content)
        clock = self._clocks.setdefault(stream, StreamClock())
        stamp_ns = content.stamp_ns
        is_ahead = clock.is_ahead(stamp_ns, received_ns) and not self._is_reached(stamp_ns)
        new = Held(item, stream, stamp_ns, received_ns, is_ahead)
        if not (is_ahead or clock.is_old(stamp_ns)):
            result = self._refuted(stream)
            result.items.append(item)
            clock.note(stamp_ns, received_ns)
            return result
        confirming = [held for held in self.held if new.confirms(held)]
        if not confirming:
            result = self._refuted(stream)
            self.held.append(new)
            return result
        has_jumped = not is_ahead
        if has_jumped:
            self._clocks.clear()
        self.held = [held for held in self.held if held not in confirming]
        for held in (*confirming, new):
            clock = self._clocks.setdefault(held.stream, StreamClock())
            clock.note(held.stamp_ns, held.received_ns)
        return Confirmed([*(held.item for held in confirming), item], has_jumped)

    def release(self, held: Held[_T] | None = None) -> list[_T]:
        """Remove and return one item that waits, or all: no other confirms or refutes them."""
        released = [one for one in self.held if held is None or one is held]
        self.held = [one for one in self.held if one not in released]
        return [one.item for one in released]

    def _is_reached(self, stamp_ns: int) -> bool:
        """Return whether another stream has come to about a stamp [ns]."""
        newest = [clock.newest_ns for clock in self._clocks.values()]
        margin_ns = round(TIME_JUMP * 1e9)
        return any(one is not None and one + margin_ns >= stamp_ns for one in newest)

    def _refuted(self, stream: str) -> Confirmed[_T]:
        """Remove the items of a stream that wait: its next stamp fits those before them."""
        refuted = [held for held in self.held if held.stream == stream]
        self.held = [held for held in self.held if held.stream != stream]
        return Confirmed(
            [held.item for held in refuted if not held.is_ahead],
            ahead=[held.item for held in refuted if held.is_ahead],
        )


def is_near(first_ns: int, second_ns: int) -> bool:
    """Return whether two stamps that are ahead differ by `SAME_TIME` at most [ns]."""
    return abs(first_ns - second_ns) <= round(SAME_TIME * 1e9)


def _stream_of(content: Sweep | BoxArray) -> str:
    """Return the name of a stream of ascending stamps: the boxes, or the clouds of one LiDAR."""
    return f'clouds {content.topic}' if isinstance(content, Sweep) else 'boxes'
