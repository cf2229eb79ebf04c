"""Tickets of box arrays: what is published for an input message once its boxes are refined."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from math import inf
from typing import Any, NamedTuple

from boxreg_ros.config import Config
from boxreg_ros.errors import TransformUnavailable
from boxreg_ros.io.items import Item
from boxreg_ros.io.session import Session
from boxreg_ros.io.transforms import boxes_to_frame, inverse
from boxreg_ros.live.transform_wait import TransformWait
from boxreg_ros.reasons import Reason
from boxreg_ros.structures import BoxArray, Floats


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
    Complete the tickets of box arrays.

    State: the last detection of each track, for boxes of tracks that miss one. Not thread-safe.

    """

    def __init__(self, session: Session, wait: TransformWait) -> None:
        self._session = session
        self._wait = wait
        self._last: dict[str, Detection] = {}

    def restart(self) -> None:
        """Forget the detections: tracks start anew."""
        self._last = {}

    def completed(self, item: Item, config: Config) -> Item:
        """
        Return boxes in the fixed frame with all that their ticket holds.

        Where the output frame is not reached, they are not `moved`. Of `config`, `coast` and
        `max_gap` are used.

        """
        given, moved = item.content, item.moved
        assert isinstance(given, BoxArray) and isinstance(moved, BoxArray)
        ticket = ticket_of(moved)
        try:
            ticket.boxes, ticket.frame = self._in_output_frame(item, given)
        except TransformUnavailable as error:
            detail = f'output_frame: {error}'
            return item._replace(moved=None, reason=Reason.NO_TRANSFORM, detail=detail)
        ticket.has_new_ids = moved.track_ids != given.track_ids
        if ticket.has_new_ids:
            ticket.boxes = replace(ticket.boxes, track_ids=moved.track_ids)
        ticket.earlier = self._earlier(item.message, moved, config)
        return item

    def _in_output_frame(self, item: Item, given: BoxArray) -> tuple[BoxArray, OutputFrame]:
        """Return boxes in the output frame, and that frame."""
        assert item.T_fixed_item is not None  # the boxes are in the fixed frame
        if not self._wait.changes_frame(given):
            return given, OutputFrame(inverse(item.T_fixed_item), None)
        frame = self._wait.output_frame
        session = self._session
        T_output_fixed = session.tree.lookup(frame, session.fixed_frame, given.stamp_ns)
        T_output_item = T_output_fixed @ item.T_fixed_item
        shown = boxes_to_frame(given, T_output_item, frame)
        return shown, OutputFrame(T_output_fixed, T_output_item)

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


def passing(message: Any, stamp_ns: int = 0) -> BoxArray:
    """
    Return an array with a ticket for a message that passes through: its early copy is out.

    Without its stamp [ns] it stands behind the newest boxes.

    """
    ticket = Ticket(message, received=inf, is_early_out=True)
    return replace(BoxArray.empty(stamp_ns, ''), ticket=ticket)


def ticket_of(boxes: BoxArray) -> Ticket:
    """Return the ticket of boxes that the registrar returns."""
    assert isinstance(boxes.ticket, Ticket)
    return boxes.ticket
