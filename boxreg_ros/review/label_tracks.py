"""The labels that rules read: the boxes of tracks, their steps, and the pairs in one place."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

from boxreg_ros.config import Config
from boxreg_ros.core.metrics import iou_3d
from boxreg_ros.structures import BOX_CENTER, BOX_EXTENT, Floats, Ints, is_valid_box, X
import numpy as np

VEHICLE, CYCLIST, PEDESTRIAN = 'vehicle', 'cyclist', 'pedestrian'
MAX_STEP = 1.0
"""Rates of change are not computed across longer gaps [s]."""


@dataclass(frozen=True)
class LabelTrack:
    """The valid labels of one track, by stamp."""

    track_id: str
    class_name: str
    kind: str
    """Group of settings of the class: vehicle, cyclist or pedestrian."""
    stamps_ns: Ints
    """(n,); one may occur twice [ns]."""
    boxes: Floats
    """(n, 9), in one fixed frame [m, rad]."""
    num_points: Ints
    """(n,), in each box; -1 where unknown."""

    @classmethod
    def of(
        cls,
        track_id: str,
        class_name: str,
        config: Config,
        stamps_ns: Ints,
        boxes: Floats,
        num_points: Ints,
    ) -> LabelTrack:
        """
        Return a track of labels, without invalid boxes.

        Parameters
        ----------
        track_id, class_name : str
            Of the track.
        config : Config
            Assigns the class name to a kind of object.
        stamps_ns : array, shape (m,)
            In any order [ns].
        boxes : array, shape (m, 9)
            In one fixed frame [m, rad]; NaN for no box.
        num_points : array, shape (m,)
            In each box; -1 where unknown.

        Returns
        -------
        track : LabelTrack
            In the order of stamps; its arrays are those given where they are so.

        """
        columns = stamps_ns, boxes, num_points
        is_valid = is_valid_box(boxes)
        if not is_valid.all() or (np.diff(stamps_ns) < 0).any():  # else copies take memory
            rows = np.flatnonzero(is_valid)
            rows = rows[np.argsort(stamps_ns[rows], kind='stable')]
            columns = stamps_ns[rows], boxes[rows], num_points[rows]
        return cls(track_id, class_name, config.kind(class_name), *columns)

    @cached_property
    def steps(self) -> Steps:
        """Return the steps between consecutive boxes, without those across gaps."""
        seconds = np.diff(self.stamps_ns) * 1e-9
        rows = np.flatnonzero((seconds > 0) & (seconds <= MAX_STEP))
        velocity = np.diff(self.boxes[:, BOX_CENTER], axis=0)[rows] / seconds[rows, None]
        return Steps(rows, seconds[rows], velocity)


class Steps(NamedTuple):
    """Steps between consecutive boxes of a track."""

    rows: Ints
    """(k,), of the box before each step."""
    seconds: Floats
    """(k,), duration [s]."""
    velocity: Floats
    """(k, 3), of the centre in the fixed frame [m/s]."""


class Pairs(NamedTuple):
    """Pairs of boxes of two tracks."""

    tracks: Ints
    """(k, 2), indices of the two tracks, ascending."""
    stamps_ns: Ints
    iou: Floats
    """(k,), 3D IoU of their boxes."""


class Labels(tuple[LabelTrack, ...]):
    """The tracks that rules are applied to."""

    @cached_property
    def rows(self) -> tuple[Ints, Floats, Ints]:
        """Return stamp [ns], box and index of the track of all boxes: (n,), (n, 9), (n,)."""
        stamps_ns = np.concatenate([np.zeros(0, np.int64), *(t.stamps_ns for t in self)])
        boxes = np.concatenate([np.zeros((0, 9)), *(t.boxes for t in self)])
        return stamps_ns, boxes, np.repeat(np.arange(len(self)), [len(t.boxes) for t in self])

    @cached_property
    def near_pairs(self) -> Pairs:
        """Return the pairs of boxes whose bounding spheres intersect."""
        return _near_pairs(*self.rows)


def _near_pairs(stamps_ns: Ints, boxes: Floats, owner: Ints) -> Pairs:
    radius = np.linalg.norm(boxes[:, BOX_EXTENT], axis=1) / 2
    reach = 2 * radius.max(initial=0.0)
    order = np.lexsort((boxes[:, X], stamps_ns))
    stamps, x, radii, owners = stamps_ns[order], boxes[order, X], radius[order], owner[order]
    centers = boxes[:, BOX_CENTER][order]
    found = [np.zeros((0, 2), np.int64)]
    # Each box is compared with the next one along x, then with the one after it, and so on.
    for step in range(1, len(order)):
        is_beside = (stamps[step:] == stamps[:-step]) & (x[step:] - x[:-step] < reach)
        i = np.flatnonzero(is_beside)
        if not len(i):
            break
        j = i + step
        distance = np.linalg.norm(centers[i] - centers[j], axis=1)
        is_near = (distance < radii[i] + radii[j]) & (owners[i] != owners[j])
        found.append(np.sort(order[np.column_stack([i, j])[is_near]], axis=1))
    a, b = np.concatenate(found).T
    by_stamp = np.lexsort((b, a, stamps_ns[a]))
    a, b = a[by_stamp], b[by_stamp]
    return Pairs(np.column_stack([owner[a], owner[b]]), stamps_ns[a], iou_3d(boxes[a], boxes[b]))
