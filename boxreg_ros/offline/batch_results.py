"""The results over all drives of `boxreg batch`: index, summary and page."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
import csv
from dataclasses import dataclass, fields
from html import escape
from io import StringIO
import json
from pathlib import Path
from typing import Any, TYPE_CHECKING
from urllib.parse import quote

from boxreg_ros import __version__
from boxreg_ros.io.box_table import csv_row, protected, unprotected
from boxreg_ros.io.storage.urls import read_text
from boxreg_ros.io.whole_files import written_whole
from boxreg_ros.offline.result_folder import SUMMARY
from boxreg_ros.structures import KEPT, REFINED

if TYPE_CHECKING:
    from boxreg_ros.offline.summary import Summary

DRIVE_FAILED = 'failed'
DRIVE_DONE = 'done'
UP_TO_DATE = 'up to date'
COUNTS = ('sweeps', 'boxes_in', 'refined', 'kept', 'damages')
REVIEW = 'review.csv'
RISK = 'risk_m'
MAX_LISTED_TRACKS = 100
"""Tracks in the report; a page of more is not read."""
PAGE_STYLE = (
    'body{font-family:sans-serif;margin:2em}table{border-collapse:collapse}'
    'td,th{border:1px solid #ccc;padding:.2em .5em;text-align:left}.failed{background:#fdd}'
)


@dataclass
class Result:
    """Result of a job: a row of the index."""

    drive: str  # name of the result folder
    status: str = DRIVE_FAILED  # one of the three words above
    seconds: float = 0.0
    sweeps: int = 0
    boxes_in: int = 0
    refined: int = 0
    kept: int = 0
    damages: int = 0
    last_line: str = ''  # its counts in words, or why it has failed
    notes: str = ''  # about its input and results

    @property
    def is_done(self) -> bool:
        """Return whether the drive has its result."""
        return self.status != DRIVE_FAILED

    def count(self, summary: Summary) -> None:
        """Take the counts of a run."""
        self.sweeps = summary.sweeps
        self.boxes_in = summary.boxes_in
        self.refined = summary.status.get(REFINED, 0)
        self.kept = summary.status.get(KEPT, 0)
        self.damages = len(summary.damage)


INDEX_COLUMNS = tuple(column.name for column in fields(Result))


def write_results(out: Path, rows: Sequence[dict[str, Any]]) -> None:
    """Write index, summary and report over all drives."""
    with written_whole(out / 'index.csv') as file:
        file.write(csv_row(INDEX_COLUMNS))
        for row in rows:
            file.write(csv_row(protected(str(row[name])) for name in INDEX_COLUMNS))
    with written_whole(out / SUMMARY) as file:
        file.write(json.dumps(_merged(rows), indent=2) + '\n')
    with written_whole(out / 'report.html') as file:
        file.write(_page(rows, _riskiest(out, [row['drive'] for row in rows])))


def _merged(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the summary over all drives."""
    return {
        'drives': len(rows),
        'done': sum(row['status'] != DRIVE_FAILED for row in rows),
        **{name: sum(row[name] for row in rows) for name in COUNTS},
        'seconds': round(sum(row['seconds'] for row in rows), 1),
        'version': __version__,
        'failed': {
            row['drive']: row['last_line'] for row in rows if row['status'] == DRIVE_FAILED
        },
    }


def _read_rows(text: str) -> Iterator[dict[str, Any]]:
    """Yield the rows of a table whose cells are no formulas."""
    for row in csv.DictReader(StringIO(text, newline='')):
        yield {name: unprotected(cell or '') for name, cell in row.items() if name}


def _riskiest(out: Path, drives: Iterable[str]) -> list[dict[str, Any]]:
    """Return the rows of all reviews with the largest risk, those first."""
    found: list[tuple[float, dict[str, Any]]] = []
    for drive in drives:
        try:
            text = read_text(out / drive / REVIEW)
        except OSError:  # the drive has failed
            continue
        for row in _read_rows(text):
            try:
                found.append((float(row[RISK]), {'drive': drive, **row}))
            except (KeyError, TypeError, ValueError):
                continue  # a review without this column has no order
    found.sort(key=lambda item: -item[0])
    return [row for _, row in found[:MAX_LISTED_TRACKS]]


def _page(drives: Sequence[dict[str, Any]], tracks: Sequence[dict[str, Any]]) -> str:
    """Return the report: the tracks to look at first, then all drives."""
    first = f'<h2>Tracks to look at first</h2>{_table(tracks)}' if tracks else ''
    return (
        f'<!doctype html><meta charset="utf-8"><title>boxreg</title><style>{PAGE_STYLE}</style>'
        f'<h1>{len(drives):,} drives</h1>{first}<h2>Drives</h2>{_table(drives)}'
    )


def _table(rows: Sequence[dict[str, Any]]) -> str:
    """Return rows as a table of HTML; those of drives that have failed are coloured."""
    names = list(rows[0]) if rows else []
    lines = [''.join(f'<th>{escape(str(name))}' for name in names)]
    lines += [''.join(f'<td>{_cell(name, row.get(name))}' for name in names) for row in rows]
    kinds = ['', *(row.get('status') for row in rows)]
    body = ''.join(f'<tr class="{k}">{line}' for k, line in zip(kinds, lines, strict=True))
    return f'<table>{body}</table>'


def _cell(name: str, value: Any) -> str:
    text = escape('' if value is None else str(value))
    link = quote(str(value), errors='surrogateescape')  # names of files may be no text
    return f'<a href="{link}/">{text}</a>' if name == 'drive' else text
