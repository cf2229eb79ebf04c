"""Results of the registrar in the order of the stamps of their box arrays, each array once."""

from __future__ import annotations

from bisect import insort
from collections.abc import Iterator
from dataclasses import dataclass

from boxreg_ros.structures import BoxArray, Floats, KEPT, RefinedBoxes
import numpy as np


@dataclass(eq=False, slots=True)
class Slot:
    """The place of one box array in the order."""

    boxes: BoxArray
    """Of the input, in the fixed frame where a transform to it is known."""
    T_fixed_sensor: Floats | None
    T_fixed_boxes: Floats | None
    """Pose of the frame of the input message; None where unknown, as that of the sensor."""
    result: RefinedBoxes | None = None
    """None until it is known."""

    @property
    def stamp_ns(self) -> int:
        """Return the stamp of the boxes [ns]."""
        return self.boxes.stamp_ns


class StampOrder:
    """
    Hold results until those of all box arrays with smaller stamps are known.

    Results are found by their ticket, because several arrays may have the same stamp. A result
    whose ticket was not announced by `expect`, or has been used, is ignored.

    """

    def __init__(self) -> None:
        self._by_stamp: list[Slot] = []
        self._by_ticket: dict[object, Slot] = {}  # without a result

    def __len__(self) -> int:
        """Return the number of box arrays that are held."""
        return len(self._by_stamp)

    def expect(self, slot: Slot, ticket: object = None) -> None:
        """Add a box array; its `ticket` returns with the result, which a slot may have already."""
        insort(self._by_stamp, slot, key=lambda slot: slot.stamp_ns)
        if slot.result is None:
            self._by_ticket[ticket] = slot

    def waiting_for(self, ticket: object) -> Slot | None:
        """Return the box array of a ticket; None if it has its result or was not announced."""
        return self._by_ticket.get(ticket)

    def take(self, ticket: object, result: RefinedBoxes) -> None:
        """Store the result of a box array."""
        slot = self._by_ticket.pop(ticket, None)
        if slot is not None:
            slot.result = result

    def ready(self) -> Iterator[tuple[Slot, RefinedBoxes]]:
        """Remove and yield the box arrays up to the first without a result."""
        while self._by_stamp:
            slot = self._by_stamp[0]
            if slot.result is None:
                return
            del self._by_stamp[0]
            yield slot, slot.result


def kept(boxes: BoxArray, reason: str) -> RefinedBoxes:
    """Return boxes as a result in which each is kept for the same reason."""
    n = len(boxes.track_ids)
    unknown = np.broadcast_to(np.eye(6), (n, 6, 6))
    return RefinedBoxes(boxes, (KEPT,) * n, (str(reason),) * n, np.zeros(n, np.int64), unknown)
