"""Eigenvalues and eigenvectors of symmetric matrices (3, 3) in closed form."""

from boxreg_ros.core.method.compile import loop
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


@loop
def eigenvector(C, value):
    """Return the unit eigenvector of a symmetric matrix (3, 3) for one of its eigenvalues."""
    a, b, c = C[0, 0] - value, C[1, 1] - value, C[2, 2] - value
    d, e, f = C[0, 1], C[0, 2], C[1, 2]
    of_rows = (  # the cross products of C less the value
        (d * f - e * b, e * d - a * f, a * b - d * d),
        (b * c - f * f, f * e - d * c, d * f - b * e),
        (f * e - c * d, c * a - e * e, e * d - f * a),
    )
    best, most = (0.0, 0.0, 0.0), 0.0
    for x, y, z in of_rows:
        squared = x * x + y * y + z * z
        if squared > most:
            best, most = (x, y, z), squared
    size = np.sqrt(most) if most > 0 else 1.0
    return best[0] / size, best[1] / size, best[2] / size
