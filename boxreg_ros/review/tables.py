"""``tracks.csv``, one row per track, and ``review.csv``, tracks in the order of their risk."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from boxreg_ros.core.id_switches import by_id, id_switches, Switch
from boxreg_ros.io.box_table import csv_row, protected
from boxreg_ros.review.changes import median, TrackChanges
from boxreg_ros.review.risk import assess, reasons_of, Risk, typical_parts, Usual
from boxreg_ros.structures import ADDED, BOX_EXTENT, INTERPOLATED, KEPT, REFINED, Y
import numpy as np

TRACKS = 'tracks.csv'
REVIEW = 'review.csv'


class TrackRow(NamedTuple):
    """The source of a row of ``tracks.csv``: the track, its risk, and the reasons in words."""

    track: TrackChanges
    risk: Risk
    reasons: str


def _count(status: str) -> Callable[[TrackRow], int]:
    return lambda row: int((row.track.status == status).sum())


def _extent(axis: int) -> Callable[[TrackRow], float]:
    return lambda row: median(row.track.boxes[:, BOX_EXTENT][:, axis])


TRACK_COLUMNS: Mapping[str, Callable[[TrackRow], Any]] = {
    'track_id': lambda row: row.track.track_id,
    'class_name': lambda row: row.track.class_name,
    'boxes': lambda row: int((~np.isin(row.track.status, ADDED)).sum()),
    'refined': _count(REFINED),
    'kept': _count(KEPT),
    'risk_m': lambda row: row.risk.track,
    'interpolated': _count(INTERPOLATED),
    'first_stamp_ns': lambda row: int(row.track.stamps_ns[0]),
    'last_stamp_ns': lambda row: int(row.track.stamps_ns[-1]),
    'median_points': lambda row: median(row.track.num_points),
    'flips': lambda row: int(row.track.is_flipped.sum()),
    'length': _extent(0),
    'width': _extent(1),
    'height': _extent(2),
    'reasons': lambda row: row.reasons,
}
"""Columns of ``tracks.csv`` in their order: name, and how the cell follows from a row."""
REVIEW_COLUMNS = ('rank', 'track_id', 'class_name', 'stamp_ns', 'risk_m', 'reasons')


def assessed(tracks: Sequence[TrackChanges]) -> list[TrackRow]:
    """Return the rows of all tracks, largest risk first, ties by track id."""
    usual = Usual.of(tracks)
    risks = [assess(track, usual) for track in tracks]
    typical = typical_parts(risks)
    switches = _switches(tracks)
    rows = []
    for track, risk in zip(tracks, risks, strict=True):
        names = set(track.input_ids)
        switched = [
            f'{switch.first} and {switch.second} changed places at {switch.stamp_ns}'
            for switch in switches
            if names & {switch.first, switch.second}
        ]
        reasons = '; '.join(filter(None, (*switched, reasons_of(track, risk, typical))))
        rows.append(TrackRow(track, risk, reasons))
    return sorted(rows, key=lambda row: (-row.risk.track, row.track.track_id))


def _switches(tracks: Sequence[TrackChanges]) -> list[Switch]:
    """Return where two ids of the input changed places."""
    if not tracks:
        return []
    names = [name for track in tracks for name in track.input_ids]
    stamps_ns = np.concatenate([track.stamps_ns for track in tracks])
    centers = np.concatenate([track.given[:, : Y + 1] for track in tracks])
    known = np.flatnonzero(np.isfinite(centers).all(1))
    return id_switches(by_id([names[row] for row in known], stamps_ns[known], centers[known]))


def write_tables(
    folder: Path,
    rows: Sequence[TrackRow],
    more_columns: Sequence[str] = (),
    more_cells: Mapping[str, Sequence[Any]] | None = None,
    proposals: Sequence[Mapping[str, Any]] = (),
) -> None:
    """
    Write ``tracks.csv`` and ``review.csv`` into a folder of results.

    Parameters
    ----------
    folder : Path
        The folder, which exists.
    rows : sequence of TrackRow
        As of `assessed`, in this order.
    more_columns : sequence of str
        Further columns of ``tracks.csv``.
    more_cells : mapping of str to sequence, optional
        Their cells by track id; empty for other tracks.
    proposals : sequence of mappings
        Objects that no box covers, as in ``summary.json``: the last rows of ``review.csv``.

    Raises
    ------
    OSError
        If a file cannot be written.

    """
    found = more_cells or {}
    absent = [''] * len(more_columns)
    _write(
        folder / TRACKS,
        [*TRACK_COLUMNS, *more_columns],
        [
            [cell(row) for cell in TRACK_COLUMNS.values()]
            + list(found.get(row.track.track_id, absent))
            for row in rows
        ],
    )
    review = [_review_row(i, row) for i, row in enumerate(rows, 1)]
    review += [_proposal_row(i, one) for i, one in enumerate(proposals, len(rows) + 1)]
    _write(folder / REVIEW, REVIEW_COLUMNS, review)


def _review_row(rank: int, row: TrackRow) -> list[Any]:
    """Return the cells of ``review.csv``; the stamp is that of the riskiest box."""
    track = row.track
    worst = int(np.argmax(row.risk.boxes))
    stamp_ns = int(track.stamps_ns[worst])
    return [rank, track.track_id, track.class_name, stamp_ns, row.risk.track, row.reasons]


def _proposal_row(rank: int, one: Mapping[str, Any]) -> list[Any]:
    """Return the cells of ``review.csv`` for an object that no box covers; it has no risk."""
    motion = f'moves at {one["speed"]} m/s' if one['speed'] else 'stands'
    reasons = f'no box; {one["sweeps"]} clouds, {one["points"]} points, {motion}; proposals.csv'
    return [rank, one['track_id'], one['class_name'], one['stamp_ns'], float('nan'), reasons]


def _write(path: Path, header: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    """Write a table; metres have three decimals, numbers that are not finite are empty cells."""
    with path.open('w', newline='', encoding='utf-8', errors='backslashreplace') as file:
        file.write(csv_row(header))
        file.writelines(csv_row(map(_cell, row)) for row in rows)


def _cell(value: Any) -> Any:
    if isinstance(value, str):
        return protected(value)
    if not isinstance(value, float):
        return value
    return f'{value:.3f}' if np.isfinite(value) else ''
