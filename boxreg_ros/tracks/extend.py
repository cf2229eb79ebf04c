"""
Extend: a track goes on before its first and after its last box while points support it.

Tracks that may be ghosts are not extended. Candidates are put on the motion model and registered
with the track. `num_supported` then counts from the track outwards: the first box without support
ends the extension.

"""

from __future__ import annotations

from boxreg_ros.config import Config
from boxreg_ros.core.method.constants import CONSTANTS
from boxreg_ros.core.support import is_owned, least_support
from boxreg_ros.structures import EXTENDED, Floats, Ints
from boxreg_ros.tracks.fill import accelerations
from boxreg_ros.tracks.prune import CONFIRMED_BOXES
from boxreg_ros.tracks.tracklet import AddedBoxes, end_motion, is_parked, Tracklet
import numpy as np

MOVING_REACH, PARKED_REACH = 1.0, 4.0
"""Longest extension of a moving and of a parked object at each end [s]. Chosen: motion is known
for a second. Literature: MS3D extends parked objects by 4 s."""


def extend(tracklet: Tracklet, array_stamps_ns: Ints, config: Config) -> list[AddedBoxes]:
    """
    Return the candidates before and after a track.

    Parameters
    ----------
    tracklet : Tracklet
        The track; one of less than `CONFIRMED_BOXES` boxes has no candidates.
    array_stamps_ns : array, shape (a,)
        Stamps of the input, ascending [ns].
    config : Config
        Settings of the kinds of objects.

    Returns
    -------
    candidates : list of AddedBoxes
        One for each end with stamps within reach, that of the first box before the other; in the
        fixed frame, from the track outwards.

    """
    if len(tracklet.stamps_ns) < CONFIRMED_BOXES:
        return []
    reach_ns = (PARKED_REACH if is_parked(tracklet.boxes) else MOVING_REACH) * 1e9
    before_ns = tracklet.first_ns - array_stamps_ns
    after_ns = array_stamps_ns - tracklet.last_ns
    earlier = array_stamps_ns[(before_ns > 0) & (before_ns <= reach_ns)]
    later = array_stamps_ns[(after_ns > 0) & (after_ns <= reach_ns)]
    return [
        _candidates(tracklet, is_last, stamps_ns, config)
        for is_last, stamps_ns in ((False, earlier[::-1]), (True, later))
        if len(stamps_ns)
    ]


def num_supported(num_points: Ints, at_end: Ints) -> int:
    """
    Return how many boxes of an extension are supported.

    Parameters
    ----------
    num_points : array, shape (n,)
        Points above the road in each box of the extension, from the track outwards.
    at_end : array, shape (m,)
        The same of the boxes at that end of the track.

    Returns
    -------
    count : int
        Boxes up to the first one with too few points.

    """
    is_supported = num_points >= least_support(at_end)
    return len(num_points) if is_supported.all() else int(np.argmin(is_supported))


def _candidates(tracklet: Tracklet, is_last: bool, stamps_ns: Ints, config: Config) -> AddedBoxes:
    """Return the boxes at some stamps beyond one end of a track."""
    motion = end_motion(tracklet, is_last, config)
    row = -1 if is_last else 0
    seconds = (stamps_ns - motion.stamp_ns) * 1e-9
    deviations = accelerations(motion.model) * (seconds**2 / 2)[:, None]
    boxes = np.array([motion.predict(int(stamp_ns)) for stamp_ns in stamps_ns])
    return AddedBoxes(
        EXTENDED,
        stamps_ns,
        boxes,
        tracklet.covariances[row] + deviations[:, :, None] ** 2 * np.eye(6),
        np.full(len(stamps_ns), tracklet.scores[row]),
    )


def points_at_end(tracklet: Tracklet, is_last: bool) -> Ints:
    """Return the points in the boxes at one end of a track."""
    points, count = tracklet.num_points, CONSTANTS.min_observations
    return points[-count:] if is_last else points[:count]


def num_free(candidates: AddedBoxes, owned: dict[int, list[Floats]]) -> int:
    """
    Return how many boxes of an extension are free of the boxes of other objects.

    Parameters
    ----------
    candidates : AddedBoxes
        From the track outwards, in the fixed frame.
    owned : dict of int to list of array, shape (9,)
        Boxes of the other objects by stamp [ns], in the same frame [m, rad].

    Returns
    -------
    count : int
        Boxes up to the first one that overlaps another object.

    """
    for count, (stamp_ns, box) in enumerate(
        zip(candidates.stamps_ns.tolist(), candidates.boxes, strict=True)
    ):
        others = owned.get(stamp_ns, [])
        if others and is_owned(box, np.array(others)):
            return count
    return len(candidates.boxes)
