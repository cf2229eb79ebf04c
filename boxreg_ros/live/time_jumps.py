"""Confirmation of time jumps before the messages after them are processed."""

from __future__ import annotations

from boxreg_ros.io.transforms import TIME_JUMP
from boxreg_ros.live.driver import ReceivedMessage
from boxreg_ros.structures import BoxArray, Sweep

CONFIRMATION_TIME = 0.5
"""A message waits this long for the one that confirms a time jump [s]: five sweeps at 10 Hz."""


class JumpConfirmation:
    """
    Holds a message with an old stamp until the next message shows whether time went back.

    Two old stamps in a row, of clouds or boxes, are a time jump; a single one is a late message.
    Without this, the first messages of a recording that loops would be late.

    """

    def __init__(self) -> None:
        self._newest_ns: dict[type[Sweep | BoxArray], int] = {}
        self._held: ReceivedMessage | None = None

    def add(self, item: ReceivedMessage) -> tuple[list[ReceivedMessage], bool]:
        """
        Return the arrivals to process now, oldest first, and whether time jumped before them.

        Parameters
        ----------
        item : ReceivedMessage
            The next message, with a stamp.

        """
        is_old = self._is_old(item)
        held = self.release()
        if is_old and held is not None:
            self._newest_ns.clear()
            self._note(held)
            self._note(item)
            return [held, item], True
        if is_old:
            self._held = item
            return [], False
        self._note(item)
        return ([item] if held is None else [held, item]), False

    def release(self) -> ReceivedMessage | None:
        """Return the held arrival, if any, to be processed as a late one."""
        held = self._held
        self._held = None
        return held

    def is_overdue(self, now: float) -> bool:
        """Return whether an arrival has been held for too long; `now` is monotonic [s]."""
        return self._held is not None and now >= self._held.received + CONFIRMATION_TIME

    @property
    def is_holding(self) -> bool:
        """Return whether an arrival is held."""
        return self._held is not None

    def _is_old(self, item: ReceivedMessage) -> bool:
        newest_ns = self._newest_ns.get(type(item.content))
        if newest_ns is None:
            return False
        return item.content.stamp_ns < newest_ns - round(TIME_JUMP * 1e9)

    def _note(self, item: ReceivedMessage) -> None:
        kind = type(item.content)
        self._newest_ns[kind] = max(self._newest_ns.get(kind, 0), item.content.stamp_ns)
