"""Stamps as text."""

from contextlib import suppress
from datetime import datetime, UTC


def time_range(first_ns: int, last_ns: int) -> str:
    """Return two stamps as seconds, with the date of the first."""
    text = f'{first_ns * 1e-9:.3f} to {last_ns * 1e-9:.3f} s'
    with suppress(OverflowError, ValueError, OSError):
        text += datetime.fromtimestamp(first_ns * 1e-9, UTC).strftime(' (%Y-%m-%d)')
    return text
