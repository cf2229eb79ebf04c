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
    'follow': SubCommand('follow', 'whole tracks from one box or a few of each object'),
    'ablation': SubCommand('ablation', 'accuracy without each ingredient of the method'),
    'speed': SubCommand('speed.command', 'time per tick, per box and per window'),
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
