"""Compiled kernels for copies of the package."""

import shutil

from paths import ROOT

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
