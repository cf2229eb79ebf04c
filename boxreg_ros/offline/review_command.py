"""`boxreg review`: its command line. A recording is relabelled before it is looked at."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from functools import partial
import json
import os
from pathlib import Path
import subprocess
import sys
from typing import NoReturn

from boxreg_ros.config import Config
from boxreg_ros.errors import RecordingError
from boxreg_ros.io.recording import Recording
from boxreg_ros.io.steps import PROGRESS
from boxreg_ros.io.storage.files import METADATA
from boxreg_ros.offline import relabel_command
from boxreg_ros.offline.arguments import (
    add_options,
    request_from,
    Settings,
    values_of,
    words_of,
)
from boxreg_ros.offline.relabel_command import arguments_of
from boxreg_ros.offline.request import NO_TOPIC, Request
from boxreg_ros.offline.result_folder import CONFIG, SUMMARY, whole_summary
from boxreg_ros.offline.sources import scene_address, source_of
from boxreg_ros.review.folders import newest_of
from boxreg_ros.review.scene import DriveSource
from boxreg_ros.review.server import add_server_arguments, classes_of, serve
from msg_adapters import ADAPTERS


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `boxreg review`."""
    parser.add_argument(
        'paths', type=Path, nargs='+', metavar='OUT|RECORDING',
        help='results of boxreg relabel --report, or recordings of one drive: these are '
        'relabelled into --out first; one that has clouds only begins with proposals',
    )  # fmt: skip
    parser.add_argument(
        '--progress', action='store_true',
        help='print how far the review of each result is, and the agreement of people, and end',
    )  # fmt: skip
    parser.add_argument(
        '-o', '--out', type=Path,
        help='with recordings: result folder, as of boxreg relabel (default: the name of the '
        'first one in this folder, with .labels)',
    )  # fmt: skip
    add_server_arguments(parser)
    add_options(parser, Request)
    add_options(parser, Settings)


def run(args: argparse.Namespace) -> int:
    """Serve a result until interrupted; return the status of a run that fails before."""
    if args.progress:
        return _print_progress([newest_of(out) for out in args.paths])
    out = args.out or _out_of(args.paths)
    if out is None:
        return _serve([_newest(path) for path in args.paths], args)
    words = [
        *(*map(str, args.paths), '-o', str(out), '--report'),
        *words_of(args, Request),
        *words_of(args, Settings),
        *(('--boxes', NO_TOPIC, '--proposals') if _has_no_boxes(args) else ()),
    ]
    request = request_from(arguments_of(words))
    if whole_summary(out, request.fingerprint()) is None:  # else it may have been reviewed
        command = [sys.executable, '-m', 'boxreg_ros.cli', 'relabel', *words]
        # This program goes on, not the person.
        environment = {**os.environ, PROGRESS: os.devnull}
        done = subprocess.run(command, check=False, env=environment)
        if done.returncode:
            return done.returncode
    else:
        print(f'{out}: up to date', flush=True)
    return _serve([_newest(out)], args)


def _newest(out: Path) -> Path:
    """Return the result that a review goes on in, and say where it is another folder."""
    newest = newest_of(out)
    if newest != out:
        print(
            f'{out}: goes on in {newest}, which was written from it with all of its decisions; '
            f'to open {out.name} itself, rename {newest.name}',
            file=sys.stderr,  # the first line of the output is the address
        )
    return newest


def _out_of(paths: Sequence[Path]) -> Path | None:
    """Return the folder for the results of recordings; None for paths that are results."""
    first = paths[0]
    if first.is_file() or (first / METADATA).is_file():
        return Path(f'{first.stem}.labels')
    return None


def _has_no_boxes(args: argparse.Namespace) -> bool:
    """Return whether recordings have clouds only, and no label files are given."""
    values = values_of(args, Request)
    if values['boxes'] or values['labels'] or scene_address(args.paths):
        return bool(values['boxes'] == NO_TOPIC)
    recording = Recording(args.paths, values['lidars'])
    recording.has_boxes = False
    with recording:
        return ADAPTERS.keys().isdisjoint(recording.topics.values())


def _serve(outs: Sequence[Path], args: argparse.Namespace) -> int:
    results = [(out, drive_of(out) if (out / SUMMARY).is_file() else None) for out in outs]
    return serve(results, args.port, args.who, args.opens, classes_of(args.classes))


def _print_progress(outs: Sequence[Path]) -> int:
    from boxreg_ros.review.progress import progress_lines, progress_of

    print('\n'.join(progress_lines([progress_of(out) for out in outs])))
    return 0


def drive_of(out: Path) -> DriveSource | None:
    """Return the recording of a result; None for a result that no command has made."""
    summary = json.loads((out / SUMMARY).read_bytes())
    command, folder = summary.get('command', []), Path(summary.get('folder', '.'))
    if command[:1] != ['relabel']:
        return None
    parser = _Parser()
    relabel_command.add_arguments(parser)
    args = parser.parse_args([*command[1:], '-o', str(out)])
    values = values_of(args, Request) | {'report': False}  # it is written
    if values['labels'] is not None:
        name, path = values['labels']
        values['labels'] = name, _within(folder, path)
    request = Request(tuple(_within(folder, path) for path in args.recordings), **values)
    config = Config.from_yaml(out / CONFIG)
    return DriveSource(
        partial(source_of, request), request.convention, summary['fixed_frame'], config, _titles,
        tuple(request.formats),
    )  # fmt: skip


def _titles() -> dict[str, str]:
    """Return the label formats with their titles."""
    from boxreg_ros.offline.formats import rows

    return {name: title for name, title, *_ in rows()}


class _Parser(argparse.ArgumentParser):
    """Refuse the command of a result that another version has made."""

    def error(self, message: str) -> NoReturn:
        """Raise RecordingError."""
        raise RecordingError(
            f'{SUMMARY}: expected a command of this version, got another one ({message}); make '
            f'the result again with boxreg relabel RECORDING -o NEW --report'
        )


def _within(folder: Path, path: Path) -> Path:
    """Return a path relative to the folder of the command; addresses of data sets as they are."""
    return folder / path if (folder / path).exists() else path
