"""Compiled kernels for copies of the package."""

import shutil

from paths import ROOT
import pytest

KERNELS = ('boxreg_ros/core/method', 'boxreg_ros/core/following/kernels')
READER = 'msg_adapters'
"""Where the only other compiled function lies, the reader of box messages."""


def copy_compiled(root):
    """
    Give a copy of the package in folder `root` what is compiled.

    Compiling takes a minute of processor time. Numba takes a compiled file for that of a source
    with the same time of change.

    """
    for folder in (*KERNELS, READER):
        sources = ROOT / folder
        for path in sources.glob('*.py'):
            shutil.copystat(path, root / folder / path.name)
        shutil.copytree(sources / '__pycache__', root / folder / '__pycache__', dirs_exist_ok=True)


def fill_cache(cache):
    """Give folder `cache` for NUMBA_CACHE_DIR what is compiled, except the reader of messages."""
    locator = pytest.importorskip('numba.core.caching')._CacheLocator
    for folder in KERNELS:
        kernels = ROOT / folder
        target = cache / locator.get_suitable_cache_subpath(str(kernels / '__init__.py'))
        shutil.copytree(kernels / '__pycache__', target, ignore=shutil.ignore_patterns('*.pyc'))
