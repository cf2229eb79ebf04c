"""Options are stated once: `batch` takes those of `relabel`, and hands them on unchanged."""

import argparse

from boxreg_ros.cli import parser
from boxreg_ros.config import COMPLETE_STEPS
from boxreg_ros.offline.arguments import config_from
from boxreg_ros.offline.batch import options_of_drives
import pytest

VALUES = {'FORMAT:PATH': 'csv:b.csv', 'KEY=VALUE': 'window=7', 'NAME,...': 'csv,mcap'}
"""Values of options whose text has a form, by their placeholder; others take a number."""


def options_of(command):
    """Return the action of each option by its longest flag."""
    subparsers = next(
        action
        for action in parser(command)._actions
        if isinstance(action, argparse._SubParsersAction)
    )
    return {
        max(action.option_strings, key=len): action
        for action in subparsers.choices[command]._actions
        if action.option_strings
    }


def test_batch_takes_every_option_of_relabel_with_the_same_meaning():
    relabel, batch = (
        {name: (a.help, a.metavar, a.choices) for name, a in options_of(command).items()}
        for command in ('relabel', 'batch')
    )
    assert relabel.keys() <= batch.keys()
    differ = {name for name in relabel.keys() & batch.keys() if relabel[name] != batch[name]}
    assert differ == {'--formats', '--out', '--workers'}  # another default; another meaning


def test_batch_hands_all_options_to_relabel():
    """Whatever each option is set to is read back by the parser of relabel."""
    words = []
    own = {'--help', '--debug', '--out', '--workers'}
    for name, action in options_of('relabel').items():
        if name in own:
            continue
        value = '0.5' if action.choices is None else list(action.choices)[-1]
        words.append(name if action.nargs == 0 else f'{name}={VALUES.get(action.metavar, value)}')
    batch = parser('batch').parse_args(['batch', 'x.mcap', '-o', 'out', *words])
    arguments = ['relabel', 'x.mcap', '-o', 'out']
    given = vars(parser('relabel').parse_args([*arguments, *words]))
    read = vars(parser('relabel').parse_args([*arguments, *options_of_drives(batch)]))
    plain = vars(parser('relabel').parse_args(arguments))
    assert {name for name in given if given[name] == plain[name]} == {
        'command', 'debug', 'out', 'recordings', 'workers',
    }  # fmt: skip
    assert read == {**given, 'workers': 1, 'subparser': read['subparser']}


@pytest.mark.parametrize(
    'words',
    [
        ['--complete', '--set', 'complete.prune=false', '--workers=2', '--set=solver.threads=3'],
        ['--set=solver.threads=3', '--set', 'complete.prune=false', '--workers=2', '--complete'],
        ['--set=solver.threads=3', '--set', 'complete={prune: false}', '--complete'],
    ],
)
def test_a_setting_of_its_own_wins_over_one_that_sets_several(words):
    args = parser('relabel').parse_args(['relabel', 'x.mcap', '-o', 'out', *words])
    config = config_from(args)
    steps = {step: getattr(config.complete, step) for step in COMPLETE_STEPS}
    assert steps == dict.fromkeys(COMPLETE_STEPS, True) | {'prune': False}
    assert config.solver.threads == 3
