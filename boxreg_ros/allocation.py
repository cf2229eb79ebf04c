"""Memory allocation and garbage collection of the commands and of the node."""

from contextlib import suppress
import ctypes
import gc
import os

# Parameters of mallopt(3), from glibc's malloc.h.
M_TRIM_THRESHOLD = -1
M_MMAP_THRESHOLD = -3
MAX_BLOCK = 32 << 20
"""Larger blocks are returned to the system [bytes]; derived: glibc allows no more."""
MAX_KEPT = 256 << 20
"""Free memory that a process keeps at most [bytes]; chosen: far above one solver step."""

YOUNG_OBJECTS = 100_000
"""New objects before a collection. Swept: 700 (of Python), 20,000 and 100,000 take 0.50, 0.17 and
0.09 s of a run of 4.5 s, most of it while libraries are imported, with the same peak memory."""


def start_no_threads() -> None:
    """
    Keep libraries from starting threads when they are imported: to be called before that.

    `boxreg relabel` forks its workers, and a fork has none of the threads of its parent, nor the
    locks that these would release. No matrix here is large enough for several threads.

    """
    os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')


def collect_rarely() -> None:
    """
    Let the garbage collector run after `YOUNG_OBJECTS` new objects.

    Objects without references are freed at once all the same; those in cycles, of which a run of
    `boxreg relabel` has some thousand small ones, are freed later.

    """
    gc.set_threshold(YOUNG_OBJECTS, *gc.get_threshold()[1:])


def keep_freed_memory() -> None:
    """
    Keep freed memory in the process for the next allocations.

    The arrays of one live solver step have 0.1 to 3 MB each and are freed after it. By default
    glibc returns such blocks to the system and gets them back zeroed, page by page, which takes a
    twelfth of the step. Has no effect with other C libraries.

    """
    with suppress(OSError, AttributeError):
        libc = ctypes.CDLL(None)
        libc.mallopt(M_MMAP_THRESHOLD, MAX_BLOCK)
        libc.mallopt(M_TRIM_THRESHOLD, MAX_KEPT)
