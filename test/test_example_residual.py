"""The page docs/tasks/add-a-residual.md, followed to the letter in a copy of the package."""

import os
import re
import shutil
import subprocess
import sys

from paths import ROOT
import pytest

PAGE = ROOT / 'docs' / 'tasks' / 'add-a-residual.md'
EXAMPLE = ROOT / 'docs' / 'examples' / 'residual_example.py'


def test_page_shows_the_example():
    source = EXAMPLE.read_text(encoding='utf-8')
    assert f'```python\n{source}```\n' in PAGE.read_text(encoding='utf-8')


@pytest.fixture
def copy(tmp_path):
    """Return a copy of the package in which the page has been followed."""
    shutil.copytree(ROOT / 'boxreg_ros', tmp_path / 'boxreg_ros', ignore=ignored)
    shutil.copytree(ROOT / 'msg_adapters', tmp_path / 'msg_adapters', ignore=ignored)
    source = EXAMPLE.read_text(encoding='utf-8')
    functions = source[source.index('@kernel') : source.index('ROW = ')]
    residual, weight = functions.split('\n\n\n')[:2]
    method = tmp_path / 'boxreg_ros' / 'core' / 'method'
    insert(method / 'residuals.py', 'RESIDUALS = (', f'{residual}\n\n\n')
    insert(method / 'weights.py', '@loop\ndef robustify', f'{weight}\n\n\n')
    insert(method / 'residuals.py', '    slip_weight,\n', '    rise_weight,\n')
    row = re.search(r'`(Residual\(rise, .*\))`', PAGE.read_text(encoding='utf-8'))[1]
    insert(method / 'residuals.py', '    Residual(slip, ', f'    {row},\n')
    setting = re.search(r'```python\n(    rise: float = .*?)```', PAGE.read_text(), re.DOTALL)[1]
    insert(tmp_path / 'boxreg_ros' / 'config.py', '    shape: float = setting(', setting)
    field = "    'rise': ('rise',),\n"
    insert(tmp_path / 'boxreg_ros' / 'core' / 'problem.py', "    'extent': ('extent',),\n", field)
    return tmp_path


def ignored(folder, names):
    return [name for name in names if name == '__pycache__']


def insert(path, before, text):
    """Insert a text before the one place where another stands."""
    source = path.read_text(encoding='utf-8')
    assert source.count(before) == 1, (path, before)
    path.write_text(source.replace(before, text + before), encoding='utf-8')


CHECK = """
import numpy as np
from boxreg_ros.core.method.assemble import accumulate, empty_axes, no_matrix
from boxreg_ros.core.method.constants import RESIDUAL_NAMES
from boxreg_ros.core.method.residuals import empty_linearised, RESIDUALS, TERMS
from boxreg_ros.core.method.arrays import COMMON

# 0.1 m up in 0.2 s, with the weight 7: r = .5, value 7 * .25 / 2, gradient 7 * .5 / .2.
i = RESIDUAL_NAMES.index('rise')
terms, common = np.zeros(2, TERMS), np.zeros((), COMMON)[()]
terms['time'], terms['W'][0, i, 0] = [0.0, 0.2], 7.0
x, gradient = np.zeros(35), np.empty(35)
x[6:9] = 1.0, 2.0, 0.1
value = accumulate(
    x, 2, terms, common, empty_axes(2), empty_linearised(), gradient, no_matrix()
)
np.testing.assert_allclose(value, 7 * 0.25 / 2)
known = np.zeros(35)
known[2], known[8] = -17.5, 17.5
np.testing.assert_allclose(gradient, known)
from boxreg_ros import Config
assert Config().vehicle.rise == 1.0
"""


def test_the_page_makes_a_residual(copy):
    command = [sys.executable, '-c', CHECK]
    done = subprocess.run(command, cwd=copy, env={**os.environ, 'PYTHONPATH': ''},
                          capture_output=True, text=True, timeout=600)  # fmt: skip
    assert done.returncode == 0, done.stderr
