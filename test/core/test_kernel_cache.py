"""Compiled kernels on disk: compiled again when a source has changed, or where none is kept."""

import ast
import os
import shutil
import subprocess
import sys

from boxreg_ros.core.method.compile import refuse_old, sources_digest
from boxreg_ros.rotations import matrix_from_rpy
import numpy as np
from paths import ROOT
import pytest

CALLER = """
import sys
from boxreg_ros.core.method.compile import kernel
from inner import inner


@kernel
def outer():
    return inner()


print(outer(), len(outer.stats.cache_hits), 'numba.np.linalg' in sys.modules)
"""
CALLED = """
from boxreg_ros.core.method.compile import kernel


@kernel
def inner():
    return {}
"""


def test_a_caller_is_compiled_again_when_a_called_kernel_of_another_module_changes(tmp_path):
    (tmp_path / 'outer.py').write_text(CALLER)

    def result_cache_hits_and_whether_numba_is_set_up(value):
        (tmp_path / 'inner.py').write_text(CALLED.format(value))
        # Python itself would take the old bytecode of a file that changes within a second.
        command = [sys.executable, '-B', 'outer.py']
        run = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
        return run.stdout.split()

    assert result_cache_hits_and_whether_numba_is_set_up(1) == ['1', '0', 'True']
    assert result_cache_hits_and_whether_numba_is_set_up(1) == ['1', '1', 'False']
    assert result_cache_hits_and_whether_numba_is_set_up(2) == ['2', '0', 'True']
    # `inner` is part of `outer`: alone, it is neither translated nor kept.
    assert not list((tmp_path / '__pycache__').glob('inner.*'))


COLLECTED = """
import gc
from boxreg_ros.core.method.compile import kernel
from numba.core import event

states = []


class Watch(event.Listener):
    def on_start(self, event):
        states.append(gc.isenabled())

    def on_end(self, event):
        states.append(gc.isenabled())


@kernel
def inner(value):
    return value + 1


@kernel
def outer(value):
    return inner(value) / value  # zero divided by zero raises nothing


with event.install_listener('numba:compile', Watch()):
    outer(0)
    try:
        outer('a')
    except Exception:
        states.append('raised')
print(*states, gc.isenabled())
"""


def test_no_garbage_is_collected_while_a_kernel_is_compiled(tmp_path):
    (tmp_path / 'collected.py').write_text(COLLECTED)
    command = [sys.executable, '-B', 'collected.py']
    run = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
    # The events of `outer` are around those of `inner`; the collector goes on after the last.
    *states, goes_on = run.stdout.split()
    assert states[:3] == ['False', 'False', 'False'] and 'raised' in states
    assert goes_on == 'True'


ROOM = """
from collections import Counter
from boxreg_ros.core.method.compile import kernel
import numpy as np
from numba.core import event

compiled = Counter()


class Watch(event.Listener):
    def on_start(self, event):
        function = event.data['dispatcher'].py_func
        compiled[function.__module__, function.__qualname__, str(event.data['args'])] += 1

    def on_end(self, event):
        pass


@kernel
def inner(n):
    return np.empty((n, 3))


@kernel
def outer(n):
    return np.empty((n, 3)), inner(n)


with event.install_listener('numba:compile', Watch()):
    outer(2)
print(*compiled.values())
"""


def test_a_function_of_numba_is_compiled_once_for_a_kernel_and_those_that_it_calls(tmp_path):
    (tmp_path / 'room.py').write_text(ROOM)
    command = [sys.executable, '-B', 'room.py']
    run = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
    # `outer`, `inner`, `empty` and what that calls.
    assert run.stdout.split() == ['1'] * 4


def test_the_digest_depends_on_every_source_that_is_imported(tmp_path):
    # a imports b, b imports c and a again; d is beside them.
    texts = {
        'a': 'from package.folder.b import B',
        'b': 'from package.folder.c import (\n    C,\n)\nfrom package.folder.a import A',
        'c': 'from os.path import join\nC = 1',
        'd': 'D = 1',
    }
    for name, text in texts.items():
        (tmp_path / f'{name}.py').write_text(text)
    digest = sources_digest.__wrapped__
    before = digest(tmp_path / 'a.py')
    (tmp_path / 'd.py').write_text('D = 2')
    assert digest(tmp_path / 'a.py') == before
    for name in 'cba':
        with (tmp_path / f'{name}.py').open('a') as file:
            file.write('\n')
        assert digest(tmp_path / 'a.py') != before
        before = digest(tmp_path / 'a.py')


def test_kernels_take_nothing_of_the_package_from_outside_of_their_folder():
    # The digest in the name of a cache file covers imports from this folder only.
    folder = ROOT / 'boxreg_ros' / 'core' / 'method'
    for path in folder.glob('*.py'):
        for node in ast.walk(ast.parse(path.read_text(encoding='utf-8'))):
            if isinstance(node, ast.ImportFrom) and node.module.startswith('boxreg_ros'):
                assert node.module.startswith('boxreg_ros.core.method'), path.name


def test_kernels_count_no_index_from_the_end():
    # Negative indices are not wrapped: the element would be one before the array.
    for path in (ROOT / 'boxreg_ros' / 'core' / 'method').glob('*.py'):
        for node in ast.walk(ast.parse(path.read_text(encoding='utf-8'))):
            if isinstance(node, ast.Subscript):
                parts = node.slice.elts if isinstance(node.slice, ast.Tuple) else [node.slice]
                found = [part for part in parts if ast.unparse(part).startswith('-')]
                assert not found, f'{path.name}:{node.lineno}'


@pytest.fixture
def copy(tmp_path):
    """Return a folder with a copy of the package and its compiled kernels."""
    shutil.copytree(ROOT / 'boxreg_ros', tmp_path / 'boxreg_ros')
    return tmp_path


ROTATE = """
import resource
import warnings
import numpy as np
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter('always')
    from boxreg_ros.core.method.rotation import fill_rotation
    R = np.empty((3, 3))
    PREPARE
    fill_rotation(0.1, 0.2, 0.3, R)
print(*[str(w.message) for w in caught], sep='\\n')
print(*R.ravel().tolist())
"""
KNOWN_ROTATION = matrix_from_rpy(np.array([0.1, 0.2, 0.3])).ravel()


def rotated(folder, prepare='pass', **places):
    """Return the warnings and the numbers of a rotation by a kernel, in a process."""
    # One kernel stands for all, which take a minute.
    done = subprocess.run(
        [sys.executable, '-c', ROTATE.replace('PREPARE', prepare)],
        cwd=folder, env={**os.environ, **places}, capture_output=True, text=True, check=True,
    )  # fmt: skip
    *texts, values = done.stdout.splitlines()
    np.testing.assert_allclose(np.array(values.split(), float), KNOWN_ROTATION, atol=1e-15)
    return [text for text in texts if text]


def test_a_read_only_home_gives_one_warning(copy):
    # Neither the package, nor NUMBA_CACHE_DIR, nor the home folder can be written: files are in
    # the place of folders, which holds for the superuser as well.
    cache = copy / 'boxreg_ros' / 'core' / 'method' / '__pycache__'
    shutil.rmtree(cache)
    cache.touch()
    places = {'HOME': str(cache), 'XDG_CACHE_HOME': str(cache), 'NUMBA_CACHE_DIR': str(cache)}
    (text,) = rotated(copy, **places)
    assert 'set NUMBA_CACHE_DIR' in text


def test_a_full_disk_gives_one_warning(copy):
    # A limit of the size of files stands for the full disk: it holds for the superuser as well.
    limit = 'resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))'
    (text,) = rotated(copy, limit, NUMBA_CACHE_DIR=str(copy / 'cache'))
    assert 'make room' in text and str(copy / 'cache') in text


def test_a_damaged_cache_is_written_again_with_one_warning(copy):
    assert rotated(copy) == []
    cache = copy / 'boxreg_ros' / 'core' / 'method' / '__pycache__'
    indexes = list(cache.glob('rotation.fill_rotation*.nbi'))
    assert indexes
    for file in indexes:
        file.write_bytes(b'damaged')
    (text,) = rotated(copy)
    assert 'delete the folder' in text
    assert rotated(copy) == []


@pytest.mark.parametrize('version', ['0.59.1', '0.60.0'])
def test_a_numba_whose_sums_are_nan_is_refused(version):
    refuse_old('0.61.2')
    refuse_old('1.0.0rc1')
    with pytest.raises(ImportError, match=rf'expected 0\.61 or newer, got {version}.*pip install'):
        refuse_old(version)
