"""Messages to publish: refined boxes as messages of the type of the input."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

from boxreg_ros.config import Config
from boxreg_ros.io.session import covariances_to_write
from boxreg_ros.io.transforms import boxes_to_frame
from boxreg_ros.structures import BoxArray, COASTED, Floats, REFINED, RefinedBoxes
from msg_adapters import Adapter
from msg_adapters.poses import turned_covariances


class Outgoing(NamedTuple):
    """A message to publish, of the type of the input."""

    message: Any
    is_final: bool  # for the topic of final boxes, not of early ones
    given: BoxArray | None = None  # in the frame of the message; None if it is passed through
    refined: RefinedBoxes | None = None
    received: float | None = None  # when the input arrived [s]
    in_fixed: RefinedBoxes | None = None  # the same as `refined`, as the registrar returns it


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
class Given:
    """An input message; the ticket of its boxes at the registrar."""

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


class Detections:
    """The last detection of each track, for boxes of tracks that miss one. Not thread-safe."""

    def __init__(self) -> None:
        self._last: dict[str, Detection] = {}

    def clear(self) -> None:
        """Forget all."""
        self._last = {}

    def earlier(self, message: Any, boxes: BoxArray, config: Config) -> dict[str, Detection]:
        """Return those of tracks that miss one in `boxes` of a message; note those of `boxes`."""
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


def passed_on(given: Given, is_final: bool) -> Outgoing:
    """Return an input message as it is."""
    return Outgoing(given.message, is_final, received=given.received or None)


def outgoing(
    refined: RefinedBoxes, given: Given, adapter: Adapter, followed: Mapping[str, Detection]
) -> Outgoing:
    """
    Return the message of refined boxes, in the output frame.

    Parameters
    ----------
    refined : RefinedBoxes
        In the fixed frame.
    given : Given
        The ticket of the boxes, which do not pass through.
    adapter : Adapter
        Of the type of the message.
    followed : mapping
        The box that each followed object began with: it may have no other in a message.

    """
    assert given.boxes is not None and given.frame is not None
    moved = refined_to_frame(refined, given.frame.T_output_fixed, given.boxes.frame_id)
    message = given.message
    coasted = refined.boxes.track_ids[len(given.boxes.track_ids) :]
    if coasted:
        sources = [(given.earlier.get(name) or followed[name])[:2] for name in coasted]
        message = adapter.with_added(message, sources)
    T_output_item = given.frame.T_output_item
    is_changed = REFINED in refined.status or COASTED in refined.status
    # Copying a message takes time; under load most boxes are kept.
    if is_changed or T_output_item is not None or given.has_new_ids or given.is_late:
        covariances = covariances_to_write(moved)
        message = adapter.to_msg(message, moved.boxes, covariances, T_output_item)
    return Outgoing(message, refined.is_final, given.boxes, moved, given.received, refined)


def refined_to_frame(refined: RefinedBoxes, T_frame_boxes: Floats, frame_id: str) -> RefinedBoxes:
    """Return refined boxes and their covariances in another frame."""
    return replace(
        refined,
        boxes=boxes_to_frame(refined.boxes, T_frame_boxes, frame_id),
        covariances=turned_covariances(refined.covariances, T_frame_boxes),
    )
