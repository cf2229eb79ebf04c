"""A track that ends although its object has points."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from boxreg_ros.review.rules.protocol import LabelTrack, Rule, Violation, WARNING

MIN_POINTS_IN_VIEW = 50
"""Fewest points of an object in view. Chosen: boxes with fewer may be lost by a detector."""
MIN_TIME_LEFT = 1.0
"""Shortest time from the end of the track to that of the labels [s]. Chosen: gaps are shorter."""


def find(tracks: Sequence[LabelTrack]) -> Iterator[Violation]:
    """Yield tracks whose last box has many points, well before the end of the labels."""
    end_ns = max((int(t.stamps_ns[-1]) for t in tracks if len(t.stamps_ns)), default=0)
    for track in tracks:
        if not len(track.stamps_ns):
            continue
        last_ns = int(track.stamps_ns[-1])
        left = (end_ns - last_ns) * 1e-9
        if left > MIN_TIME_LEFT and track.num_points[-1] >= MIN_POINTS_IN_VIEW:
            text = f'ends {left:.1f} s before the labels with {track.num_points[-1]} points'
            yield Violation(track.track_id, last_ns, text)


RULE = Rule(
    'ends-in-view',
    WARNING,
    'the track ends although its object is in view',
    'extend the track, or merge it with the one that goes on',
    find,
)
