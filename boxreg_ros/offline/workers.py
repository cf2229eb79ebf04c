"""
Work beside this thread: forked processes that run one function each, and calls in a thread.

Processes for Python code, of which the interpreter runs one thread at a time.

"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from functools import partial
import gc
import os
import pickle
import signal
import socket
from traceback import format_exc
from typing import Any, ParamSpec

from boxreg_ros.errors import BoxregError

Receive = Callable[[], Any]
Send = Callable[[Any], None]
Serve = Callable[[Receive, Send], None]

SIGNALS = (signal.SIGINT, signal.SIGHUP, signal.SIGTERM)
"""Signals that end a run."""
ENDED = (EOFError, OSError, pickle.UnpicklingError)
"""Errors of a connection whose other end was closed, also within an item."""


class WorkerProcess:
    """The parent's end of the connection to a worker process, with its purpose for errors."""

    def __init__(self, connection: socket.socket, purpose: str) -> None:
        self._receive, self._send = _ends(connection)
        self._purpose = purpose

    def send(self, item: Any) -> None:
        """Send an item that can be pickled; raise BoxregError if the process has ended."""
        with self._report_end():
            self._send(item)

    def receive(self) -> Any:
        """Return the next item; raise BoxregError if the process has ended, or its exception."""
        with self._report_end():
            item = self._receive()
        if isinstance(item, Exception):
            raise item
        return item

    @contextmanager
    def _report_end(self) -> Iterator[None]:
        """Turn a closed connection into an error that names the process."""
        try:
            yield
        except ENDED:
            raise BoxregError(
                f'the process that {self._purpose}: expected it to run until all is done, but it '
                f'has ended; the most frequent cause is too little memory: choose a smaller '
                f'track_window or sampling.points'
            ) from None


@contextmanager
def run_in_worker(serve: Serve, purpose: str) -> Iterator[WorkerProcess]:
    """
    Run a function in a worker process for the duration of the block.

    The process is forked: it starts at once and sees a copy of all data of this one. No other
    thread may hold a lock that the function needs. The worker ends with the block, and also if
    this process is killed.

    Parameters
    ----------
    serve : callable
        Called in the worker with a function that waits for the next item sent to it, and one that
        sends an item back; an exception it raises is sent back.
    purpose : str
        Its work as a verb phrase, as in 'reads the recording', for errors.

    Yields
    ------
    process : WorkerProcess
        The connection to the worker.

    """
    parent_end, worker_end = socket.socketpair()
    gc.freeze()  # collections then leave alone what both processes share
    # A signal would be lost in the functions that modules run after a fork.
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    pid = os.fork()
    if pid == 0:
        parent_end.close()
        try:
            _run(serve, worker_end)
        finally:
            os._exit(0)  # skips the clean-up handlers: the parent runs the same ones
    worker_end.close()  # otherwise the end of the worker does not close the connection
    try:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        yield WorkerProcess(parent_end, purpose)
    finally:
        parent_end.close()
        # Where SIGCHLD is ignored, an ended worker has no entry left to signal or wait for.
        with suppress(ProcessLookupError, ChildProcessError):
            os.kill(pid, signal.SIGKILL)  # the worker has nothing to clean up
            os.waitpid(pid, 0)


def _run(serve: Serve, connection: socket.socket) -> None:
    """Run the function in the worker and send back the exception it raises."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)  # the parent handles them and ends the worker

    receive, send = _ends(connection)
    with suppress(*ENDED):  # the parent has closed the connection
        try:
            serve(receive, send)
        except Exception as error:
            error.add_note(format_exc())  # pickling drops the traceback
            # Except where tblib is installed: it pickles all that led to the error, if it can be.
            error.__cause__ = error.__context__ = None
            send(error.with_traceback(None))


def _ends(connection: socket.socket) -> tuple[Receive, Send]:
    """Return functions for pickled items; `multiprocessing` would copy each array once more."""
    reader = connection.makefile('rb')
    writer = connection.makefile('wb')

    def send(item: Any) -> None:
        pickle.dump(item, writer, pickle.HIGHEST_PROTOCOL)
        writer.flush()

    return partial(pickle.load, reader), send


_P = ParamSpec('_P')


class Background:
    """
    Call functions one after another in a thread, while the caller goes on.

    At most `most_waiting` calls are incomplete when a call returns to the caller: with 0 it waits
    for each. `complete` or `abandon` is the end.

    """

    def __init__(self, most_waiting: int) -> None:
        self._most_waiting = most_waiting
        self._waiting: deque[Future[object]] = deque()
        self._thread = ThreadPoolExecutor(1)

    def __call__(
        self, function: Callable[_P, object], *args: _P.args, **kwargs: _P.kwargs
    ) -> None:
        """Call a function after those before it; raise the first exception of an earlier call."""
        self._waiting.append(self._thread.submit(function, *args, **kwargs))
        self._wait(self._most_waiting)

    def complete(self) -> None:
        """Wait for all calls, which must be the last ones; raise the first exception of them."""
        try:
            self._wait(0)
        finally:
            self.abandon()

    def abandon(self) -> None:
        """Wait for the call that has begun, and leave out the others."""
        self._thread.shutdown(cancel_futures=True)

    def _wait(self, most_waiting: int) -> None:
        """Wait until at most some of the calls are incomplete; raise their exceptions."""
        while len(self._waiting) > most_waiting:
            self._waiting.popleft().result()
