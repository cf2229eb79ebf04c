"""Progress of a long run, to be displayed by the caller and watched by `boxreg batch`."""

from __future__ import annotations

from contextlib import suppress
import os

PIPE = 'BOXREG_PROGRESS'
"""Environment variable with the descriptor of a pipe that gets a byte for each step forward."""


def advanced() -> None:
    """Report a step forward to the process that watches this one, if there is one."""
    if PIPE in os.environ:
        with suppress(OSError):  # the pipe is full, or nobody reads it
            os.write(int(os.environ[PIPE]), b'.')


class Progress:
    """Progress that nobody displays; a display overrides both methods."""

    def show(self, done: float, total: float) -> None:
        """Show that `done` of `total` seconds of the recording have been read."""

    def announce(self, activity: str) -> None:
        """Show the activity that the run waits for, until the next `show`."""
