"""Threads that share the parts of a batch."""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from itertools import pairwise
from multiprocessing import cpu_count
from typing import Any, NamedTuple, TypeVar

NUM_CORES = cpu_count()
LEAST_TIME = 100.0
"""Windows of a thread take longer than this, since handing them over takes as long [us]. Measured:
`refine` of 64 windows by two threads took a twelfth more CPU time than by one."""


class _Threads(NamedTuple):
    pool: ThreadPoolExecutor
    workers: int


_threads: ContextVar[_Threads | None] = ContextVar('threads', default=None)
_Part = TypeVar('_Part')
_Result = TypeVar('_Result')


@contextmanager
def shared_between(workers: int) -> Iterator[None]:
    """
    Let `mapped` use a number of threads, that of the caller included; 0: one per core.

    They end with the block: a process that is forked later would wait for threads that it does
    not have. Each starts when it gets its first part. A block within another uses its threads.
    An exception, of a signal too, does not wait for them: one may compile for a minute.

    """
    workers = workers or NUM_CORES
    if workers == 1 or _threads.get() is not None:
        yield
        return
    pool = ThreadPoolExecutor(workers)
    token = _threads.set(_Threads(pool, workers))
    is_whole = False
    try:
        yield
        is_whole = True
    finally:
        _threads.reset(token)
        pool.shutdown(wait=is_whole, cancel_futures=True)


def num_workers() -> int:
    """Return how many threads share the parts of a batch: 1 outside of `shared_between`."""
    threads = _threads.get()
    return 1 if threads is None else threads.workers


def mapped(function: Callable[[_Part], _Result], parts: Sequence[_Part]) -> list[_Result]:
    """Return the results of a function for each of some parts; the caller takes the first."""
    threads = _threads.get()
    if threads is None or threads.workers < 2 or len(parts) < 2:
        return [function(part) for part in parts]
    others = [threads.pool.submit(function, part) for part in parts[1:]]
    return [function(parts[0]), *(other.result() for other in others)]


def run(kernel: Callable[..., Any], microseconds: float, windows: int, *arguments: Any) -> None:
    """
    Run a kernel for a number of `windows`, shared between threads within `shared_between`.

    Its first arguments are the first window, and that after the last. One of ten boxes takes about
    so many `microseconds`, as measured. No window depends on another: the results do not depend
    on the number of threads.

    """
    parts = max(1, min(num_workers(), int(windows * microseconds / LEAST_TIME)))
    if parts == 1:
        kernel(0, windows, *arguments)
        return
    ends = [windows * part // parts for part in range(parts + 1)]
    mapped(lambda span: kernel(*span, *arguments), list(pairwise(ends)))


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Run torch in the calling thread alone: for small tensors more only wait for each other."""
    import torch  # the process that crops the points of a recording does without

    num_threads = torch.get_num_threads()
    if num_threads == 1:
        yield
        return
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(num_threads)
