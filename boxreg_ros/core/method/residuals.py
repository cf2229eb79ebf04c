"""
The residuals of one window, (M2) to (M7): each is stated once, as r and its derivatives.

A residual of observation n writes r, J = dr/d(poses n, n + 1, ...) and S = dr/d(a few shared
variables), and returns how many rows of r and columns of S it has. Its weight stands beside it in
`RESIDUALS`; `assemble` sums r' W r / 2, its gradient and the curvature J' W J over all of them.

"""

from typing import Any, NamedTuple

from boxreg_ros.core.method.arrays import (
    ANCHOR,
    BIAS,
    EXTENT,
    GAP,
    PIVOT,
    POSE,
    PRIOR,
    SIDESLIP,
    SPAN,
)
from boxreg_ros.core.method.compile import kernel, loop
from boxreg_ros.core.method.rotation import fill_rotation_derivatives
from boxreg_ros.core.method.weights import (
    acceleration_weight,
    input_weight,
    rigid_shape_weight,
    slip_weight,
    zero_motion_weight,
)
from numba import literal_unroll
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
    is_combination : bool
        Whether it has six rows and depends on its poses by one linear combination of them.

    """

    function: Any
    weight: Any
    poses: int
    is_robust: bool
    name: str
    is_combination: bool = False


LINEARISED = np.dtype(
    [
        ('r', float, POSE),
        ('J', float, (POSE, SPAN)),
        ('S', float, (POSE, POSE)),
        ('columns', int, POSE),
        ('share', float, 3),
        ('R', float, (3, 3)),
        ('dR', float, (3, 3, 3)),
        ('step', float, POSE),
        ('pull', float, POSE),
        ('curvature', float, (POSE, POSE)),
        ('plane', float, 4),
        ('by_angles', float, (4, 3)),
        ('weighted', float, (4, 3)),
        ('off', float, PRIOR),
        ('pin_factor', float, POSE),
    ],
    align=True,
)
"""
One residual at one state, of at most 6 rows.

r, J, S
    Residual (6,); derivatives by up to three poses (6, 18), and by the shared variables `columns`
    (6, 6). J and S are zero before a residual function is called.
columns
    Of the shared variables, (6,).
share
    Factors of the poses in a combination of them, (3,): the first six columns of J are derivatives
    by this.
R, dR, step, pull, curvature, plane, by_angles, weighted, off, pin_factor
    To work in.
"""


NO_LINEARISED = np.zeros(1, LINEARISED)

AXES = np.dtype(
    [
        ('R', float, (3, 3)),
        ('dR', float, (3, 3, 3)),
        ('squared', float),
        ('face_weight', float, 6),
        ('parked', bool),
    ],
    align=True,
)
"""
Axes of a pose of a state.

R, dR
    Columns are the axes (3, 3); derivatives by roll, pitch and yaw, in front (3, 3, 3).
squared, face_weight, parked
    To work in, of its observation: `weights.robustify`, `weigh_faces` and `fill_parked`.
"""


@kernel
def empty_linearised():
    """Return room for one residual."""
    room = np.empty(1, LINEARISED)
    room[0] = NO_LINEARISED[0]  # numpy's zeros take numba a tenth of a second
    return room


@loop
def fill_plane(n, axis, poses, terms, at, plane, by_angles):
    """
    Write the plane u of a box centre, normal to an axis: q is u'(q, 1) in front of it.

    q is seen from the input centre. u (4,) turns with the angles of the pose, `by_angles` (4, 3).
    The distance of q from a face along the axis (M2) is that, or its negative for the face at the
    back, plus `level_of`.

    """
    R, dR, given = at[n].R, at[n].dR, terms[n].given
    plane[3] = 0.0
    for k in range(3):
        by_angles[3, k] = 0.0
    for j in range(3):
        shift = poses[n, j] - given[j]
        plane[j] = R[j, axis]
        plane[3] -= plane[j] * shift
        for k in range(3):
            by_angles[j, k] = dR[k, j, axis]
            by_angles[3, k] -= by_angles[j, k] * shift


@loop
def level_of(n, face, shared, terms):
    """Return how far a point at the box centre is in front of a face: mostly less than 0 [m]."""
    return terms[n].inset[face] + shared[GAP + face] - shared[EXTENT + face // 2] / 2


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
    out.share[0] = 1.0


@loop
def input_pose(n, poses, shared, terms, at, out):
    """Write the step of a pose from its input, less the bias (M3)."""
    fill_step(poses[n], terms[n].given, terms[n].axes, out)
    for k in range(POSE):
        out.r[k] -= shared[BIAS + k]
        out.S[k, k] = -1.0
        out.columns[k] = BIAS + k
    return POSE, POSE


@loop
def rigid_shape(n, poses, shared, terms, at, out):
    """Write root'(step - anchor - wanted step), the rigid shape of the track (M4)."""
    fill_step(poses[n], terms[n].start, terms[n].axes, out)
    root, wanted, axes = terms[n].root, terms[n].wanted, terms[n].axes
    step = out.step
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


@loop
def acceleration(n, poses, shared, terms, at, out):
    """Write the second difference of three poses over time, in the axes of the second (M5)."""
    axes = terms[n + 1].axes
    first = terms[n + 1].time - terms[n].time
    second = terms[n + 2].time - terms[n + 1].time
    mean = (first + second) / 2
    out.share[0], out.share[2] = 1 / (first * mean), 1 / (second * mean)
    out.share[1] = -(1 / first + 1 / second) / mean
    change = out.step
    for k in range(POSE):
        forward = (poses[n + 2, k] - poses[n + 1, k]) / second
        change[k] = (forward - (poses[n + 1, k] - poses[n, k]) / first) / mean
    for k in range(3):
        out.r[k] = axes[0, k] * change[0] + axes[1, k] * change[1] + axes[2, k] * change[2]
        out.r[3 + k] = change[3 + k]
        for j in range(3):
            out.J[k, j] = axes[j, k]
        out.J[3 + k, 3 + k] = 1.0
    return POSE, 0


@loop
def zero_motion(n, poses, shared, terms, at, out):
    """Write the step from a pose to the next (M6)."""
    for k in range(POSE):
        out.r[k] = poses[n + 1, k] - poses[n, k]
        out.J[k, k] = 1.0
    out.share[0], out.share[1] = -1.0, 1.0
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
            turned = at[n + 1].R[j, 0] - at[n].R[j, 0]
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
                out.J[side, 3 + k] += tilt + pivot * across * at[n].dR[k, j, 0]
                out.J[side, POSE + 3 + k] += tilt - pivot * across * at[n + 1].dR[k, j, 0]
    return 2, 2


RESIDUALS = (
    Residual(input_pose, input_weight, 1, False, 'input', True),
    Residual(rigid_shape, rigid_shape_weight, 1, False, 'rigid shape', True),
    Residual(acceleration, acceleration_weight, 3, True, 'acceleration', True),
    Residual(zero_motion, zero_motion_weight, 2, False, 'zero motion', True),
    Residual(slip, slip_weight, 2, True, 'slip'),
)
"""All residuals of observations but those of the faces, which `assemble.add_faces` sums."""
POSES_OF = np.array([row.poses for row in RESIDUALS])
IS_ROBUST = np.array([row.is_robust for row in RESIDUALS])
IS_COMBINATION = np.array([row.is_combination for row in RESIDUALS])
"""Columns of the table, of which a kernel looks up those of a row."""


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
def fill_residual(i, n, poses, shared, terms, at, out):
    """Write residual `i` of observation n; return its numbers of rows and columns."""
    k, found = 0, (0, 0)
    for row in literal_unroll(RESIDUALS):
        if k == i:
            found = row.function(n, poses, shared, terms, at, out)
        k += 1
    return found


@loop
def fill_weight(i, n, r, window, constants, W):
    """Write the weights of residual `i` of observation n."""
    k = 0
    for row in literal_unroll(RESIDUALS):
        if k == i:
            row.weight(n, r, window, constants, W)
        k += 1


@loop
def fill_axes(poses, first, last, at):
    """Write the axes of the poses `first` to `last`."""
    for n in range(first, last):
        fill_rotation_derivatives(poses[n, 3], poses[n, 4], poses[n, 5], at[n].R, at[n].dR)
