"""Compiled kernels on disk are not used any more when the source of any of them has changed."""

import ast
import subprocess
import sys

from boxreg_ros.core.kernels.compile import sources_digest
from paths import ROOT
import pytest

pytest.importorskip('numba')

CALLER = """
from boxreg_ros.core.kernels.compile import kernel
from inner import inner


@kernel
def outer():
    return inner()


print(outer(), len(outer.stats.cache_hits))
"""
CALLED = """
from boxreg_ros.core.kernels.compile import kernel


@kernel
def inner():
    return {}
"""


def test_a_caller_is_compiled_again_when_a_called_kernel_of_another_module_changes(tmp_path):
    (tmp_path / 'outer.py').write_text(CALLER)

    def result_and_cache_hits(value):
        (tmp_path / 'inner.py').write_text(CALLED.format(value))
        # Python itself would take the old bytecode of a file that changes within a second.
        command = [sys.executable, '-B', 'outer.py']
        run = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
        return run.stdout.split()

    assert result_and_cache_hits(1) == ['1', '0']
    assert result_and_cache_hits(1) == ['1', '1']
    assert result_and_cache_hits(2) == ['2', '0']


def test_the_digest_depends_on_every_source_of_the_folder(tmp_path):
    (tmp_path / 'a.py').write_text('A = 1')
    (tmp_path / 'b.py').write_text('B = 1')
    before = sources_digest.__wrapped__(tmp_path)
    (tmp_path / 'b.py').write_text('B = 2')
    assert sources_digest.__wrapped__(tmp_path) != before


def test_kernels_take_nothing_of_the_package_from_outside_of_their_folder():
    # The digest in the name of a cache file covers the sources of this folder only.
    folder = ROOT / 'boxreg_ros' / 'core' / 'kernels'
    for path in folder.glob('*.py'):
        for node in ast.walk(ast.parse(path.read_text(encoding='utf-8'))):
            if isinstance(node, ast.ImportFrom) and node.module.startswith('boxreg_ros'):
                assert node.module.startswith('boxreg_ros.core.kernels'), path.name
