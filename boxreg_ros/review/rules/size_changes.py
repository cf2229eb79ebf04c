"""A rigid object whose extents change over its track."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from boxreg_ros.review.rules.protocol import LabelTrack, Rule, VEHICLE, Violation, WARNING
from boxreg_ros.structures import BOX_EXTENT
import numpy as np

MAX_CHANGE = 0.1
"""Largest difference from the median, as part of it. Chosen: twice the error of a detector."""


def find(tracks: Sequence[LabelTrack]) -> Iterator[Violation]:
    """Yield the box of each vehicle whose extents are furthest from their median."""
    for track in tracks:
        if track.kind != VEHICLE or len(track.boxes) < 2:
            continue
        extents = track.boxes[:, BOX_EXTENT]
        change = np.abs(extents / np.median(extents, axis=0) - 1).max(axis=1)
        row = int(np.argmax(change))
        if change[row] > MAX_CHANGE:
            text = f'extents differ by up to {change[row]:.0%} from their median'
            yield Violation(track.track_id, int(track.stamps_ns[row]), text)


RULE = Rule(
    'size-changes',
    WARNING,
    'the extents of a rigid object change over its track',
    'give all boxes of the track one size',
    find,
)
