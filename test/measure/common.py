"""Options that measurements share, and the JSON document of their output."""

from __future__ import annotations

import argparse
import json
import shlex
import sys
from typing import Any

from boxreg_ros import __version__
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.offline.box_scores import match, Matches
from boxreg_ros.offline.evaluate import finite

BOXREG = (sys.executable, '-m', 'boxreg_ros.cli')
"""The command in a process of its own, of this environment."""
PROGRAM = 'python test/measure'
SCOPE = {
    '--min-points': (100, 'leave out true boxes with fewer points'),
    '--classes': (
        ['car', 'van', 'truck'], 'only true boxes whose class name holds one of these words',
        {'nargs': '+', 'metavar': 'WORD'},
    ),
}  # fmt: skip
"""The options by which true boxes are in scope."""


def class_words(args: argparse.Namespace) -> list[str]:
    """Return the class words of ``--classes``, which may be separated by commas as well."""
    return [word for part in args.classes for word in part.split(',') if word]


def in_scope(boxes: BoxTable, truth: BoxTable, args: argparse.Namespace) -> Matches:
    """Compare boxes with the true boxes that the options `SCOPE` leave in scope."""
    return match(boxes, truth, args.min_points, class_words(args))


def print_json(results: Any) -> None:
    """
    Print the results of a measurement as one JSON document.

    The document has three members: ``version`` of the package, ``command`` as it was typed, and
    ``results``. NaN becomes ``null``. `docs/results.py` writes its tables from such files.

    """
    command = f'{PROGRAM} {shlex.join(sys.argv[1:])}'
    document = {'version': __version__, 'command': command, 'results': finite(results)}
    print(json.dumps(document))
