"""How long the registrar waits for clouds and boxes that do not arrive."""

from __future__ import annotations

from boxreg_ros.core.registrar import BoxRegistrar
from boxreg_ros.live.tickets import ticket_of

BOXES_SILENCE = 3.0
"""After this time without boxes, final boxes are published without further observations [s]."""
CLOUD_SILENCE = 0.5
"""After this time without clouds, boxes that have waited as long are published unrefined [s]. Five
periods of a LiDAR of 10 Hz."""


class Silence:
    """
    Decide when boxes or clouds have ceased to arrive.

    The caller sets `boxes_received`, when boxes arrived last [s]. Not thread-safe.

    """

    def __init__(self, registrar: BoxRegistrar) -> None:
        self._registrar = registrar
        self.boxes_received = 0.0

    def has_no_boxes(self, now: float) -> bool:
        """Return whether no boxes have arrived for long."""
        return now >= self.boxes_received + max(BOXES_SILENCE, self._registrar.config.max_gap)

    def overdue_ns(self, now: float, cloud_received: float) -> int | None:
        """
        Return the newest stamp of a cloud that boxes have waited for too long [ns].

        None while clouds arrive, the last one at `cloud_received`, or no boxes wait.

        """
        if now < cloud_received + CLOUD_SILENCE:
            return None
        overdue = [
            boxes.stamp_ns
            for boxes in self._registrar.unpaired
            if now >= ticket_of(boxes).received + CLOUD_SILENCE
        ]
        if not overdue:
            return None
        # Beyond the reach of these boxes: a cloud that arrived before them may still be theirs.
        return max(overdue) + round(self._registrar.config.reach * 1e9) + 1
