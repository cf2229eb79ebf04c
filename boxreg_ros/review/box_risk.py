"""The risk of a box of a report if it were another one, for a person who drags it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from boxreg_ros.review.changes import TrackChanges
from boxreg_ros.review.risk import assess, Usual
from boxreg_ros.rotations import matrix_from_rpy
from boxreg_ros.structures import BOX_EXTENT, Floats, ROLL, Z
import numpy as np

OUTER_PART = 0.1
"""Part of the points near a face that are its outermost points; chosen."""
NEAR_FACE = 0.5
"""Points so far inside of a face count as near it [m]; chosen."""
MIN_FACE_POINTS = 5
"""Fewer points do not show where a face is; chosen."""


def risks_of_box(
    part: Mapping[str, Any], row: int, box: Floats, class_name: str, points: Floats
) -> tuple[float, float]:
    """
    Return the risk of a box of a report as it is and as `box` would have it [m].

    What follows from the points changes by what the points of the report show: where the outermost
    ones are from each face, and how many of them are outside. The deviations stay. `part` is as of
    `TrackPart.part`; the box (9,) [m, rad] and the points (M, 3) near it [m] are relative to its
    origin.

    """
    outside, sizes = part['usual']
    usual = Usual(outside, {} if sizes is None else {class_name: np.array(sizes)})
    before = _changes(part, class_name)
    old, new = (evidence(points, one) for one in (before.boxes[row], box))
    boxes, faces = before.boxes.copy(), before.face_distances.copy()
    near = before.near_points.copy()
    boxes[row] = box
    faces[row] += np.nan_to_num(new[0] - old[0])
    total = near[row].sum()
    share = near[row, 1] / max(1, total) + new[1] - old[1]
    near[row, 1] = round(total * float(np.clip(share, 0, 1)))
    near[row, 0] = total - near[row, 1]
    after = replace(before, boxes=boxes, face_distances=faces, near_points=near)
    first, second = (float(assess(track, usual).boxes[row]) for track in (before, after))
    return first, second


def evidence(points: Floats, box: Floats) -> tuple[Floats, float]:
    """Return how far the outermost points are off each face (6,) [m], and the part outside."""
    local = (points - box[: Z + 1]) @ matrix_from_rpy(box[None, ROLL:])[0]
    half = box[BOX_EXTENT] / 2
    is_above_road = local[:, 2] > 0.3 - half[2]
    is_near = (np.abs(local) < half + 0.6).all(1) & is_above_road
    is_inside = (np.abs(local) < half).all(1)
    distances = np.full(6, np.nan)
    for face in range(6):
        axis, sign = face // 2, 1 - 2 * (face % 2)
        ahead = sign * local[is_near, axis] - half[axis]
        ahead = np.sort(ahead[ahead > -NEAR_FACE])
        if len(ahead) >= MIN_FACE_POINTS:
            distances[face] = ahead[-int(np.ceil(OUTER_PART * len(ahead))) :].mean()
    count = int(is_near.sum())
    return distances, float((is_near & ~is_inside).sum() / count) if count else 0.0


def _changes(part: Mapping[str, Any], class_name: str) -> TrackChanges:
    """Return the track of a part, as far as its risk depends on it."""
    n = len(part['stamps'])
    given, boxes = (np.array(part[name], np.float64).reshape(n, 9) for name in ('given', 'boxes'))
    return TrackChanges(
        track_id='',
        class_name=class_name,
        input_ids=('',) * n,
        stamps_ns=np.array(part['stamps'], np.int64),
        given=given,
        boxes=boxes,
        change=np.array(part['change'], np.float64).reshape(n, 4),
        deviations=np.array(part['deviations'], np.float64).reshape(n, 4),
        extent_deviations=np.array(part['extent_deviations'], np.float64).reshape(n, 3),
        face_distances=np.array(part['faces'], np.float64).reshape(n, 6),
        near_points=np.array(part['near'], np.float64).reshape(n, 2),
        disagreement=np.array(part['disagreement'], np.float64),
        is_flipped=np.array(part['flipped'], bool),
        status=np.array(part['status']),
        reasons=np.array(part['reasons']),
        num_points=np.array(part['num_points'], np.int64),
    )
