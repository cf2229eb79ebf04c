"""A vehicle that moves backward for long or fast."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from boxreg_ros.review.rules.protocol import LabelTrack, PEDESTRIAN, Rule, Violation, WARNING
from boxreg_ros.structures import YAW
import numpy as np

MIN_SPEED = 2.0
"""Slower motion backward is parking [m/s]. Chosen."""
MIN_PART = 0.5
"""Part of the steps that are backward at least. Chosen."""
MIN_STEPS = 5
"""Fewest steps of a track. Chosen: half a second at 10 Hz; noise of single boxes is no motion."""


def find(tracks: Sequence[LabelTrack]) -> Iterator[Violation]:
    """Yield vehicles and cyclists that move backward most of the time."""
    for track in tracks:
        steps = track.steps()
        if track.kind == PEDESTRIAN or len(steps.rows) < MIN_STEPS:
            continue
        yaw = track.boxes[steps.rows, YAW]
        forward = steps.velocity[:, 0] * np.cos(yaw) + steps.velocity[:, 1] * np.sin(yaw)
        is_backward = forward < -MIN_SPEED
        if is_backward.mean() > MIN_PART:
            row = steps.rows[np.argmax(is_backward)]
            text = f'moves backward at {-np.median(forward[is_backward]):.1f} m/s'
            yield Violation(track.track_id, int(track.stamps_ns[row]), text)


RULE = Rule(
    'backward',
    WARNING,
    'a vehicle drives backward',
    'turn the heading of the track by 180 degrees',
    find,
)
