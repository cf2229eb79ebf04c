"""
Fused loops over windows, compiled by numba: the hot path of the solver on a CPU.

Each module has plain loops over the numbers of one window, which read like docs/method.md. Its
torch twin computes the same for a whole batch, runs on a GPU and where numba cannot be used, and
is what the tests compare with. `compiled` decides which of them runs.

"""

from __future__ import annotations

from functools import cache
from types import ModuleType
from typing import Any, NamedTuple, TYPE_CHECKING
from warnings import warn

import numpy as np

if TYPE_CHECKING:  # not needed to crop
    from torch import Tensor


class Kernels(NamedTuple):
    """The modules with compiled functions."""

    crop: ModuleType
    expectation: ModuleType
    face_support: ModuleType
    noise: ModuleType
    rigid_shape: ModuleType
    rounds: ModuleType


def contiguous(tensor: Tensor) -> Any:
    """Return the values of a tensor as a contiguous array, for a kernel."""
    return np.ascontiguousarray(tensor.numpy())


def compiled(like: Tensor) -> Kernels | None:
    """Return the kernels for tensors as `like`; None on a GPU, and where numba does not work."""
    return load() if like.is_cpu else None


@cache
def load() -> Kernels | None:
    """Return the kernels; None where numba does not work, with one warning."""
    try:
        from boxreg_ros.core.kernels import (
            crop,
            expectation,
            face_support,
            noise,
            rigid_shape,
            rounds,
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
    return Kernels(crop, expectation, face_support, noise, rigid_shape, rounds)
