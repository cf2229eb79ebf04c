"""Tickets of box arrays: what is published for an input message once its boxes are refined."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from math import inf
from typing import Any, NamedTuple

from boxreg_ros.config import Config
from boxreg_ros.io.items import Item
from boxreg_ros.structures import BoxArray, Floats
import numpy as np

PASSING = BoxArray(0, '', (), (), np.zeros(0), np.zeros((0, 9)))
"""In the place of a message that passes through: it stands behind the newest boxes."""


class Detection(NamedTuple):
    """The last message with a box of a track, the row of the box, and its stamp [ns]."""

    message: Any
    row: int
    stamp_ns: int


class OutputFrame(NamedTuple):
    """How boxes get from the fixed frame, and from their message, to that of the output."""

    T_output_fixed: Floats
    T_output_item: Floats | None
    """None: it is that of the message."""


@dataclass(eq=False, slots=True)
class Ticket:
    """An input message; the registrar returns it with the boxes of the message."""

    message: Any
    boxes: BoxArray | None = None
    """In the output frame; None: the message passes through."""
    received: float = 0.0
    frame: OutputFrame | None = None
    has_new_ids: bool = False
    earlier: Mapping[str, Detection] = field(default_factory=dict)
    """By id, of the tracks that have no box in the message."""
    is_late: bool = False
    """Whether its boxes were corrected."""
    is_early_out: bool = False


class Tickets:
    """
    Give box arrays their tickets.

    State: the last detection of each track, for boxes of tracks that miss one. Not thread-safe.

    """

    def __init__(self) -> None:
        self._last: dict[str, Detection] = {}

    def restart(self) -> None:
        """Forget the detections: tracks start anew."""
        self._last = {}

    def issue(
        self, item: Item, shown: BoxArray, moved: BoxArray, frame: OutputFrame, config: Config
    ) -> BoxArray:
        """
        Return boxes with their ticket.

        Parameters
        ----------
        item : Item
            The input message.
        shown, moved : BoxArray
            Its boxes in the output frame, and in the fixed frame with their ids.
        frame : OutputFrame
            Of the output.
        config : Config
            `coast` and `max_gap` are used.

        """
        assert isinstance(item.content, BoxArray)
        has_new_ids = moved.track_ids != item.content.track_ids
        ticket = Ticket(
            item.message,
            replace(shown, track_ids=moved.track_ids) if has_new_ids else shown,
            item.received,
            frame,
            has_new_ids,
            self._earlier(item.message, moved, config),
        )
        return replace(moved, ticket=ticket)

    def _earlier(self, message: Any, boxes: BoxArray, config: Config) -> dict[str, Detection]:
        """Return the detections of tracks that have none in `boxes`; note those of `boxes`."""
        # `coast` may become larger while tracks without a detection wait for their end.
        oldest_ns = boxes.stamp_ns - round((config.coast + config.max_gap) * 1e9)
        own = set(boxes.track_ids)
        earlier = {
            track_id: detection
            for track_id, detection in self._last.items()
            if detection.stamp_ns >= oldest_ns and track_id not in own
        }
        self._last = earlier | {
            track_id: Detection(message, row, boxes.stamp_ns)
            for row, track_id in enumerate(boxes.track_ids)
        }
        return earlier


def passing(message: Any) -> BoxArray:
    """Return an array with a ticket for a message that passes through: its early copy is out."""
    return replace(PASSING, ticket=Ticket(message, received=inf, is_early_out=True))


def ticket_of(boxes: BoxArray) -> Ticket:
    """Return the ticket of boxes that the registrar returns."""
    assert isinstance(boxes.ticket, Ticket)
    return boxes.ticket
