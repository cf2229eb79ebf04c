"""Check of boxes that lie on one another: two detectors or trackers on one topic."""

from __future__ import annotations

from collections import Counter, defaultdict

from boxreg_ros.config import Config
from boxreg_ros.core.metrics import iou_3d
from boxreg_ros.structures import BOX_CENTER, BOX_EXTENT, BoxArray, Floats, is_valid_box
import numpy as np

SAME_OBJECT_IOU = 0.4
"""
3D IoU from which two boxes are of one object.

Chosen: boxes of one car by two detectors have .7 in the median, of one pedestrian .45; two
objects have .1 at most.

"""
MIN_TWICE = 30
"""Boxes with another one on them that a finding needs; chosen: one object at 15 stamps."""
MIN_ID_PAIRS = 3
"""Pairs of ids that it needs; chosen: trackers may give an object two for a while."""
MIN_SHARE_TWICE = 0.3
"""Part of the boxes of a kind; chosen: where one detector sees half as far it is half of them."""
MAX_LOOKED = 3000
"""After this number of boxes the check ends; chosen: 5 s of 60 boxes at 10 Hz."""


class TwiceCheck:
    """Count the boxes that lie on one of another id, by kind: rider and bicycle may do so."""

    def __init__(self, config: Config) -> None:
        self._config = config
        self._last: BoxArray | None = None
        self._boxes = Counter[str]()
        self._twice = Counter[str]()
        self._pairs = defaultdict[str, set[frozenset[str]]](set)

    def add(self, boxes: BoxArray) -> None:
        """Add the next boxes, of a stamp of their own or of that of the ones before."""
        if self._boxes.total() >= MAX_LOOKED:
            return
        last, self._last = self._last, boxes
        others = last if last is not None and last.stamp_ns == boxes.stamp_ns else None
        arrays = [boxes] if others is None else [boxes, others]
        kinds = [self._config.kind(name) for one in arrays for name in one.class_names]
        ids = [name for one in arrays for name in one.track_ids]
        values = np.concatenate([one.boxes for one in arrays])
        self._boxes.update(kinds[: len(boxes.boxes)])
        twice = set[int]()
        for a, b in _overlapping(values):
            is_new = a < len(boxes.boxes)  # the others have been compared among themselves
            if is_new and kinds[a] == kinds[b] and ids[a] != ids[b]:
                twice |= {a, b}
                self._pairs[kinds[a]].add(frozenset((ids[a], ids[b])))
        self._twice.update(kinds[row] for row in twice)

    @property
    def finding(self) -> str:
        """Return that objects have two boxes; empty if they have one."""
        named = [
            f'{count} of {self._boxes[kind]} ({kind})'
            for kind, count in self._twice.items()
            if count >= max(MIN_TWICE, MIN_SHARE_TWICE * self._boxes[kind])
            and len(self._pairs[kind]) >= MIN_ID_PAIRS
        ]
        if not named:
            return ''
        return (
            f'boxes: expected one for each object, got another one with an id of its own on '
            f'{", ".join(named)}, as of two detectors or trackers on one topic: each object comes '
            f'out twice; publish the boxes of one of them, or leave those of the other out of the '
            f'boxes.csv that boxreg convert RECORDING#TOPIC --from recording --to csv writes and '
            f'boxreg relabel --labels csv:FOLDER reads'
        )


def _overlapping(boxes: Floats) -> list[tuple[int, int]]:
    """Return the pairs of rows of boxes (n, 9) that are of one object, the lower one first."""
    rows = np.flatnonzero(is_valid_box(boxes))
    centers, lengths = boxes[rows, BOX_CENTER], boxes[rows, BOX_EXTENT].max(axis=1)
    away = np.abs(centers[:, None] - centers).max(axis=2)
    is_near = away < np.maximum(lengths, lengths[:, None]) / 2
    a, b = (rows[one] for one in np.nonzero(np.triu(is_near, 1)))
    is_same = iou_3d(boxes[a], boxes[b]) >= SAME_OBJECT_IOU
    return list(zip(a[is_same].tolist(), b[is_same].tolist(), strict=True))
