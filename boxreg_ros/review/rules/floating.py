"""A box above or below the ground of its neighbours."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from boxreg_ros.review.rules.protocol import LabelTrack, Rule, Violation, WARNING
from boxreg_ros.structures import Floats, HEIGHT, X, Y, Z
import numpy as np
from numpy.typing import NDArray

NEIGHBOURHOOD = 15.0
"""Boxes within this distance share their ground [m]. Chosen: 1 m off at a slope of 7 %."""
MIN_NEIGHBOURS = 3
"""Fewest boxes around. Derived: the median of three is not moved by one that is off."""
MAX_OFFSET = 1.0
"""Largest distance of the bottom of a box from the median of its neighbours [m]. Chosen."""


def find(tracks: Sequence[LabelTrack]) -> Iterator[Violation]:
    """Yield the first box of each track that is off the bottoms of the boxes around it."""
    stamps_ns = np.concatenate([np.zeros(0, np.int64), *(t.stamps_ns for t in tracks)])
    boxes = np.concatenate([np.zeros((0, 9)), *(t.boxes for t in tracks)])
    owner = np.repeat(np.arange(len(tracks)), [len(t.boxes) for t in tracks])
    bottom = boxes[:, Z] - boxes[:, HEIGHT] / 2
    reported: set[int] = set()
    order = np.argsort(stamps_ns, kind='stable')
    starts = np.flatnonzero(np.diff(stamps_ns[order])) + 1
    for rows in np.split(order, starts):
        if len(rows) <= MIN_NEIGHBOURS or np.ptp(bottom[rows]) <= MAX_OFFSET:
            continue  # none can be off the median of the others
        x, y = boxes[rows][:, [X, Y]].T
        near = np.hypot(np.subtract.outer(x, x), np.subtract.outer(y, y)) < NEIGHBOURHOOD
        np.fill_diagonal(near, False)
        counts = near.sum(axis=1)
        heights = bottom[rows] - _medians(bottom[rows], near)
        for i in np.flatnonzero((counts >= MIN_NEIGHBOURS) & (np.abs(heights) > MAX_OFFSET)):
            index = int(owner[rows[i]])
            if index not in reported:
                reported.add(index)
                text = f'bottom {heights[i]:+.2f} m off those of {counts[i]} boxes around it'
                yield Violation(tracks[index].track_id, int(stamps_ns[rows[i]]), text)


def _medians(values: Floats, is_in: NDArray[np.bool_]) -> Floats:
    """Return for each row of `is_in` (n, n) the median of the values (n,) in it; inf for none."""
    ordered = np.sort(np.where(is_in, values, np.inf), axis=1)
    counts = is_in.sum(axis=1)
    rows = np.arange(len(values))
    medians: Floats = (ordered[rows, (counts - 1) // 2] + ordered[rows, counts // 2]) / 2
    return medians


RULE = Rule(
    'floating',
    WARNING,
    'a box floats above, or is sunk below, the ground of the boxes around it',
    'correct its height; ignore it on bridges and slopes',
    find,
)
