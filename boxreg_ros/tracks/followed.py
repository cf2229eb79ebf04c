"""The completion of tracks that were followed from keyframes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from boxreg_ros.core.follow import FollowedTrack
from boxreg_ros.rotations import wrap_angle
from boxreg_ros.structures import BoxArray, Floats, HUMAN, RefinedBoxes, ROLL
from boxreg_ros.tracks.complete import AddedBox, CompletionPlan, unchanged_plan
from boxreg_ros.tracks.effects import TrackSteps
import numpy as np

UNSUPPORTED = np.diag(np.square([0.5, 0.5, 0.2, 0.05, 0.05, 0.1]))
"""Covariance of added boxes without points: x y z [m] and roll pitch yaw [rad]; chosen."""

EXACT = 0.006
"""Median of the moves of keyframes by the solve, if they are exact [m]; swept: 0.003 of exact
ones, 0.011 of those with the error of a person of 0.03."""
MIN_KEYFRAMES = 20
"""Fewer keyframes give no median; chosen."""


def followed_plan(
    given: Sequence[BoxArray], tracks: Sequence[FollowedTrack], has_seeds: bool = True
) -> CompletionPlan:
    """
    Return the plan that adds the boxes of followed tracks; none is rejected or renamed.

    Parameters
    ----------
    given : sequence of BoxArray
        Keyframes, and an empty array for each sweep without one.
    tracks : sequence of FollowedTrack
        From these keyframes.
    has_seeds : bool
        Whether the keyframes are in `given`; if not, they are added too.

    """
    plan = unchanged_plan(given)
    stamps = np.array([array.stamp_ns for array in given], np.int64)
    order = np.argsort(stamps, kind='stable')
    for track in tracks:
        steps = TrackSteps(track.track_id, track.class_name)
        plan.tracks.append(steps)
        for stamp_ns, box, word in zip(track.stamps_ns, track.boxes, track.status, strict=True):
            after = int(np.searchsorted(stamps[order], stamp_ns))
            near = order[max(0, after - 1) : after + 1]
            array = plan.arrays[int(near[np.abs(stamps[near] - stamp_ns).argmin()])]
            if word == HUMAN and has_seeds:
                if track.status.count(HUMAN) == 1 and track.track_id in array.track_ids:
                    # The extents of a single one may have grown.
                    array.moved[array.track_ids.index(track.track_id)] = box
                continue
            array.added.append(
                AddedBox(track.track_id, track.class_name, word, box, UNSUPPORTED, 1.0)
            )
    return plan


def closed_onto_exact(
    given: Sequence[BoxArray], results: Sequence[RefinedBoxes]
) -> list[RefinedBoxes]:
    """
    Return results that go through the keyframes, if these are exact; otherwise the results.

    The solve has moved keyframes by their error and its own. Where it has moved half of them by
    less than `EXACT`, which is its own, they are kept, and boxes between them are moved by the
    difference, interpolated in time.

    Parameters
    ----------
    given : sequence of BoxArray
        Keyframes as they were registered, and empty arrays.
    results : sequence of RefinedBoxes
        Of the same arrays, each with added boxes behind the keyframes.

    """
    moves = [
        result.boxes.boxes[: len(array.track_ids)] - array.boxes
        for array, result in zip(given, results, strict=True)
    ]
    moved = np.concatenate([np.zeros((0, 9)), *moves])
    if len(moved) < MIN_KEYFRAMES or np.median(np.abs(moved[:, :3])) > EXACT:
        return list(results)
    steps: dict[str, tuple[list[int], list[Floats]]] = {}  # stamps, and differences of boxes
    for array, result, move in zip(given, results, moves, strict=True):
        for name, one in zip(result.boxes.track_ids, move, strict=False):
            stamps, found = steps.setdefault(name, ([], []))
            stamps.append(array.stamp_ns)
            found.append(np.append(one[:ROLL], wrap_angle(one[ROLL:])))
    return [_moved_back(result, steps) for result in results]


def _moved_back(
    result: RefinedBoxes, steps: Mapping[str, tuple[list[int], list[Floats]]]
) -> RefinedBoxes:
    """Return a result whose boxes are moved back by the differences of their tracks."""
    boxes = result.boxes.boxes.copy()
    for row, name in enumerate(result.boxes.track_ids):
        stamps, found = steps[name]
        for column, values in enumerate(np.transpose(found)):
            boxes[row, column] -= np.interp(result.boxes.stamp_ns, stamps, values)
    boxes[:, ROLL:] = wrap_angle(boxes[:, ROLL:])
    return replace(result, boxes=replace(result.boxes, boxes=boxes))
