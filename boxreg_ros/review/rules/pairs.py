"""Pairs of boxes of one stamp that may overlap, found once for all rules."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple

from boxreg_ros.core.metrics import iou_3d
from boxreg_ros.review.rules.protocol import LabelTrack
from boxreg_ros.structures import BOX_CENTER, BOX_EXTENT, Floats, Ints, X
import numpy as np


class Pairs(NamedTuple):
    """
    Pairs of boxes of two tracks.

    Attributes
    ----------
    tracks : array, shape (k, 2)
        Indices of the two tracks, ascending.
    stamps_ns : array, shape (k,)
        Their stamp [ns].
    iou : array, shape (k,)
        3D IoU of their boxes.

    """

    tracks: Ints
    stamps_ns: Ints
    iou: Floats


class Labels(tuple[LabelTrack, ...]):
    """The tracks that rules are applied to."""

    @cached_property
    def near_pairs(self) -> Pairs:
        """Return the pairs of boxes whose bounding spheres intersect."""
        return _near_pairs(self)


def _near_pairs(tracks: Sequence[LabelTrack]) -> Pairs:
    stamps_ns = np.concatenate([np.zeros(0, np.int64), *(t.stamps_ns for t in tracks)])
    boxes = np.concatenate([np.zeros((0, 9)), *(t.boxes for t in tracks)])
    owner = np.repeat(np.arange(len(tracks)), [len(t.boxes) for t in tracks])
    radius = np.linalg.norm(boxes[:, BOX_EXTENT], axis=1) / 2
    reach = 2 * radius.max(initial=0.0)
    order = np.lexsort((boxes[:, X], stamps_ns))
    found = [np.zeros((0, 2), np.int64)]
    # Each box is compared with the next one along x, then with the one after it, and so on.
    first = np.arange(len(order))
    for step in range(1, len(order)):
        first = first[first + step < len(order)]
        i, j = order[first], order[first + step]
        is_beside = (stamps_ns[i] == stamps_ns[j]) & (boxes[j, X] - boxes[i, X] < reach)
        first, i, j = first[is_beside], i[is_beside], j[is_beside]
        distance = np.linalg.norm(boxes[i, BOX_CENTER] - boxes[j, BOX_CENTER], axis=1)
        is_near = (distance < radius[i] + radius[j]) & (owner[i] != owner[j])
        found.append(np.sort(np.column_stack([i, j])[is_near], axis=1))
        if not len(first):
            break
    a, b = np.concatenate(found).T
    by_stamp = np.lexsort((b, a, stamps_ns[a]))
    a, b = a[by_stamp], b[by_stamp]
    return Pairs(np.column_stack([owner[a], owner[b]]), stamps_ns[a], iou_3d(boxes[a], boxes[b]))
