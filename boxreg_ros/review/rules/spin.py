"""A heading that turns too fast, or flips."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from boxreg_ros.review.rules.protocol import ERROR, LabelTrack, PEDESTRIAN, Rule, Violation
from boxreg_ros.rotations import wrap_angle
from boxreg_ros.structures import YAW
import numpy as np

MAX_RATE = 2.0
"""Largest yaw rate of vehicles and cyclists [rad/s]. Chosen: a U-turn in 1.6 s."""
MIN_TURN = 0.1
"""Smallest turn that counts [rad]: more than errors of detectors."""


def find(tracks: Sequence[LabelTrack]) -> Iterator[Violation]:
    """Yield the fastest turn of each vehicle or cyclist."""
    for track in tracks:
        steps = track.steps()
        if track.kind == PEDESTRIAN or not len(steps.rows):
            continue
        turn = np.abs(wrap_angle(np.diff(track.boxes[:, YAW])[steps.rows]))
        rate = np.where(turn > MIN_TURN, turn / steps.seconds, 0.0)
        row = int(np.argmax(rate))
        if rate[row] > MAX_RATE:
            text = f'turns by {np.degrees(turn[row]):.0f} degrees in {steps.seconds[row]:.2f} s'
            yield Violation(track.track_id, int(track.stamps_ns[steps.rows[row] + 1]), text)


RULE = Rule(
    'spin',
    ERROR,
    'the heading turns faster than a vehicle can, or flips',
    'correct the heading; a turn by 180 degrees is a flip',
    find,
)
