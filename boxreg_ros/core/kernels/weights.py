"""
Weights of all residuals of one window in one round, in plain loops.

The torch twin is `boxreg_ros.core.weights.weigh`, which has the formulas and their reasons.

"""

from math import inf, sqrt

from boxreg_ros.core.kernels.compile import kernel
from boxreg_ros.core.kernels.normal_equations import ANCHOR, BIAS, EXTENT, GAP, PIVOT
from boxreg_ros.core.kernels.rotation import fill_rotation
import numpy as np


@kernel
def fill_axes(pose, axes):
    """Write the rotations (N, 3, 3) of poses (N, 6)."""
    for n in range(len(pose)):
        fill_rotation(pose[n, 3], pose[n, 4], pose[n, 5], axes[n])


@kernel
def fill_surprise(given, times, valid, axes, surprise):
    """
    Write how far each input pose is from the least deviating prediction of its neighbours (N, 6).

    Predictions of constant velocity from the two before, from the two after, and from one on each
    side; along `axes` [m, rad].

    """
    N = len(given)
    away = np.empty(3)
    for n in range(N):
        for k in range(6):
            surprise[n, k] = inf
        for pair in range(3):
            a = n + (-2, -1, 1)[pair]
            b = n + (-1, 1, 2)[pair]
            if a < 0 or b >= N or not (valid[a] and valid[b] and valid[n]):
                continue
            share = (times[n] - times[a]) / (times[b] - times[a])
            for k in range(3):
                away[k] = given[n, k] - given[a, k] - (given[b, k] - given[a, k]) * share
                angle = given[n, 3 + k] - given[a, 3 + k]
                angle -= (given[b, 3 + k] - given[a, 3 + k]) * share
                if abs(angle) < surprise[n, 3 + k]:
                    surprise[n, 3 + k] = abs(angle)
            for k in range(3):
                along = axes[n, 0, k] * away[0] + axes[n, 1, k] * away[1] + axes[n, 2, k] * away[2]
                if abs(along) < surprise[n, k]:
                    surprise[n, k] = abs(along)
        for k in range(6):
            surprise[n, k] = surprise[n, k] / 3 if surprise[n, k] < inf else 0.0


@kernel
def weigh_faces(n, distance, weight, moments, surprise, valid, errors, outlier):
    """Turn weights (6,) of the faces of one observation into information; scale its moments."""
    away = surprise[0] ** 2 + surprise[1] ** 2
    own = valid / (1 + away**2) ** 2
    for face in range(6):
        robust = 1 / (1 + (distance[face] / outlier) ** 2) ** 2
        weight[face] *= robust * own / errors[face] ** 2
        for a in range(4):
            for b in range(4):
                moments[face, a, b] *= weight[face]


@kernel
def weigh_prior(pose, given, bias, axes, surprise, valid, error, widened, outlier, w):
    """Write the weights (6,) of the deviation of one pose from its input."""
    for k in range(6):
        if k < 3:
            r = 0.0
            for j in range(3):
                r += axes[j, k] * (pose[j] - given[j])
        else:
            r = pose[k] - given[k]
        off = (abs(r - bias[k]) + surprise[k]) / error[k]
        w[k] = valid / widened[k] ** 2 / (1 + (off / outlier) ** 2)


@kernel
def weigh_shared(
    shared, expected, deviation, face_distance, face_weight, spread, outlier, w
):
    """Write the weights (22,) of the prior on the shared variables."""
    for s in range(len(w)):
        w[s] = deviation[s] ** -2
    for face in range(6):
        axis = face // 2
        total = 0.0
        distance = 0.0
        for n in range(len(face_weight)):
            total += face_weight[n, face]
            distance += face_distance[n, face] * face_weight[n, face]
        away = distance / max(total, 1e-9)
        wide = spread**2 + deviation[BIAS + axis] ** 2 + (deviation[EXTENT + axis] / 2) ** 2
        unusual = (shared[GAP + face] - expected[GAP + face]) ** 2 / spread**2
        unusual = max(unusual, away**2 / wide)
        w[GAP + face] /= spread**2 * (1 + unusual / outlier**2)


@kernel
def weigh_acceleration(axes, information, valid, W):
    """Write the weight (6, 6) of a second difference: `information` (6,) along the box axes."""
    for j in range(6):
        for k in range(6):
            W[j, k] = 0.0
    for j in range(3):
        for k in range(3):
            total = 0.0
            for m in range(3):
                total += axes[j, m] * information[m] * axes[k, m]
            W[j, k] = total * valid
        W[3 + j, 3 + j] = information[3 + j] * valid


@kernel
def soften(far, limit, n):
    """Return the robust factor of a motion residual: no stencil yields more than the two before."""
    least = far[n]
    if n >= 2:
        least = min(least, far[n - 1], far[n - 2])
    return 1 / (1 + least / limit**2) ** 2
