"""Progress of a long run, displayed by the caller, and its times."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
import time


class Progress:
    """Progress that nobody displays; a display overrides both methods."""

    def show(self, done: float, total: float) -> None:
        """Show that `done` of `total` seconds of the recording have been read."""

    def announce(self, activity: str) -> None:
        """Show the activity that the run waits for, until the next `show`."""


class Stopwatch:
    """
    Sum up the time of each stage [s].

    The times of worker processes are added to it. Processes overlap, so the sum of all stages
    can be larger than the total.

    """

    def __init__(self) -> None:
        self._begun = time.perf_counter()
        self._seconds: dict[str, float] = defaultdict(float)

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Add the duration of the block to a stage."""
        begun = time.perf_counter()
        yield
        self.add(stage, time.perf_counter() - begun)

    def add(self, stage: str, seconds: float) -> None:
        """Add a time measured elsewhere to a stage."""
        self._seconds[stage] += seconds

    def begun(self, stage: str) -> None:
        """Add the time since construction to a stage: the preparation before the work."""
        self.add(stage, time.perf_counter() - self._begun)

    def stages(self) -> dict[str, float]:
        """Return the time of each stage [s]."""
        return {name: round(seconds, 4) for name, seconds in self._seconds.items()}

    def seconds(self) -> dict[str, float]:
        """Return the time of each stage, and as ``total`` the time since construction [s]."""
        return {**self.stages(), 'total': round(time.perf_counter() - self._begun, 4)}
