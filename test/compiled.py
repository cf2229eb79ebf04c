"""Compiled kernels for copies of the package."""

import shutil

from paths import ROOT
import pytest

KERNELS = ROOT / 'boxreg_ros' / 'core' / 'method'


def copy_compiled(kernels):
    """
    Give the kernels in a folder what is compiled of those of the source tree.

    Compiling takes a minute of processor time. Numba takes a compiled file for that of a source
    with the same time of change.

    """
    for path in KERNELS.glob('*.py'):
        shutil.copystat(path, kernels / path.name)
    cache = KERNELS / '__pycache__'
    if cache.is_dir():
        shutil.copytree(cache, kernels / '__pycache__', dirs_exist_ok=True)


def fill_cache(folder):
    """
    Give a folder for NUMBA_CACHE_DIR what is compiled of the kernels in the source tree.

    The reader of box messages, the only other compiled module, is left out: it takes a second.

    """
    locator = pytest.importorskip('numba.core.caching')._CacheLocator
    cache = folder / locator.get_suitable_cache_subpath(str(KERNELS / 'rotation.py'))
    shutil.copytree(KERNELS / '__pycache__', cache, ignore=shutil.ignore_patterns('*.pyc'))
