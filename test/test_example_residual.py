"""The page docs/tasks/add-a-residual.md, followed to the letter in a copy of package and tests."""

import os
import re
import shutil
import subprocess
import sys

from paths import ROOT
import pytest

PAGE = ROOT / 'docs' / 'tasks' / 'add-a-residual.md'
EXAMPLE = ROOT / 'docs' / 'examples' / 'residual_example.py'
COPIED = ('boxreg_ros', 'msg_adapters', 'test/core/test_method.py', 'test/reference',
          'test/scenes.py', 'test/paths.py', 'test/measure')  # fmt: skip


def test_page_shows_the_example():
    source = EXAMPLE.read_text(encoding='utf-8')
    assert f'```python\n{source}```\n' in PAGE.read_text(encoding='utf-8')


def block(language, begin):
    """Return the code of the page that begins with a text."""
    page = PAGE.read_text(encoding='utf-8')
    return re.search(rf'```{language}\n({re.escape(begin)}.*?)```', page, re.DOTALL)[1]


@pytest.fixture
def copy(tmp_path):
    """Return a copy of package and tests in which the page has been followed."""
    for name in COPIED:
        target = tmp_path / name
        target.parent.mkdir(parents=True, exist_ok=True)
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, target, ignore=shutil.ignore_patterns('__pycache__'))
        else:
            shutil.copy(ROOT / name, target)
    source = EXAMPLE.read_text(encoding='utf-8')
    functions = source[source.index('@kernel') : source.index('ROW = ')]
    residual, weight = functions.split('\n\n\n')[:2]
    core = tmp_path / 'boxreg_ros' / 'core'
    insert(core / 'method' / 'residuals.py', 'RESIDUALS = (', f'{residual}\n\n\n')
    insert(core / 'method' / 'weights.py', '@loop\ndef robustify', f'{weight}\n\n\n')
    insert(core / 'method' / 'residuals.py', '    slip_weight,\n', '    rise_weight,\n')
    row = re.search(r'`(Residual\(rise, .*\))`', PAGE.read_text(encoding='utf-8'))[1]
    insert(core / 'method' / 'residuals.py', ')\n"""All residuals of', f'    {row},\n')
    setting = block('python', '    rise: float = ')
    insert(tmp_path / 'boxreg_ros' / 'config.py', '    shape: float = setting(', setting)
    insert(core / 'problem.py', "    'extent': ('extent',),\n", "    'rise': ('rise',),\n")
    oracle = tmp_path / 'test' / 'reference' / 'objective.py'
    insert(oracle, 'OF_OBSERVATIONS = {', block('text', 'def rise(p, s, t):') + '\n\n')
    insert(oracle, "    'slip': slip,\n", "    'rise': rise,\n")
    (tmp_path / 'test' / 'core' / 'test_rise.py').write_text(CHECK, encoding='utf-8')
    return tmp_path


def insert(path, before, text):
    """Insert a text before the one place where another stands."""
    source = path.read_text(encoding='utf-8')
    assert source.count(before) == 1, (path, before)
    path.write_text(source.replace(before, text + before), encoding='utf-8')


CHECK = """
from boxreg_ros import Config
from boxreg_ros.core.method.assemble import accumulate, empty_axes, no_matrix, number_of
from boxreg_ros.core.method.arrays import COMMON, PRIOR
from boxreg_ros.core.method.constants import CONSTANTS, RESIDUAL_NAMES
from boxreg_ros.core.method.residuals import empty_linearised, RESIDUALS, TERMS
from boxreg_ros.core.method.weights import Weighing
from boxreg_ros.core.problem import settings_of_kinds
from measure.ablation import INGREDIENTS
import numpy as np

I = RESIDUAL_NAMES.index('rise')
POSES = np.zeros((2, 6))
POSES[1, :3] = 1.0, 2.0, 0.1  # 0.1 m up in 0.2 s: r = 0.5 m/s


def constants_of(config):
    return CONSTANTS.with_settings(config).in_round(False, False).record()[0]


def weight(config):
    # Of the row of the table, for a car. All weights together take 8 s to compile.
    ones = np.ones(6)
    window = Weighing(2, ones, ones, np.zeros(2, bool), ones, np.zeros(2, bool),
                      settings_of_kinds(config)[0])
    w = np.zeros(6)
    RESIDUALS[I].weight(0, np.array([0.5]), window, constants_of(config), w)
    return w[0]


def test_the_setting_is_the_weight():
    assert Config().vehicle.rise == 1.0
    assert weight(Config().updated({'vehicle.rise': 0.5})) == 4.0


def test_the_ablation_leaves_it_out():
    without = Config().updated(INGREDIENTS['rise'].settings)
    counts = [number_of(2, 2, constants_of(c)['residuals'][I]) for c in (Config(), without)]
    assert counts == [1, 0]  # no box follows the last one


def test_value_and_gradient_by_hand():
    # With the weight 7: value 7 * .25 / 2, gradient 7 * .5 / .2.
    terms, common = np.zeros(2, TERMS), np.zeros((), COMMON)[()]
    terms['time'], terms['W'][0, I, 0] = [0.0, 0.2], 7.0
    x, gradient = np.zeros(35), np.empty(35)
    x[:12] = POSES.ravel()
    value = accumulate(
        x, 2, terms, common, np.zeros(PRIOR), np.zeros((PRIOR, PRIOR)), empty_axes(2),
        empty_linearised(), gradient, no_matrix(),
    )
    np.testing.assert_allclose(value, 7 * 0.25 / 2)
    known = np.zeros(35)
    known[2], known[8] = -17.5, 17.5
    np.testing.assert_allclose(gradient, known)
"""


def test_the_page_makes_a_residual(copy):
    # The oracle, automatic differentiation, sums the residual of the page too.
    tests = ['test/core/test_rise.py', 'test/core/test_method.py']
    only = 'rise or automatic or by_hand and value'
    command = [sys.executable, '-m', 'pytest', '-q', '-p', 'no:cacheprovider', *tests, '-k', only]
    folders = os.pathsep.join(map(str, (copy, copy / 'test')))
    # Kernels that are used once need no optimisation.
    environment = {**os.environ, 'PYTHONPATH': folders, 'NUMBA_OPT': '0'}
    done = subprocess.run(
        command, cwd=copy, env=environment, capture_output=True, text=True, timeout=600
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert '7 passed' in done.stdout, done.stdout
