"""Compiled kernels for copies of the package."""

import shutil

from paths import ROOT
import pytest

KERNELS = ('boxreg_ros/core/method',)
READER = 'msg_adapters'
"""Where the only other compiled function lies, the reader of box messages."""


def copy_compiled(root):
    """
    Give a copy of the package in folder `root` what is compiled.

    Compiling takes a minute of processor time. Numba takes a compiled file for that of a source
    with the same time of change.

    """
    for folder in (*KERNELS, READER):
        for path in (ROOT / folder).glob('*.py'):
            shutil.copystat(path, root / folder / path.name)
        copy_cache(folder, root / folder / '__pycache__')


def fill_cache(cache):
    """Give folder `cache` for NUMBA_CACHE_DIR what is compiled, except the reader of messages."""
    locator = pytest.importorskip('numba.core.caching')._CacheLocator
    for folder in KERNELS:
        source = str(ROOT / folder / '__init__.py')
        copy_cache(folder, cache / locator.get_suitable_cache_subpath(source))


def copy_cache(folder, target):
    """Copy the compiled functions of a folder of the source tree."""
    target.mkdir(parents=True, exist_ok=True)
    for path in (ROOT / folder / '__pycache__').glob('*.nb[ic]'):
        shutil.copy2(path, target)
