"""How far people are with the review of drives, and how well they agree."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from itertools import combinations
from math import isfinite
from pathlib import Path

from boxreg_ros.core.metrics import iou_3d
from boxreg_ros.io.box_table import BoxTable, parsed_rows, unprotected
from boxreg_ros.io.stamp_join import joined_stamps
from boxreg_ros.review.decisions import Decision, DECISIONS, held, read_decisions
from boxreg_ros.review.tables import REVIEW
from boxreg_ros.structures import Floats, REFINED
import numpy as np
import orjson

PAUSE = 300.0
"""A person who decides nothing for so long does something else [s]; chosen."""
UNREAD = 2.0
"""A track that is accepted so soon after the decision before was hardly looked at [s]; chosen."""


@dataclass(frozen=True, slots=True)
class DriveProgress:
    """The review of one result."""

    out: Path
    """Its folder."""
    tracks: int
    decided: int
    """Tracks with a decision."""
    accepted: int
    unread: int
    """Tracks accepted within `UNREAD` of the decision before of the same person."""
    risk: float
    """Sum over all tracks [m]."""
    risk_left: float
    """Of the tracks without a decision [m]."""
    seconds: float
    """Time between the decisions of each person, pauses left out, of all of them [s]."""
    people: tuple[str, ...]
    """Who have decided."""

    @property
    def minutes_a_track(self) -> float:
        """Return the time for each track that was decided [min]; NaN without any."""
        return self.seconds / 60 / self.decided if self.decided else np.nan


def progress_of(out: Path) -> DriveProgress:
    """Return how far the review of a result is; RecordingError if its files cannot be read."""
    risks = _risks(out / REVIEW)
    path = out / DECISIONS
    made = read_decisions(path) if path.exists() else []
    standing = held(made)
    decided = {one.track_id for one in standing if one.kind != 'none'} & risks.keys()
    accepted = {one.track_id for one in standing if one.kind == 'accept' and one.stamp_ns is None}
    seconds, hasty = _pace(made)
    left = sum(risk for name, risk in risks.items() if name not in decided)
    people = tuple(sorted({one.who for one in made if one.who}))
    return DriveProgress(
        out, len(risks), len(decided), len(accepted & risks.keys()), len(accepted & hasty),
        sum(risks.values()), left, seconds, people,
    )  # fmt: skip


def progress_lines(drives: Sequence[DriveProgress]) -> list[str]:
    """Return a table of drives, most risk left first, their sum, and the agreement of people."""
    drives = sorted(drives, key=lambda one: -one.risk_left)
    head = ' tracks  decided  accepted  unread  risk left  min/track'
    width = max([len(str(one.out)) for one in drives] + [5])
    lines = [f'{"drive":<{width}} {head}  people']
    lines += [f'{one.out!s:<{width}} {_cells(one)}  {", ".join(one.people)}' for one in drives]
    if len(drives) > 1:
        lines.append(f'{"all":<{width}} {_cells(total(drives))}')
    return [*lines, agreement_text([one.out for one in drives])]


def agreement_text(outs: Sequence[Path]) -> str:
    """Return how well people agree, and we with them, in words."""
    theirs, ours = agreement(outs)
    if not len(theirs):
        return 'no box was drawn by two people: their agreement is not known'
    own = f', ours with theirs {ours.mean():.3f} ({len(ours)} boxes)' if len(ours) else ''
    return f'3D IoU of two people {theirs.mean():.3f} ({len(theirs)} boxes){own}'


def agreement(outs: Sequence[Path]) -> tuple[Floats, Floats]:
    """
    Return how well people agree where two have drawn the same box.

    In one result, or in several ones of the same request and files, which each reviews alone: the
    3D IoU (n,) of the boxes of two people, and (m,) of the refined box with each of these.

    """
    drawn: dict[tuple[str, str, int | None], dict[str, Floats]] = defaultdict(dict)
    refined: dict[tuple[str, str, int | None], Floats] = {}
    for out in outs:
        path = out / DECISIONS
        made = read_decisions(path) if path.exists() else []
        pins = [one for one in made if one.kind == 'pin' and one.box is not None]
        if not pins:
            continue
        table = BoxTable.read(out / 'boxes.csv')
        pins = _at_stamps_of(table, pins)
        drive = str(orjson.loads((out / 'summary.json').read_bytes()).get('fingerprint', out))
        for one in pins:
            assert one.box is not None
            drawn[drive, one.track_id, one.stamp_ns][one.who] = one.box
        rows = zip(table.track_ids, table.stamps_ns.tolist(), table.status, strict=True)
        for row, (track_id, stamp_ns, status) in enumerate(rows):
            if status == REFINED:
                refined[drive, track_id, stamp_ns] = table.boxes[row]
    shared = {key: list(boxes.values()) for key, boxes in drawn.items() if len(boxes) > 1}
    pairs = [pair for boxes in shared.values() for pair in combinations(boxes, 2)]
    own = [(refined[key], box) for key, boxes in shared.items() if key in refined for box in boxes]
    return _overlaps(pairs), _overlaps(own)


def _at_stamps_of(table: BoxTable, pins: Sequence[Decision]) -> list[Decision]:
    """Return decisions with the stamps of the boxes they are of, see `joined_stamps`."""
    stamps_ns = [one.stamp_ns for one in pins if one.stamp_ns is not None]
    joined = joined_stamps(np.array(stamps_ns, np.int64), table.stamps_ns).stamps_ns.tolist()
    stamp_of = dict(zip(stamps_ns, joined, strict=True))
    return [
        one if one.stamp_ns is None else replace(one, stamp_ns=stamp_of[one.stamp_ns])
        for one in pins
    ]


def _overlaps(pairs: Sequence[tuple[Floats, Floats]]) -> Floats:
    if not pairs:
        return np.zeros(0)
    first, second = (np.array(side) for side in zip(*pairs, strict=True))
    return np.asarray(iou_3d(first, second))


def total(drives: Sequence[DriveProgress]) -> DriveProgress:
    """Return the sums over drives."""
    names = ('tracks', 'decided', 'accepted', 'unread', 'risk', 'risk_left', 'seconds')
    sums = {name: sum(getattr(one, name) for one in drives) for name in names}
    people = tuple(sorted({name for one in drives for name in one.people}))
    return DriveProgress(out=Path('all'), people=people, **sums)


def _cells(one: DriveProgress) -> str:
    left = one.risk_left / one.risk if one.risk else 0.0
    pace = '' if np.isnan(one.minutes_a_track) else f'{one.minutes_a_track:.1f}'
    return (
        f'{one.tracks:>7,} {one.decided:>8,} {one.accepted:>9,} {one.unread:>7,} {left:>10.0%} '
        f'{pace:>10}'
    )


def _risks(path: Path) -> dict[str, float]:
    """Return the risk of each track of a result by its id [m]."""
    risks = dict(parsed_rows(path, _risk))
    return {name: risk for name, risk in risks.items() if isfinite(risk)}  # proposals have none


def _risk(row: dict[str, str]) -> tuple[str, float]:
    """Return id and risk of a row."""
    return unprotected(row['track_id']), float(row['risk_m'] or 'nan')


def _pace(made: Sequence[Decision]) -> tuple[float, set[str]]:
    """Return the time of all people [s], and the tracks that were accepted unread."""
    last: dict[str, datetime] = {}
    seconds = 0.0
    hasty: set[str] = set()
    for one in made:
        try:
            when = datetime.fromisoformat(one.when)
        except ValueError:
            continue  # of version 1
        before = last.get(one.who)
        last[one.who] = when
        gap = PAUSE if before is None else (when - before).total_seconds()
        if 0 <= gap < PAUSE:
            seconds += gap
        if one.kind == 'accept' and one.stamp_ns is None:
            (hasty.add if 0 <= gap < UNREAD else hasty.discard)(one.track_id)
    return seconds, hasty
