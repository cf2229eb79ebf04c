"""What a run writes beside its labels: tables of tracks, violated rules and the report."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TYPE_CHECKING

from boxreg_ros.config import Config
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.io.stamp_join import joined_stamps
from boxreg_ros.io.times import time_range
from boxreg_ros.offline.notes import MAX_NAMED
from boxreg_ros.offline.summary import Summary
from boxreg_ros.structures import Floats, Ints, PROPOSED
import numpy as np

if TYPE_CHECKING:
    from boxreg_ros.core.point_labels import PointLabeller
    from boxreg_ros.offline.stored_sweeps import StoredSweeps
    from boxreg_ros.review.changes import TrackChanges
    from boxreg_ros.review.rules import Violation
    from boxreg_ros.review.tables import TrackRow
    from boxreg_ros.tracks.complete import CompletionPlan, TrackSteps
    from boxreg_ros.tracks.proposals import Proposal

PROPOSALS = 'proposals.csv'
STEP_COLUMNS = (
    'fragments', 'filled', 'extended', 'rejected', 'reclassified', 'ambiguous', 'unfilled',
)  # fmt: skip
"""Fields of `TrackSteps` that ``tracks.csv`` has."""
SUMMED = ('rejected', 'filled', 'extended', 'reclassified', 'unfilled')
"""Those whose sums ``summary.json`` has."""


def completed_counts(plan: CompletionPlan | None) -> dict[str, int]:
    """Return the numbers of tracks and boxes that each step changed; empty without steps."""
    if plan is None:
        return {}
    tracks = plan.tracks
    return {
        'tracks': len(tracks),
        'joined': sum(track.fragments - 1 for track in tracks),
        'ambiguous': sum(bool(track.ambiguous) for track in tracks),
        **{name: sum(getattr(track, name) for track in tracks) for name in SUMMED},
    }


def write_track_tables(
    folder: Path,
    tracks: Sequence[TrackChanges],
    plan: CompletionPlan | None,
    proposals: Sequence[Mapping[str, Any]] = (),
) -> list[TrackRow]:
    """Write the tables of tracks; return their rows, largest risk first."""
    from boxreg_ros.review.tables import assessed, write_tables

    rows = assessed(tracks)
    columns = () if plan is None else STEP_COLUMNS
    cells = {} if plan is None else _step_cells(plan.tracks)
    write_tables(folder, rows, columns, cells, proposals)
    return rows


def checked(
    tracks: Sequence[TrackChanges], config: Config
) -> tuple[dict[str, dict[str, int]], dict[str, list[Violation]]]:
    """Return the number of violations of each rule, ``before`` and ``after``, and those after."""
    from boxreg_ros.review.label_tracks import LabelTrack
    from boxreg_ros.review.rules import counts, violations

    def found(boxes_of: Callable[[TrackChanges], Floats]) -> dict[str, list[Violation]]:
        return violations(
            [
                LabelTrack.of(
                    *(track.track_id, track.class_name, config, track.stamps_ns),
                    *(boxes_of(track), track.num_points),
                )
                for track in tracks
            ]
        )

    before = counts(found(lambda track: track.given))
    after = found(lambda track: track.labels)
    return {'before': before, 'after': counts(after)}, after


def fitting_truth(
    truth: BoxTable | None, path: Path | None, tracks: Sequence[TrackChanges], summary: Summary
) -> BoxTable | None:
    """Return the true boxes for the report; None, with a warning, where they do not fit."""
    if truth is None:
        return None
    stamps = np.concatenate([np.zeros(0, np.int64), *(track.stamps_ns for track in tracks)])
    joined = joined_stamps(truth.stamps_ns, stamps)
    names = {track.track_id for track in tracks}
    problem = ''
    if truth.frame_id != summary.fixed_frame:
        problem = f'frame {summary.fixed_frame!r}, got {truth.frame_id!r}'
    elif len(stamps) and not joined.num_common:
        problem = f'boxes of {_range_of(stamps)}, got {_range_of(truth.stamps_ns)}'
    elif names.isdisjoint(truth.track_ids):
        problem = f'tracks {sorted(names)[:MAX_NAMED]}, got {truth.track_ids[:MAX_NAMED]}'
    line = joined.finding('the true boxes', 'the results')
    if problem:
        line = (
            f'truth {str(path)!r}: expected {problem}; the report is written without it: '
            f'give the true boxes of this drive to --truth'
        )
    summary.warning = '; '.join(filter(None, (summary.warning, line)))
    return None if problem else replace(truth, stamps_ns=joined.stamps_ns)


def _range_of(stamps_ns: Ints) -> str:
    return time_range(int(stamps_ns.min()), int(stamps_ns.max()))


def _step_cells(tracks: Sequence[TrackSteps]) -> dict[str, list[int | str]]:
    """Return the cells of `STEP_COLUMNS` by track id."""
    found = {one.track_id: [getattr(one, name) for name in STEP_COLUMNS] for one in tracks}
    words = STEP_COLUMNS.index('ambiguous')
    for cells in found.values():
        cells[words] = ' '.join(cells[words])
    return found


def write_proposals(
    folder: Path, sweeps: StoredSweeps, labeller: PointLabeller, fixed_frame: str
) -> list[dict[str, Any]]:
    """Write a box of each object that no box covers to `PROPOSALS`; return them, longest first."""
    from boxreg_ros.tracks.proposals import Proposer  # imports parts of SciPy

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
