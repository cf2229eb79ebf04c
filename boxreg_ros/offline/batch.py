"""
`boxreg batch`: one `boxreg relabel` per drive, several at a time, each in a process of its own.

A drive that is done is not done again: its job has a key, the hash of its files' content, the
options and the version.

"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import as_completed, ThreadPoolExecutor
import csv
from dataclasses import dataclass, field
from glob import glob
import hashlib
import json
import os
from pathlib import Path
import shlex
import shutil
import subprocess
import sys
import time
from typing import Any

from boxreg_ros import __version__
from boxreg_ros.errors import ConfigError
from boxreg_ros.io.whole_files import written_whole
from boxreg_ros.offline.arguments import add_recording_arguments, config_from, lidar_options
from boxreg_ros.offline.batch_report import write_batch_report
from boxreg_ros.offline.result_folder import earlier_summary, SUMMARY

DONE = 0
FAILED = 1
JOBS = 'jobs'
"""Folder with the key and the log of each job."""
MANIFESTS = ('.txt', '.lst')
Process = subprocess.Popen[bytes]
INDEX_COLUMNS = (
    'drive', 'status', 'exit_status', 'attempts', 'seconds', 'sweeps', 'boxes_in', 'refined',
    'kept', 'damages', 'last_line', 'key',
)  # fmt: skip
END_SECONDS = 10.0
"""Time that a job has to remove its files after SIGTERM [s]; then it is killed."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `boxreg batch`."""
    add_recording_arguments(
        parser, 'each is one drive; also a pattern in quotes, or a .txt or .lst file of drives'
    )
    parser.add_argument(
        '-o', '--out', type=Path, required=True, help='folder with one result folder per drive'
    )
    parser.add_argument(
        '--workers', type=int, default=1, metavar='N',
        help='drives that are relabelled at a time, each on one core (default: %(default)s)',
    )  # fmt: skip
    parser.add_argument(
        '--formats', default='csv', metavar='NAME,...',
        help='label formats to write, see `boxreg formats` (default: %(default)s)',
    )  # fmt: skip
    parser.add_argument('--report', action='store_true', help='write report.html for each drive')
    parser.add_argument(
        '--strict', action='store_true', help='a drive that cannot be read completely has failed'
    )
    parser.add_argument(
        '--shard', type=_shard, default=(1, 1), metavar='I/N',
        help='do only every N-th drive, beginning with the I-th: one part per machine',
    )  # fmt: skip
    parser.add_argument(
        '--timeout', type=float, metavar='S', help='longest time for one drive [s] (default: none)'
    )
    parser.add_argument(
        '--retries', type=int, default=1, metavar='N',
        help='how often a drive whose process was killed is tried again (default: %(default)s)',
    )  # fmt: skip


@dataclass
class Job:
    """
    One drive.

    Attributes
    ----------
    name : str
        Name of its result folder.
    recordings : tuple of Path
        Files or folders, merged by time.
    key : str
        Hash of the content of its files, the options and the version.

    """

    name: str
    recordings: tuple[Path, ...]
    key: str = ''
    status: str = 'waiting'
    exit_status: int | None = None
    attempts: int = 0
    seconds: float = 0.0
    last_line: str = ''
    summary: dict[str, Any] = field(default_factory=dict)

    def files(self) -> Iterator[Path]:
        """Yield all files of the recordings."""
        for path in self.recordings:
            inner = sorted(path.iterdir()) if path.is_dir() else [path]
            yield from (file for file in inner if file.is_file())

    def size(self) -> int:
        """Return the size of all files [bytes]."""
        return sum(file.stat().st_size for file in self.files())

    def row(self) -> dict[str, Any]:
        """Return the row of the job in the index."""
        status = self.summary.get('status', {})
        return {
            'drive': self.name,
            'status': self.status,
            'exit_status': '' if self.exit_status is None else self.exit_status,
            'attempts': self.attempts,
            'seconds': round(self.seconds, 1),
            'sweeps': self.summary.get('sweeps', 0),
            'boxes_in': self.summary.get('boxes_in', 0),
            'refined': status.get('refined', 0),
            'kept': status.get('kept', 0),
            'damages': len(self.summary.get('damage', ())),
            'last_line': self.last_line,
            'key': self.key,
        }


def run(args: argparse.Namespace) -> int:
    """Relabel all drives that are not done; return 1 if one has failed."""
    if args.workers < 1 or args.retries < 0:
        raise ConfigError(
            f'workers and retries: expected 1 and 0 or more, got {args.workers} and {args.retries}'
        )
    config_from(args)  # refuses wrong settings before any drive is begun
    index, count = args.shard
    jobs = jobs_of(args.recordings)[index - 1 :: count]
    options = _options(args)
    folder = args.out / JOBS
    folder.mkdir(parents=True, exist_ok=True)
    from tqdm import tqdm

    total = sum(job.size() for job in jobs)
    is_hidden = not sys.stderr.isatty()
    with tqdm(total=total, unit='B', unit_scale=True, disable=is_hidden, leave=False) as bar:
        for job in _run_all(jobs, options, args):
            bar.update(job.size())
            failed = sum(job.status == 'failed' for job in jobs)
            bar.set_postfix_str(f'{failed} failed')
            if job.status == 'failed':
                bar.write(f'boxreg: {job.name}: {job.last_line}', file=sys.stderr)
    shard = '' if count == 1 else f'.{index}-of-{count}'
    _write_results(args.out, jobs, shard)
    done = sum(job.status != 'failed' for job in jobs)
    skipped = sum(job.status == 'up to date' for job in jobs)
    print(f'{args.out}: {done:,} of {len(jobs):,} drives done, {skipped:,} of them earlier')
    return DONE if done == len(jobs) else FAILED


def jobs_of(arguments: Sequence[Path]) -> list[Job]:
    """
    Return one job per drive of recordings, patterns and manifests.

    A manifest is a text file with one drive per line: its recordings, merged by time. Relative
    paths begin at the manifest; ``#`` begins a comment.

    Raises
    ------
    ConfigError
        If a recording does not exist or is named twice; the message has all of them.

    """
    drives: list[tuple[Path, ...]] = []
    for argument in arguments:
        if argument.suffix in MANIFESTS and argument.is_file():
            drives += _manifest(argument)
        elif not argument.exists() and glob(str(argument)):
            drives += [(Path(path),) for path in sorted(glob(str(argument)))]
        else:
            drives.append((argument,))
    problems = list(_problems(drives))
    if problems:
        raise ConfigError('; '.join(problems))
    return [Job(name, drive) for name, drive in zip(_names(drives), drives, strict=True)]


def _manifest(path: Path) -> Iterator[tuple[Path, ...]]:
    for line in path.read_text(encoding='utf-8').splitlines():
        words = shlex.split(line, comments=True)
        if words:
            yield tuple(path.parent / word for word in words)


def _problems(drives: Iterable[tuple[Path, ...]]) -> Iterator[str]:
    seen: set[Path] = set()
    for path in (path for drive in drives for path in drive):
        if not path.exists():
            yield f'{path}: expected a recording, got no such file'
        elif path.resolve() in seen:
            yield f'{path}: expected each drive once, got it twice'
        seen.add(path.resolve())


def _names(drives: Sequence[tuple[Path, ...]]) -> list[str]:
    """Return a name for each drive: the stem of its first path, with its folders if needed."""
    stems = [drive[0].stem for drive in drives]
    if len(set(stems)) == len(stems):
        return stems
    paths = [str(drive[0].resolve().with_suffix('')) for drive in drives]
    common = os.path.commonpath(paths)
    return [os.path.relpath(path, common).replace(os.sep, '_') for path in paths]


def _options(args: argparse.Namespace) -> list[str]:
    """Return the options of `boxreg relabel` for every drive."""
    options = ['--formats', args.formats, *lidar_options(args)]
    for name in ('boxes', 'odometry', 'pose_reference', 'size_order', 'forward_axis'):
        value = getattr(args, name)
        if value is not None:
            options.append(f'--{name.replace("_", "-")}={value}')
    if args.config is not None:
        options.append(f'--config={args.config}')
    options += [f'--set={key}={json.dumps(value)}' for key, value in args.set]
    options += [f'--{name}' for name in ('report', 'strict') if getattr(args, name)]
    return options


def _run_all(jobs: list[Job], options: list[str], args: argparse.Namespace) -> Iterator[Job]:
    """Run the jobs, `args.workers` at a time; yield each when it has ended."""
    running: set[Process] = set()
    with ThreadPoolExecutor(args.workers) as pool:
        futures = [pool.submit(_run_job, job, options, args, running) for job in jobs]
        try:
            for future in as_completed(futures):
                yield future.result()
        except BaseException:  # a signal to this process, too
            pool.shutdown(wait=False, cancel_futures=True)
            for process in list(running):
                process.terminate()
            raise


def _run_job(job: Job, options: list[str], args: argparse.Namespace, running: set[Process]) -> Job:
    """Relabel a drive if it is not done."""
    state = args.out / JOBS / f'{job.name}.json'
    result = args.out / job.name
    earlier = _read_state(state)
    settings = [*options, str(config_from(args))]
    try:
        hashes = _hashes(job, earlier)
    except OSError as error:
        job.status, job.last_line = 'failed', str(error)
        return job
    key = repr((__version__, settings, [found[-1] for found in hashes]))
    job.key = hashlib.sha256(key.encode()).hexdigest()
    if earlier.get('key') == job.key and earlier_summary(result) is not None:
        job.status, job.exit_status = 'up to date', DONE
    else:
        _attempt(job, options, args, running)
    job.summary = earlier_summary(result) or {}
    if job.status != 'failed':
        with written_whole(state) as file:
            file.write(json.dumps({'key': job.key, 'files': hashes}, indent=2))
    return job


def _attempt(
    job: Job, options: list[str], args: argparse.Namespace, running: set[Process]
) -> None:
    """Run the process of a job until it ends by itself, or its retries are used up."""
    command = [sys.executable, '-m', 'boxreg_ros.cli', 'relabel', *map(str, job.recordings)]
    command += ['-o', str(args.out / job.name), *options]
    if args.workers > 1:
        command.append('--workers=1')  # the drives share the cores; results are the same
    log = args.out / JOBS / f'{job.name}.log'
    begun = time.monotonic()
    while job.attempts <= args.retries:
        for remains in args.out.glob(f'.{job.name}.*.partial'):  # of a process that was killed
            shutil.rmtree(remains, ignore_errors=True)
        job.attempts += 1
        with log.open('wb') as file:
            process = subprocess.Popen(command, stdout=file, stderr=subprocess.STDOUT)
            running.add(process)
            is_late = _wait(process, args.timeout)
            running.discard(process)
        job.exit_status = process.returncode
        lines = log.read_text(encoding='utf-8', errors='replace').strip().splitlines()
        last_line = lines[-1] if lines else f'ended with status {process.returncode}'
        job.last_line = last_line.removeprefix('boxreg: ')
        if is_late:
            job.last_line = f'not done after {args.timeout:g} s: raise --timeout'
        if process.returncode >= 0 or is_late:  # neither changes when it is tried again
            break
        job.last_line = (
            f'its process was killed by signal {-process.returncode}; the most frequent cause is '
            f'too little memory: use fewer --workers'
        )
    job.seconds = time.monotonic() - begun
    job.status = 'done' if job.exit_status == DONE else 'failed'


def _wait(process: Process, timeout: float | None) -> bool:
    """Wait for a process; end it after `timeout` [s], and return whether that was needed."""
    try:
        process.wait(timeout)
        return False
    except subprocess.TimeoutExpired:
        process.terminate()
    try:
        process.wait(END_SECONDS)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    return True


def _hashes(job: Job, earlier: dict[str, Any]) -> list[list[Any]]:
    """Return path, size, time and hash of each file; unchanged ones are not read again."""
    known = {tuple(found[:3]): found[3] for found in earlier.get('files', [])}
    hashes = []
    for file in job.files():
        about = file.stat()
        place = str(file.resolve()), about.st_size, about.st_mtime_ns
        hashes.append([*place, known.get(place) or _hash(file)])
    return hashes


def _hash(path: Path) -> str:
    with path.open('rb') as file:
        return hashlib.file_digest(file, 'sha256').hexdigest()


def _read_state(path: Path) -> dict[str, Any]:
    try:
        state = json.loads(path.read_text(encoding='utf-8'))
    except (OSError, ValueError):
        return {}
    return state if isinstance(state, dict) else {}


def _write_results(out: Path, jobs: list[Job], shard: str) -> None:
    """Write the index, the merged summary and the report over all drives."""
    rows = [job.row() for job in jobs]
    with written_whole(out / f'index{shard}.csv') as file:
        writer = csv.DictWriter(file, INDEX_COLUMNS, lineterminator='\n')
        writer.writeheader()
        writer.writerows(rows)
    totals = {
        name: sum(row[name] for row in rows)
        for name in ('sweeps', 'boxes_in', 'refined', 'kept', 'damages', 'seconds')
    }
    merged = {
        'drives': len(rows),
        'done': sum(row['status'] != 'failed' for row in rows),
        **totals,
        'version': __version__,
        'failed': {row['drive']: row['last_line'] for row in rows if row['status'] == 'failed'},
    }
    stem, suffix = SUMMARY.split('.')
    with written_whole(out / f'{stem}{shard}.{suffix}') as file:
        file.write(json.dumps(merged, indent=2) + '\n')
    with written_whole(out / f'report{shard}.html') as file:
        write_batch_report(file, out, rows)


def _shard(text: str) -> tuple[int, int]:
    """Return I and N of ``I/N``."""
    index, slash, count = text.partition('/')
    if not (slash and index.isdecimal() and count.isdecimal() and 1 <= int(index) <= int(count)):
        raise argparse.ArgumentTypeError(f'expected I/N with 1 <= I <= N, got {text!r}')
    return int(index), int(count)
