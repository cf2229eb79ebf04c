"""`boxreg compile`: compile the method now, for images and robots."""

from __future__ import annotations

import argparse
from itertools import product
from pathlib import Path
import sys
import time
import warnings

from boxreg_ros.config import Config
from boxreg_ros.errors import BoxregError
from boxreg_ros.io.compilation import announced_compilation
from boxreg_ros.io.warm_up import warm_up, warm_up_followed, warm_up_follower, warm_up_labels

COMPILED_ESTIMATES = ('final', 'track')
"""Those of the node and of `boxreg relabel`; an early estimate is part of the final one."""
MODES = ('3d', 'bev')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options: there are none."""


def run(args: argparse.Namespace) -> int:
    """Compile what has not been compiled yet, and print where it is kept."""
    import numba

    begun = time.monotonic()
    with warnings.catch_warnings():
        warnings.simplefilter('error', RuntimeWarning)
        try:
            number = _compile()
        except RuntimeWarning as warning:
            raise BoxregError(str(warning)) from None
    what = 'nothing to compile'
    if number:
        what = f'compiled {number} functions in {time.monotonic() - begun:.0f} s'
    folder = vars(numba.config)['CACHE_DIR']  # set from the environment, at run time
    beside = f'{Path(__file__).parents[1]}, beside its sources'
    print(f'{what}; kept in {folder or beside}')
    return 0


def _compile() -> int:
    """Register with each estimate and mode, and follow; return the functions compiled."""
    with announced_compilation(lambda text: print(text, file=sys.stderr)) as done:
        for estimate, mode in product(COMPILED_ESTIMATES, MODES):
            warm_up(Config.from_dict({'estimate': estimate, 'mode': mode}))
        warm_up_follower(Config.from_dict({'estimate': 'track'}))
        warm_up_followed(Config())
        warm_up_labels(Config())
    return done.functions
