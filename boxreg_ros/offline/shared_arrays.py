"""
Items of a worker process on their way to its parent, with large arrays in memory that both share.

A socket would take them in pieces of 0.2 MB, for each of which the system allocates memory and
wakes a process.

"""

from __future__ import annotations

from contextlib import suppress
from mmap import mmap
import pickle
from typing import Any

from boxreg_ros.errors import BoxregError
from boxreg_ros.offline.workers import Receive, Send, WorkerProcess

SLOTS = 4
"""Items in shared memory: so many are sent ahead. Chosen: the receiver takes at most two at once,
as a cloud and its boxes, and caches of the processor hold four clouds."""
SLOT_BYTES = 2**26
"""Larger items go through the socket. Chosen: 5 million float32 points; memory that is not used is
not taken."""
SHARED_BYTES = 2**17
"""Smaller items go through the socket, too. Chosen: those that it takes in one piece."""


def shared_memory() -> mmap:
    """Return memory for `Sender` and `Receiver`, to be made before the worker is forked."""
    return mmap(-1, SLOTS * SLOT_BYTES)


class Sender:
    """Send items from the worker; `receive` returns slots that the parent has read."""

    def __init__(self, memory: mmap, receive: Receive, send: Send) -> None:
        self._memory = memoryview(memory)
        self._receive = receive
        self._send = send
        self._free = [*range(SLOTS)]

    def __call__(self, item: Any) -> None:
        """Send an item that can be pickled."""
        arrays: list[pickle.PickleBuffer] = []
        pickled = pickle.dumps(item, pickle.HIGHEST_PROTOCOL, buffer_callback=arrays.append)
        contents = [array.raw() for array in arrays]
        if not SHARED_BYTES <= sum(content.nbytes for content in contents) <= SLOT_BYTES:
            self._send((pickled, arrays, None))
            return
        slot = self._free.pop() if self._free else self._receive()
        places = []
        begin = slot * SLOT_BYTES
        for content in contents:
            places.append(slice(begin, begin + content.nbytes))
            self._memory[places[-1]] = content
            begin = places[-1].stop
        self._send((pickled, places, slot))


class Receiver:
    """Receive the items in the parent."""

    def __init__(self, memory: mmap, process: WorkerProcess) -> None:
        self._memory = memoryview(memory)
        self._process = process

    def __call__(self) -> Any:
        """Return the next item; raise as `WorkerProcess.receive`."""
        pickled, arrays, slot = self._process.receive()
        if slot is not None:
            # Copies: the registrar keeps clouds for two seconds.
            arrays = [bytearray(self._memory[place]) for place in arrays]
            with suppress(BoxregError):  # the worker has ended: it needs no slot
                self._process.send(slot)
        return pickle.loads(pickled, buffers=arrays)
