"""Calls in a thread: their order is kept, and only a limited number of them waits."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import ParamSpec

_P = ParamSpec('_P')


class Background:
    """
    Call functions one after another in a thread, while the caller goes on.

    At most `most_waiting` calls are incomplete when a call returns to the caller: with 0 it waits
    for each. `complete` or `abandon` is the end.

    """

    def __init__(self, most_waiting: int) -> None:
        self._most_waiting = most_waiting
        self._waiting: deque[Future[object]] = deque()
        self._thread = ThreadPoolExecutor(1)

    def __call__(
        self, function: Callable[_P, object], *args: _P.args, **kwargs: _P.kwargs
    ) -> None:
        """Call a function after those before it; raise the first exception of an earlier call."""
        self._waiting.append(self._thread.submit(function, *args, **kwargs))
        self._wait(self._most_waiting)

    def complete(self) -> None:
        """Wait for all calls, which must be the last ones; raise the first exception of them."""
        try:
            self._wait(0)
        finally:
            self.abandon()

    def abandon(self) -> None:
        """Wait for the call that has begun, and leave out the others."""
        self._thread.shutdown(cancel_futures=True)

    def _wait(self, most_waiting: int) -> None:
        """Wait until at most some of the calls are incomplete; raise their exceptions."""
        while len(self._waiting) > most_waiting:
            self._waiting.popleft().result()
