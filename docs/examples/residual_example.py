"""A residual with its torch twin and its kernel: the vertical velocity in the fixed frame."""

from typing import Any

from boxreg_ros.core.batch import State
from boxreg_ros.core.kernels.normal_equations import is_wanted
from boxreg_ros.core.terms import Linearised
from torch import Tensor


def rise(state: State, times: Tensor) -> Linearised:
    """Return the vertical velocity of each box in the fixed frame (M31) [m/s]."""
    rate = 1 / times.diff(dim=1)[..., None, None]  # (B, N - 1, 1, 1)
    residual = state.pose[..., 2].diff(dim=1)[..., None, None] * rate
    by_pose = rate.new_zeros(*rate.shape, 12)  # two poses of six numbers
    by_pose[..., 2] = -rate
    by_pose[..., 8] = rate
    return Linearised(residual, by_pose, residual.new_zeros(1, 1, 0))


def add_rise(n: int, poses: Any, terms: Any, gradient: Any, A: Any) -> float:
    """Add the vertical velocity from pose n to n + 1 (M31)."""
    w = terms.W_rise[n]
    rate = 1 / (terms.times[n + 1] - terms.times[n])
    r = rate * (poses[n + 1, 2] - poses[n, 2])
    gradient[6 * n + 2] -= w * rate * r
    gradient[6 * n + 8] += w * rate * r
    if is_wanted(A):
        A.links[n, 2, 2] += w * rate**2
        A.links[n, 2, 8] -= w * rate**2
        A.links[n + 1, 2, 2] += w * rate**2
    return float(0.5 * w * r**2)
