"""Measurements for the pages of results, and their command."""

import argparse
from importlib import import_module
import json
from pathlib import Path
import sys
from typing import Any

from boxreg_ros.allocation import collect_rarely, keep_freed_memory
from boxreg_ros.errors import BoxregError
from boxreg_ros.offline.evaluate import finite
from measure.common import print_json, PROGRAM

MEASUREMENTS = {
    'real': 'accuracy of each method on recordings with known truth',
    'paper': "the paper's experiment: its Table I and two figures",
    'follow': 'whole tracks from one box or a few of each object',
    'ablation': 'accuracy without each ingredient of the method',
    'speed': 'time per tick, per box and per window, and of relabel',
    'pair': 'CPU seconds of this checkout beside those of another, by turns',
    'kinds': 'gain of each class of objects, with standard errors',
    'detector': 'average precision of a detector by the labels that it is trained on',
    'proposals': 'objects without boxes that are proposed, and false alarms',
    'tracks': 'broken tracks before and after each completing step',
    'sensitivity': 'accuracy with each setting halved and doubled',
    'highway': 'accuracy at 5 and at 30 m/s, with boxes of either time',
    'clusters': 'accuracy of boxes of clusters, which hold what is seen of an object',
    'points': 'labels of points against those of a simulation',
    'lidars': 'accuracy on a truck with LiDARs at its corners',
    'covariance': 'covariances against errors, by estimate and class',
    'velocities': 'errors of velocities of the input and of each estimate',
    'review': 'how early the review list shows the bad tracks',
    'labeller': 'actions of a labeller until a drive with planted errors is right',
    'report': 'first paint and frame times of report.html',
    'scale': 'core hours and memory per hour, and a simulated fleet',
    'load': 'latency and accuracy of the live node by number of tracks',
    'node': 'latency and memory of the live node, over DDS',
    'robot': 'the live node at the rates of a robot, as a table',
    'renew': 'run the command of each stored measurement again, and store its output',
}
"""Modules of this package, each with `ARGUMENTS` and `run`, and their summaries."""
RECORDINGS = (Path, 'folder: one recording and truth.csv', {'nargs': '+'})
"""The argument of those that measure on recordings."""
METAVARS = {int: 'N', float: 'S', Path: 'DATA'}
"""Of arguments by type, where they state no other."""
MEASURE = (sys.executable, str(Path(__file__).parent))
"""The command in a process of its own, of this environment."""


def add_arguments(parser, arguments):
    """
    Declare arguments of a measurement.

    Each has a default, or its type where there is none; a help text, and further keywords of
    argparse; or a function that declares it.

    """
    for name, stated in arguments.items():
        if callable(stated):
            stated(parser)
            continue
        default, text, *more = stated
        if default is False:
            parser.add_argument(name, action='store_true', help=text)
            continue
        keywords = dict(*more)
        if isinstance(default, type):
            kind = default
        else:
            kind = type((default or [0])[0]) if isinstance(default, list) else type(default)
            text, keywords['default'] = f'{text} (default: %(default)s)'.strip(), default
        if 'action' not in keywords:
            keywords['type'] = kind
        keywords.setdefault('metavar', METAVARS.get(kind))
        parser.add_argument(name, help=text, **keywords)


def main(words: list[str]) -> int:
    """Run the measurement that the first word names, with the others as its options."""
    name, *options = words or ['--help']
    if name not in MEASUREMENTS:
        listed = '\n'.join(f'  {key:12} {text}' for key, text in MEASUREMENTS.items())
        print(f'usage: {PROGRAM} NAME [OPTION]...\n\n{listed}')
        return 0 if name in ('-h', '--help') else 2
    module = import_module(f'measure.{name}')
    parser = argparse.ArgumentParser(f'{PROGRAM} {name}', description=f'{MEASUREMENTS[name]}.')
    add_arguments(parser, module.ARGUMENTS)
    parser.add_argument('--json', action='store_true', help='print one JSON object')
    args = parser.parse_args(options)
    keep_freed_memory()
    collect_rarely()
    try:
        results = module.run(args)
    except BoxregError as error:
        print(f'{PROGRAM} {name}: {error}', file=sys.stderr)
        return 1
    if results is None:
        return 0
    if args.json:
        print_json(results)
    else:
        print(shown(name, finite(results)))
    return 0


def shown(name: str, results: Any) -> str:
    """Return results as the tables of their page, or indented where they have none."""
    from results import KINDS  # which imports measurements itself

    if name not in KINDS:
        return json.dumps(results, indent=2)
    return '\n\n'.join(KINDS[name].tables(results))
