"""Messages that are one: arrays of one stamp, per object or class; those recorded twice."""

from __future__ import annotations

from collections import deque
from dataclasses import replace

from boxreg_ros.structures import BOX_CENTER, BoxArray, concatenated, LENGTH
import numpy as np

JOIN_NS = 20 * 10**6
"""Box arrays of one stamp that are received within this time are one array [ns]; chosen: they are
published in a burst, and detectors are slower."""
REPEAT_NS = 10**9
"""Messages with a stamp that are received within this time and are equal are one [ns]; derived:
clocks of recorders differ by less, where NTP sets them, and no recording is played in a shorter
loop."""
STAMP_BYTES = slice(4, 12)
"""Of a message with a header, in the encodings of ROS 1 and 2."""


class Repeats:
    """Messages that a recording has a second time, as where its files overlap in time."""

    def __init__(self) -> None:
        self._recent = deque[tuple[int, str, bytes]]()

    def has(self, received_ns: int, topic: str, data: bytes) -> bool:
        """
        Return whether a message, the next by receive time, is equal to one before it.

        That is within `REPEAT_NS` where it has a stamp, else within `JOIN_NS`.

        """
        while self._recent and received_ns - self._recent[0][0] > REPEAT_NS:
            self._recent.popleft()
        within_ns = REPEAT_NS if any(data[STAMP_BYTES]) else JOIN_NS
        is_repeated = any(
            received_ns - before_ns <= within_ns and [topic, data] == message
            for before_ns, *message in self._recent
        )
        if not is_repeated:
            self._recent.append((received_ns, topic, data))
        return is_repeated


def are_parts(boxes: BoxArray, more: BoxArray) -> bool:
    """
    Return whether two arrays have different objects of one stamp, in one frame.

    Their ids say so, their classes, where a detector publishes one array for each, or their
    places, where each of several detectors numbers its own: boxes nearer to each other than half
    a length are of one object.

    """
    if (boxes.stamp_ns, boxes.frame_id) != (more.stamp_ns, more.frame_id):
        return False
    is_named_apart = any(
        '' not in (*names, *others) and set(names).isdisjoint(others)
        for names, others in (
            (boxes.track_ids, more.track_ids),
            (boxes.class_names, more.class_names),
        )
    )
    if is_named_apart:
        return True
    one, other = boxes.boxes[:, None], more.boxes[None]
    apart = np.linalg.norm(one[..., BOX_CENTER] - other[..., BOX_CENTER], axis=-1)
    return bool((apart > np.maximum(one[..., LENGTH], other[..., LENGTH]) / 2).all())


def joined(boxes: BoxArray, more: BoxArray) -> BoxArray:
    """Return the boxes of two arrays of one stamp and frame."""
    both = boxes, more
    attributes = [one.attributes_of(row) for one in both for row in range(len(one.track_ids))]
    whole = concatenated([one.plain() for one in both])
    return replace(whole, attributes=tuple(attributes) if any(attributes) else ())
