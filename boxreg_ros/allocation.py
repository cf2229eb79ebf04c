"""How a process of ours, whole commands and the node, allocates its memory."""

from contextlib import suppress
import ctypes

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3  # of glibc's malloc.h
ONE, ALL = 32 << 20, 256 << 20  # [bytes]


def keep_freed_memory() -> None:
    """
    Keep what is freed for what is allocated next.

    Arrays of a live tick take some 100 kB to 3 MB each, and go with it. By default glibc gives
    such memory back and fetches it anew, emptied page by page: a twelfth of a tick. Blocks of up
    to 32 MB now stay, 256 MB at most. Where the C library is another one, nothing changes.

    """
    with suppress(OSError, AttributeError):
        libc = ctypes.CDLL(None)
        libc.mallopt(M_MMAP_THRESHOLD, ONE)
        libc.mallopt(M_TRIM_THRESHOLD, ALL)
