"""`boxreg relabel --proposals`: objects that no box covers, by one more reading."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from boxreg_ros.core.point_labels import PointLabeller
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.io.fixed_frame import FixedFrameItems
from boxreg_ros.offline.point_products import object_tracks
from boxreg_ros.offline.request import Request
from boxreg_ros.review.changes import TrackChanges
from boxreg_ros.structures import PROPOSED, Sweep
from boxreg_ros.tracks.proposals import Proposal, Proposer
import numpy as np

PROPOSALS = 'proposals.csv'


def write_proposals(
    folder: Path,
    request: Request,
    tracks: Sequence[TrackChanges],
    array_stamps_ns: Sequence[int],
    fixed_frame: str,
) -> list[dict[str, Any]]:
    """
    Find objects that no box covers, and write a box of each to `PROPOSALS`.

    Parameters
    ----------
    folder : Path
        Of the results.
    request : Request
        Of the run.
    tracks : sequence of TrackChanges
        Results of the run.
    array_stamps_ns : sequence of int
        Stamps of all box arrays [ns].
    fixed_frame : str
        That of the run.

    Returns
    -------
    proposals : list of dict
        For ``summary.json``, longest first.

    """
    objects = object_tracks(tracks)
    margins = np.zeros((len(objects), 6))
    known = PointLabeller(objects, np.array(array_stamps_ns, np.int64), request.config, margins)
    proposer = Proposer()
    with request.recording() as recording:
        items = FixedFrameItems(recording, request.config, request.convention, request.fixed_frame)
        for item in items.read():
            sweep = item.moved
            if isinstance(sweep, Sweep) and known.knows(sweep.stamp_ns):
                boxes = known.objects_at(sweep.stamp_ns).boxes
                sweep = sweep.in_frame()
                proposer.add(sweep.stamp_ns, sweep.points, sweep.origin, boxes)
    found = proposer.proposals()
    names = [f'missed-{number}' for number in range(1, len(found) + 1)]
    BoxTable(
        np.array([one.stamp_ns for one in found], np.int64),
        fixed_frame,
        tuple(names),
        tuple(one.class_name for one in found),
        np.full(len(found), np.nan),
        np.array([one.box for one in found]).reshape(-1, 9),
        (PROPOSED,) * len(found),
        np.array([one.num_points for one in found], np.int64),
    ).write(folder / PROPOSALS)
    return [_as_json(name, one) for name, one in zip(names, found, strict=True)]


def _as_json(name: str, one: Proposal) -> dict[str, Any]:
    x, y, z = one.box[:3].round(2).tolist()
    return {
        'track_id': name,
        'class_name': one.class_name,
        'stamp_ns': one.stamp_ns,
        'place': [x, y, z],
        'sweeps': len(one.stamps_ns),
        'first_stamp_ns': int(one.stamps_ns[0]),
        'last_stamp_ns': int(one.stamps_ns[-1]),
        'points': one.num_points,
        'speed': round(one.speed, 1),
    }
