"""Linters as tests: each has to be installed to run, and to find nothing."""

import importlib.util
import subprocess
import sys

from paths import ROOT
import pytest

SOURCES = ['boxreg_ros', 'msg_adapters', 'test', 'setup.py']


@pytest.mark.parametrize(
    'command',
    [
        ['ruff', 'check', '.'],
        ['ruff', 'format', '--check', '.'],
        ['mypy'],
        ['ament_flake8.main', '--config', '.flake8', *SOURCES],
        ['ament_pep257.main', *SOURCES],
        ['ament_xmllint.main', 'package.xml'],
    ],
    ids=' '.join,
)
def test_linter_finds_nothing(command):
    module = command[0]
    if importlib.util.find_spec(module.partition('.')[0]) is None:
        pytest.skip(f'{module} is not installed')
    done = subprocess.run(
        [sys.executable, '-m', *command], cwd=ROOT, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stdout + done.stderr


def test_manifest_is_valid():
    """Check what the schema asks for, without fetching it as xmllint does."""
    catkin = pytest.importorskip('catkin_pkg.package')
    warnings = []
    manifest = catkin.parse_package(ROOT, warnings=warnings)
    manifest.validate(warnings=warnings)
    assert not warnings
    assert manifest.get_build_type() == 'ament_python'
