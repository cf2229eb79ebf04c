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

    What processes beside this one take is added; as their work overlaps, stages may add up to
    more than the total.

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

    def stages(self) -> dict[str, float]:
        """Return what each stage took."""
        return {name: round(seconds, 4) for name, seconds in self._seconds.items()}

    def seconds(self) -> dict[str, float]:
        """Return what each stage took, and the total since this was made."""
        return {**self.stages(), 'total': round(time.perf_counter() - self._begun, 4)}
