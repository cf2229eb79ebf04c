"""
Refined boxes to label files; one module per format.

A writer gets a folder of its own to write to, then one `RefinedBoxes` after the other, stamps
ascending, and never holds more than the tracks' names.

"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import cast, Protocol

from boxreg_ros.errors import ConfigError
from boxreg_ros.structures import RefinedBoxes

WRITERS = {
    'csv': 'boxreg_ros.labels.csv',
    'openlabel': 'boxreg_ros.labels.openlabel',
}


class LabelWriter(Protocol):
    """What ``Writer(folder)`` of every module named in `WRITERS` offers."""

    def write(self, refined: RefinedBoxes) -> None:
        """Add the boxes of one stamp."""

    def close(self) -> None:
        """Complete the files."""


def writer_for(name: str, folder: Path) -> LabelWriter:
    """
    Return a writer of this format for the results in `folder`.

    Raises
    ------
    ConfigError
        For a format that does not exist.

    """
    if name not in WRITERS:
        raise ConfigError(f'format {name!r}: expected one of {", ".join(WRITERS)}')
    return cast(LabelWriter, import_module(WRITERS[name]).Writer(folder))
