"""Two boxes in one place."""

from __future__ import annotations

from collections.abc import Iterator

from boxreg_ros.review.rules.protocol import ERROR, Labels, Rule, Violation
import numpy as np

MAX_IOU = 0.1
"""Largest 3D IoU of two objects. Chosen: neighbours touch by errors of their boxes only."""
DUPLICATE_IOU = 0.7
"""Above, the boxes are of one object, which `duplicate` reports. Chosen: as KITTI matches cars."""


def find(tracks: Labels) -> Iterator[Violation]:
    """Yield the largest overlap of each pair of tracks."""
    worst: dict[tuple[int, int], tuple[float, int]] = {}
    pairs = tracks.near_pairs
    for row in np.flatnonzero((pairs.iou > MAX_IOU) & (pairs.iou < DUPLICATE_IOU)):
        key = int(pairs.tracks[row, 0]), int(pairs.tracks[row, 1])
        found = float(pairs.iou[row]), int(pairs.stamps_ns[row])
        worst[key] = max(worst.get(key, found), found)
    for (a, b), (value, stamp_ns) in sorted(worst.items()):
        text = f'overlaps with track {tracks[b].track_id}: 3D IoU {value:.2f}'
        yield Violation(tracks[a].track_id, stamp_ns, text)


RULE = Rule(
    'overlap',
    ERROR,
    'two boxes are in one place',
    'correct position, size or heading of one of them',
    find,
)
