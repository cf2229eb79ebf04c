"""Work ahead: the next items of an iterator are made in a thread while one is used."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
import sys
from typing import Any, TypeVar

TURN = 1e-4
"""
Neither thread lets the other wait for longer, if it has the lock of the interpreter [s].

numpy and torch hand that lock over at every call of any size, and by default would get it back
after 5 ms.

"""

_T = TypeVar('_T')


@contextmanager
def ahead(items: Iterator[_T], count: int) -> Iterator[Iterator[_T]]:
    """
    Yield what `items` yields, in the same order, made in one other thread.

    An error of `items` is raised where its item would have come. When the block ends, however it
    ends, the item in the making is waited for, and no other is begun.

    Parameters
    ----------
    items : iterator
        Used by the other thread alone while the block lasts.
    count : int
        Items made, or in the making, beside the one in use.

    """
    end: Any = object()
    thread = ThreadPoolExecutor(1, thread_name_prefix='ahead')
    before = sys.getswitchinterval()

    def each() -> Iterator[_T]:
        coming = deque(thread.submit(next, items, end) for _ in range(count))
        while (item := coming.popleft().result()) is not end:
            coming.append(thread.submit(next, items, end))
            yield item

    sys.setswitchinterval(TURN)
    try:
        yield each()
    finally:
        thread.shutdown(cancel_futures=True)
        sys.setswitchinterval(before)
