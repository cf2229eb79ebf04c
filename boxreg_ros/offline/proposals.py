"""`boxreg relabel --proposals`: objects that no box covers, by the points of all sweeps."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from boxreg_ros.core.point_labels import PointLabeller
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.offline.stored_sweeps import StoredSweeps
from boxreg_ros.structures import PROPOSED
from boxreg_ros.tracks.proposals import Proposal, Proposer
import numpy as np

PROPOSALS = 'proposals.csv'


def write_proposals(
    folder: Path,
    sweeps: StoredSweeps,
    labeller: PointLabeller,
    fixed_frame: str,
) -> list[dict[str, Any]]:
    """Write a box of each object that no box covers to `PROPOSALS`; return them, longest first."""
    proposer = Proposer()
    for sweep, _ in sweeps:
        if sweep is not None and labeller.knows(sweep.stamp_ns):
            boxes = labeller.objects_at(sweep.stamp_ns).boxes
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
