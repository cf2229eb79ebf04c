"""Assignment of ids to boxes: association of each box with a track, over time."""

from __future__ import annotations

from dataclasses import dataclass, replace

from boxreg_ros.structures import BOX_CENTER, BOX_EXTENT, BoxArray, Floats, is_valid_box
import numpy as np

CENTER_STD = 0.3
"""Standard deviation of a detected centre [m]."""
INITIAL_SPEED_STD = 10.0
"""Standard deviation of the velocity of an object at its first detection [m/s], per axis."""
ACCELERATION_STD = 3.0
"""Standard deviation of the acceleration [m/s^2], constant between two detections."""
LOG_EXTENT_STD = 0.3
"""Standard deviation of the logarithm of the ratio of two detected extents."""
GATE = 20.0
"""
Largest squared distance of a box to its track, in standard deviations.

Centre and extents have six degrees of freedom: chi-square has 99.7 % below 20.

"""


@dataclass(eq=False, slots=True)
class _Track:
    """A constant-velocity Kalman filter of the centre, with one covariance (2, 2) for all axes."""

    track_id: str
    stamp_ns: int
    center: Floats
    velocity: Floats
    covariance: Floats
    extent: Floats

    @classmethod
    def started(cls, track_id: str, stamp_ns: int, box: Floats) -> _Track:
        covariance = np.diag([CENTER_STD**2, INITIAL_SPEED_STD**2])
        extent = box[BOX_EXTENT]
        return cls(track_id, stamp_ns, box[BOX_CENTER], np.zeros(3), covariance, extent)

    def predicted(self, stamp_ns: int) -> tuple[Floats, Floats]:
        """Return centre (3,) and covariance (2, 2) at a stamp."""
        seconds = (stamp_ns - self.stamp_ns) * 1e-9
        F = np.array([[1.0, seconds], [0.0, 1.0]])
        G = np.array([seconds**2 / 2, abs(seconds)]) * ACCELERATION_STD
        return self.center + seconds * self.velocity, F @ self.covariance @ F.T + np.outer(G, G)

    def update(self, stamp_ns: int, box: Floats) -> None:
        """Update the filter with the newest box of this track."""
        center, covariance = self.predicted(stamp_ns)
        gain = covariance[0] / (covariance[0, 0] + CENTER_STD**2)
        innovation = box[BOX_CENTER] - center
        self.stamp_ns = stamp_ns
        self.center = center + gain[0] * innovation
        self.velocity = self.velocity + gain[1] * innovation
        self.covariance = covariance - np.outer(gain, covariance[0])
        self.extent = box[BOX_EXTENT]


class Tracker:
    """
    Assign ids that stay with the object; ids of the input are not used.

    Boxes are assigned to the predictions of the tracks with least total cost, within a gate. A box
    without a track starts one; a track without a box for longer than `max_gap` [s], which may
    change, ends. The result depends on the order of calls only. `count` ids have been assigned so
    far.

    """

    def __init__(self, max_gap: float) -> None:
        self.max_gap = max_gap
        self.count = 0
        self.forget()

    def forget(self) -> None:
        """End all tracks; ids that were assigned are not used again."""
        self._tracks: list[_Track] = []
        self._newest_ns: int | None = None

    def identify(self, boxes: BoxArray) -> BoxArray:
        """
        Return boxes in a fixed frame with ids; invalid boxes get the id ``''``.

        Boxes with an older stamp than others before are assigned to tracks but do not change them;
        without a track they get an id that is not used again. If stamps go back further than
        `max_gap`, all tracks end.

        """
        from scipy.optimize import linear_sum_assignment  # slow, and only association needs it

        stamp_ns, max_gap_ns = boxes.stamp_ns, round(self.max_gap * 1e9)
        if self._newest_ns is not None and stamp_ns < self._newest_ns - max_gap_ns:
            self.forget()  # a recording in a loop
        is_late = self._newest_ns is not None and stamp_ns <= self._newest_ns
        if not is_late:
            self._newest_ns = stamp_ns
            oldest = stamp_ns - max_gap_ns
            self._tracks = [track for track in self._tracks if track.stamp_ns >= oldest]
        rows = np.flatnonzero(is_valid_box(boxes.boxes))
        costs = self._costs(stamp_ns, boxes.boxes[rows])
        ids = [''] * len(boxes.boxes)
        # Costs are cut off at the gate: a pair beyond it costs as much as no pair.
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
        """Return the squared distances (boxes, tracks) in standard deviations."""
        costs = np.zeros((len(boxes), len(self._tracks)))
        for k, track in enumerate(self._tracks):
            center, covariance = track.predicted(stamp_ns)
            away = np.square(boxes[:, BOX_CENTER] - center).sum(axis=1)
            unlike = np.square(np.log(boxes[:, BOX_EXTENT] / track.extent)).sum(axis=1)
            costs[:, k] = away / (covariance[0, 0] + CENTER_STD**2) + unlike / LOG_EXTENT_STD**2
        return costs
