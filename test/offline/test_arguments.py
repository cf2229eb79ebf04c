"""Options are stated once: `batch` takes those of `relabel`, and hands them on unchanged."""

import argparse
import shlex

from boxreg_ros.cli import parser
from boxreg_ros.config import COMPLETE_STEPS
from boxreg_ros.offline.arguments import config_from
from boxreg_ros.offline.batch import options_of_drives
import pytest

WORDS = """
--points /left --points /right --sensor-frame left --sensor-frame right --time-unit us
--odometry /odom --associate --labels csv:b.csv --fixed-frame map --start 1 --end 2.5
--decisions d.csv --formats csv,mcap --with-points --swap-axes --label-frame left --report
--truth t.csv --complete --set complete.prune=false --set vehicle.names=[car,van] --strict
--fail-under 0.9 --label-points --clouds static --clouds object --undistort
"""


def options_of(command):
    """Return help, placeholder and choices of each option, by its longest flag."""
    subparsers = next(
        action
        for action in parser(command)._actions
        if isinstance(action, argparse._SubParsersAction)
    )
    return {
        max(action.option_strings, key=len): (action.help, action.metavar, action.choices)
        for action in subparsers.choices[command]._actions
        if action.option_strings
    }


def test_batch_takes_every_option_of_relabel_with_the_same_meaning():
    relabel = options_of('relabel')
    batch = options_of('batch')
    assert relabel.keys() - batch.keys() == {'--resume'}  # a batch always does
    differ = {name for name in relabel.keys() & batch.keys() if relabel[name] != batch[name]}
    assert differ == {'--formats', '--out', '--workers'}  # another default; another meaning


def test_batch_hands_all_options_to_relabel():
    """The words are read back by the parser of relabel: the same request and settings."""
    words = shlex.split(WORDS)
    batch = parser('batch').parse_args(['batch', 'x.mcap', '-o', 'out', *words])
    handed = options_of_drives(batch)
    arguments = ['relabel', 'x.mcap', '-o', 'out']
    given = parser('relabel').parse_args([*arguments, *words])
    read = parser('relabel').parse_args([*arguments, *handed])
    read = {**vars(read), 'subparser': given.subparser}
    assert read == {**vars(given), 'workers': 1}
    assert {name for name, value in read.items() if value in (None, [], '')} == {
        'boxes', 'camera', 'config', 'info',
    }  # fmt: skip


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
