"""Memory allocation of the commands and of the node."""

from contextlib import suppress
import ctypes

# Parameters of mallopt(3), from glibc's malloc.h.
M_TRIM_THRESHOLD = -1
M_MMAP_THRESHOLD = -3
MAX_BLOCK = 32 << 20
"""Larger blocks are returned to the system [bytes]; derived: glibc allows no more."""
MAX_KEPT = 256 << 20
"""Free memory that a process keeps at most [bytes]; chosen: far above one solver step."""


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
