"""One object with two labels."""

from __future__ import annotations

from collections.abc import Iterator

from boxreg_ros.review.rules.overlap import DUPLICATE_IOU
from boxreg_ros.review.rules.protocol import ERROR, Labels, Rule, Violation
import numpy as np


def find(tracks: Labels) -> Iterator[Violation]:
    """Yield ids that occur twice at a stamp, and pairs of tracks with nearly equal boxes."""
    for track in tracks:
        twice = np.flatnonzero(np.diff(track.stamps_ns) == 0)
        if len(twice):
            stamp_ns = int(track.stamps_ns[twice[0]])
            text = f'its id occurs twice at {len(twice)} stamps'
            yield Violation(track.track_id, stamp_ns, text)
    pairs = tracks.near_pairs
    reported: set[tuple[int, int]] = set()
    for row in np.flatnonzero(pairs.iou >= DUPLICATE_IOU):
        a, b = pairs.tracks[row].tolist()
        if (a, b) not in reported:
            reported.add((a, b))
            text = f'has the box of track {tracks[b].track_id}'
            yield Violation(tracks[a].track_id, int(pairs.stamps_ns[row]), text)


RULE = Rule(
    'duplicate',
    ERROR,
    'one object has two labels',
    'remove one of them, or merge the two tracks',
    find,
)
