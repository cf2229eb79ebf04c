"""`measure pair`: cases in processes of two checkouts, by turns."""

from argparse import Namespace
import shlex
import sys

from boxreg_ros.errors import BoxregError
from measure import pair
import pytest

CASES = ['tick 8']


def checkout(folder, environment):
    """Make a folder whose environment has the packages of this one, and variables of its own."""
    python = folder / '.venv' / 'bin' / 'python'
    python.parent.mkdir(parents=True)
    python.write_text(f'#!/bin/sh\n{environment} exec {shlex.quote(sys.executable)} "$@"\n')
    python.chmod(0o755)
    return folder


@pytest.fixture
def small_cases(monkeypatch):
    for name, value in {'TICK_POINTS': 3_000, 'TICKS': 2, 'WINDOWS': 2, 'SEEDS': 2}.items():
        monkeypatch.setattr(pair, name, value)


def test_both_checkouts_have_figures_and_a_ratio(tmp_path, small_cases, monkeypatch):
    monkeypatch.setattr(pair, 'ROOT', checkout(tmp_path / 'this', ''))
    other = checkout(tmp_path / 'other', '')
    found = pair.run(Namespace(other=other, repeats=1, seconds=1.0, only=CASES))
    assert [*found] == CASES
    for case in found.values():
        for figure in ('cpu', 'memory'):
            assert case[f'{figure}, this'] > 0
            ratio = case[f'{figure}, this'] / case[f'{figure}, other']
            assert case[f'{figure}, ratio'] == pytest.approx(ratio)


def test_the_median_of_the_runs_of_each_counts():
    runs = {'other': [{'cpu': 4.0}, {'cpu': 1.0}, {'cpu': 2.0}], 'this': [{'cpu': 1.0}] * 3}
    assert pair._compared(runs) == {'cpu, other': 2.0, 'cpu, this': 1.0, 'cpu, ratio': 0.5}


def test_what_fails_in_a_checkout_is_named(tmp_path, small_cases):
    with pytest.raises(BoxregError, match='expected a checkout with an environment'):
        pair.run(Namespace(other=tmp_path, repeats=1, seconds=1.0, only=CASES))
    other = checkout(tmp_path / 'other', 'false &&')
    with pytest.raises(BoxregError, match=f'tick 8 failed in {other}'):
        pair.run(Namespace(other=other, repeats=1, seconds=1.0, only=CASES))
