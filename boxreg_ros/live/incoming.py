"""The order of the messages that arrive: joined by stamp, and checked for jumps of time."""

from __future__ import annotations

from collections.abc import Iterator
from math import inf

from boxreg_ros.io.items import Item
from boxreg_ros.io.session import is_placeholder
from boxreg_ros.io.time_jumps import Confirmed, Held, JumpConfirmation
from boxreg_ros.live.bursts import Bursts
from boxreg_ros.structures import BoxArray

CONFIRMATION_TIME = 0.5
"""A message waits this long for the one that confirms a time jump [s]: five sweeps at 10 Hz."""
AHEAD_TIME = 3.0
"""The same of one that is ahead of all others [s]; chosen: boxes of the slowest detectors, 1 Hz,
have come three times."""


class Incoming:
    """
    Decide which messages are processed next.

    Messages of boxes of one stamp are joined; then one whose stamp is old, or ahead of its stream,
    waits for a second one. Not thread-safe.

    """

    def __init__(self) -> None:
        self._bursts = Bursts()
        self._jumps = JumpConfirmation[Item]()

    @property
    def is_joining(self) -> bool:
        """Return whether a message of boxes waits for others of its stamp."""
        return self._bursts.held is not None

    @property
    def is_holding(self) -> bool:
        """Return whether messages wait for others."""
        return self.is_joining or bool(self._jumps.held)

    def add(self, item: Item) -> Iterator[Confirmed[Item]]:
        """Add a message; yield what it confirms, to be processed before the next is taken."""
        if is_placeholder(item.content):
            yield Confirmed([item])
            return
        is_boxes = isinstance(item.content, BoxArray)
        for whole in self._bursts.add(item) if is_boxes else [item]:
            yield self._jumps.add(whole, whole.content, whole.received_ns)

    def release(
        self, now: float = inf, more_boxes: bool = False, more: bool = False
    ) -> Iterator[Confirmed[Item]]:
        """
        Yield what no other message has confirmed in time [s]: late ones, and those not to use.

        While there are `more_boxes`, those that wait for others of their stamp wait on; while
        there are `more` messages of any kind, those that one of them may confirm.

        """
        for whole in [] if more_boxes else self._bursts.release(now):
            yield self._jumps.add(whole, whole.content, whole.received_ns)
        for held in [] if more else self._jumps.held:
            if now >= held.item.received + _patience(held):
                released = self._jumps.release(held)
                yield Confirmed(ahead=released) if held.is_ahead else Confirmed(released)

    def reset(self) -> list[Item]:
        """Forget all stamps; return the messages that wait."""
        waiting = [*self._jumps.release(), *self._bursts.release()]
        self._jumps.restart()
        return waiting


def _patience(held: Held[Item]) -> float:
    """Return how long a message waits for the next of its stream [s]."""
    return AHEAD_TIME if held.is_ahead else CONFIRMATION_TIME
