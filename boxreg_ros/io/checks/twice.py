"""Checks of boxes that are published twice: by two detectors or trackers, or again and again."""

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

MIN_REPEATED = 0.3
"""Part of the arrays that repeat the one before; chosen: of 10 Hz published at 15 Hz a third."""
MIN_HOLDS = 5
"""New arrays that are repeated; chosen: more than the stops of all objects of a scene."""
MIN_HELD_BOXES = 2
"""Boxes of an array that is compared: a single one may stand still, now and then."""
MAX_MIXED = 0.1
"""Part of the arrays with boxes that are as before and others that are not; chosen: parked ones
are so in the fixed frame, if they are rounded."""


class RepeatCheck:
    """
    Find arrays that repeat the boxes before them at a later stamp, as timers publish them.

    Their boxes are where objects were before. All of them are equal, then all are new.

    """

    def __init__(self) -> None:
        self._stamp_ns = 0
        self._last = set[bytes]()
        self._was_new = False
        self._new = self._repeated = self._mixed = self._holds = 0

    def add(self, boxes: BoxArray) -> None:
        """Add the next boxes, in the frame of their message."""
        own = {box.tobytes() for box in boxes.boxes}
        last, self._last = self._last, own
        is_later = boxes.stamp_ns > self._stamp_ns
        self._stamp_ns = boxes.stamp_ns
        if not is_later or min(len(own), len(last)) < MIN_HELD_BOXES:
            return
        is_repeated, is_new = own == last, own.isdisjoint(last)
        self._holds += is_repeated and self._was_new
        self._new += is_new
        self._repeated += is_repeated
        self._mixed += not (is_new or is_repeated)
        self._was_new = is_new

    @property
    def finding(self) -> str:
        """Return that boxes are repeated; empty if they are not."""
        total = self._new + self._repeated + self._mixed
        is_rare = self._holds < MIN_HOLDS or self._repeated < MIN_REPEATED * total
        if is_rare or self._mixed > MAX_MIXED * total:
            return ''
        return (
            f'boxes: expected new ones in each message, got those of the one before with a later '
            f'stamp in {self._repeated:,} of {total:,}, as of a timer: they are where their '
            f'objects were before; publish them once, with the stamp of their cloud, or leave '
            f'the repeated ones out of the boxes.csv that boxreg convert RECORDING#TOPIC --from '
            f'recording --to csv writes and boxreg relabel --labels csv:FOLDER reads'
        )


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
