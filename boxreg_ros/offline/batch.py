"""
`boxreg batch`: `boxreg relabel` for each of many drives, on workers of Dask.

A drive is done, and not done again, if its result folder is whole and was made by the same request
from the same files. The workers are processes of this machine or those of a cluster; without Dask
one drive is relabelled after another.

"""

from __future__ import annotations

import argparse
from collections.abc import Collection, Sequence
from dataclasses import fields
from itertools import chain
from pathlib import Path
import sys

from boxreg_ros.errors import ConfigError, RecordingError
from boxreg_ros.io.storage.urls import url_of
from boxreg_ros.io.whole_files import written_whole
from boxreg_ros.offline.arguments import (
    add_options,
    add_recordings,
    config_from,
    Settings,
    values_of,
    words_of,
)
from boxreg_ros.offline.batch_results import Result, UP_TO_DATE, write_results
from boxreg_ros.offline.fleet import relabelled_drives
from boxreg_ros.offline.job import Job, jobs_of, LEARNING
from boxreg_ros.offline.relabel_command import Demands
from boxreg_ros.offline.request import Request
from boxreg_ros.offline.result_folder import earlier_summary, has_changed, INPUT_MODEL, writing
from boxreg_ros.review.decisions import DECISIONS
from boxreg_ros.review.folders import newest_of

DRIVE = '{drive}'
"""Stands for the name of the drive in the options of a batch."""
DRIVE_SETTINGS = tuple(one.name for one in fields(Settings) if one.name != 'workers')
"""Options of `Settings` that a drive takes; ``--workers`` is the number of drives here."""


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
    where = parser.add_mutually_exclusive_group()
    where.add_argument(
        '--workers', type=int, metavar='N', dest='processes',
        help='drives that are relabelled at a time, each in a process on one core (default: one '
        'for each core; without Dask 1)',
    )  # fmt: skip
    where.add_argument(
        '--address', metavar='SCHEDULER',
        help='scheduler of a Dask cluster, as in tcp://10.0.0.1:8786, whose workers see the files '
        'under the same paths',
    )  # fmt: skip
    parser.add_argument(
        '--learn', action='store_true',
        help='relabel every drive twice: first into OUT/learning, then beginning with what all '
        'drives have shown of their detector, OUT/input_model.json',
    )  # fmt: skip


def run(args: argparse.Namespace) -> int:
    """Relabel all drives that are not done; return 1 if one has failed."""
    _check(args)
    with writing(args.out):
        if earlier_summary(args.out) is not None:
            raise RecordingError(
                f'output {str(args.out)!r}: expected a folder for all drives, got the result of '
                f'one, whose summary and report would be lost; choose another with -o'
            )
        jobs = jobs_of(args.recordings)
        if not jobs:
            raise ConfigError(
                'RECORDING: expected at least one drive, got none; see boxreg batch -h'
            )
        if args.decisions and len(jobs) > 1 and DRIVE not in str(args.decisions):
            raise ConfigError(
                f'--decisions: expected {DRIVE} in the path, a file for each drive, got '
                f'{str(args.decisions)!r}: the same ids are of other objects in other drives'
            )
        out = args.out if url_of(args.out) else args.out.absolute()
        if args.learn:
            args.input_model = (*args.input_model, _learnt(jobs, out, args))
        results = _results(jobs, out, args)
        write_results(out, [vars(result) for result in results])
    done = sum(result.is_done for result in results)
    skipped = sum(result.status == UP_TO_DATE for result in results)
    print(f'{args.out}: {done:,} of {len(jobs):,} drives done, {skipped:,} of them earlier')
    for result in results if url_of(out) is None else ():
        if result.status == UP_TO_DATE and has_changed(out / result.drive / DECISIONS):
            print(f'boxreg: {result.drive}: {_unwritten(out / result.drive)}', file=sys.stderr)
    others = _other_results(out, {job.name for job in jobs})
    if others:
        print(
            f'{others:,} other results in this folder are not in index.csv, summary.json and '
            f'report.html, which are of the drives of this call: give all to have them there'
        )
    return 0 if done == len(jobs) else 1


def _unwritten(out: Path) -> str:
    """Return where the labels with the decisions that were made on a result are."""
    newest = newest_of(out)
    if newest != out:
        return f'the labels with the decisions of its review are in {newest}'
    return f'its labels do not have the decisions of its review: boxreg review {out}, Ctrl-S'


def _other_results(out: Path, names: Collection[str]) -> int:
    """Return how many results of other calls are in a folder; 0 of a URL, which is not listed."""
    folders = out.iterdir() if url_of(out) is None else ()
    # `boxreg review` writes NAME.corrected beside a result.
    others = (path for path in folders if path.name.partition('.corrected')[0] not in names)
    return sum(earlier_summary(path) is not None for path in others)


def _check(args: argparse.Namespace) -> None:
    """Refuse wrong options before any drive is begun."""
    if args.processes is not None and args.processes < 1:
        raise ConfigError(f'--workers: expected 1 or more, got {args.processes}')
    if args.learn and url_of(args.out) is not None:
        raise ConfigError(
            '--learn: expected an output on this machine, got a URL; run boxreg batch here '
            'first, and give its input_model.json files to --input-model'
        )
    # Options that cannot work together are refused; the workers need the packages of the report.
    Request((), config=config_from(args), **values_of(args, Request) | {'report': False})


def _results(jobs: Sequence[Job], out: Path, args: argparse.Namespace) -> list[Result]:
    """Relabel the drives, show the progress and those that fail, and return their results."""
    from tqdm import tqdm

    options = options_of_drives(args)
    todo = [job for job in jobs if not job.problem]
    todo.sort(key=Job.size, reverse=True)  # no large drive is left to the end
    commands = {job.name: _words(job, out, options) for job in todo}
    ended = relabelled_drives(commands, args.processes, args.address)
    impossible = [Result(job.name, last_line=job.problem) for job in jobs if job.problem]
    found: dict[str, Result] = {}
    failed = 0
    is_hidden = not sys.stderr.isatty()
    with tqdm(total=len(jobs), unit='drive', disable=is_hidden, leave=False) as bar:
        for result in chain(impossible, ended):
            if not result.is_done:
                failed += 1
                bar.write(f'boxreg: {result.drive}: {result.last_line}', file=sys.stderr)
            found[result.drive] = result
            bar.update()
            bar.set_postfix_str(f'{failed} failed')
    others = iter(impossible)
    return [next(others) if job.problem else found[job.name] for job in jobs]


def options_of_drives(args: argparse.Namespace) -> list[str]:
    """Return the options of `boxreg relabel` for every drive."""
    options = [*words_of(args, Request), *words_of(args, Settings, *DRIVE_SETTINGS)]
    return [*options, *words_of(args, Demands), '--workers=1']  # the drives share the cores


def _words(job: Job, out: Path, options: Sequence[str]) -> list[str]:
    """Return the arguments of `boxreg relabel` for a drive."""
    own = [word.replace(DRIVE, job.name) for word in options]
    return [*map(str, job.recordings), '-o', str(out / job.name), *own]


def _learnt(jobs: Sequence[Job], out: Path, args: argparse.Namespace) -> Path:
    """Relabel all drives once, and return the file of what they have shown together."""
    from boxreg_ros.core.input_statistics import to_text
    from boxreg_ros.io.input_models import read_models

    first = argparse.Namespace(**vars(args) | {'report': False, 'formats': ('csv',)})
    results = _results(jobs, out / LEARNING, first)
    models = [out / LEARNING / one.drive / INPUT_MODEL for one in results if one.is_done]
    text = to_text(read_models(models))
    together = out / INPUT_MODEL
    # Unchanged, it stays as it is: it belongs to what decides whether a drive is done.
    if not together.exists() or together.read_text(encoding='utf-8') != text:
        with written_whole(together) as file:
            file.write(text)
    return together
