"""
Worker processes: one forked process that runs one function, and messages to and from it.

Processes and not threads, because the interpreter runs Python code in one thread at a time.

"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
import gc
import os
import pickle
import signal
import socket
import struct
from traceback import format_exc
from typing import Any

from boxreg_ros.errors import BoxregError
import numpy as np

Receive = Callable[[], Any]
Send = Callable[[Any], None]
Serve = Callable[[Receive, Send], None]

LARGE_BYTES = 2**16
"""Arrays of at least this size are sent without a copy into the pickled message [bytes]."""


class WorkerProcess:
    """
    The parent's end of the connection to a worker process.

    Parameters
    ----------
    connection : socket
        Connection to the worker.
    purpose : str
        The work of the process as a verb phrase, as in 'reads the recording'; used in errors.

    """

    def __init__(self, connection: socket.socket, purpose: str) -> None:
        self._connection = connection
        self._purpose = purpose

    def send(self, item: Any) -> None:
        """
        Send an item that can be pickled.

        Raises
        ------
        BoxregError
            If the process has ended.

        """
        with self._report_end():
            _send(self._connection, item)

    def receive(self) -> Any:
        """
        Wait for the next item from the worker and return it.

        Raises
        ------
        BoxregError
            If the process has ended.
        Exception
            The exception that ended the function in the worker.

        """
        with self._report_end():
            item = _receive(self._connection)
        if isinstance(item, Exception):
            raise item
        return item

    @contextmanager
    def _report_end(self) -> Iterator[None]:
        """Turn a closed connection into an error that names the process."""
        try:
            yield
        except (EOFError, OSError):
            raise BoxregError(
                f'the process that {self._purpose}: expected it to run until all is done, but it '
                f'has ended; the most frequent cause is too little memory: choose a smaller '
                f'track_window or sampling.points'
            ) from None


@contextmanager
def run_in_worker(serve: Serve, purpose: str) -> Iterator[WorkerProcess]:
    """
    Run a function in a worker process for the duration of the block, and yield its connection.

    The process is forked: it starts at once and sees a copy of all data of this one. No other
    thread may hold a lock that the function needs. The worker ends with the block, and also if
    this process is killed.

    Parameters
    ----------
    serve : callable
        The function to run. Its arguments are a function that waits for the next item sent to
        the worker, and one that sends an item back. An exception it raises is sent back.
    purpose : str
        The work of the process as a verb phrase; used in errors.

    """
    parent_end, worker_end = socket.socketpair()
    gc.freeze()  # collections then leave alone what both processes share
    pid = os.fork()
    if pid == 0:
        parent_end.close()
        try:
            _run(serve, worker_end)
        finally:
            os._exit(0)  # skips the clean-up handlers: the parent runs the same ones
    worker_end.close()  # otherwise the end of the worker does not close the connection
    try:
        yield WorkerProcess(parent_end, purpose)
    finally:
        parent_end.close()
        # Where SIGCHLD is ignored, an ended worker has no entry left to signal or wait for.
        with suppress(ProcessLookupError, ChildProcessError):
            os.kill(pid, signal.SIGKILL)  # the worker has nothing to clean up
            os.waitpid(pid, 0)


def _run(serve: Serve, connection: socket.socket) -> None:
    """Run the function in the worker and send back the exception it raises."""
    for number in (signal.SIGINT, signal.SIGHUP, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)  # the parent handles them and ends the worker

    def receive() -> Any:
        return _receive(connection)

    def send(item: Any) -> None:
        _send(connection, item)

    with suppress(EOFError, OSError):  # the parent has closed the connection
        try:
            serve(receive, send)
        except Exception as error:
            error.add_note(format_exc())  # pickling drops the traceback
            send(error)


def _send(connection: socket.socket, item: Any) -> None:
    """
    Send the pickled item without its large arrays, and each large array as it lies in memory.

    `multiprocessing.Connection` is not used: it would copy each array once more on either side,
    and place tensors in shared memory.

    """
    large: list[memoryview] = []

    def keep_in_message(buffer: pickle.PickleBuffer) -> bool:
        if buffer.raw().nbytes < LARGE_BYTES:
            return True
        large.append(buffer.raw())
        return False

    message = pickle.dumps(item, pickle.HIGHEST_PROTOCOL, buffer_callback=keep_in_message)
    sizes = [len(message), *(buffer.nbytes for buffer in large)]
    connection.sendall(struct.pack(f'<Q{len(sizes)}Q', len(sizes), *sizes))
    connection.sendall(message)
    for buffer in large:
        connection.sendall(buffer)


def _receive(connection: socket.socket) -> Any:
    """Return the next item that `_send` sent."""
    (count,) = struct.unpack('<Q', _received(connection, 8))
    sizes = struct.unpack(f'<{count}Q', _received(connection, 8 * count))
    message, *buffers = (_received(connection, size) for size in sizes)
    return pickle.loads(message, buffers=buffers)


def _received(connection: socket.socket, size: int) -> memoryview:
    """Return the next `size` bytes."""
    buffer = np.empty(size, np.uint8).data  # not zeroed, as a bytearray would be
    rest = buffer
    while len(rest):
        received = connection.recv_into(rest, 0, socket.MSG_WAITALL)
        if not received:
            raise EOFError('the other end of the connection is closed')
        rest = rest[received:]
    return buffer
