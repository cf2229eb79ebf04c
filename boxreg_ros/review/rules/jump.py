"""A centre that jumps."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from boxreg_ros.review.rules.protocol import ERROR, LabelTrack, Rule, Violation
import numpy as np

MAX_ACCELERATION = 30.0
"""Largest horizontal acceleration [m/s^2]. Derived: three times that of emergency braking."""
MIN_JUMP = 0.5
"""Smallest deviation from constant velocity that is a jump [m]: more than errors of detectors."""


def find(tracks: Sequence[LabelTrack]) -> Iterator[Violation]:
    """Yield the largest jump of each track."""
    for track in tracks:
        steps = track.steps()
        if len(steps.rows) < 2:
            continue
        change = np.linalg.norm(np.diff(steps.velocity[:, :2], axis=0), axis=1)
        seconds = (steps.seconds[1:] + steps.seconds[:-1]) / 2
        jump = np.where(change / seconds > MAX_ACCELERATION, change * seconds, 0.0)
        row = int(np.argmax(jump))
        if jump[row] > MIN_JUMP:
            text = f'centre {jump[row]:.2f} m off constant velocity'
            yield Violation(track.track_id, int(track.stamps_ns[steps.rows[row + 1]]), text)


RULE = Rule(
    'jump',
    ERROR,
    'the centre jumps: no road user accelerates like this',
    'correct the box, or split the track if its id has switched to another object',
    find,
)
