"""Progress of a long run, to be displayed by the caller."""

from __future__ import annotations


class Progress:
    """Progress that nobody displays; a display overrides both methods."""

    def show(self, done: float, total: float) -> None:
        """Show that `done` of `total` seconds of the recording have been read."""

    def announce(self, activity: str) -> None:
        """Show the activity that the run waits for, until the next `show`."""
