"""How far a long run is, for the program that has started it."""

from __future__ import annotations

from contextlib import suppress
import os
from pathlib import Path

PROGRESS = 'BOXREG_PROGRESS'
"""Environment variable with the path of a file that has what is done, and the total [s]."""


def advanced(done: float, total: float) -> None:
    """Write how many seconds of the total are done, if another program wants to know."""
    if PROGRESS in os.environ:
        with suppress(OSError):
            Path(os.environ[PROGRESS]).write_text(f'{done:.1f} {total:.1f}', encoding='utf-8')
