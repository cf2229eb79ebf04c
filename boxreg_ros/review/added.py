"""The track of an object that a person has added, as the page shows it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from boxreg_ros.core.follow import FollowedTrack
from boxreg_ros.review.changes import TrackChanges
from boxreg_ros.review.payload import TrackPart, TrackTruth
from boxreg_ros.review.risk import assess, evidence
from boxreg_ros.review.scene import DriveScene
from boxreg_ros.review.tables import TrackRow
from boxreg_ros.rotations import matrix_from_rpy
from boxreg_ros.structures import BOX_EXTENT, BoxArray, Floats, ROLL, Z
import numpy as np

MAX_CLICKED = 400
"""Most points of a box that the page gets; as in a report."""


def added_track(
    scene: DriveScene, seeds: Sequence[BoxArray], begin_ns: int, grows: bool = False
) -> dict[str, Any]:
    """
    Follow an added object from its boxes; return its track as the page shows it.

    Parameters
    ----------
    scene : DriveScene
        The recording.
    seeds : sequence of BoxArray
        Boxes of one object in the fixed frame, an array each.
    begin_ns : int
        Stamp from which the times of the page are counted [ns].
    grows : bool
        Whether a single box may grow to the points of the track.

    Returns
    -------
    track : dict
        ``row`` and ``part`` are as of the tracks of a report; ``ends`` stamp and reason before the
        first box and after the last; ``problems`` the seeds that could not be used, and why.

    Raises
    ------
    RecordingError
        If the recording cannot be read, or no seed can be followed.

    """
    track = scene.follow(seeds, grows)
    stamps_ns = track.stamps_ns.tolist()
    of_boxes = scene.near(stamps_ns, track.boxes)
    changes = _changes(track, of_boxes)
    poses = zip(of_boxes, matrix_from_rpy(track.boxes[:, ROLL:]), track.boxes, strict=True)
    near = [local @ R.T + box[: Z + 1] for local, R, box in poses]
    faces = [evidence(*one)[0] for one in zip(near, changes.boxes, strict=True)]
    changes = replace(changes, face_distances=np.nan_to_num(np.array(faces).reshape(-1, 6)))
    row = TrackRow(changes, assess(changes), '')
    n = len(track.rows)
    unknown = TrackTruth(np.full((n, 9), np.nan), np.full(n, np.nan), np.full(n, np.nan))
    part = TrackPart(row, near, scene.sensors_at(stamps_ns), unknown)
    return {
        'row': part.row(track.stamps_ns),
        'part': part.part(begin_ns, MAX_CLICKED),
        'ends': [{'stamp': str(end.stamp_ns), 'reason': end.reason} for end in track.ends],
        'problems': track.problems,
    }


def _changes(track: FollowedTrack, near: Sequence[Floats]) -> TrackChanges:
    """Return an added track; `near` has the points near each box, in its frame."""
    n = len(track.rows)
    pairs = zip(near, track.boxes[:, BOX_EXTENT] / 2, strict=True)
    inside = np.array([(np.abs(local) < half).all(1).sum() for local, half in pairs], np.int64)
    totals = np.array([len(local) for local in near], np.int64)
    return TrackChanges(
        track_id=track.track_id,
        class_name=track.class_name,
        input_ids=(track.track_id,) * n,
        stamps_ns=track.stamps_ns,
        given=np.full((n, 9), np.nan),
        boxes=track.boxes,
        change=np.full((n, 4), np.nan),
        deviations=np.full((n, 4), np.nan),
        extent_deviations=np.full((n, 3), np.nan),
        face_distances=np.zeros((n, 6)),
        near_points=np.column_stack([inside, totals - inside]),
        disagreement=np.zeros(n),
        is_flipped=np.zeros(n, bool),
        status=np.array(track.status),
        reasons=np.full(n, '', '<U1'),
        num_points=inside,
    )
