"""`boxreg review`: its command line. A recording is relabelled before it is looked at."""

from __future__ import annotations

import argparse
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
        help='result of boxreg relabel --report, or recordings of one drive: these are relabelled '
        'into --out first',
    )  # fmt: skip
    parser.add_argument(
        '-o', '--out', type=Path, help='with recordings: result folder, as of boxreg relabel'
    )
    add_server_arguments(parser)
    add_options(parser, Request)
    add_options(parser, Settings)


def run(args: argparse.Namespace) -> int:
    """Serve a result until interrupted; return the status of a run that fails before."""
    if args.out is None:
        (out,) = args.paths if len(args.paths) == 1 else (None,)
        if out is None or out.is_file():
            raise ConfigError(
                '-o: expected the folder for the results of these recordings, got none; add -o OUT'
            )
        return _serve(out, args)
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
    return _serve(args.out, args)


def _serve(out: Path, args: argparse.Namespace) -> int:
    source = drive_of(out) if (out / SUMMARY).is_file() else None
    return serve(out, args.port, args.who, source)
