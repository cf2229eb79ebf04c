"""Pairs of boxes of one stamp that may overlap, found once for all rules."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple

from boxreg_ros.core.metrics import iou_3d
from boxreg_ros.review.rules.protocol import LabelTrack
from boxreg_ros.structures import BOX_EXTENT, Floats, Ints, X, Z
import numpy as np
from scipy.spatial.distance import cdist


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
    order = np.argsort(stamps_ns, kind='stable')
    found = [np.zeros((0, 2), np.int64)]
    for rows in np.split(order, np.flatnonzero(np.diff(stamps_ns[order])) + 1):
        centres = boxes[rows, X : Z + 1]
        is_near = cdist(centres, centres) < radius[rows][:, None] + radius[rows]
        i, j = np.nonzero(is_near & (owner[rows][:, None] < owner[rows]))
        found.append(np.column_stack([rows[i], rows[j]]))
    a, b = np.concatenate(found).T
    return Pairs(np.column_stack([owner[a], owner[b]]), stamps_ns[a], iou_3d(boxes[a], boxes[b]))
