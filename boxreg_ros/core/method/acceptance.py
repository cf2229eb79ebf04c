"""Which boxes of an estimate are accepted (M27)."""

from typing import Any, NamedTuple

from boxreg_ros.core.method.arrays import most_points, POSE
from boxreg_ros.core.method.articulation import changes_shape, extent_ranges
from boxreg_ros.core.method.compile import kernel, loop, small_array
from boxreg_ros.core.method.expectation import SIZE
from boxreg_ros.core.method.faces import fill_moved, fill_velocity, to_box_axes
from boxreg_ros.core.method.noise import are_finite
from boxreg_ros.core.method.rotation import fill_rotation
from boxreg_ros.core.method.selection import sum_of
import numpy as np

ACCEPTED, NO_POINTS, NOT_FINITE, NO_GAIN, NOT_RIGID = range(5)
"""Results of the tests; of several that fail the first."""


class Tested(NamedTuple):
    """
    What the tests find of B windows.

    Attributes
    ----------
    results : array, shape (B, N)
        One of `ACCEPTED` and the others; padding is accepted.
    boxes : array, shape (B, N, 9)
        The refined boxes, angles within [-pi, pi).
    near_points : array, shape (B, N, 2)
        Points in each refined box, or near it, and the others of its observation.
    ranges : array, shape (B, 2, 3)
        Of the input extents, see `extent_ranges`: those of the windows before, widened.
    is_finite : array, shape (B,)
        Whether all boxes and covariances of a window are finite, those of padding as well.

    """

    results: Any
    boxes: Any
    near_points: Any
    ranges: Any
    is_finite: Any


class _Room(NamedTuple):
    """Arrays to work in, for observations of at most M points: (3, M) and (3, 3)."""

    moved: Any
    local: Any
    R: Any


@loop
def count_held(b, n, problem, velocity, pose, extent, margin, room):
    """Return how many points of an observation are in a box, or less than `margin` outside."""
    moved, local, R = room
    box = problem.boxes[b, n]
    fill_rotation(pose[3], pose[4], pose[5], R)
    m = fill_moved(b, n, problem, velocity, moved)
    shift = (pose[0] - box[0], pose[1] - box[1], pose[2] - box[2])
    to_box_axes(m, moved, shift, R, local)
    reach_x, reach_y, reach_z = (
        extent[0] / 2 + margin, extent[1] / 2 + margin, extent[2] / 2 + margin
    )  # fmt: skip
    count = 0
    for i in range(m):
        count += (
            (abs(local[0, i]) < reach_x)
            & (abs(local[1, i]) < reach_y)
            & (abs(local[2, i]) < reach_z)
        )
    return count


@loop
def fill_box(pose, extent, base, box):
    """Write a box (9,) by its pose relative to `base` (3,), its angles within [-pi, pi)."""
    for k in range(3):
        box[k] = pose[k] + base[k]
        box[3 + k] = extent[k]
        box[6 + k] = (pose[3 + k] + np.pi) % (2 * np.pi) - np.pi


@kernel
def accept(
    first, last, problem, base, poses, extents, covariances, margin, span, constants, found
):
    """
    Test the refined boxes of windows `first` to `last`.

    The tests, in their order: the window has points; box and covariance are finite and the extent
    is positive; the refined box holds nearly as many points as the input box, which the objective
    does not require; the body keeps its shape, as the objective assumes.

    Parameters
    ----------
    first, last : int
        First window, and the one after the last.
    problem : Problem
        Input of the batch.
    base : array, shape (B, 3)
        Origin of its centres in the fixed frame [m].
    poses, extents : array, shapes (B, N, 6) and (B, N, 3)
        The refined boxes [m, rad].
    covariances : array, shape (B, N, 6, 6)
        Of the poses.
    margin : float
        Points up to this far outside of a box are held [m].
    span : int
        Of `extent_ranges`.
    constants : array of one record of `Constants`, shape (1,)
        Of the method.
    found : Tested
        Written; the ranges of the windows before are given.

    """
    M = most_points(problem.counts[first:last])
    room = _Room(np.empty((3, M)), np.empty((3, M)), np.empty((3, 3)))
    accept_in_turn(
        first, last, problem, base, poses, extents, covariances, margin, span, constants[0], found,
        room, np.empty((poses.shape[1], POSE)),
    )  # fmt: skip


@loop
def accept_in_turn(first, last, problem, base, poses, extents, covariances, margin, span,
                   constants, found, room, given):  # fmt: skip
    """Do what `accept` does; `room`, and `given` (N, 6) for input poses, are to work in."""
    velocity = small_array(3)
    for k in range(3):
        velocity[k] = 0.0
    kept_part = 1 - constants.max_lost_part
    for b in range(first, last):
        length, boxes, times = problem.lengths[b], problem.boxes[b], problem.times[b]
        extent_ranges(boxes, length, span, found.ranges[b])
        is_bent = changes_shape(found.ranges[b], problem.of_class[b].extent, constants.gate)
        has_points = sum_of(problem.counts[b]) > 0
        found.is_finite[b] = True
        for n in range(len(boxes)):
            for k in range(POSE):
                given[n, k] = boxes[n, k if k < 3 else k + 3]
        for n in range(len(boxes)):
            of_poses, extent = poses[b], extents[b, n]
            is_finite = are_finite(of_poses[n]) and are_finite(extent)
            is_finite &= min(extent[0], extent[1], extent[2]) > 0.0
            for k in range(POSE):
                is_finite &= are_finite(covariances[b, n, k])
            found.is_finite[b] &= is_finite
            fill_box(of_poses[n], extent, base[b], found.boxes[b, n])
            found.results[b, n] = ACCEPTED
            if n >= length:
                continue
            held, count = -1, problem.counts[b, n]
            least = kept_part * count - constants.min_face_points
            for is_input in range(2):
                if problem.is_moving:
                    fill_velocity(of_poses, times, n, length, velocity)
                inside = count_held(b, n, problem, velocity, of_poses[n], extent, margin, room)
                if is_input:
                    least = kept_part * inside - constants.min_face_points
                else:
                    held = inside
                if held >= least:  # at most: counting those of the input boxes takes time
                    break
                of_poses, extent = given, boxes[n, 3 : 3 + SIZE]
            found.near_points[b, n, 0] = held
            found.near_points[b, n, 1] = count - held
            if not has_points:
                found.results[b, n] = NO_POINTS
            elif not is_finite:
                found.results[b, n] = NOT_FINITE
            elif held < least:
                found.results[b, n] = NO_GAIN
            elif is_bent:
                found.results[b, n] = NOT_RIGID
