"""Progress of a long run, for whoever displays it."""

from __future__ import annotations


class Progress:
    """Progress that nobody displays; a display overrides both methods."""

    def show(self, done: float, total: float) -> None:
        """Show that `done` of `total` seconds of the recording have been read."""

    def announce(self, activity: str) -> None:
        """Show what the run waits for, until the next `show`."""
