"""Notice of the compilation of kernels, which takes long at the very first run."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

COMPILING = 'compiling the solver, once after an installation: about a minute'


@contextmanager
def announced_compilation(announce: Callable[[str], None]) -> Iterator[None]:
    """Call `announce` with `COMPILING` if numba compiles anything in the block."""
    try:
        from numba.core import event
    except Exception:  # whatever an incomplete installation raises; the solver warns of it
        yield
        return

    class Notice(event.Listener):
        """Announce the first compilation; kernels that are loaded from files cause no event."""

        is_given = False

        def on_start(self, event: object) -> None:
            if not self.is_given:
                self.is_given = True
                announce(COMPILING)

        def on_end(self, event: object) -> None:
            pass

    with event.install_listener('numba:compile', Notice()):
        yield
