"""The results over all drives of `boxreg batch`: index, summary and report, of shards or all."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
import csv
from io import StringIO
import json
from pathlib import Path
import re
from typing import Any

from boxreg_ros import __version__
from boxreg_ros.errors import RecordingError
from boxreg_ros.io.storage.urls import names_of, read_text, url_of
from boxreg_ros.io.whole_files import written_whole
from boxreg_ros.offline.batch_report import write_batch_report
from boxreg_ros.offline.job import Job, JOB_FAILED
from boxreg_ros.offline.result_folder import SUMMARY

COUNTS = ('sweeps', 'boxes_in', 'refined', 'kept', 'damages')
INDEX_COLUMNS = (
    'drive', 'status', 'exit_status', 'attempts', 'seconds', 'peak_mb', *COUNTS, 'last_line',
    'key',
)  # fmt: skip
SHARD_INDEX = re.compile(r'index\.(\d+)-of-(\d+)\.csv')


def row_of(job: Job) -> dict[str, Any]:
    """Return the row of a job in the index."""
    status = job.summary.get('status', {})
    return {
        'drive': job.name,
        'status': job.status,
        'exit_status': '' if job.exit_status is None else job.exit_status,
        'attempts': job.attempts,
        'seconds': round(job.seconds, 1),
        'peak_mb': round(job.peak_bytes / 1e6),
        'sweeps': job.summary.get('sweeps', 0),
        'boxes_in': job.summary.get('boxes_in', 0),
        'refined': status.get('refined', 0),
        'kept': status.get('kept', 0),
        'damages': len(job.summary.get('damage', ())),
        'last_line': job.last_line,
        'key': job.key,
    }


def write_results(out: Path, rows: Sequence[dict[str, Any]], shard: str = '') -> None:
    """
    Write the index, the merged summary and the report over all drives.

    Parameters
    ----------
    out : Path
        Folder with the result folders.
    rows : sequence of dict
        As of `row_of`.
    shard : str
        Part of the file names, as in ``.1-of-8``; empty for all drives.

    """
    with written_whole(out / f'index{shard}.csv') as file:
        writer = csv.DictWriter(file, INDEX_COLUMNS, lineterminator='\n')
        writer.writeheader()
        writer.writerows(rows)
    merged = {
        'drives': len(rows),
        'done': sum(row['status'] != JOB_FAILED for row in rows),
        **{name: sum(int(row[name]) for row in rows) for name in COUNTS},
        'seconds': round(sum(float(row['seconds']) for row in rows), 1),
        'peak_mb': max((int(row['peak_mb']) for row in rows), default=0),
        'version': __version__,
        'failed': {row['drive']: row['last_line'] for row in rows if row['status'] == JOB_FAILED},
    }
    stem, suffix = SUMMARY.split('.')
    with written_whole(out / f'{stem}{shard}.{suffix}') as file:
        file.write(json.dumps(merged, indent=2) + '\n')
    with written_whole(out / f'report{shard}.html') as file:
        write_batch_report(file, out, rows)


def rows_of_shards(out: Path) -> list[dict[str, Any]]:
    """
    Return the rows of the indexes of all shards, ordered by drive.

    Raises
    ------
    RecordingError
        If there are none, some are missing, or they are of different numbers of shards.

    """
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
        rows += csv.DictReader(StringIO(read_text(path)))
    return sorted(rows, key=lambda row: str(row['drive']))


def _listed(numbers: Iterable[int]) -> str:
    return ', '.join(map(str, sorted(numbers))) or 'none'
