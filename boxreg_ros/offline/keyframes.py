"""The first pass over a recording whose boxes are keyframes: follow them through all sweeps."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

from boxreg_ros.config import Config
from boxreg_ros.core.follow import (
    follow_points,
    FollowedTrack,
    keyframe_deviations,
    with_points,
)
from boxreg_ros.core.following.person import DEVIATIONS
from boxreg_ros.io.stamp_join import LARGEST_OFFSET_NS
from boxreg_ros.io.sweep_store import SweepStore
from boxreg_ros.offline.completion import Arrivals, Moved
from boxreg_ros.review.corrections import Corrections
from boxreg_ros.structures import BoxArray, Floats
from boxreg_ros.tracks.complete import CompletionPlan
from boxreg_ros.tracks.decided import with_decisions
from boxreg_ros.tracks.followed import followed_plan
import numpy as np


def keyframes(
    items: Iterable[tuple[Moved, bool]],
    fixed_frame: str,
    config: Config,
    corrections: Corrections,
) -> tuple[CompletionPlan, list[Arrivals], list[FollowedTrack], Floats]:
    """
    Follow the boxes of a recording through its sweeps.

    Parameters
    ----------
    items : iterable of (Sweep, BoxArray or None, bool)
        In the fixed frame, and whether time went back before the item; None for one without a
        transform.
    fixed_frame : str
        Name of this frame.
    config : Config
        Settings of the kinds of objects.
    corrections : Corrections
        Pins of a person where the input has no box are keyframes, too.

    Returns
    -------
    plan : CompletionPlan
        What is added, for the arrays of `Arrivals.completed` of all parts.
    parts : list of Arrivals
        What arrived between time jumps, with the sweeps.
    tracks : list of FollowedTrack
        Of all parts.
    deviations : array, shape (9,)
        Of the columns of a keyframe [m, rad], see `person.DEVIATIONS`.

    """
    # A keyframe beside the stamp of a sweep does not take the place of the boxes of that.
    parts = arrivals(items, with_sweeps=True, reach_ns=LARGEST_OFFSET_NS)
    plan = CompletionPlan([], [])
    tracks: list[FollowedTrack] = []
    deviations = DEVIATIONS
    for part in parts:
        store = sweeps_of(part)
        pins = corrections.keyframes(part.arrays, fixed_frame)
        seeds = sorted([*part.arrays, *pins], key=lambda array: array.stamp_ns)
        found = followed(seeds, store, config)
        found = [with_decisions(track, corrections) for track in found]
        arrays = part.completed(fixed_frame)
        plan.append(followed_plan(arrays, found, decided=corrections))
        tracks += found
        own = (replace(track, boxes=_from_store(track.boxes, store, -1)) for track in found)
        of_tracks = (
            with_points(track, store, store.sensor_origins) for track in own if track.boxes.size
        )
        of_part = keyframe_deviations(of_tracks, config)
        deviations = np.maximum(deviations, of_part)
    return plan, parts, tracks, deviations


def arrivals(
    items: Iterable[tuple[Moved, bool]], with_sweeps: bool, reach_ns: int | None = None
) -> list[Arrivals]:
    """Return what arrived in each part between time jumps; `reach_ns` is that of `Arrivals`."""
    parts = [Arrivals.empty(with_sweeps, reach_ns)]
    for item, restarts in items:
        if restarts:
            parts.append(Arrivals.empty(with_sweeps, reach_ns))
        if item is not None:
            parts[-1].add(item)
    return parts


def sweeps_of(part: Arrivals) -> SweepStore:
    """Return the sweeps of a part that has them."""
    assert part.sweeps is not None
    return part.sweeps


def add_objects(
    plan: CompletionPlan,
    parts: Sequence[Arrivals],
    corrections: Corrections,
    fixed_frame: str,
    config: Config,
) -> list[FollowedTrack]:
    """
    Add the objects of a person to a plan, followed through the sweeps of their part.

    The plan is for the arrays of `Arrivals.completed`; the parts, between time jumps, have their
    sweeps. Return the tracks as they were followed.

    """
    seeds_of: dict[int, list[BoxArray]] = {}
    for seed in corrections.seeds(fixed_frame):
        away = [_away(sweeps_of(part), seed.stamp_ns) for part in parts]
        seeds_of.setdefault(int(np.argmin(away)), []).append(seed)
    tracks: list[FollowedTrack] = []
    first = 0
    for index, part in enumerate(parts):
        arrays = part.completed(fixed_frame)
        # Their size is what a person has decided.
        found = followed(seeds_of.get(index, []), sweeps_of(part), config, grows=False)
        plan.add(followed_plan(arrays, corrections.added(found), has_seeds=False), first)
        tracks += found
        first += len(arrays)
    return tracks


def _away(store: SweepStore, stamp_ns: int) -> float:
    """Return the time from a stamp to the nearest sweep of a store [ns]."""
    stamps_ns = np.array(store.stamps_ns, np.int64)
    return float(np.abs(stamps_ns - stamp_ns).min()) if len(stamps_ns) else np.inf


def followed(
    arrays: Sequence[BoxArray], store: SweepStore, config: Config, grows: bool = True
) -> list[FollowedTrack]:
    """Return the tracks of keyframes, in the fixed frame; `grows` is that of `follow_points`."""
    if not len(store) or not arrays:
        return []
    seeds = [replace(array, boxes=_from_store(array.boxes, store, -1)) for array in arrays]
    stamps_ns = np.array(store.stamps_ns, np.int64)
    found = follow_points(stamps_ns, store, seeds, config, store.sensor_origins, grows)
    return [replace(track, boxes=_from_store(track.boxes, store)) for track in found]


def _from_store(boxes: Floats, store: SweepStore, sign: int = 1) -> Floats:
    """Return boxes (N, 9) moved from the frame of a store, or into it."""
    found = boxes.copy()
    found[:, :3] += sign * (np.zeros(3) if store.origin is None else store.origin)
    return found


def ends_of(tracks: Sequence[FollowedTrack]) -> list[dict[str, Any]]:
    """Return where each track ends and why, for ``summary.json``."""
    return [
        {
            'track_id': track.track_id,
            'boxes': len(track.rows),
            'before': track.ends[0]._asdict() if track.ends else None,
            'after': track.ends[1]._asdict() if track.ends else None,
            'problems': list(track.problems),
        }
        for track in tracks
    ]
