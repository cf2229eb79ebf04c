"""
Fill: missing boxes between two boxes of a track are put on the motion model.

They are then registered to their points like the boxes of the input. Where there are no points,
the box on the motion model stays, with a covariance that grows with the distance to both ends.

"""

from __future__ import annotations

from boxreg_ros.config import ClassConfig, Config
from boxreg_ros.core.method.constants import CONSTANTS
from boxreg_ros.core.motion import motion_at
from boxreg_ros.structures import Floats, INTERPOLATED, Ints
from boxreg_ros.tracks.tracklet import AddedBoxes, between, is_parked, Tracklet
import numpy as np


def fill(tracklet: Tracklet, array_stamps_ns: Ints, config: Config) -> list[AddedBoxes]:
    """Return the boxes of each gap of a track, at stamps (a,) of the input, ascending."""
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
