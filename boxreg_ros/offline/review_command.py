"""`boxreg review`: its command line. A recording is relabelled before it is looked at."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
import subprocess
import sys

from boxreg_ros.errors import ConfigError
from boxreg_ros.offline.arguments import add_options, Settings, words_of
from boxreg_ros.offline.request import Request
from boxreg_ros.offline.result_folder import SUMMARY
from boxreg_ros.offline.reviewed_drive import drive_of
from boxreg_ros.review.server import add_server_arguments, serve


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `boxreg review`."""
    parser.add_argument(
        'paths', type=Path, nargs='+', metavar='OUT|RECORDING',
        help='results of boxreg relabel --report, or recordings of one drive: these are '
        'relabelled into --out first',
    )  # fmt: skip
    parser.add_argument(
        '--progress', action='store_true',
        help='print how far the review of each result is, and the agreement of people, and end',
    )  # fmt: skip
    parser.add_argument(
        '-o', '--out', type=Path, help='with recordings: result folder, as of boxreg relabel'
    )
    add_server_arguments(parser)
    add_options(parser, Request)
    add_options(parser, Settings)


def run(args: argparse.Namespace) -> int:
    """Serve a result until interrupted; return the status of a run that fails before."""
    if args.progress:
        return _print_progress(args.paths)
    if args.out is None:
        is_result = [(path / SUMMARY).is_file() for path in args.paths]
        if args.paths[0].is_file() or (len(args.paths) > 1 and not all(is_result)):
            raise ConfigError(
                '-o: expected the folder for the results of these recordings, got none; add -o OUT'
            )
        return _serve(args.paths, args)
    done = subprocess.run(
        [
            *(sys.executable, '-m', 'boxreg_ros.cli', 'relabel', *map(str, args.paths)),
            *('-o', str(args.out), '--report', '--resume'),
            *words_of(args, Request),
            *words_of(args, Settings),
        ],
        check=False,
    )
    if done.returncode:
        return done.returncode
    return _serve([args.out], args)


def _serve(outs: Sequence[Path], args: argparse.Namespace) -> int:
    results = [(out, drive_of(out) if (out / SUMMARY).is_file() else None) for out in outs]
    return serve(results, args.port, args.who)


def _print_progress(outs: Sequence[Path]) -> int:
    from boxreg_ros.review.progress import by_risk_left, progress_lines, progress_of

    print('\n'.join(progress_lines(by_risk_left(map(progress_of, outs)))))
    return 0
