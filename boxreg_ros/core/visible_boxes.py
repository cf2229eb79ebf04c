"""
Boxes of what a sweep shows of an object, as those of clusters, in place of the whole of it (M12b).

They end where their points do, on all sides, and grow as the object comes near or turns. The side
toward the sensor is right, the other one is not known: such a box gets the extents of its track,
away from the sensor.

"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from boxreg_ros.config import Config
from boxreg_ros.core.observation import GOOD_POINTS, Observations
from boxreg_ros.rotations import matrix_from_rpy
from boxreg_ros.structures import BOX_CENTER, BOX_EXTENT, Floats, ROLL, Z
import numpy as np
from numpy.typing import NDArray

# All of these are chosen, except where an origin stands beside them.
POINT_DISTANCE = 0.1
"""
A side has points if one is so near to it [m].

Measured, boxes with points on all four sides: .83 to .90 of those of clusters; of boxes of whole
objects .01 to .09 with the errors of a detector, .00 to .29 of true ones.

"""
MIN_LENGTH = 1.0
"""Longer side of a box that is compared [m]: those of walkers have points near all sides."""
MIN_VISIBLE = 0.5
"""Part of the boxes of a track that end at their points, and of the tracks."""
MIN_COMPARED_TRACKS, MIN_BOXES_COMPARED = 5, 50
"""Tracks and boxes that decide: fewer may all be seen from two sides."""
COMPARED_BOXES = 300
"""After so many boxes that decide the question is closed."""
WHOLE_QUANTILE = 0.95
"""Part of the boxes of a track that are not longer than it: clusters of two objects are few."""
HELD_EXTENTS = 1000
"""Newest boxes of a track that show its extents: those of a parked object for 100 s."""
MIN_CHANGE = 0.05
"""Change of an extent, as a part, by which boxes of a track are lengthened again."""

VISIBLE_WARNING = (
    'boxes end where their points do, on all sides, as those of clusters: they hold what is seen '
    'of an object; each is lengthened away from the sensor to the extents that its track has '
    'shown so far; if boxes are of whole objects, set sampling.box_extents=whole'
)


class VisibleBoxes:
    """
    Evidence that the boxes of a stream hold what is seen of their objects.

    It depends on the order of box arrays alone, and is final once it is found.

    Parameters
    ----------
    config : Config
        `sampling.box_extents` says so, or that it is to be found.

    """

    def __init__(self, config: Config) -> None:
        self._is_open = config.sampling.box_extents == 'auto'
        self.are_found = config.sampling.box_extents == 'visible'
        self._boxes, self._visible = Counter[str](), Counter[str]()  # by track

    @property
    def warning(self) -> str:
        """Return what a user should know; empty for boxes of whole objects."""
        return VISIBLE_WARNING if self.are_found else ''

    def add(self, track_ids: Sequence[str], seen: Observations) -> bool:
        """
        Compare new boxes with their points; return whether they are visible ones from now on.

        Parameters
        ----------
        track_ids : sequence of n str
            Of their tracks.
        seen : Observations
            Of the boxes as they were given; further ones behind them are left out.

        """
        if not self._is_open:
            return False
        are_compared, are_visible = _end_at_points(seen)
        for row in np.flatnonzero(are_compared[: len(track_ids)]).tolist():
            self._boxes[track_ids[row]] += 1
            self._visible[track_ids[row]] += bool(are_visible[row])
        parts = [self._visible[name] >= MIN_VISIBLE * count for name, count in self._boxes.items()]
        total = self._boxes.total()
        is_known = len(parts) >= MIN_COMPARED_TRACKS and total >= MIN_BOXES_COMPARED
        self.are_found = is_known and sum(parts) >= MIN_VISIBLE * len(parts)
        self._is_open = not self.are_found and not (is_known and total >= COMPARED_BOXES)
        return self.are_found


def _end_at_points(seen: Observations) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return which boxes are large and have enough points, and which have some on all sides."""
    half = seen.boxes[:, BOX_EXTENT].T.astype(np.float32) / 2  # in columns: a fifth of the time
    x, y, z = np.ascontiguousarray(seen.points.T)
    R = matrix_from_rpy(seen.boxes[:, ROLL:]).astype(np.float32).transpose(1, 2, 0)
    from_x, from_y, from_z = np.repeat(R, seen.counts, 2)
    local = x * from_x + y * from_y + z * from_z
    is_inside = (np.abs(local) <= np.repeat(half + POINT_DISTANCE, seen.counts, 1)).all(0)
    owner = np.repeat(np.arange(len(seen.boxes)), seen.counts)
    counts = np.bincount(owner[is_inside], minlength=len(seen.boxes))
    rows = np.flatnonzero(counts)
    inside, first = local[:Z, is_inside], (np.cumsum(counts) - counts)[rows]
    ends = np.zeros((2, 2, len(counts)), np.float32)
    ends[0][:, rows] = np.maximum.reduceat(inside, first, 1)
    ends[1][:, rows] = -np.minimum.reduceat(inside, first, 1)
    has_all = (np.abs(ends - half[:Z]) <= POINT_DISTANCE).all(axis=(0, 1))
    is_large = 2 * half[:Z].max(0) >= MIN_LENGTH
    return is_large & (counts >= 2 * GOOD_POINTS), np.asarray(has_all)


def whole_extents(extents: Sequence[Floats], known: Floats | None) -> Floats:
    """
    Return the extents (3,) of an object by those of its visible boxes so far [m].

    Those that are `known` (3,), if they are the same but for `MIN_CHANGE`.

    """
    found: Floats = np.quantile(extents, WHOLE_QUANTILE, axis=0)
    if known is not None and (np.abs(found / known - 1) <= MIN_CHANGE).all():
        return known
    return found


def lengthened(box: Floats, extents: Floats, sensor: Floats) -> Floats:
    """
    Return a box that is not smaller than some extents, with the faces that are seen in place.

    Parameters
    ----------
    box : array, shape (9,)
        In the fixed frame [m, rad].
    extents : array, shape (3,)
        Least length, width and height [m].
    sensor : array, shape (3,)
        Position of the sensor in the fixed frame [m]; NaN where it is unknown.

    Returns
    -------
    box : array, shape (9,)
        Lengthened at the ends away from the sensor, at the top, and at both ends of an axis where
        the sensor is between their planes, or unknown (M12b).

    """
    found = box.copy()
    own = box[BOX_EXTENT]
    found[BOX_EXTENT] = np.maximum(own, extents)
    R = matrix_from_rpy(box[ROLL:])
    local = np.nan_to_num((sensor - box[BOX_CENTER]) @ R)
    side = np.sign(local) * (np.abs(local) > own / 2)
    side[Z] = -1.0  # all stand on the road
    found[BOX_CENTER] -= R @ (side * (found[BOX_EXTENT] - own) / 2)
    return found
