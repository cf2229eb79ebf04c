"""Messages to publish: refined boxes as messages of the type of the input."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import Any, NamedTuple

from boxreg_ros.io.session import covariances_to_write, refined_to_frame, Session
from boxreg_ros.io.transforms import boxes_to_frame
from boxreg_ros.live.following import Following
from boxreg_ros.live.static_points import StaticPoints
from boxreg_ros.live.tickets import Detection, Ticket, ticket_of
from boxreg_ros.reasons import Reason
from boxreg_ros.structures import BoxArray, COASTED, kept, REFINED, RefinedBoxes
from msg_adapters import Adapter


class Outgoing(NamedTuple):
    """A message to publish, of the type of the input."""

    message: Any
    is_final: bool  # for the topic of final boxes, not of early ones
    given: BoxArray | None = None  # in the frame of the message; None if it is passed through
    refined: RefinedBoxes | None = None
    received: float | None = None  # when the input arrived [s]
    in_fixed: RefinedBoxes | None = None  # the same as `refined`, as the registrar returns it


class OutgoingQueue:
    """
    Results of the registrar on their way to messages.

    Both survive an error while messages are made: `abandoned` has them. Early boxes are shown to
    `static_points`, if any. Not thread-safe.

    """

    def __init__(self, following: Following, static_points: StaticPoints | None) -> None:
        self._following = following
        self._static_points = static_points
        self._results = deque[RefinedBoxes]()
        self._made: list[Outgoing] = []

    def messages(self, results: list[RefinedBoxes], adapter: Adapter | None) -> list[Outgoing]:
        """
        Return the messages to publish for results of the registrar.

        Parameters
        ----------
        results : list of RefinedBoxes
            In the fixed frame, with the tickets of their input.
        adapter : Adapter or None
            That has read the messages of the input; None before the first of them.

        Returns
        -------
        list of Outgoing
            In the order of `results`, of the type of the input.

        """
        self._results += results
        self._following.report()
        while self._results:
            refined = self._results[0]
            ticket = ticket_of(refined.boxes)
            if refined.is_final or not ticket.is_early_out:
                self._made.append(self._message_of(refined, ticket, adapter))
            if self._static_points is not None and not ticket.is_early_out:
                self._static_points.add_boxes(refined)
            ticket.is_early_out = True
            self._results.popleft()
        made = self._made
        self._made = []
        return made

    def abandoned(self, results: list[RefinedBoxes]) -> tuple[list[Outgoing], list[Any]]:
        """
        Return what is to be published after an error while messages were made.

        Parameters
        ----------
        results : list of RefinedBoxes
            Further ones, with the tickets of their input.

        Returns
        -------
        ready : list of Outgoing
            Those made before the error; all others pass through.
        inputs : list of message
            Input messages of the results that were not turned into messages, `results` behind
            those before them.

        """
        lost = [*self._results, *results]
        self._results.clear()
        ready = self._made
        self._made = []
        for refined in lost:
            ticket = ticket_of(refined.boxes)
            if not ticket.is_early_out:
                ready.append(_passed_on(ticket, False))
                ticket.is_early_out = True
            if refined.is_final:
                ready.append(_passed_on(ticket, True))
        return ready, [ticket_of(refined.boxes).message for refined in lost]

    def _message_of(
        self, refined: RefinedBoxes, ticket: Ticket, adapter: Adapter | None
    ) -> Outgoing:
        """Return the message to publish for a result."""
        if ticket.boxes is None:
            return Outgoing(ticket.message, refined.is_final)
        assert adapter is not None
        return _outgoing(refined, ticket, adapter, self._following.sources)


def labels_passed_through(message: Any, adapter: Adapter, session: Session) -> RefinedBoxes | None:
    """
    Return the boxes of a message that passed through as kept.

    Parameters
    ----------
    message : message
        Of the boxes.
    adapter : Adapter
        That reads it.
    session : Session
        Has the transforms and the fixed frame.

    Returns
    -------
    refined : RefinedBoxes or None
        In the fixed frame, or in that of the message where no transform is known; None if the
        message cannot be read.

    """
    try:
        boxes = adapter.from_msg(message)
    except Exception:  # it was reported when the message arrived
        return None
    T_fixed_boxes = session.tree.find(session.fixed_frame, boxes.frame_id, boxes.stamp_ns)
    if T_fixed_boxes is None:
        return kept(boxes, Reason.NO_TRANSFORM)
    moved = boxes_to_frame(boxes, T_fixed_boxes, session.fixed_frame)
    return kept(moved, Reason.BOXES_QUEUE_FULL)


def _passed_on(ticket: Ticket, is_final: bool) -> Outgoing:
    """Return an input message as it is."""
    return Outgoing(ticket.message, is_final, received=ticket.received or None)


def _outgoing(
    refined: RefinedBoxes, ticket: Ticket, adapter: Adapter, followed: Mapping[str, Detection]
) -> Outgoing:
    """
    Return the message of refined boxes, in the output frame.

    Parameters
    ----------
    refined : RefinedBoxes
        In the fixed frame.
    ticket : Ticket
        That of the boxes, which do not pass through.
    adapter : Adapter
        Of the type of the message.
    followed : mapping
        The box that each followed object began with: it may have no other in a message.

    """
    assert ticket.boxes is not None and ticket.frame is not None
    moved = refined_to_frame(refined, ticket.frame.T_output_fixed, ticket.boxes.frame_id)
    message = ticket.message
    coasted = refined.boxes.track_ids[len(ticket.boxes.track_ids) :]
    if coasted:
        sources = [(ticket.earlier.get(name) or followed[name])[:2] for name in coasted]
        message = adapter.with_added(message, sources)
    T_output_item = ticket.frame.T_output_item
    is_changed = REFINED in refined.status or COASTED in refined.status
    # Copying a message takes time; under load most boxes are kept.
    if is_changed or T_output_item is not None or ticket.has_new_ids or ticket.is_late:
        covariances = covariances_to_write(moved)
        message = adapter.to_msg(message, moved.boxes, covariances, T_output_item)
    return Outgoing(message, refined.is_final, ticket.boxes, moved, ticket.received, refined)
