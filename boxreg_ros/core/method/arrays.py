"""
What the functions of a round pass to each other: records, and named tuples of arrays.

Letters of the shapes: B windows, N observations of a window, K kinds of objects. The terms of a
batch are an array (B, N) of records `residuals.TERMS`, and (B,) of `COMMON`. Only the first
`lengths` observations of a window are read; the others are padding. There are S shared variables,
`SHARED` of whole tracks and `ANCHOR` of sliding windows.

"""

from typing import Any, NamedTuple

from boxreg_ros.core.method.compile import loop
import numpy as np

POSE = 6
"""Variables of a pose: x y z roll pitch yaw."""
EXTENT, BIAS, GAP, PIVOT, SIDESLIP, ANCHOR, SHARED = 0, 3, 9, 15, 16, 17, 23
"""First of the shared variables of each kind, and their number: extent (3), input bias (6),
labelling margins (6), pivot, sideslip, anchor of the rigid shape (6). Sliding windows have none of
the last."""
PRIOR = 2 * POSE + ANCHOR
"""Variables of the marginalisation prior: two poses and the shared ones of a sliding window."""
TOP, BOTTOM = 4, 5
"""The face that is observed by the road, not by points of the object."""
SPAN = 3 * POSE
"""Variables of the poses that a residual depends on at most."""
LANES = 16
"""Points of an observation, and columns of a coupling, are padded to a multiple of this. Derived:
four vectors of 256 bits, as loops are compiled: then none are left to be taken one by one."""
WIDTH = -(-(SHARED + 2 * POSE) // LANES) * LANES
"""The most columns of a coupling."""
BOX_POSE = (0, 1, 2, 6, 7, 8)
"""Places of the pose in a box x y z length width height roll pitch yaw."""


COMMON = np.dtype(
    [
        ('shared', float, SHARED),
        ('deviation', float, SHARED),
        ('pose_deviation', float, POSE),
        ('widened_deviation', float, POSE),
        ('unmodelled_bias', float, POSE),
        ('unclaimed', float, GAP),
        ('margin_variance', float, 6),
        ('W_shared', float, SHARED),
    ],
    align=True,
)
"""
What the observations of a window have in common in one round.

shared, deviation
    Expected means and deviations of the shared variables before points are used (M14), (23,).
pose_deviation, widened_deviation
    Deviation of the input poses along the axes of their boxes, without their bias; the same,
    widened for the correlation of the errors of neighbours, (6,) [m, rad].
unmodelled_bias
    Deviation of the bias of windows with a pinned box, where no bias is estimated; else 0, (6,).
unclaimed
    Variances of the errors of mean input extents and bias beyond those of `deviation` (M28), (9,).
margin_variance
    Of the margins of the kind, which all its tracks have in common (M15), (6,) [m^2].
W_shared
    Weights of the shared variables (M8), (23,).
"""

INPUTS = np.dtype(
    [
        ('deviation', float, 9),
        ('correlation', float, 9),
        ('extent_error', float, 3),
        ('low_noise', float),
        ('margin', float, 6),
        ('spread', float, 6),
        ('margin_variance', float, 6),
        ('occlusion_inset', float, 6),
        ('range_inset', float, 6),
        ('median', float, 3),
        ('slopes', float, (3, 3)),
    ],
    align=True,
)
"""
The model of the input of a stream, for one kind of objects.

deviation, correlation
    Of the errors of poses along the box axes and of extents that change along a track (M16):
    deviation in units of the settings; correlation from one observation to the next, (9,).
extent_error
    Deviation of the errors of extents that are constant along a track, in the same units, (3,).
low_noise
    Factor for low-noise input (M17), 1 for others.
margin, margin_variance, spread
    Labelling margin of each face less the one of the settings [m], the variance of this estimate
    [m^2], and the deviation between tracks, in units of the settings (M15), (6,).
occlusion_inset, range_inset
    How much further inside the points of an occluded face are, and those of an object 70 m away,
    (6,) [m].
median, slopes
    Of the population of extents (M18), (3,) and (3, 3); slopes are 0 where there is none.
"""


BLOCK = np.dtype([('links', float, (POSE, SPAN)), ('border', float, (POSE, SHARED))], align=True)
"""
The rows of one pose in the symmetric matrix of a window.

links
    Upper triangle of its own block, and the blocks with the two poses after it, (6, 18).
border
    Block with the S shared variables, in the first columns, (6, 23).
"""


class Arrowhead(NamedTuple):
    """
    The symmetric matrix of one window as `arrowhead` keeps it.

    Attributes
    ----------
    poses : array of `BLOCK`, shape (N + 2,)
        Two poses of padding, zero, end the chain.
    corner : array, shape (S, S)
        Upper triangle of the block of the shared variables.

    """

    poses: Any
    corner: Any


class Factor(NamedTuple):
    """
    A factor L' D L of B matrices (M1), in blocks: what solves for a right side, and inverts.

    Attributes
    ----------
    own : array, shape (B, N, 6, 6)
        Inverse of the block of each pose, without the poses before it.
    coupling : array, shape (B, N, 6, S + 12)
        Regression of each pose on the variables after it: the shared ones, and two poses. Padded
        with zeros to a multiple of `LANES`.
    corner : array, shape (B, S, S)
        Inverse of the block of the shared variables, without the poses.

    """

    own: Any
    coupling: Any
    corner: Any


@loop
def copy(values, target):
    """
    Write the first of some values to a target (n,).

    Where a slice is set to an array, numba compiles the text of an error into the kernel.

    """
    for k in range(len(target)):
        target[k] = values[k]


@loop
def padded(count):
    """Return the least multiple of `LANES` that is a `count` or more."""
    return (count + LANES - 1) & -LANES  # of which the compiler sees that it is one


@loop
def most_points(counts):
    """Return the most points of an observation, of `counts` (B, N), as a multiple of `LANES`."""
    most = 1
    for b in range(len(counts)):
        for n in range(counts.shape[1]):
            most = max(most, counts[b, n])
    return padded(most)


@loop
def factor_of_window(b, factor):
    """Return the factor of window `b`."""
    return Factor(factor.own[b], factor.coupling[b], factor.corner[b])


class Posterior(NamedTuple):
    """
    Covariances of the estimate, and the residuals of its faces.

    Attributes
    ----------
    poses : array, shape (B, N, 6, 6)
        Covariances of x y z roll pitch yaw [m, rad].
    extents : array, shape (B, 3, 3)
        Covariances of length, width and height [m].
    face_distances : array, shape (B, N, 6)
        Signed distance of the outermost points of each face from where they are expected, by the
        estimated extents and the margins of other tracks, positive outside [m]; 0 without points.
    kinematics : array of `KINEMATICS`, shape (B, N)
        Velocities and accelerations.

    """

    poses: Any
    extents: Any
    face_distances: Any
    kinematics: Any


class Quadratic(NamedTuple):
    """
    The quadratic form that replaces an observation (M13), in two poses and shared variables.

    Attributes
    ----------
    state, step : array, shape (B, 29)
        Where the residuals were linearised, and the step from there to the minimum.
    information : array, shape (B, 29, 29)
        Curvature.

    """

    state: Any
    step: Any
    information: Any


def no_priors(B: int) -> Quadratic:
    """Return room for what B windows leave."""
    step = np.full((B, PRIOR), np.nan)  # by which `estimation` knows what leaves nothing
    return Quadratic(np.empty((B, PRIOR)), step, np.empty((B, PRIOR, PRIOR)))


class Solution(NamedTuple):
    """
    A batch that is being solved: the start of a round, then its end.

    Attributes
    ----------
    poses, shared : array, shapes (B, N, 6) and (B, S)
        Boxes, and the variables that all observations of a window share.
    evidence : array, shape (B, 3, 3)
        Evidence of the points about the extents (M18): logarithms of the input extents;
        corrections by the points alone; their weights.
    posterior : Posterior
        Of windows that are done.
    left : Quadratic
        What full windows leave to the next ones; the step of others is NaN, and the rest not
        written. No rows if it is not wanted.

    """

    poses: Any
    shared: Any
    evidence: Any
    posterior: Any
    left: Quadratic
