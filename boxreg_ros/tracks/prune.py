"""
Prune: ghosts and duplicates are rejected.

A *duplicate* overlaps the boxes of a track with more evidence. A *ghost* has one or two boxes, no
points, or does not move like one object. A track with many boxes is neither: the detector has
confirmed it again and again.

"""

from __future__ import annotations

from collections.abc import Sequence

from boxreg_ros.config import Config
from boxreg_ros.core.method.margins import MIN_HITS
from boxreg_ros.core.metrics import iou_3d
from boxreg_ros.core.observation import GOOD_POINTS
from boxreg_ros.structures import BOX_EXTENT, Floats, X, Y
from boxreg_ros.tracks.tracklet import Tracklet
import numpy as np

CONFIRMED_BOXES = 6
"""A track with so many boxes is not rejected; chosen: twice the three that trackers ask for."""
CONTAINED = 0.5
"""Part of a box inside another one that makes it a duplicate; chosen: objects do not overlap."""
DUPLICATE_PART = 0.5
"""Part of the boxes of a track that are duplicates, for the whole; chosen: the majority."""
MAX_ACCELERATION = 30.0
"""Mean second difference of a track that is not one object [m/s^2]; chosen: three times the
braking of a car, beyond the jitter of most detectors."""


def ghosts(tracklets: list[Tracklet]) -> set[str]:
    """Return the ids of tracks of few boxes without consistent points or consistent motion."""
    first_ns = min((tracklet.first_ns for tracklet in tracklets), default=0)
    last_ns = max((tracklet.last_ns for tracklet in tracklets), default=0)
    found = set()
    for tracklet in tracklets:
        # An object that appears at the end of a recording has no time for more boxes.
        is_cut = tracklet.first_ns == first_ns or tracklet.last_ns == last_ns
        is_flash = len(tracklet.stamps_ns) < MIN_HITS and not is_cut
        if is_flash or _is_ghost(tracklet):
            found.add(tracklet.track_id)
    return found


def evidence(tracklet: Tracklet) -> int:
    """Return the number of boxes with `GOOD_POINTS` points."""
    return int((tracklet.num_points >= GOOD_POINTS).sum())


def by_evidence(tracklets: Sequence[Tracklet]) -> list[Tracklet]:
    """Return tracklets with the most evidence first, of equal ones the longest."""
    return sorted(tracklets, key=lambda t: (evidence(t), len(t.stamps_ns)), reverse=True)


def _is_ghost(tracklet: Tracklet) -> bool:
    """Return whether a short track lacks consistent points or consistent motion."""
    n = len(tracklet.stamps_ns)
    if n >= CONFIRMED_BOXES:
        return False
    if 2 * evidence(tracklet) <= n:
        return True
    return n >= 3 and _mean_acceleration(tracklet) > MAX_ACCELERATION


def _mean_acceleration(tracklet: Tracklet) -> float:
    """Return the mean norm of the second difference of the centre [m/s^2]."""
    steps = np.diff(tracklet.stamps_ns)[:, None] * 1e-9
    velocities = np.diff(tracklet.boxes[:, X : Y + 1], axis=0) / steps
    accelerations = np.diff(velocities, axis=0) / ((steps[1:] + steps[:-1]) / 2)
    return float(np.linalg.norm(accelerations, axis=1).mean())


def duplicates(tracklets: list[Tracklet], config: Config) -> set[str]:
    """
    Find tracks of few boxes that overlap those of tracks with more evidence.

    Only tracks of one kind of object: a rider and a bicycle are no duplicates.

    Parameters
    ----------
    tracklets : list of Tracklet
        All of them, in the fixed frame.
    config : Config
        Assigns class names to kinds of objects.

    Returns
    -------
    track_ids : set of str
        Of the duplicates. Tracks of `CONFIRMED_BOXES` or more are none.

    """
    rejected: set[str] = set()
    rows: dict[int, list[tuple[Tracklet, int]]] = {}  # boxes of better tracks, by stamp
    for tracklet in by_evidence(tracklets):
        kind = tracklet.model(config)
        inside = 0
        for row, stamp_ns in enumerate(tracklet.stamps_ns.tolist()):
            others = [
                other.boxes[i]
                for other, i in rows.get(stamp_ns, ())
                if other.model(config) is kind
            ]
            inside += _is_contained(tracklet.boxes[row], others)
        n = len(tracklet.stamps_ns)
        if n < CONFIRMED_BOXES and inside >= DUPLICATE_PART * n:
            rejected.add(tracklet.track_id)
            continue
        for row, stamp_ns in enumerate(tracklet.stamps_ns.tolist()):
            rows.setdefault(stamp_ns, []).append((tracklet, row))
    return rejected


def _is_contained(box: Floats, others: list[Floats]) -> bool:
    """Return whether a part of at least `CONTAINED` of the smaller of two boxes is in both."""
    if not others:
        return False
    boxes = np.array(others)
    distances = np.linalg.norm(boxes[:, :2] - box[:2], axis=1)
    boxes = boxes[distances < np.linalg.norm(box[BOX_EXTENT]) + boxes[:, BOX_EXTENT].max(axis=1)]
    if not len(boxes):
        return False
    iou = iou_3d(np.tile(box, (len(boxes), 1)), boxes)
    volumes = boxes[:, BOX_EXTENT].prod(axis=1)
    own = box[BOX_EXTENT].prod()
    shared = iou / (1 + iou) * (volumes + own)
    return bool((shared / np.minimum(volumes, own) >= CONTAINED).any())
