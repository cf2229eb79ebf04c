"""A vehicle that moves sideways."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from boxreg_ros.review.rules.protocol import LabelTrack, PEDESTRIAN, Rule, Violation, WARNING
from boxreg_ros.structures import YAW
import numpy as np

MAX_SIDEWAYS = 1.0
"""Largest median sideways speed over a second [m/s]. Chosen: far above the slip of a tyre."""
MAX_SLOPE = 0.2
"""Largest sideways over forward speed. Derived: the centre is half a wheelbase off the axle."""
SLIDING_STEPS = 5
"""Steps of the running median. Chosen: noise of single boxes is no slide."""


def find(tracks: Sequence[LabelTrack]) -> Iterator[Violation]:
    """Yield the place where each vehicle or cyclist slides fastest."""
    for track in tracks:
        steps = track.steps()
        if track.kind == PEDESTRIAN or len(steps.rows) < SLIDING_STEPS:
            continue
        yaw = track.boxes[steps.rows, YAW]
        x, y = steps.velocity[:, :2].T
        forward = np.abs(x * np.cos(yaw) + y * np.sin(yaw))
        sideways = np.abs(y * np.cos(yaw) - x * np.sin(yaw))
        excess = sideways - MAX_SLOPE * forward
        windows = np.lib.stride_tricks.sliding_window_view(excess, SLIDING_STEPS)
        medians = np.median(windows, axis=1)
        row = int(np.argmax(medians))
        if medians[row] > MAX_SIDEWAYS:
            middle = steps.rows[row + SLIDING_STEPS // 2]
            text = f'moves sideways at {sideways[row + SLIDING_STEPS // 2]:.1f} m/s'
            yield Violation(track.track_id, int(track.stamps_ns[middle]), text)


RULE = Rule(
    'sliding',
    WARNING,
    'a vehicle moves sideways',
    'correct the heading of the track',
    find,
)
