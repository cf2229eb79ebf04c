"""Notice of the compilation of kernels, which takes long at the very first run."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
import time

COMPILING = 'compiling the solver, once after an installation: about a minute'
PROGRESS_PERIOD = 10.0
"""Time between two lines of progress [s]; chosen: a person waits this long without a doubt."""


@dataclass
class Compilation:
    """What was compiled: the number of functions, each with those that it calls."""

    functions: int = 0


@contextmanager
def announced_compilation(announce: Callable[[str], None]) -> Iterator[Compilation]:
    """Call `announce` with `COMPILING`, then with the progress, if numba compiles in the block."""
    from numba.core import event  # it takes half a second

    done = Compilation()

    class Notice(event.Listener):
        """Announce compilations; kernels that are loaded from files cause no event."""

        begun = 0.0
        due = 0.0

        def on_start(self, event: object) -> None:
            if not self.begun:
                self.begun = time.monotonic()
                self.due = self.begun + PROGRESS_PERIOD
                announce(COMPILING)

        def on_end(self, event: object) -> None:
            done.functions += 1
            now = time.monotonic()
            if now >= self.due:
                self.due = now + PROGRESS_PERIOD
                announce(
                    f'compiling the solver: {done.functions} functions in {now - self.begun:.0f} s'
                )

    with event.install_listener('numba:compile', Notice()):
        yield done
