"""The completion of tracks that were followed from keyframes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from boxreg_ros.core.follow import FollowedTrack
from boxreg_ros.core.following.exact import between_exact, Keyframes
from boxreg_ros.core.following.person import (
    are_exact,
    corrections,
    diagonals,
    moved,
    residuals,
)
from boxreg_ros.core.tables import rows_by_key
from boxreg_ros.structures import (
    BoxArray,
    EXTENDED,
    Floats,
    HUMAN,
    INTERPOLATED,
    KEPT,
    REFINED,
    RefinedBoxes,
)
from boxreg_ros.tracks.complete import AddedBox, CompletionPlan, TrackSteps, unchanged_plan
from boxreg_ros.tracks.decided import Decided, DecidedTrack, NOTHING
import numpy as np

UNSUPPORTED = np.diag(np.square([0.5, 0.5, 0.2, 0.05, 0.05, 0.1]))
"""Covariance of added boxes without points: x y z [m] and roll pitch yaw [rad]; chosen."""


def followed_plan(
    given: Sequence[BoxArray],
    tracks: Sequence[FollowedTrack],
    has_seeds: bool = True,
    decided: Decided = NOTHING,
) -> CompletionPlan:
    """
    Return the plan that adds the boxes of followed tracks; none is rejected or renamed.

    Parameters
    ----------
    given : sequence of BoxArray
        The keyframes, and an empty array for each sweep without one, in the fixed frame; at least
        one.
    tracks : sequence of FollowedTrack
        In the same frame. Each box is added to the array with the nearest stamp.
    has_seeds : bool
        Whether `given` has the keyframes of these tracks; else they are added, too.
    decided : Decided
        The decisions of a person, by default none.

    Returns
    -------
    plan : CompletionPlan
        For the arrays `given`, in their order.

    """
    plan = unchanged_plan(given)
    stamps = np.array([array.stamp_ns for array in given], np.int64)
    order = np.argsort(stamps, kind='stable')
    seeds_of = _arrays_of_tracks(given) if has_seeds else {}
    for track in tracks:
        steps = TrackSteps(track.track_id, track.class_name)
        plan.tracks.append(steps)
        own = DecidedTrack.of_followed(track, decided)
        seeds = np.array(seeds_of.get(track.track_id, []), np.int64)
        for stamp_ns, box, followed in zip(
            track.stamps_ns, track.boxes, track.status, strict=True
        ):
            after = int(np.searchsorted(stamps[order], stamp_ns))
            near = order[max(0, after - 1) : after + 1]
            array = plan.arrays[int(near[np.abs(stamps[near] - stamp_ns).argmin()])]
            word = followed
            if word == HUMAN and len(seeds) and own.pin(int(stamp_ns)) is None:
                seed = plan.arrays[int(seeds[np.abs(stamps[seeds] - stamp_ns).argmin()])]
                if track.status.count(HUMAN) == 1:
                    # The extents of a single one may have grown.
                    seed.moved[seed.track_ids.index(track.track_id)] = box
                if seed is array:
                    continue
                # It is beside the stamp of its sweep, which has a box of its own.
                is_between = stamps[seeds].min() < stamp_ns < stamps[seeds].max()
                word = INTERPOLATED if is_between else EXTENDED
            class_name = own.class_name(int(stamp_ns)) if own.stamps_ns else track.class_name
            array.added.append(AddedBox(track.track_id, class_name, word, box, UNSUPPORTED, 1.0))
    return plan


def _arrays_of_tracks(given: Sequence[BoxArray]) -> dict[str, list[int]]:
    """Return the indices of the arrays that have a box of each track."""
    found: dict[str, list[int]] = {}
    for index, array in enumerate(given):
        for track_id in array.track_ids:
            found.setdefault(track_id, []).append(index)
    return found


def with_evidence(
    given: Sequence[BoxArray], results: Sequence[RefinedBoxes], deviations: Floats
) -> list[RefinedBoxes]:
    """
    Return results that are nearer to the keyframes if these show it, see `person.corrections`.

    Boxes between keyframes are moved by the steps of these, interpolated in time; between exact
    ones, a line or spline takes their place where it errs less, see `between_exact`.

    Parameters
    ----------
    given : sequence of BoxArray
        The keyframes as they were registered.
    results : sequence of RefinedBoxes
        That of each array, in the same frame: the boxes of `given` in their order, then added
        ones.
    deviations : array, shape (9,)
        With which the keyframes were registered, of the columns of a box [m, rad].

    Returns
    -------
    results : list of RefinedBoxes
        With other boxes; status and covariances are the same.

    """
    keyframes = [
        (array.track_ids[row], array.stamp_ns, array.boxes[row], result.boxes.boxes[row],
         diagonals(result.covariances[row], result.extent_covariances[row]),
         result.status[row] == REFINED)
        for array, result in zip(given, results, strict=True)
        for row in range(len(array.track_ids))
    ]  # fmt: skip
    if not any(keyframe[-1] for keyframe in keyframes):
        return list(results)
    names, *columns = zip(*keyframes, strict=True)
    stamps_ns, boxes, fits, spread, is_fit = map(np.array, columns)
    shown = boxes[is_fit], fits[is_fit], spread[is_fit], deviations
    steps = np.zeros_like(boxes)
    steps[is_fit] = corrections(*shown)
    if not steps.any():
        return list(results)
    exact, away = are_exact(*shown), residuals(boxes, fits)
    away[~is_fit] = np.nan
    rows_of = rows_by_key(names)
    places: dict[str, list[tuple[int, int]]] = {name: [] for name in rows_of}
    for index, result in enumerate(results):
        for row, name in enumerate(result.boxes.track_ids):
            if name in places:
                places[name].append((index, row))
    found = [result.boxes.boxes.copy() for result in results]
    for name, rows in rows_of.items():
        at = np.array([results[index].boxes.stamp_ns for index, _ in places[name]], np.int64)
        own = np.array([found[index][row] for index, row in places[name]])
        fit_rows = rows[is_fit[rows]]
        if len(fit_rows):
            own = moved(at, own, stamps_ns[fit_rows], steps[fit_rows])
        if exact:
            key_ns, first = np.unique(stamps_ns[rows], return_index=True)  # of two, the first
            keys = rows[first]
            own = between_exact(at, own, Keyframes(key_ns, boxes[keys], away[keys]))
        for (index, row), box in zip(places[name], own, strict=True):
            if results[index].status[row] != KEPT:
                found[index][row] = box
    return [
        replace(result, boxes=replace(result.boxes, boxes=own))
        for result, own in zip(results, found, strict=True)
    ]
