"""The completion of tracks that were followed from keyframes."""

from __future__ import annotations

from collections.abc import Sequence

from boxreg_ros.core.follow import FollowedTrack
from boxreg_ros.structures import BoxArray, HUMAN, INTERPOLATED
from boxreg_ros.tracks.complete import AddedBox, CompletionPlan, PlannedArray
from boxreg_ros.tracks.track_steps import TrackSteps
import numpy as np

UNSUPPORTED = np.diag(np.square([0.5, 0.5, 0.2, 0.05, 0.05, 0.1]))
"""Covariance of added boxes without points: x y z [m] and roll pitch yaw [rad]; chosen."""


def followed_plan(given: Sequence[BoxArray], tracks: Sequence[FollowedTrack]) -> CompletionPlan:
    """
    Return the plan that adds the boxes of followed tracks; none is rejected or renamed.

    Parameters
    ----------
    given : sequence of BoxArray
        Keyframes, and an empty array for each sweep without one.
    tracks : sequence of FollowedTrack
        From these keyframes.

    """
    plan = CompletionPlan([PlannedArray([*a.track_ids], [*a.class_names]) for a in given], [])
    stamps = np.array([array.stamp_ns for array in given], np.int64)
    order = np.argsort(stamps, kind='stable')
    for track in tracks:
        steps = TrackSteps(track.track_id, track.class_name)
        plan.tracks.append(steps)
        for stamp_ns, box, word in zip(track.stamps_ns, track.boxes, track.status, strict=True):
            if word == HUMAN:
                continue
            after = int(np.searchsorted(stamps[order], stamp_ns))
            near = order[max(0, after - 1) : after + 1]
            array = plan.arrays[int(near[np.abs(stamps[near] - stamp_ns).argmin()])]
            array.added.append(
                AddedBox(track.track_id, track.class_name, word, box, UNSUPPORTED, 1.0)
            )
            steps.filled += word == INTERPOLATED
            steps.extended += word != INTERPOLATED
    return plan
