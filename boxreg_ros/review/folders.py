"""The folders of a result and of the labels that are written from it, one after the other."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import count, takewhile
from pathlib import Path
import re

from boxreg_ros.review.decisions import DECISIONS

SUMMARY = 'summary.json'


def newest_of(out: Path) -> Path:
    """
    Return the result that was last written from one with all of its decisions, else itself.

    A result that was made again since counts as the newer one.

    """
    newest = out
    folders = _folders_after(out if out.name not in ('', '..') else out.resolve())
    for new in takewhile(_is_whole, folders) if _is_whole(out) else ():
        made_ns, earlier_ns = ((one / SUMMARY).stat().st_mtime_ns for one in (new, newest))
        if made_ns > earlier_ns and _decided_in(new).startswith(_decided_in(newest)):
            newest = new
    return newest


def next_folder(out: Path) -> Path:
    """Return the folder beside a result for the labels with its decisions; no other's is lost."""
    known = _decided_in(out)
    return next(
        new
        for new in _folders_after(out)
        if not (new / DECISIONS).exists() or known.startswith(_decided_in(new))
    )


def _folders_after(out: Path) -> Iterator[Path]:
    """Yield the folders beside a result for labels that are written from it, without end."""
    found = re.fullmatch(r'(.+)\.corrected(?:-(\d+))?', out.name)
    base, first = (found[1], int(found[2] or 1)) if found else (out.name, 0)
    for number in count(first + 1):
        yield out.with_name(f'{base}.corrected' + (f'-{number}' if number > 1 else ''))


def _is_whole(out: Path) -> bool:
    return (out / SUMMARY).is_file()


def _decided_in(out: Path) -> bytes:
    """Return the file of the decisions of a result; empty without one."""
    path = out / DECISIONS
    return path.read_bytes() if path.exists() else b''
