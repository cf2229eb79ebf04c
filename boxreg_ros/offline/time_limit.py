"""A limit for calls that may never return: of files on a network mount that is dead."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from threading import Thread
from typing import TypeVar

_T = TypeVar('_T')


def within(seconds: float | None, call: Callable[[], _T]) -> _T:
    """
    Call a function, but wait for it no longer than a time limit.

    Parameters
    ----------
    seconds : float or None
        Longest time to wait for it [s]; None for any.
    call : callable
        Runs in a thread of its own, which is left behind if it is late: a read from a dead mount
        cannot be interrupted. The thread does not keep the process from its end.

    Raises
    ------
    TimeoutError
        If the call has not returned in time.

    """
    result: Future[_T] = Future()

    def run() -> None:
        try:
            result.set_result(call())
        except BaseException as error:
            result.set_exception(error)

    Thread(target=run, daemon=True).start()
    return result.result(seconds)
