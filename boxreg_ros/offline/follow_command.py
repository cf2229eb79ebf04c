"""
`boxreg follow`: whole tracks from a few boxes of each object.

It is `boxreg relabel --keyframes` with the boxes of a file.

"""

from __future__ import annotations

import argparse
from pathlib import Path
import sys

from boxreg_ros.errors import ConfigError
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.offline import relabel_command
from boxreg_ros.offline.arguments import RECORDINGS
from boxreg_ros.structures import PROPOSED

DEFAULT_OUT = Path('followed')
"""Result folder unless another is given."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `boxreg follow`."""
    parser.add_argument('recording', type=Path, metavar='RECORDING', help=RECORDINGS)
    parser.add_argument(
        'seeds', type=Path, nargs='?', metavar='SEEDS',
        help='boxes to follow, one or more of each object: CSV with the columns of boxes.csv; '
        'those of other label formats by --labels',
    )  # fmt: skip
    relabel_command.add_run_arguments(parser, DEFAULT_OUT)
    parser.set_defaults(keyframes=True)


def run(args: argparse.Namespace) -> int:
    """Follow the seeds, print one closing line, and return the exit status."""
    if (args.seeds is None) == (args.labels is None):
        got = 'neither' if args.seeds is None else f'{args.seeds} and --labels'
        raise ConfigError(
            f'SEEDS: expected a table of boxes or --labels FORMAT:PATH, got {got}; give one'
        )
    args.recordings = [args.recording]
    if args.seeds is not None:
        _require_accepted(args.seeds)
        args.labels = ('csv', args.seeds)
    return relabel_command.run(args)


def _require_accepted(seeds: Path) -> None:
    """Say how many boxes are proposals that no one has accepted; raise if there is no other."""
    words = [word for table in BoxTable.read_frames(seeds).values() for word in table.status]
    if not words:
        raise ConfigError(
            f'{seeds}: expected boxes to follow, got a table of none; add a box of each object'
        )
    proposed = words.count(PROPOSED)
    if not proposed:
        return
    line = f'{seeds}: {proposed} of {len(words)} boxes are proposals'
    remedy = f'write accepted in place of {PROPOSED} into the column status to follow one'
    if proposed == len(words):
        raise ConfigError(f'{line}, expected accepted ones; {remedy}')
    print(f'boxreg: {line} and not followed; {remedy}', file=sys.stderr)
