"""
Fused loops over windows, compiled by numba: the hot path of the solver on a CPU.

Each module has plain loops over the numbers of one window, which read like docs/method.md. Its
torch twin computes the same for a whole batch, runs on a GPU and where numba cannot be used, and
is what the tests compare with. `compiled` decides which of them runs.

"""

from functools import cache
from types import ModuleType
from typing import NamedTuple
from warnings import warn

from torch import Tensor


class Kernels(NamedTuple):
    """The modules with compiled functions."""

    arrowhead: ModuleType
    face_support: ModuleType
    normal_equations: ModuleType
    rigid_shape: ModuleType


def compiled(like: Tensor) -> Kernels | None:
    """Return the kernels for tensors as `like`; None on a GPU, and where numba does not work."""
    return _load() if like.is_cpu else None


@cache
def _load() -> Kernels | None:
    try:
        from boxreg_ros.core.kernels import (
            arrowhead,
            face_support,
            normal_equations,
            rigid_shape,
        )
    except Exception as error:  # whatever an incomplete or unsupported installation raises
        reason = ' '.join(f'{type(error).__name__}: {error}'.split())
        warn(
            f'numba: expected to compile the solver, got {reason}; the solver runs by torch with '
            f'the same results, several times slower: pip install --upgrade numba',
            RuntimeWarning,
            stacklevel=2,
        )
        return None
    return Kernels(arrowhead, face_support, normal_equations, rigid_shape)
