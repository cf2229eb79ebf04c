"""
`boxreg batch`: one `boxreg relabel` per drive, several at a time, each in a process of its own.

A drive that is done is not done again: its job has a key, the hash of its files' content, the
options and the version. The jobs run on this machine or on a Ray cluster; several machines
without Ray do one shard each.

"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import as_completed, ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import fields, replace
from math import inf
from pathlib import Path
import sys
from typing import Any

from boxreg_ros.config import Config
from boxreg_ros.errors import ConfigError, RecordingError
from boxreg_ros.io.storage.urls import url_of
from boxreg_ros.io.whole_files import written_whole
from boxreg_ros.offline.arguments import add_options, add_recordings, Settings, values_of, words_of
from boxreg_ros.offline.batch_results import (
    DRIVE_FAILED,
    Result,
    rows_of_shards,
    UP_TO_DATE,
    write_results,
)
from boxreg_ros.offline.job import Job, jobs_of, LEARNING
from boxreg_ros.offline.job_process import JobRunner, read_states
from boxreg_ros.offline.relabel_command import Demands
from boxreg_ros.offline.request import Request
from boxreg_ros.offline.result_folder import alone, earlier_summary, INPUT_MODEL, writing

ENGINES = ('local', 'ray')
DRIVE_TIMEOUT = 1800.0
"""Chosen: the longest step, the last windows of a drive of an hour, takes some minutes [s]."""
MEMORY = 2.0
"""Three times the memory measured for 150,000 points (docs/results/speed.md#scale) [GB]."""
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
    parser.add_argument(
        '--learn', action='store_true',
        help='relabel every drive twice: first into OUT/learning, then beginning with what all '
        'drives have shown of their detector, OUT/input_model.json',
    )  # fmt: skip
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
        '--timeout', type=float, default=DRIVE_TIMEOUT, metavar='S',
        help='longest time of a drive without progress [s] (default: %(default)g)',
    )  # fmt: skip
    parser.add_argument(
        '--memory', type=float, default=MEMORY, metavar='GB',
        help='largest memory of a drive [GB] (default: %(default)g)',
    )  # fmt: skip
    parser.add_argument(
        '--retries', type=int, default=1, metavar='N',
        help='how often a drive whose process was killed is tried again (default: %(default)s)',
    )  # fmt: skip


def run(args: argparse.Namespace) -> int:
    """Relabel all drives that are not done; return 1 if one has failed."""
    index, count = args.shard
    part = '' if count == 1 or args.merge else f'.{index}-of-{count}'
    with writing(args.out):
        jobs: list[Job] = []
        rows: list[dict[str, Any]] = []
        if args.merge:
            rows = rows_of_shards(args.out)
        else:
            _check(args)
            if earlier_summary(args.out) is not None:
                raise RecordingError(
                    f'output {str(args.out)!r}: expected a folder for all drives, got the result '
                    f'of one, whose summary and report would be lost; choose another with -o'
                )
            known = {name: one['recordings'] for name, one in read_states(args.out).items()}
            drives = jobs_of(args.recordings, known)
            if not drives:
                raise ConfigError(
                    'RECORDING: expected at least one drive, got none; see boxreg batch -h'
                )
            jobs = drives[index - 1 :: count]
        with alone(args.out / f'.index{part}.lock', f'output {str(args.out)!r}'):
            if args.learn and jobs:
                args.input_model = (*args.input_model, _learnt(jobs, args))
            rows += [vars(result) for result in _results(jobs, args)]
            write_results(args.out, rows, part)
    done = sum(row['status'] != DRIVE_FAILED for row in rows)
    skipped = sum(row['status'] == UP_TO_DATE for row in rows)
    print(f'{args.out}: {done:,} of {len(rows):,} drives done, {skipped:,} of them earlier')
    return 0 if done == len(rows) else 1


def _check(args: argparse.Namespace) -> None:
    """Refuse wrong options before any drive is begun."""
    if args.workers < 1 or args.retries < 0:
        raise ConfigError(
            f'workers and retries: expected 1 and 0 or more, got {args.workers} and {args.retries}'
        )
    if not (args.timeout > 0 and 0 < args.memory < inf):
        raise ConfigError(
            f'timeout and memory: expected more than 0, and a number of GB, got '
            f'{args.timeout:g} and {args.memory:g}'
        )
    if args.learn and (args.shard != (1, 1) or url_of(args.out) is not None):
        raise ConfigError(
            '--learn: expected all drives in one folder of this machine, got --shard or a URL; '
            'run boxreg batch there first, and give its input_model.json files to --input-model'
        )
    if args.address is not None and args.engine != 'ray':
        raise ConfigError(
            '--address: expected with --engine ray, got it without; add --engine ray'
        )
    _request(args)  # refuses options that cannot work together


def _request(args: argparse.Namespace) -> Request:
    """Return the request of all drives, without their recordings."""
    options = values_of(args, Request) | {'report': False}  # to check that imports torch
    return Request((), config=_config(args), **options)


def _config(args: argparse.Namespace) -> Config:
    """Return the settings of all drives."""
    return replace(Settings(**values_of(args, Settings)), workers=None).effective()


def _results(jobs: Sequence[Job], args: argparse.Namespace) -> list[Result]:
    """Run all jobs, show the progress and the jobs that fail, and return their results."""
    from tqdm import tqdm

    if not jobs:
        return []
    with ThreadPoolExecutor(REQUESTS) as pool:
        sizes = dict(zip(jobs, pool.map(Job.size, jobs), strict=True))
    by_size = sorted(jobs, key=lambda job: -sizes[job])  # no large one is left to the end
    runner = JobRunner(
        args.out if url_of(args.out) else args.out.absolute(),
        tuple(options_of_drives(args)),
        str(_config(args)),
        _request(args).inputs(),
        args.retries,
        args.timeout,
        round(args.memory * 1e9),
    )
    results = {}
    failed = 0
    is_hidden = not sys.stderr.isatty()
    with tqdm(total=len(jobs), unit='drive', disable=is_hidden, leave=False) as bar:
        for job, result in _ended(by_size, runner, args):
            results[job] = result
            if not result.is_done:
                failed += 1
                bar.write(f'boxreg: {job.name}: {result.last_line}', file=sys.stderr)
            bar.update()
            bar.set_postfix_str(f'{failed} failed')
    return [results[job] for job in jobs]


def _learnt(jobs: Sequence[Job], args: argparse.Namespace) -> Path:
    """Relabel all drives once, and return the file of what they have shown together."""
    from boxreg_ros.core.input_statistics import to_text
    from boxreg_ros.io.input_models import read_models

    first = argparse.Namespace(**vars(args) | {'out': args.out / LEARNING, 'report': False})
    first.formats = ('csv',)
    found = _results(jobs, first)
    done = [job.name for job, result in zip(jobs, found, strict=True) if result.is_done]
    together: Path = args.out / INPUT_MODEL
    drives = read_models([first.out / name / INPUT_MODEL for name in done])
    with written_whole(together) as file:
        file.write(to_text(drives))
    return together.absolute()


def _ended(
    jobs: Sequence[Job], runner: JobRunner, args: argparse.Namespace
) -> Iterator[tuple[Job, Result]]:
    """Run jobs, several at a time, and yield each with its result when it has ended."""
    start: Callable[[Job], Result] = runner
    workers, end = args.workers, runner.end
    with ExitStack() as cluster:
        if args.engine == 'ray':
            from boxreg_ros.offline.ray_engine import ray_engine

            start, workers, end = cluster.enter_context(ray_engine(runner, args.address))
        pool = cluster.enter_context(ThreadPoolExecutor(workers))
        futures = {pool.submit(start, job): job for job in jobs}
        try:
            for future in as_completed(futures):
                yield futures[future], future.result()
        except BaseException:  # a signal to this process, too
            pool.shutdown(wait=False, cancel_futures=True)
            end()
            raise


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
