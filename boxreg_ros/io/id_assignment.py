"""Ids for boxes that have none: which box of now is which of before."""

from __future__ import annotations

from dataclasses import dataclass, replace

from boxreg_ros.structures import BoxArray, Floats, HEIGHT, is_valid_box, LENGTH, X, Z
import numpy as np
from scipy.optimize import linear_sum_assignment

CENTER = 0.3
"""Deviation of a detected centre [m]."""
SPEED = 10.0
"""Deviation of the speed of an object that is seen for the first time [m/s]."""
ACCELERATION = 3.0
"""Deviation of what a speed changes by in a second [m/s^2]."""
EXTENT = 0.3
"""Deviation of a detected extent, as the logarithm of its ratio to the one before."""
GATE = 20.0
"""Boxes whose squared deviations from a track add up to more are another object."""


@dataclass(eq=False, slots=True)
class _Track:
    """
    A constant velocity filter on the centre, the same for each of the three axes.

    `spread` (2, 2) is the covariance of position and velocity along one axis.

    """

    track_id: str
    stamp_ns: int
    center: Floats
    velocity: Floats
    spread: Floats
    extent: Floats

    @classmethod
    def started(cls, track_id: str, stamp_ns: int, box: Floats) -> _Track:
        spread = np.diag([CENTER**2, SPEED**2])
        extent = box[LENGTH : HEIGHT + 1]
        return cls(track_id, stamp_ns, box[X : Z + 1], np.zeros(3), spread, extent)

    def predicted(self, stamp_ns: int) -> tuple[Floats, Floats]:
        """Return centre (3,) and covariance (2, 2) at a stamp."""
        seconds = (stamp_ns - self.stamp_ns) * 1e-9
        F = np.array([[1.0, seconds], [0.0, 1.0]])
        G = np.array([seconds**2 / 2, abs(seconds)]) * ACCELERATION
        return self.center + seconds * self.velocity, F @ self.spread @ F.T + np.outer(G, G)

    def update(self, stamp_ns: int, box: Floats) -> None:
        """Take a box as the newest of this track."""
        center, spread = self.predicted(stamp_ns)
        gain = spread[0] / (spread[0, 0] + CENTER**2)
        surprise = box[X : Z + 1] - center
        self.stamp_ns = stamp_ns
        self.center = center + gain[0] * surprise
        self.velocity = self.velocity + gain[1] * surprise
        self.spread = spread - np.outer(gain, spread[0])
        self.extent = box[LENGTH : HEIGHT + 1]


class Tracker:
    """
    Give boxes ids that stay with the object, whatever ids they came with.

    Deterministic: the order of calls is its only input. Gated assignment of least total cost
    between the boxes and where constant velocity takes the tracks. A box that fits no track
    starts one.

    Parameters
    ----------
    max_gap : float
        A track that was not seen for longer is forgotten [s]; may change.

    Attributes
    ----------
    count : int
        Ids given so far.

    """

    def __init__(self, max_gap: float) -> None:
        self.max_gap = max_gap
        self.count = 0
        self.forget()

    def forget(self) -> None:
        """Begin anew; ids that were given do not come again."""
        self._tracks: list[_Track] = []
        self._newest_ns: int | None = None

    def identify(self, boxes: BoxArray) -> BoxArray:
        """
        Return the boxes, given in a fixed frame, with ids.

        Invalid boxes get the id ``''``. Boxes older than others before find the tracks, but
        change none; one that finds none starts none, and its id comes once only. Where stamps
        go back further than `max_gap`, all tracks are forgotten.

        """
        stamp_ns, max_gap_ns = boxes.stamp_ns, round(self.max_gap * 1e9)
        if self._newest_ns is not None and stamp_ns < self._newest_ns - max_gap_ns:
            self.forget()  # a recording that starts again
        is_late = self._newest_ns is not None and stamp_ns <= self._newest_ns
        if not is_late:
            self._newest_ns = stamp_ns
            oldest = stamp_ns - max_gap_ns
            self._tracks = [track for track in self._tracks if track.stamp_ns >= oldest]
        rows = np.flatnonzero(is_valid_box(boxes.boxes))
        costs = self._costs(stamp_ns, boxes.boxes[rows])
        ids = [''] * len(boxes.boxes)
        # A pair beyond the gate costs as much as two that stay alone.
        pairs = zip(*linear_sum_assignment(np.minimum(costs, GATE)), strict=True)
        found = {int(rows[i]): self._tracks[k] for i, k in pairs if costs[i, k] < GATE}
        for row in rows.tolist():
            track = found.get(row)
            if track is None:
                self.count += 1
                track = _Track.started(str(self.count), stamp_ns, boxes.boxes[row])
                if not is_late:
                    self._tracks.append(track)
            elif not is_late:
                track.update(stamp_ns, boxes.boxes[row])
            ids[row] = track.track_id
        return replace(boxes, track_ids=tuple(ids))

    def _costs(self, stamp_ns: int, boxes: Floats) -> Floats:
        """Return the squared deviations (boxes, tracks) of each box from each track."""
        costs = np.zeros((len(boxes), len(self._tracks)))
        for k, track in enumerate(self._tracks):
            center, spread = track.predicted(stamp_ns)
            away = np.square(boxes[:, X : Z + 1] - center).sum(axis=1)
            unlike = np.square(np.log(boxes[:, LENGTH : HEIGHT + 1] / track.extent)).sum(axis=1)
            costs[:, k] = away / (spread[0, 0] + CENTER**2) + unlike / EXTENT**2
        return costs
