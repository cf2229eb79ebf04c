"""Evidence for an object where a box is predicted that the detector does not have."""

from collections.abc import Sequence

from boxreg_ros.core.method.constants import CONSTANTS
from boxreg_ros.core.method.margins import MIN_HITS
from boxreg_ros.core.metrics import iou_3d
from boxreg_ros.core.observation import FACE_TOLERANCE, GOOD_POINTS, Observation
from boxreg_ros.rotations import matrix_from_rpy
from boxreg_ros.structures import BOX_EXTENT, Floats, Ints, ROLL
import numpy as np

SUPPORT_PART = 0.3
"""
Least part of the points that the end of the track has, in a supported box.

Chosen: within the longest extension the range, and so the number, changes less.

"""
OWNED = 0.1
"""3D IoU at which two boxes are of one object; chosen: objects do not overlap."""


def least_support(at_end: Ints) -> float:
    """Return the points that a supported box has, by those of boxes at the end of its track."""
    return max(CONSTANTS.min_face_points, SUPPORT_PART * float(np.median(at_end)))


def is_owned(box: Floats, others: Floats) -> bool:
    """Return whether a box (9,) overlaps one of `others` (n, 9): their object owns its place."""
    distance = np.linalg.norm(others[:, :2] - box[:2], axis=1)
    reach = np.linalg.norm(others[:, BOX_EXTENT], axis=1) + np.linalg.norm(box[BOX_EXTENT])
    near = others[distance < reach / 2]
    return bool(len(near)) and bool(iou_3d(np.tile(box, (len(near), 1)), near).max() > OWNED)


def points_to_confirm(detected: Sequence[Observation]) -> float:
    """
    Return the points inside a predicted box that confirm it, by the last detections of its track.

    Infinity for a track that is likely to be a ghost.

    """
    counts = points_inside(detected)
    if len(counts) < MIN_HITS or 2 * (counts >= GOOD_POINTS).sum() <= len(counts):
        return np.inf
    return least_support(counts[-CONSTANTS.min_observations :])


def points_inside(observations: Sequence[Observation]) -> Ints:
    """Return for each observation how many of its points, sampled above the road, are inside."""
    counts = np.zeros(len(observations), np.int64)
    for i, observation in enumerate(observations):
        offset = np.abs(observation.points @ matrix_from_rpy(observation.box[ROLL:]))
        half = observation.box[BOX_EXTENT] / 2 + FACE_TOLERANCE
        counts[i] = (offset <= half).all(1).sum()
    return counts
