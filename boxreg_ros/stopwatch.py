"""What each stage of a long run takes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
import time
from typing import TypeVar

_T = TypeVar('_T')


class Stopwatch:
    """
    Adds up what each stage takes [s].

    Two threads use it, for different stages, and a process beside them; as their work overlaps,
    stages may add up to more than the total.

    """

    def __init__(self) -> None:
        self._begun = time.perf_counter()
        self._seconds: Counter[str] = Counter()

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Count what the block takes to a stage."""
        begun = time.perf_counter()
        yield
        self.add(stage, time.perf_counter() - begun)

    def add(self, stage: str, seconds: float) -> None:
        """Count what was measured elsewhere to a stage."""
        self._seconds[stage] += seconds  # type: ignore[assignment]

    def each(self, stage: str, items: Iterator[_T]) -> Iterator[_T]:
        """Yield `items`, adding up what it takes to get them."""
        end = object()
        while True:
            with self(stage):
                item = next(items, end)
            if item is end:
                return
            yield item  # type: ignore[misc]

    def seconds(self) -> dict[str, float]:
        """Return what each stage took, and the total since this was made."""
        total = time.perf_counter() - self._begun
        return {**{k: round(v, 4) for k, v in self._seconds.items()}, 'total': round(total, 4)}
