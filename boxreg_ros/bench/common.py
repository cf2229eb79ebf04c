"""Options, table rows and the JSON document that the sub-commands of `boxreg bench` share."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
import json
import math
from pathlib import Path
import shlex
import sys
from typing import Any

from boxreg_ros import __version__
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.offline.box_scores import match, Matches
from boxreg_ros.offline.evaluate import finite
from tqdm import tqdm

BOXREG = (sys.executable, '-m', 'boxreg_ros.cli')
"""The command in a process of its own, of this environment."""
NAME_WIDTH = 22  # characters of the first column
CELL_WIDTH = 9  # characters of each other column


def add_scope_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the recordings to measure on, and which of their true boxes are in scope."""
    parser.add_argument(
        'data', type=Path, nargs='+', metavar='DATA', help='folder: one recording and truth.csv'
    )
    parser.add_argument(
        '--min-points', type=int, default=100, metavar='N',
        help='leave out true boxes with fewer points (default: 100)',
    )  # fmt: skip
    parser.add_argument(
        '--classes', nargs='+', default=['car', 'van', 'truck'], metavar='WORD',
        help='only true boxes whose class name holds one of these words (default: car van truck)',
    )  # fmt: skip


def add_json_argument(parser: argparse.ArgumentParser) -> None:
    """Declare ``--json``."""
    parser.add_argument('--json', action='store_true', help='print one JSON object, for programs')


def class_words(args: argparse.Namespace) -> list[str]:
    """Return the class words of ``--classes``, which may be separated by commas as well."""
    return [word for part in args.classes for word in part.split(',') if word]


def in_scope(boxes: BoxTable, truth: BoxTable, args: argparse.Namespace) -> Matches:
    """Compare boxes with the true boxes that `add_scope_arguments` leaves in scope."""
    return match(boxes, truth, args.min_points, class_words(args))


def progress_bar(total: int, args: argparse.Namespace) -> Any:
    """Return a progress bar on stderr, hidden with ``--json`` and without a terminal."""
    is_hidden = args.json or not sys.stderr.isatty()
    return tqdm(total=total, leave=False, disable=is_hidden)


def line(name: str, row: Sequence[float | str] | str) -> str:
    """Return one line of a table: a name and its cells, or a name and a remark."""
    if isinstance(row, str):
        return f'{name:{NAME_WIDTH}} {row}'
    cells = ''.join(f'{_cell(value):>{CELL_WIDTH}}' for value in row)
    return f'{name:{NAME_WIDTH}}{cells}'


def _cell(value: float | str) -> str:
    if isinstance(value, str):
        return value
    return '-' if math.isnan(value) else f'{value:.3f}'


def print_json(results: Any, program: str = 'boxreg') -> None:
    """
    Print the results of a sub-command of a program as one JSON document.

    The document has three members: ``version`` of the package, ``command`` as it was typed, and
    ``results``. NaN becomes ``null``. `docs/results.py` writes its tables from such files.

    """
    command = f'{program} {shlex.join(sys.argv[1:])}'
    document = {'version': __version__, 'command': command, 'results': finite(results)}
    print(json.dumps(document))
