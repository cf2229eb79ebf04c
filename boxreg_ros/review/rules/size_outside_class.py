"""Extents that no object of the class has."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from boxreg_ros.review.rules.protocol import (
    CYCLIST,
    LabelTrack,
    PEDESTRIAN,
    Rule,
    VEHICLE,
    Violation,
    WARNING,
)
from boxreg_ros.structures import BOX_EXTENT
import numpy as np

BOUNDS = {
    VEHICLE: ((1.5, 0.8, 0.8), (26.0, 3.6, 5.0)),
    CYCLIST: ((0.8, 0.2, 0.8), (3.0, 1.4, 2.4)),
    PEDESTRIAN: ((0.2, 0.2, 0.7), (1.8, 1.6, 2.4)),
}
"""Least and largest length, width and height [m]. Chosen: from small cars to articulated buses,
from children to large persons with their arms stretched out."""


def find(tracks: Sequence[LabelTrack]) -> Iterator[Violation]:
    """Yield the first box of each track that is outside the bounds of its class."""
    for track in tracks:
        low, high = np.array(BOUNDS[track.kind])
        extents = track.boxes[:, BOX_EXTENT]
        rows = np.flatnonzero(((extents < low) | (extents > high)).any(axis=1))
        if len(rows):
            size = ' x '.join(f'{value:.2f}' for value in extents[rows[0]])
            text = f'{track.class_name} of {size} m in {len(rows)} boxes'
            yield Violation(track.track_id, int(track.stamps_ns[rows[0]]), text)


RULE = Rule(
    'size-outside-class',
    WARNING,
    'the extents are those of no object of this class',
    'correct the size or the class of the track',
    find,
)
