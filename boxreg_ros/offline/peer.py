"""Processes beside this one: of the threads of one, the interpreter lets one at a time work."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from multiprocessing import Pipe
from multiprocessing.connection import Connection
import os
import pickle
import signal
from traceback import format_exc
from typing import Any

from boxreg_ros.errors import BoxregError
import numpy as np
import torch

Serve = Callable[[Callable[[], Any], Callable[[Any], None]], None]
LARGE = 2**16  # arrays of so many bytes travel as they are, without being copied into a message


class Peer:
    """
    The process beside this one.

    Parameters
    ----------
    connection : Connection
        To it.
    purpose : str
        What it does, as in 'reads the recording'.

    """

    def __init__(self, connection: Connection, purpose: str) -> None:
        self._connection = connection
        self._purpose = purpose

    def send(self, item: Any) -> None:
        """
        Send what can be pickled.

        Raises
        ------
        BoxregError
            If the process has ended.

        """
        with self._alive():
            _send(self._connection, item)

    def receive(self) -> Any:
        """
        Wait for what it sends next.

        Raises
        ------
        BoxregError
            If it has ended.
        Exception
            That which ended what it did.

        """
        with self._alive():
            item = _receive(self._connection)
        if isinstance(item, Exception):
            raise item
        return item

    @contextmanager
    def _alive(self) -> Iterator[None]:
        try:
            yield
        except (EOFError, OSError):
            raise BoxregError(
                f'the process that {self._purpose} has ended before it was done; most often there '
                f'is not enough memory: choose a smaller track_window or sampling.points'
            ) from None


@contextmanager
def beside(serve: Serve, purpose: str) -> Iterator[Peer]:
    """
    Run `serve` in a process of its own for as long as the block lasts, and yield that process.

    It is forked: all there is now is known there, too, and it starts at once. So no other thread
    should be at work that holds what it needs. It ends when this process does, however that ends.

    Parameters
    ----------
    serve : callable
        Given what waits for the next item sent here, and what sends one back. An error it raises
        is sent back.
    purpose : str
        What it does, for the message of an error.

    """
    here, there = Pipe()
    if not (pid := os.fork()):
        here.close()
        try:
            _run(serve, there)
        finally:
            os._exit(0)  # whatever happened: what the other side cleans up is not done twice
    there.close()  # else nobody would notice when the process ends
    try:
        yield Peer(here, purpose)
    finally:
        here.close()
        with suppress(ProcessLookupError, ChildProcessError):  # where nobody waits for children
            os.kill(pid, signal.SIGKILL)  # it has nothing to clean up
            os.waitpid(pid, 0)


def _run(serve: Serve, there: Connection) -> None:
    for number in (signal.SIGINT, signal.SIGHUP, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)  # what ends the other side ends this one
    torch.set_num_threads(1)
    with suppress(EOFError, OSError):  # the other side is gone
        try:
            serve(lambda: _receive(there), lambda item: _send(there, item))
        except Exception as error:
            error.add_note(format_exc())  # a traceback does not travel
            _send(there, error)


def _send(there: Connection, item: Any) -> None:
    # A connection's own pickling would have tensors shared, by files that both sides keep open.
    large: list[pickle.PickleBuffer] = []

    def is_small(array: pickle.PickleBuffer) -> bool:
        if array.raw().nbytes >= LARGE:
            large.append(array)
            return False
        return True

    message = pickle.dumps(item, pickle.HIGHEST_PROTOCOL, buffer_callback=is_small)
    there.send_bytes(pickle.dumps([array.raw().nbytes for array in large]))
    there.send_bytes(message)
    for array in large:
        there.send_bytes(array.raw())


def _receive(there: Connection) -> Any:
    sizes, message = pickle.loads(there.recv_bytes()), there.recv_bytes()
    arrays = [np.empty(size, np.uint8) for size in sizes]
    for array in arrays:
        there.recv_bytes_into(array)
    return pickle.loads(message, buffers=arrays)
