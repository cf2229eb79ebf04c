"""`boxreg bench`: the table of its sub-commands, each a module of its own."""

from __future__ import annotations

import argparse
from importlib import import_module
from typing import Any, NamedTuple


class SubCommand(NamedTuple):
    """Module that implements a sub-command, and its summary."""

    module: str
    summary: str


MEASUREMENTS = {
    'paper': SubCommand('paper', "the paper's experiment: its Table I and two figures"),
    'real': SubCommand('accuracy', 'accuracy on recordings with known truth'),
    'kinds': SubCommand('kinds', 'gain of each class of objects, with standard errors'),
    'tracks': SubCommand('tracks', 'broken tracks before and after each completing step'),
    'ablation': SubCommand('ablation', 'accuracy without each ingredient of the method'),
    'sensitivity': SubCommand('sensitivity', 'accuracy with each setting halved and doubled'),
    'highway': SubCommand('highway', 'accuracy at 5 and at 30 m/s, with boxes of either time'),
    'lidars': SubCommand('lidars', 'accuracy on a truck with LiDARs at its corners'),
    'covariance': SubCommand('covariance', 'covariances against errors, by estimate and class'),
    'review': SubCommand('review', 'how early the review list shows the bad tracks'),
    'report': SubCommand('report', 'first paint and frame times of report.html'),
    'speed': SubCommand('speed.command', 'time per tick, per box and per window'),
    'scale': SubCommand('scale', 'core hours and memory per hour, and a simulated fleet'),
    'load': SubCommand('load', 'latency and accuracy of the live node by number of tracks'),
    'node': SubCommand('node', 'latency and memory of the live node, over DDS'),
    'kills': SubCommand('kills', 'loss of recorded labels when a process is killed'),
}


class _Parser(argparse.ArgumentParser):
    """The parser of a sub-command: its module, which is slow to import, adds the options."""

    measurement = ''

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Add the options of the sub-command, then parse."""
        _module(self.measurement).add_arguments(self)
        return super().parse_known_args(args, namespace)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the sub-commands; only the one that is used declares its options."""
    names = ','.join(MEASUREMENTS)
    kinds = parser.add_subparsers(
        dest='kind', required=True, metavar=f'{{{names}}}', parser_class=_Parser
    )
    for name, measurement in MEASUREMENTS.items():
        kind = kinds.add_parser(
            name, help=measurement.summary, description=f'{measurement.summary}.'
        )
        kind.measurement = name


def run(args: argparse.Namespace) -> int:
    """Run one sub-command and return the exit status."""
    return int(_module(args.kind).run(args))


def _module(name: str) -> Any:
    return import_module(f'boxreg_ros.bench.{MEASUREMENTS[name].module}')
