"""Locks of outputs: one process at a time writes to each."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
import errno
import fcntl
import os
from pathlib import Path
import socket
import time
from typing import IO

from boxreg_ros.errors import RecordingError

WITHOUT_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)
"""Answers of file systems that have no locks, as of some clusters."""
POLL_PERIOD = 0.1
"""Time between two tries to get a lock [s]."""

_held: set[int] = set()
"""Descriptors of the locks of this process."""


@contextmanager
def locked(path: Path, subject: str, seconds: float = 0.0) -> Iterator[None]:
    """
    Hold the lock that a file stands for, and delete the file at the end.

    The kernel releases the lock when the process ends, in whichever way. A file system without
    locks lets everyone in. Another process is waited for `seconds` [s]; then a RecordingError
    names the `subject` that is locked.

    """
    file = _acquired(path, subject, time.monotonic() + seconds)
    _held.add(file.fileno())
    try:
        file.truncate(0)
        file.write(f'{os.getpid()} on {socket.gethostname()}\n')
        file.flush()
        yield
    finally:
        path.unlink(missing_ok=True)  # before the lock is released: see `_is_current`
        _held.discard(file.fileno())
        file.close()


def _acquired(path: Path, subject: str, deadline: float) -> IO[str]:
    """Return the open file of a lock that this process has got."""
    while True:
        file = path.open('a+')
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.seek(0)
            owner = file.read().strip()
            file.close()
            if time.monotonic() >= deadline:
                raise RecordingError(
                    f'{subject}: expected an output that no other process writes to, got one in '
                    f'use by process {owner}; wait until it has ended, or choose another'
                ) from None
            time.sleep(POLL_PERIOD)
            continue
        except OSError as error:
            if error.errno not in WITHOUT_LOCKS:
                file.close()
                raise
        if _is_current(file, path):
            return file
        file.close()


def _is_current(file: IO[str], path: Path) -> bool:
    """Return whether `path` is still this file: the process before may have deleted it."""
    try:
        return os.path.samestat(os.fstat(file.fileno()), path.stat())
    except FileNotFoundError:
        return False


def _release_in_child() -> None:
    """Close the locks in a forked process, which else would hold them longer than its parent."""
    for descriptor in _held:
        os.close(descriptor)
    _held.clear()


os.register_at_fork(after_in_child=_release_in_child)
