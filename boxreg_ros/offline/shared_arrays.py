"""
Items of a worker process on their way to its parent, with large arrays in memory that both share.

A socket would take them in pieces of 0.2 MB, for each of which the system allocates memory and
wakes a process.

"""

from __future__ import annotations

from collections import deque
from contextlib import suppress
from itertools import accumulate
from mmap import mmap
import pickle
from typing import Any
from weakref import finalize

from boxreg_ros.errors import BoxregError
from boxreg_ros.offline.workers import Receive, Send, WorkerProcess
import numpy as np

SLOTS_AHEAD = 4
"""Items that are sent ahead. Chosen: the receiver takes at most two at once, as a cloud and its
boxes."""
SLOTS_KEPT = 12
"""Items that the receiver keeps in shared memory; further ones are copied. Derived: at 10 Hz late
boxes wait with eight clouds, and four are compared with later boxes, or have none yet."""
SLOTS = SLOTS_AHEAD + SLOTS_KEPT
SLOT_BYTES = 2**25
"""Larger items go through the socket. Chosen: 2.7 million float32 points; memory that is not used
is not taken."""
ARRAY_ALIGNMENT = 64
"""Arrays begin at multiples of this [bytes]; chosen: a line of the cache."""
SHARED_BYTES = 2**17
"""Smaller items go through the socket, too. Chosen: those that it takes in one piece."""


def shared_memory() -> list[mmap]:
    """Return the slots of `Sender` and `Receiver`, to be made before the worker is forked."""
    return [mmap(-1, SLOT_BYTES) for _ in range(SLOTS)]


class Sender:
    """Send items from the worker; `receive` returns the slots of later items."""

    def __init__(self, memory: list[mmap], receive: Receive, send: Send) -> None:
        self._memory = memory
        self._receive = receive
        self._send = send
        self._free = [*range(SLOTS_AHEAD)]

    def __call__(self, item: Any) -> None:
        """Send an item that can be pickled."""
        arrays: list[pickle.PickleBuffer] = []
        pickled = pickle.dumps(item, pickle.HIGHEST_PROTOCOL, buffer_callback=arrays.append)
        contents = [array.raw() for array in arrays]
        lines = [-(-content.nbytes // ARRAY_ALIGNMENT) for content in contents]
        ends = [line * ARRAY_ALIGNMENT for line in accumulate(lines, initial=0)]
        if not SHARED_BYTES <= ends[-1] <= SLOT_BYTES:
            self._send((pickled, arrays, None))
            return
        slot = self._free.pop() if self._free else self._receive()
        places = []
        for begin, content in zip(ends, contents, strict=False):
            places.append(slice(begin, begin + content.nbytes))
            self._memory[slot][places[-1]] = content
        self._send((pickled, places, slot))


class Receiver:
    """Receive the items in the parent; some of their arrays are in shared memory while in use."""

    def __init__(self, memory: list[mmap], process: WorkerProcess) -> None:
        self._memory = memory
        self._process = process
        self._unused = iter(range(SLOTS_AHEAD, SLOTS))
        self._freed = deque[int]()  # slots whose arrays were freed, in any thread

    def __call__(self) -> Any:
        """Return the next item; raise as `WorkerProcess.receive`."""
        pickled, arrays, slot = self._process.receive()
        if slot is not None:
            end = arrays[-1].stop
            content = np.frombuffer(self._memory[slot], np.uint8, end)
            # Freed slots first: as little memory as possible is ever used.
            other = self._freed.pop() if self._freed else next(self._unused, None)
            if other is None:
                other, shared = slot, content
                # Not of malloc, which would keep it, between smaller pieces, once it is freed.
                content = np.frombuffer(mmap(-1, end), np.uint8)
                content[:] = shared
            else:
                finalize(content, self._freed.append, slot).atexit = False
            with suppress(BoxregError):  # the worker has ended: it needs no slot
                self._process.send(other)
            arrays = [content[place] for place in arrays]
        return pickle.loads(pickled, buffers=arrays)
