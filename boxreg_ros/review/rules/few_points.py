"""A track with hardly any points in its boxes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from boxreg_ros.review.rules.protocol import LabelTrack, Rule, Violation, WARNING
import numpy as np

MIN_LABEL_POINTS = 5
"""Fewest points of a box. Literature: as Waymo leaves out boxes with fewer at its harder level."""
MAX_PART = 0.5
"""Part of the boxes of a track that may have fewer. Chosen."""


def find(tracks: Sequence[LabelTrack]) -> Iterator[Violation]:
    """Yield tracks most of whose boxes have too few points; unknown numbers are left out."""
    for track in tracks:
        known = track.num_points >= 0
        few = known & (track.num_points < MIN_LABEL_POINTS)
        if known.any() and few.sum() > MAX_PART * known.sum():
            text = f'{few.sum()} of {known.sum()} boxes have fewer than {MIN_LABEL_POINTS} points'
            yield Violation(track.track_id, int(track.stamps_ns[np.argmax(few)]), text)


RULE = Rule(
    'few-points',
    WARNING,
    'most boxes of the track have too few points to check them',
    'look at a camera image, or leave the track out',
    find,
)
