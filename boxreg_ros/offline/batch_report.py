"""The page over all drives of `boxreg batch`: the riskiest tracks first, then every drive."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
import csv
from html import escape
from pathlib import Path
from typing import Any, TextIO
from urllib.parse import quote

from boxreg_ros.io.storage.urls import read_text

REVIEW = 'review.csv'
RISK = 'risk_m'
MAX_LISTED_TRACKS = 100
"""Tracks in the report; a page of more is not read."""
PAGE_STYLE = (
    'body{font-family:sans-serif;margin:2em}table{border-collapse:collapse}'
    'td,th{border:1px solid #ccc;padding:.2em .5em;text-align:left}.failed{background:#fdd}'
)


def write_batch_report(file: TextIO, out: Path, rows: Sequence[dict[str, Any]]) -> None:
    """
    Write one HTML page.

    Parameters
    ----------
    file : TextIO
        Open for writing.
    out : Path
        Folder with the result folders; those with a ``review.csv`` give the tracks.
    rows : sequence of dict
        Rows of the index.

    """
    tracks = _riskiest(out, [row['drive'] for row in rows])
    file.write(
        f'<!doctype html><meta charset="utf-8"><title>boxreg</title><style>{PAGE_STYLE}</style>'
    )
    file.write(f'<h1>{len(rows):,} drives</h1>')
    if tracks:
        file.write('<h2>Tracks to look at first</h2>')
        _write_table(file, tracks)
    file.write('<h2>Drives</h2>')
    linked = [
        {name: row[name] for name in row if name not in ('key', 'exit_status')} for row in rows
    ]
    _write_table(file, linked)


def _riskiest(out: Path, drives: Iterable[str]) -> list[dict[str, Any]]:
    """Return the rows of all reviews with the largest risk, those first."""
    found: list[tuple[float, dict[str, Any]]] = []
    for drive in drives:
        try:
            text = read_text(out / drive / REVIEW)
        except OSError:  # the drive has failed
            continue
        for row in csv.DictReader(text.splitlines()):
            try:
                found.append((float(row[RISK]), {'drive': drive, **row}))
            except (KeyError, TypeError, ValueError):
                continue  # a review without this column has no order
    found.sort(key=lambda item: -item[0])
    return [row for _, row in found[:MAX_LISTED_TRACKS]]


def _write_table(file: TextIO, rows: Sequence[dict[str, Any]]) -> None:
    names = list(rows[0]) if rows else []
    file.write('<table><tr>' + ''.join(f'<th>{escape(str(name))}' for name in names) + '</tr>')
    for row in rows:
        kind = ' class="failed"' if row.get('status') == 'failed' else ''
        cells = ''.join(f'<td>{_cell(name, row.get(name, ""))}' for name in names)
        file.write(f'<tr{kind}>{cells}</tr>')
    file.write('</table>')


def _cell(name: str, value: Any) -> str:
    text = escape(str(value))
    return f'<a href="{quote(str(value))}/">{text}</a>' if name == 'drive' else text
