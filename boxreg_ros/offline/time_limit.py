"""A limit for calls that may never return: of files on a network mount that is dead."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from threading import Thread, TIMEOUT_MAX
import time
from typing import TypeVar

_T = TypeVar('_T')


class Watch:
    """
    Time without progress.

    Parameters
    ----------
    limit : float
        Longest time without progress [s].

    """

    def __init__(self, limit: float) -> None:
        self.limit = limit
        self._since = time.monotonic()

    def advanced(self) -> None:
        """Note that there was progress."""
        self._since = time.monotonic()

    @property
    def left(self) -> float:
        """Return the time until the limit is reached [s], at least 0."""
        return max(self._since + self.limit - time.monotonic(), 0.0)


def watched(watch: Watch, call: Callable[[], _T]) -> _T:
    """
    Call a function, but wait for it no longer than a time without progress.

    Parameters
    ----------
    watch : Watch
        The limit; the function notes its progress there.
    call : callable
        Runs in a thread of its own, which is left behind if it is late: a read from a dead mount
        cannot be interrupted. The thread does not keep the process from its end.

    Raises
    ------
    TimeoutError
        If the call makes no progress in time.

    """
    result: Future[_T] = Future()

    def run() -> None:
        try:
            result.set_result(call())
        except BaseException as error:
            result.set_exception(error)

    Thread(target=run, daemon=True).start()
    while True:
        try:
            return result.result(min(watch.left, TIMEOUT_MAX))
        except TimeoutError:
            if result.done() or not watch.left:
                raise
