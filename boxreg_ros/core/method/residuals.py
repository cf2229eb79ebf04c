"""
The residuals of one window, (M2) to (M7): each is stated once, as r and its derivatives.

A residual of observation n writes r, J = dr/d(poses n, n + 1, ...) and S = dr/d(a few shared
variables), and returns how many rows of r and columns of S it has. Its weight stands beside it in
`RESIDUALS`; `assemble` sums r' W r / 2, its gradient and the curvature J' W J over all of them.

"""

from typing import Any, NamedTuple

from boxreg_ros.core.method.arrays import ANCHOR, BIAS, EXTENT, GAP, PIVOT, POSE, SIDESLIP, SPAN
from boxreg_ros.core.method.compile import kernel, loop
from boxreg_ros.core.method.rotation import fill_rotation_derivatives
from boxreg_ros.core.method.weights import (
    acceleration_weight,
    input_weight,
    rigid_shape_weight,
    slip_weight,
    zero_motion_weight,
)
import numpy as np


class Residual(NamedTuple):
    """
    A row of `RESIDUALS`.

    Attributes
    ----------
    function, weight : kernel
        Writes the residual of an observation, and its weights at the start of a round.
    poses : int
        Consecutive poses that it depends on.
    is_robust : bool
        Whether (M24) down-weights it as a whole.
    name : str
        Of the switch of `measure ablation`, and in docs/method.md.

    """

    function: Any
    weight: Any
    poses: int
    is_robust: bool
    name: str


class Linearised(NamedTuple):
    """
    One residual at one state, of at most 6 rows.

    Attributes
    ----------
    r, J, S : array, shapes (6,), (6, 18) and (6, 6)
        Residual; derivatives by up to three poses, and by the shared variables `columns`. J and S
        are zero before a residual function is called.
    columns : array, shape (6,)
        Of the shared variables.
    R, dR : array, shapes (3, 3) and (3, 3, 3)
        To work in.

    """

    r: Any
    J: Any
    S: Any
    columns: Any
    R: Any
    dR: Any


class Axes(NamedTuple):
    """
    Axes of the poses of a state.

    Attributes
    ----------
    R, dR : array, shapes (N, 3, 3) and (N, 3, 3, 3)
        Columns are the axes; derivatives by roll, pitch and yaw, in front.

    """

    R: Any
    dR: Any


@kernel
def empty_linearised():
    """Return room for one residual."""
    return Linearised(
        np.zeros(POSE), np.zeros((POSE, SPAN)), np.zeros((POSE, POSE)), np.zeros(POSE, np.int64),
        np.zeros((3, 3)), np.zeros((3, 3, 3)),
    )  # fmt: skip


@loop
def fill_plane(n, face, poses, shared, terms, at, v, by_angles):
    """
    Write the plane of a face (M2): its signed distance from a point q is v'(q, 1).

    q is seen from the input centre. The normal turns with the angles of the pose, `by_angles`
    (4, 3); the level also falls by the normal with the position, rises with the margin, and falls
    by half of the extent.

    """
    R, dR, given = at.R[n], at.dR[n], terms[n].given
    axis = face // 2
    sign = 1.0 - 2.0 * (face % 2)
    v[3] = terms[n].inset[face] + shared[GAP + face] - shared[EXTENT + axis] / 2
    for k in range(3):
        by_angles[3, k] = 0.0
    for j in range(3):
        shift = poses[n, j] - given[j]
        v[j] = sign * R[j, axis]
        v[3] -= v[j] * shift
        for k in range(3):
            by_angles[j, k] = sign * dR[k, j, axis]
            by_angles[3, k] -= by_angles[j, k] * shift


@loop
def fill_step(pose, origin, axes, out):
    """Write diag(axes', I)(p - origin), the step of a pose in the axes of its box."""
    for k in range(3):
        out.r[k] = 0.0
        for j in range(3):
            out.r[k] += axes[j, k] * (pose[j] - origin[j])
            out.J[k, j] = axes[j, k]
        out.r[3 + k] = pose[3 + k] - origin[3 + k]
        out.J[3 + k, 3 + k] = 1.0


@loop
def input_pose(n, poses, shared, terms, at, out):
    """Write the step of a pose from its input, less the bias (M3)."""
    fill_step(poses[n], terms[n].given, terms[n].axes, out)
    for k in range(POSE):
        out.r[k] -= shared[BIAS + k]
        out.S[k, k] = -1.0
        out.columns[k] = BIAS + k
    return POSE, POSE


@kernel
def rigid_shape(n, poses, shared, terms, at, out):
    """Write root'(step - anchor - wanted step), the rigid shape of the track (M4)."""
    fill_step(poses[n], terms[n].start, terms[n].axes, out)
    root, wanted, axes = terms[n].root, terms[n].wanted, terms[n].axes
    step = out.R.ravel()
    for k in range(POSE):
        step[k] = out.r[k] - shared[ANCHOR + k] - wanted[k]
        out.columns[k] = ANCHOR + k
    for k in range(POSE):
        out.r[k] = 0.0
        for m in range(POSE):
            out.r[k] += root[m, k] * step[m]
            out.S[k, m] = -root[m, k]
            out.J[k, m] = root[m, k]
        for j in range(3):
            out.J[k, j] = (
                root[0, k] * axes[j, 0] + root[1, k] * axes[j, 1] + root[2, k] * axes[j, 2]
            )
    return POSE, POSE


@kernel
def acceleration(n, poses, shared, terms, at, out):
    """Write the second difference of three poses over time, in the axes of the second (M5)."""
    axes = terms[n + 1].axes
    first = terms[n + 1].time - terms[n].time
    second = terms[n + 2].time - terms[n + 1].time
    mean = (first + second) / 2
    share = (1 / (first * mean), -(1 / first + 1 / second) / mean, 1 / (second * mean))
    change = out.R.ravel()
    for k in range(POSE):
        forward = (poses[n + 2, k] - poses[n + 1, k]) / second
        change[k] = (forward - (poses[n + 1, k] - poses[n, k]) / first) / mean
    for k in range(3):
        out.r[k] = axes[0, k] * change[0] + axes[1, k] * change[1] + axes[2, k] * change[2]
        out.r[3 + k] = change[3 + k]
        for i in range(3):
            for j in range(3):
                out.J[k, POSE * i + j] = share[i] * axes[j, k]
            out.J[3 + k, POSE * i + 3 + k] = share[i]
    return POSE, 0


@loop
def zero_motion(n, poses, shared, terms, at, out):
    """Write the step from a pose to the next (M6)."""
    for k in range(POSE):
        out.r[k] = poses[n + 1, k] - poses[n, k]
        out.J[k, k] = -1.0
        out.J[k, POSE + k] = 1.0
    return POSE, 0


@loop
def slip(n, poses, shared, terms, at, out):
    """
    Write the velocity of the pivot across the path and upward (M7) [m/s].

    The axes of the path are those at the mean of two orientations, turned by the sideslip.

    """
    pivot = shared[PIVOT]
    before, after = poses[n], poses[n + 1]
    fill_rotation_derivatives(
        (before[3] + after[3]) / 2, (before[4] + after[4]) / 2, (before[5] + after[5]) / 2,
        out.R, out.dR,
    )  # fmt: skip
    rate = 1 / (terms[n + 1].time - terms[n].time)
    out.columns[0] = PIVOT
    out.columns[1] = SIDESLIP
    for side in range(2):
        axis = 1 + side
        sideslip = shared[SIDESLIP] if side == 0 else 0.0
        out.r[side] = 0.0
        for j in range(3):
            turned = at.R[n + 1, j, 0] - at.R[n, j, 0]
            step = after[j] - before[j] - pivot * turned
            across = (out.R[j, axis] - sideslip * out.R[j, 0]) * rate
            out.r[side] += across * step
            out.J[side, j] = -across
            out.J[side, POSE + j] = across
            out.S[side, 0] -= across * turned
            if side == 0:
                out.S[side, 1] -= out.R[j, 0] * rate * step
            for k in range(3):
                tilt = step * (out.dR[k, j, axis] - sideslip * out.dR[k, j, 0]) * rate / 2
                out.J[side, 3 + k] += tilt + pivot * across * at.dR[n, k, j, 0]
                out.J[side, POSE + 3 + k] += tilt - pivot * across * at.dR[n + 1, k, j, 0]
    return 2, 2


RESIDUALS = (
    Residual(input_pose, input_weight, 1, False, 'input'),
    Residual(rigid_shape, rigid_shape_weight, 1, False, 'rigid shape'),
    Residual(acceleration, acceleration_weight, 3, True, 'acceleration'),
    Residual(zero_motion, zero_motion_weight, 2, False, 'zero motion'),
    Residual(slip, slip_weight, 2, True, 'slip'),
)
"""All residuals of observations but those of the faces, which `assemble.add_plane` sums."""


TERMS = np.dtype(
    [
        ('time', float),
        ('given', float, POSE),
        ('start', float, POSE),
        ('axes', float, (3, 3)),
        ('num_points', float),
        ('distance', float, 6),
        ('visibility', float, 6),
        ('inset', float, 6),
        ('inset_shares', float, (2, 6)),
        ('W_faces', float, (6, 4, 4)),
        ('wanted', float, POSE),
        ('root', float, (POSE, POSE)),
        ('W', float, (len(RESIDUALS), POSE)),
    ],
    align=True,
)
"""
Data and weights of the residuals of one observation in one round.

time
    Of the observation [s].
given, start
    Input pose, and pose at the start of the round, (6,) [m, rad].
axes
    Axes of the box at the start of the round, (3, 3).
num_points
    Points in and near the box.
distance
    Mean signed distance of the outermost points of each face from where they are expected,
    positive outside, (6,) [m].
visibility
    1 for a visible face, less for an occluded or distant one, 0 without points, (6,).
inset, inset_shares
    How far further inside than the labelling margin the points are expected, (6,) [m]; multiples
    of occlusion inset and range inset in that, (2, 6).
W_faces
    Faces (M2): mean of (q, 1)(q, 1)' over the outermost points q of each face, from the centre of
    the input box [m], times the weight of the face, (6, 4, 4).
wanted, root
    Rigid shape (M4): wanted step (6,), and a root of its information (6, 6).
W
    Weights of the `RESIDUALS` that begin here, 0 where they are left out, (n, 6).
"""


@loop
def fill_axes(poses, first, last, at):
    """Write the axes of the poses `first` to `last`."""
    for n in range(first, last):
        fill_rotation_derivatives(poses[n, 3], poses[n, 4], poses[n, 5], at.R[n], at.dR[n])
