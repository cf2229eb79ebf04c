"""Eigenvalues and eigenvectors of symmetric matrices (3, 3) in closed form."""

from boxreg_ros.core.method.compile import kernel, loop
import numpy as np


@loop
def eigenvalues(C):
    """Return the eigenvalues of a symmetric matrix (3, 3), ascending, in closed form."""
    mean = (C[0, 0] + C[1, 1] + C[2, 2]) / 3
    a, b, c = C[0, 0] - mean, C[1, 1] - mean, C[2, 2] - mean
    d, e, f = C[0, 1], C[0, 2], C[1, 2]
    p = np.sqrt((a * a + b * b + c * c + 2 * (d * d + e * e + f * f)) / 6)
    if p == 0.0:
        return mean, mean, mean
    det = (a * (b * c - f * f) - d * (d * c - f * e) + e * (d * f - b * e)) / (2 * p**3)
    angle = np.arccos(min(1.0, max(-1.0, det))) / 3
    high = mean + 2 * p * np.cos(angle)
    low = mean + 2 * p * np.cos(angle + 2 * np.pi / 3)
    return low, 3 * mean - high - low, high


@kernel
def eigenvector(C, value):
    """Return the unit eigenvector of a symmetric matrix (3, 3) for one of its eigenvalues."""
    rows = C - value * np.eye(3)
    best = np.zeros(3)
    most = 0.0
    for i in range(3):
        u, v = rows[i], rows[(i + 1) % 3]
        x = u[1] * v[2] - u[2] * v[1]
        y = u[2] * v[0] - u[0] * v[2]
        z = u[0] * v[1] - u[1] * v[0]
        squared = x * x + y * y + z * z
        if squared > most:
            most = squared
            best[0], best[1], best[2] = x, y, z
    return best / np.sqrt(most) if most > 0 else best
