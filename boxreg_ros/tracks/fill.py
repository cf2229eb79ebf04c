"""
Fill: missing boxes between two boxes of a track are put on the motion model.

They are then registered to their points like the boxes of the input. Where there are no points,
the box on the motion model stays, with a covariance that grows with the distance to both ends.
Tracks that are detected rarely are not filled.

"""

from __future__ import annotations

from collections.abc import Sequence

from boxreg_ros.config import ClassConfig, Config
from boxreg_ros.core.method.constants import CONSTANTS
from boxreg_ros.core.motion import motion_at
from boxreg_ros.structures import Floats, INTERPOLATED, Ints
from boxreg_ros.tracks.prune import CONFIRMED_BOXES
from boxreg_ros.tracks.tracklet import AddedBoxes, between, is_parked, Tracklet
import numpy as np

RARE = 0.5
"""Part of the usual rate of detection of a drive below which a track is not filled; chosen: less
than half as often."""


def rarely_detected(tracklets: Sequence[Tracklet], detected_ns: Ints, config: Config) -> set[str]:
    """
    Return the ids of tracks that have a box far less often than usual, see `_rate`.

    A bush is detected now and then, an object about as often as other objects: boxes between
    those of a bush would be as false as these. How often an object is detected depends on the
    detector, and is the median over the tracks of `CONFIRMED_BOXES` or more; without such tracks
    it is not known, and no track is rarely detected.

    Parameters
    ----------
    tracklets : sequence of Tracklet
        All tracks of the recording.
    detected_ns : array, shape (a,)
        Stamps of the arrays with boxes, ascending [ns]: detectors may be slower than the LiDAR.
    config : Config
        Settings of the kinds of objects.

    Returns
    -------
    track_ids : set of str
        Gaps of these tracks are not filled.

    """
    rates = {one.track_id: _rate(one, detected_ns, config) for one in tracklets}
    usual = [rates[one.track_id] for one in tracklets if len(one.stamps_ns) >= CONFIRMED_BOXES]
    if not usual:
        return set()
    least = RARE * float(np.median(usual))
    return {track_id for track_id, rate in rates.items() if rate < least}


def _rate(tracklet: Tracklet, detected_ns: Ints, config: Config) -> float:
    """
    Return the part of the stamps behind its first box at which a track has one.

    Pauses longer than `complete.fill_gap` do not count, nor does a single gap, as if there were
    none: the object may have been out of sight.

    """
    steps = np.diff(np.searchsorted(detected_ns, tracklet.stamps_ns))
    steps = steps[np.diff(tracklet.stamps_ns) <= config.complete.fill_gap * 1e9]
    return len(steps) / int(steps.sum()) if (steps > 1).sum() > 1 else 1.0


def fill(tracklet: Tracklet, array_stamps_ns: Ints, config: Config) -> list[AddedBoxes]:
    """
    Return the boxes for the gaps of a track.

    Parameters
    ----------
    tracklet : Tracklet
        The track.
    array_stamps_ns : array, shape (a,)
        Stamps of the input, ascending [ns].
    config : Config
        Longer gaps than `complete.fill_gap` [s] are filled only where the object is parked.

    Returns
    -------
    added : list of AddedBoxes
        One for each gap that is filled, with a box at each stamp in it, in the fixed frame.

    """
    added = []
    max_gap_ns = config.complete.fill_gap * 1e9
    for row in range(len(tracklet.stamps_ns) - 1):
        before_ns, after_ns = tracklet.stamps_ns[row : row + 2]
        is_between = (array_stamps_ns > before_ns) & (array_stamps_ns < after_ns)
        stamps_ns = array_stamps_ns[is_between]
        if len(stamps_ns) and (
            after_ns - before_ns <= max_gap_ns or is_parked(tracklet.boxes[row : row + 2])
        ):
            added.append(_filled(tracklet, row, stamps_ns, config))
    return added


def _filled(tracklet: Tracklet, row: int, stamps_ns: Ints, config: Config) -> AddedBoxes:
    """Return the boxes at some stamps between box `row` and the next one."""
    model = tracklet.model(config)
    cut = row + 1
    before = motion_at(tracklet.stamps_ns[:cut], tracklet.boxes[:cut], -1, model)
    after = motion_at(tracklet.stamps_ns[cut:], tracklet.boxes[cut:], 0, model)
    fractions = (stamps_ns - before.stamp_ns) / (after.stamp_ns - before.stamp_ns)
    s = fractions[:, None, None]
    covariances = (1 - s) * tracklet.covariances[row] + s * tracklet.covariances[cut]
    # With a constant acceleration a, the object is a s t / 2 off the curve between its ends, at
    # the time s after one and t before the other.
    products = (stamps_ns - before.stamp_ns) * 1e-9 * (after.stamp_ns - stamps_ns) * 1e-9 / 2
    deviations = products[:, None] * accelerations(model)
    scores = (1 - fractions) * tracklet.scores[row] + fractions * tracklet.scores[cut]
    return AddedBoxes(
        INTERPOLATED,
        stamps_ns,
        between(before, after, stamps_ns),
        covariances + deviations[:, :, None] ** 2 * np.eye(6),
        scores,
    )


def accelerations(model: ClassConfig) -> Floats:
    """Return usual accelerations of x y z [m/s^2] and roll pitch yaw [rad/s^2], shape (6,)."""
    horizontal = max(model.acceleration, model.cornering)
    return np.array(
        [horizontal, horizontal, CONSTANTS.vertical, *[CONSTANTS.tilting] * 2, model.turning]
    )
