"""
`boxreg batch`: one `boxreg relabel` per drive, several at a time, each in a process of its own.

A drive that is done is not done again: its job has a key, the hash of its files' content, the
options and the version. The jobs run on this machine or on a Ray cluster; several machines
without Ray do one shard each.

"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from concurrent.futures import as_completed, ThreadPoolExecutor
from dataclasses import fields, replace
from pathlib import Path
import sys
from typing import Any

from boxreg_ros.config import Config
from boxreg_ros.errors import ConfigError
from boxreg_ros.io.storage.urls import url_of
from boxreg_ros.offline.arguments import (
    add_options,
    add_recordings,
    Settings,
    values_of,
    words_of,
)
from boxreg_ros.offline.batch_results import row_of, rows_of_shards, write_results
from boxreg_ros.offline.job import Job, JOB_FAILED, jobs_of, UP_TO_DATE
from boxreg_ros.offline.job_process import JobRunner
from boxreg_ros.offline.relabel_command import Demands
from boxreg_ros.offline.request import Request
from boxreg_ros.offline.result_folder import writing

DONE = 0
FAILED = 1
ENGINES = ('local', 'ray')
DRIVE_SETTINGS = tuple(one.name for one in fields(Settings) if one.name != 'workers')
"""Options of `Settings` that a drive takes; ``--workers`` is the number of drives here."""
REQUESTS = 16
"""Sizes of files that are asked for at a time; chosen: servers answer each in some 0.1 s."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `boxreg batch`."""
    several = 'each is one drive; also a pattern in quotes, or a .txt or .lst file of drives'
    add_recordings(parser, several, '*')
    add_options(parser, Request, formats=('csv',))
    add_options(parser, Settings, *DRIVE_SETTINGS)
    add_options(parser, Demands)
    parser.add_argument(
        '-o', '--out', type=Path, required=True, help='folder with one result folder per drive'
    )
    parser.add_argument(
        '--workers', type=int, default=1, metavar='N',
        help='drives that are relabelled at a time, each on one core (default: %(default)s)',
    )  # fmt: skip
    _add_machine_arguments(parser)


def _add_machine_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of machines, and of drives that hang or are killed."""
    parser.add_argument(
        '--shard', type=_shard, default=(1, 1), metavar='I/N',
        help='do only every N-th drive, beginning with the I-th: one part per machine',
    )  # fmt: skip
    parser.add_argument(
        '--merge', action='store_true',
        help='write index.csv, summary.json and report.html over all shards in OUT, no drives',
    )  # fmt: skip
    parser.add_argument(
        '--engine', choices=ENGINES, default='local',
        help='run the jobs on this machine or on a Ray cluster (default: %(default)s)',
    )  # fmt: skip
    parser.add_argument(
        '--address', metavar='HOST:PORT',
        help='Ray cluster (default: the one that this machine belongs to, else a new local one)',
    )  # fmt: skip
    parser.add_argument(
        '--timeout', type=float, metavar='S', help='longest time for one drive [s] (default: none)'
    )
    parser.add_argument(
        '--retries', type=int, default=1, metavar='N',
        help='how often a drive whose process was killed is tried again (default: %(default)s)',
    )  # fmt: skip


def run(args: argparse.Namespace) -> int:
    """Relabel all drives that are not done; return 1 if one has failed."""
    if args.merge:
        rows = rows_of_shards(args.out)
        write_results(args.out, rows)
        return _ended(args.out, rows)
    _check(args)
    index, count = args.shard
    jobs = jobs_of(args.recordings)[index - 1 :: count]
    with writing(args.out):
        if url_of(args.out) is None:
            args.out.mkdir(parents=True, exist_ok=True)
        _run_all(jobs, args)
        rows = [row_of(job) for job in jobs]
        write_results(args.out, rows, '' if count == 1 else f'.{index}-of-{count}')
    return _ended(args.out, rows)


def _check(args: argparse.Namespace) -> None:
    """Refuse wrong options before any drive is begun."""
    if not args.recordings:
        raise ConfigError('RECORDING: expected at least one drive, got none; see boxreg batch -h')
    if args.workers < 1 or args.retries < 0:
        raise ConfigError(
            f'workers and retries: expected 1 and 0 or more, got {args.workers} and {args.retries}'
        )
    if args.address is not None and args.engine != 'ray':
        raise ConfigError(
            '--address: expected with --engine ray, got it without; add --engine ray'
        )
    options = values_of(args, Request) | {'report': False}  # to check that imports torch
    Request((), config=_config(args), **options)


def _config(args: argparse.Namespace) -> Config:
    """Return the settings of all drives."""
    return replace(Settings(**values_of(args, Settings)), workers=None).effective()


def _run_all(jobs: list[Job], args: argparse.Namespace) -> None:
    """Run all jobs, and show the progress and the jobs that fail."""
    from tqdm import tqdm

    waiting = [job for job in jobs if job.status != JOB_FAILED]
    with ThreadPoolExecutor(REQUESTS) as pool:
        list(pool.map(Job.measure, waiting))
    jobs = sorted(jobs, key=lambda job: -job.size)  # no large one is left to the end
    options = tuple(options_of_drives(args))
    runner = JobRunner(args.out, options, str(_config(args)), args.retries, args.timeout)
    total = sum(job.size for job in waiting)
    is_hidden = not sys.stderr.isatty()
    failed = 0
    with tqdm(total=total, unit='B', unit_scale=True, disable=is_hidden, leave=False) as bar:
        for job in _ended_jobs(jobs, runner, args):
            if job.status == JOB_FAILED:
                failed += 1
                bar.write(f'boxreg: {job.name}: {job.last_line}', file=sys.stderr)
            else:
                bar.update(job.size)
            bar.set_postfix_str(f'{failed} failed')


def _ended_jobs(jobs: list[Job], runner: JobRunner, args: argparse.Namespace) -> Iterator[Job]:
    """Yield each job when it has ended; in `jobs` it has its results."""
    if args.engine == 'ray':
        from boxreg_ros.offline.ray_engine import run_on_ray

        yield from run_on_ray(jobs, runner, args.address)
    else:
        yield from _run_locally(jobs, runner, args.workers)


def _run_locally(jobs: list[Job], runner: JobRunner, workers: int) -> Iterator[Job]:
    """Run the jobs, `workers` at a time."""
    with ThreadPoolExecutor(workers) as pool:
        futures = [pool.submit(runner, job) for job in jobs]
        try:
            for future in as_completed(futures):
                yield future.result()
        except BaseException:  # a signal to this process, too
            pool.shutdown(wait=False, cancel_futures=True)
            runner.end()
            raise


def _ended(out: Path, rows: Sequence[dict[str, Any]]) -> int:
    """Print how many drives are done, and return the exit status."""
    done = sum(row['status'] != JOB_FAILED for row in rows)
    skipped = sum(row['status'] == UP_TO_DATE for row in rows)
    print(f'{out}: {done:,} of {len(rows):,} drives done, {skipped:,} of them earlier')
    return DONE if done == len(rows) else FAILED


def options_of_drives(args: argparse.Namespace) -> list[str]:
    """Return the options of `boxreg relabel` for every drive."""
    options = words_of(args, Request) + words_of(args, Settings, *DRIVE_SETTINGS)
    options += words_of(args, Demands)
    return [*options, '--workers=1']  # the drives share the cores; results are the same


def _shard(text: str) -> tuple[int, int]:
    """Return I and N of ``I/N``."""
    index, slash, count = text.partition('/')
    if not (slash and index.isdecimal() and count.isdecimal() and 1 <= int(index) <= int(count)):
        raise argparse.ArgumentTypeError(f'expected I/N with 1 <= I <= N, got {text!r}')
    return int(index), int(count)
