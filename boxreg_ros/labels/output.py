"""Label files of one drive in several formats."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from boxreg_ros.labels.protocol import LabelFrame, Options, Provenance
from boxreg_ros.labels.registry import require_boxes, writer_for
from boxreg_ros.structures import REJECTED

WITH_REJECTED = ('csv', 'mcap')
"""Formats that hold every box of the input; the messages of an overlay are those of the input."""


class LabelOutput:
    """
    Write each frame in every format; errors are those of `writer_for`.

    Rejected boxes, which a step or a person has taken out, are in the formats `WITH_REJECTED`.

    """

    def __init__(
        self, folder: Path, formats: Sequence[str], provenance: Provenance, options: Options
    ) -> None:
        require_boxes(formats)
        self._writers = {name: writer_for(name, folder, provenance, options) for name in formats}

    def write(self, frame: LabelFrame) -> None:
        """Add the boxes of one stamp to every format."""
        accepted = replace(frame, refined=frame.refined.without(REJECTED))
        for name, writer in self._writers.items():
            writer.write(frame if name in WITH_REJECTED else accepted)

    def close(self) -> None:
        """Complete the files."""
        for writer in self._writers.values():
            writer.close()

    def left_out(self) -> dict[str, dict[str, int]]:
        """Return the number of boxes that a format cannot represent, by format and reason."""
        counts = {name: dict(+writer.dropped) for name, writer in self._writers.items()}
        return {name: dropped for name, dropped in counts.items() if dropped}

    def notes(self) -> list[str]:
        """Return what writers assumed, and what readers of files leave out, with the format."""
        return [
            f'format {name}: {note}'
            for name, writer in self._writers.items()
            for note in getattr(writer, 'notes', ())
        ]
