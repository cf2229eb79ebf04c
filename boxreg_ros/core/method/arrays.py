"""
What the functions of a round pass to each other, as named tuples of arrays.

Letters of the shapes: B windows, N observations of a window, K kinds of objects. A tuple of a batch
has all B windows in front; `of_window` functions return views of one. Only the first `lengths`
observations of a window are read; the others are padding.

"""

from typing import Any, NamedTuple

from boxreg_ros.core.method.compile import kernel

POSE = 6
"""Variables of a pose: x y z roll pitch yaw."""
EXTENT, BIAS, GAP, PIVOT, ANCHOR, SIDESLIP, SHARED = 0, 3, 9, 15, 16, 22, 23
"""First of the shared variables of each kind, and their number: extent (3), input bias (6),
labelling margins (6), pivot, anchor of the rigid shape (6), sideslip."""
PRIOR = 2 * POSE + SHARED
"""Variables of the marginalisation prior: two poses and the shared ones."""
BOTTOM = 5
"""The face that is observed by the road, not by points of the object."""
SPAN = 3 * POSE
"""Variables of the poses that a residual depends on at most."""
BOX_POSE = (0, 1, 2, 6, 7, 8)
"""Places of the pose in a box x y z length width height roll pitch yaw."""


class Faces(NamedTuple):
    """
    The outermost points on each face of each box.

    Attributes
    ----------
    moments : array, shape (B, N, 6, 4, 4)
        Mean of (q, 1)(q, 1)' over the points q, from the centre of the input box [m]; once they
        are weighed, times the weight of the face: `Terms.W_faces` is the same array.
    distance : array, shape (B, N, 6)
        Their mean signed distance from where they are expected, positive outside [m].
    weight : array, shape (B, N, 6)
        1 for a visible face, less for an occluded or distant one, 0 without points.
    inset : array, shape (B, N, 6)
        How far further inside than the labelling margin they are expected [m].
    inset_shares : array, shape (B, N, 2, 6)
        Multiples of occlusion inset and range inset in that.
    num_points : array, shape (B, N)
        Points in and near the box.

    """

    moments: Any
    distance: Any
    weight: Any
    inset: Any
    inset_shares: Any
    num_points: Any


class Expected(NamedTuple):
    """
    Means and deviations before the points of a window are used (M15).

    Attributes
    ----------
    shared, deviation : array, shape (B, 23)
        Means and deviations of the shared variables.
    pose_deviation, widened_deviation : array, shape (B, 6)
        Deviation of the input poses along the axes of their boxes, without their bias; the same,
        widened for the correlation of the errors of neighbours [m, rad].
    unmodelled_bias : array, shape (B, 6)
        Deviation of the bias of windows with a pinned box, where no bias is estimated; else 0.
    error : array, shape (B, 15)
        Deviations of the errors of mean input extents, bias and margins, as far as known (M28).

    """

    shared: Any
    deviation: Any
    pose_deviation: Any
    widened_deviation: Any
    unmodelled_bias: Any
    error: Any


class Inputs(NamedTuple):
    """
    Estimated errors of the input of a stream, one row for each of K kinds of objects.

    Lengths are in units of the deviations of the settings, but those in [m].

    Attributes
    ----------
    deviation, correlation : array, shape (K, 9)
        Of poses along the box axes and of extents (M14): deviation about the mean of a track;
        correlation from one observation to the next.
    weight : array, shape (K,)
        Of this noise against the settings: 0 without observations, near 1 after many.
    gap_correction, occlusion_inset, range_inset : array, shape (K, 6)
        Labelling margin of each face less the one of the settings; how much further inside the
        points of an occluded face are, and those of an object 70 m away [m].
    median, slopes : array, shapes (K, 3) and (K, 3, 3)
        Of the population of extents (M16); slopes are 0 where there is none.
    gap_variance, gap_tracks, gap_noise : array, shape (K, 6)
        Between the gaps of tracks (M18a): variance [m^2], number of tracks, and the share of the
        variance of an observation in that of the mean of a track.

    """

    deviation: Any
    correlation: Any
    weight: Any
    gap_correction: Any
    occlusion_inset: Any
    range_inset: Any
    median: Any
    slopes: Any
    gap_variance: Any
    gap_tracks: Any
    gap_noise: Any


class Terms(NamedTuple):
    """
    Data and weights of all residuals (M1) in one round.

    Attributes
    ----------
    given, start : array, shape (B, N, 6)
        Input poses, and poses at the start of the round.
    axes : array, shape (B, N, 3, 3)
        Axes of the boxes at the start of the round.
    times : array, shape (B, N)
        Time of each observation [s].
    inset, W_faces : array, shapes (B, N, 6) and (B, N, 6, 4, 4)
        Faces (M2).
    wanted, root : array, shapes (B, N, 6) and (B, N, 6, 6)
        Rigid shape (M4): wanted step, and a root of its information. No rows where it is off.
    W : array, shape (B, n, N, 6)
        Weights of the n `RESIDUALS`, by the observation where each begins; 0 where it is left out.
    prior_mean, W_prior : array, shapes (B, 35) and (B, 35, 35)
        Marginalisation prior (M9).
    expected, W_shared : array, shape (B, 23)
        Shared variables (M8).

    """

    given: Any
    start: Any
    axes: Any
    times: Any
    inset: Any
    W_faces: Any
    wanted: Any
    root: Any
    W: Any
    prior_mean: Any
    W_prior: Any
    expected: Any
    W_shared: Any


@kernel
def terms_of_window(b, terms):
    """Return the terms of window `b`."""
    return Terms(
        terms.given[b], terms.start[b], terms.axes[b], terms.times[b], terms.inset[b],
        terms.W_faces[b], terms.wanted[b], terms.root[b], terms.W[b], terms.prior_mean[b],
        terms.W_prior[b], terms.expected[b], terms.W_shared[b],
    )  # fmt: skip


@kernel
def expected_of_window(b, expected):
    """Return the expectation of window `b`."""
    return Expected(
        expected.shared[b], expected.deviation[b], expected.pose_deviation[b],
        expected.widened_deviation[b], expected.unmodelled_bias[b], expected.error[b],
    )  # fmt: skip


class Arrowhead(NamedTuple):
    """
    A matrix as `arrowhead` keeps it, or its Cholesky factor.

    Attributes
    ----------
    links : array, shape (B, N + 2, 6, 18)
        Blocks of each pose: upper triangle of its own, and those with the two poses after it. Two
        poses of padding, zero, end the chain.
    border : array, shape (B, N + 2, 6, 23)
        Blocks of each pose with the shared variables.
    corner : array, shape (B, 23, 23)
        Upper triangle of the block of the shared variables.

    """

    links: Any
    border: Any
    corner: Any


@kernel
def matrix_of_window(b, matrix):
    """Return the matrix of window `b`."""
    return Arrowhead(matrix.links[b], matrix.border[b], matrix.corner[b])


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

    """

    poses: Any
    extents: Any
    face_distances: Any


class Solution(NamedTuple):
    """
    A batch that is being solved: the start of a round, then its end.

    Attributes
    ----------
    poses, shared : array, shapes (B, N, 6) and (B, 23)
        Boxes, and the variables that all observations of a window share.
    evidence : array, shape (B, 3, 3)
        Evidence of the points about the extents (M17): logarithms of the input extents;
        corrections by the points alone; their weights.
    posterior : Posterior
        Of windows that are done.
    prior_state, prior_step, prior_information : array, shapes (B, 35), (B, 35), (B, 35, 35)
        What full windows leave to the next ones (M13): linearisation point, step from there to
        the minimum, information; NaN for others, no rows if it is not wanted.

    """

    poses: Any
    shared: Any
    evidence: Any
    posterior: Any
    prior_state: Any
    prior_step: Any
    prior_information: Any
