"""A residual, its weight and its row: the vertical velocity in the fixed frame."""

from boxreg_ros.core.method.compile import kernel
from boxreg_ros.core.method.residuals import Residual


@kernel
def rise(n, poses, shared, terms, at, out):
    """Write the vertical velocity of a box in the fixed frame (M31) [m/s]."""
    rate = 1 / (terms[n + 1].time - terms[n].time)
    out.r[0] = rate * (poses[n + 1, 2] - poses[n, 2])
    out.J[0, 2] = -rate  # z of pose n
    out.J[0, 8] = rate  # z of pose n + 1
    return 1, 0  # rows, shared variables


@kernel
def rise_weight(n, r, window, constants, w):
    """Write the weight of the vertical velocity (M31)."""
    w[0] = 1 / window.of_class.rise**2


ROW = Residual(rise, rise_weight, poses=2, is_robust=False, name='rise')
