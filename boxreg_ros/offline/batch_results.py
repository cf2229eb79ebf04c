"""The results over all drives of `boxreg batch`: index, summary and page, of shards or all."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
import csv
from dataclasses import dataclass, fields
from html import escape
from io import StringIO
import json
from pathlib import Path
import re
from typing import Any
from urllib.parse import quote

from boxreg_ros import __version__
from boxreg_ros.errors import RecordingError
from boxreg_ros.io.box_table import csv_row, protected, unprotected
from boxreg_ros.io.storage.urls import names_of, read_text, url_of
from boxreg_ros.io.whole_files import written_whole
from boxreg_ros.offline.result_folder import SUMMARY

DRIVE_FAILED = 'failed'
DRIVE_DONE = 'done'
UP_TO_DATE = 'up to date'
COUNTS = ('sweeps', 'boxes_in', 'refined', 'kept', 'damages')
REVIEW = 'review.csv'
RISK = 'risk_m'
MAX_LISTED_TRACKS = 100
"""Tracks in the report; a page of more is not read."""
UNLISTED = ('key', 'exit_status')
"""Columns of the index that the report leaves out."""
PAGE_STYLE = (
    'body{font-family:sans-serif;margin:2em}table{border-collapse:collapse}'
    'td,th{border:1px solid #ccc;padding:.2em .5em;text-align:left}.failed{background:#fdd}'
)
SHARD_INDEX = re.compile(r'index\.(\d+)-of-(\d+)\.csv')


@dataclass
class Result:
    """Result of a job: a row of the index."""

    drive: str  # name of the result folder
    status: str = DRIVE_FAILED  # one of the three words above
    # of its last process; negative for the signal that ended it
    exit_status: int | None = None
    attempts: int = 0  # processes that were started
    seconds: float = 0.0  # of all attempts
    peak_mb: int = 0  # largest memory of a process and its workers, their shared pages divided
    sweeps: int = 0
    boxes_in: int = 0
    refined: int = 0
    kept: int = 0
    damages: int = 0
    last_line: str = ''  # last line that its process printed, or why it failed
    key: str = ''  # hash of the content of its files, the options and the version

    @property
    def is_done(self) -> bool:
        """Return whether the drive has its result."""
        return self.status != DRIVE_FAILED

    def count(self, summary: dict[str, Any]) -> None:
        """Take the counts of a ``summary.json``."""
        status = summary.get('status', {})
        self.sweeps = summary.get('sweeps', 0)
        self.boxes_in = summary.get('boxes_in', 0)
        self.refined = status.get('refined', 0)
        self.kept = status.get('kept', 0)
        self.damages = len(summary.get('damage', ()))


INDEX_COLUMNS = tuple(column.name for column in fields(Result))


def write_results(out: Path, rows: Sequence[dict[str, Any]], shard: str = '') -> None:
    """Write index, merged summary and report over all drives; `shard` is as in ``.1-of-8``."""
    with written_whole(out / f'index{shard}.csv') as file:
        file.write(csv_row(INDEX_COLUMNS))
        for row in rows:
            file.write(csv_row(protected(str(row[name])) for name in INDEX_COLUMNS))
    stem, suffix = SUMMARY.split('.')
    with written_whole(out / f'{stem}{shard}.{suffix}') as file:
        file.write(json.dumps(_merged(rows), indent=2) + '\n')
    with written_whole(out / f'report{shard}.html') as file:
        file.write(_page(rows, _riskiest(out, [row['drive'] for row in rows])))


def _merged(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the summary over all drives."""
    return {
        'drives': len(rows),
        'done': sum(row['status'] != DRIVE_FAILED for row in rows),
        **{name: sum(int(row[name]) for row in rows) for name in COUNTS},
        'seconds': round(sum(float(row['seconds']) for row in rows), 1),
        'peak_mb': max((int(row['peak_mb']) for row in rows), default=0),
        'version': __version__,
        'failed': {
            row['drive']: row['last_line'] for row in rows if row['status'] == DRIVE_FAILED
        },
    }


def rows_of_shards(out: Path) -> list[dict[str, Any]]:
    """Return the rows of the indexes of all shards, ordered by drive; refuse missing shards."""
    found = {}
    counts = set()
    names = names_of(out) if url_of(out) else [path.name for path in out.glob('index.*')]
    for match in filter(None, map(SHARD_INDEX.fullmatch, names)):
        found[int(match[1])] = out / match[0]
        counts.add(int(match[2]))
    if len(counts) != 1:
        raise RecordingError(
            f'{out}: expected the indexes of all shards of one --shard I/N, got those of '
            f'{_listed(counts)}; run the shards first, or delete the others'
        )
    (count,) = counts
    missing = sorted(set(range(1, count + 1)) - found.keys())
    if missing:
        raise RecordingError(
            f'{out}: expected the indexes of {count} shards, got all but {_listed(missing)}; '
            f'run these first'
        )
    rows: list[dict[str, Any]] = []
    for path in found.values():
        try:
            part = list(_read_rows(read_text(path)))
            _merged(part)
        except (KeyError, ValueError) as error:  # UnicodeDecodeError, too
            raise RecordingError(
                f'{path}: expected the index of a shard, got an error in {error}; run it again'
            ) from None
        rows += part
    return sorted(rows, key=lambda row: str(row['drive']))


def _read_rows(text: str) -> Iterator[dict[str, Any]]:
    """Yield the rows of a table whose cells are no formulas."""
    for row in csv.DictReader(StringIO(text, newline='')):
        yield {name: unprotected(cell or '') for name, cell in row.items() if name}


def _listed(numbers: Iterable[int]) -> str:
    return ', '.join(map(str, sorted(numbers))) or 'none'


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
    shown = [{name: row[name] for name in row if name not in UNLISTED} for row in drives]
    first = f'<h2>Tracks to look at first</h2>{_table(tracks)}' if tracks else ''
    return (
        f'<!doctype html><meta charset="utf-8"><title>boxreg</title><style>{PAGE_STYLE}</style>'
        f'<h1>{len(drives):,} drives</h1>{first}<h2>Drives</h2>{_table(shown)}'
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
