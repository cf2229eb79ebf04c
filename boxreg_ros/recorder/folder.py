"""Folder of a recording of labels: its lock, and recovery of segments that were cut off."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
import fcntl
import os
from pathlib import Path
from typing import IO

from boxreg_ros.errors import RecordingError
from boxreg_ros.recorder.segment import recover

LOCK = '.lock'


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """
    Keep other recordings out of a folder.

    The kernel releases the lock when the process ends, in whichever way.

    Raises
    ------
    RecordingError
        If the folder cannot be written to, or another process records into it.

    """
    try:
        file = (folder / LOCK).open('a+')
    except OSError as error:
        raise RecordingError(
            f'record_to {str(folder)!r}: expected a folder that can be written to, got: '
            f'{error.strerror}; choose another, or change its owner or mode'
        ) from None
    with file:
        _lock(file, folder)
        file.truncate(0)
        file.write(f'{os.getpid()}\n')
        file.flush()
        yield


def recover_all(opened: Sequence[Path]) -> int:
    """
    Complete the segments of a locked folder that were cut off.

    Parameters
    ----------
    opened : sequence of Path
        From `open_segments`, before a further segment was opened.

    Returns
    -------
    recovered : int
        Number of segments made: one whose journal has no frame is deleted only.

    """
    return sum(recover(path) > 0 for path in opened)


def _lock(file: IO[str], folder: Path) -> None:
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        file.seek(0)
        raise RecordingError(
            f'record_to {str(folder)!r}: expected a folder that nobody records into, got one in '
            f'use by process {file.read().strip()}; choose another, or stop that recording'
        ) from None
