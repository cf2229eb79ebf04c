"""How kernels are compiled: by numba, once, kept on disk."""

from collections.abc import Callable
from typing import Any, TypeVar

import numba

REORDER = {'contract', 'reassoc'}
"""
Sums may be taken in another order, so that they use vector instructions. NaN and infinity are
handled as usual.

"""
_F = TypeVar('_F', bound=Callable[..., Any])


def kernel(function: _F) -> _F:
    """
    Compile a function of numbers and arrays.

    It runs without the interpreter's lock: threads share the windows of a batch, and as no window
    depends on another, the results do not depend on the number of threads. (Numba's own threads
    do not survive a fork, and the workers of `boxreg relabel` are forked.)

    """
    return numba.njit(
        function, cache=True, nogil=True, error_model='numpy', fastmath=REORDER
    )

