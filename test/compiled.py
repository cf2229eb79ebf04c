"""Compiled kernels for copies of the package."""

import shutil

from paths import ROOT
import pytest

KERNELS = 'boxreg_ros/core/method'
QUICKEST = 'path_costs.fill_costs_'
"""Begin of the names of the files of a kernel that compiles in some seconds."""


def copy_compiled(root):
    """
    Give a copy of the package in folder `root` what is compiled.

    Compiling takes a minute of processor time. Numba takes a compiled file for that of a source
    with the same time of change.

    """
    for path in (ROOT / KERNELS).glob('*.py'):
        shutil.copystat(path, root / KERNELS / path.name)
    copy_cache(root / KERNELS / '__pycache__')


def fill_cache(cache):
    """Give folder `cache` for NUMBA_CACHE_DIR what is compiled, except one kernel."""
    locator = pytest.importorskip('numba.core.caching')._CacheLocator
    source = str(ROOT / KERNELS / '__init__.py')
    target = cache / locator.get_suitable_cache_subpath(source)
    copy_cache(target)
    missing = list(target.glob(f'{QUICKEST}*'))
    assert missing
    for path in missing:
        path.unlink()


def copy_cache(target):
    """Copy the compiled functions of the source tree."""
    target.mkdir(parents=True, exist_ok=True)
    for path in (ROOT / KERNELS / '__pycache__').glob('*.nb[ic]'):
        shutil.copy2(path, target)
