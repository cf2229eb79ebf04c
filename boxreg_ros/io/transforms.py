"""
Rigid transforms and poses, and what they move.

``T_target_source`` is a (4, 4) matrix that maps coordinates of `source` to `target`.

"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

from boxreg_ros.rotations import (
    interpolate_quaternion,
    matrix_from_quaternion,
    matrix_from_rpy,
    rotated_kinematics,
    rpy_from_matrix,
)
from boxreg_ros.structures import BOX_CENTER, BoxArray, Floats, FrameMotion, ROLL, Sweep
import numpy as np

Pose = tuple[float, ...]
"""x y z qx qy qz qw [m]."""


def numbers_of(position: Any, orientation: Any) -> Pose:
    """Return the numbers of a position and an orientation of ROS."""
    at, turn = position, orientation
    return at.x, at.y, at.z, turn.x, turn.y, turn.z, turn.w


def matrix(pose: Floats) -> Floats:
    """Return T (..., 4, 4) of x y z qx qy qz qw (..., 7)."""
    T = np.zeros((*pose.shape[:-1], 4, 4))
    T[..., :3, :3] = matrix_from_quaternion(pose[..., 3:])
    T[..., :3, 3] = pose[..., :3]
    T[..., 3, 3] = 1.0
    return T


def inverse(T: Floats) -> Floats:
    """Return the inverse of rigid transforms T (..., 4, 4)."""
    inverted = np.zeros_like(T)
    R = np.swapaxes(T[..., :3, :3], -1, -2)
    inverted[..., :3, :3] = R
    inverted[..., :3, 3] = -(R @ T[..., :3, 3, None])[..., 0]
    inverted[..., 3, 3] = 1.0
    return inverted


def interpolated(stamps_ns: Sequence[int], poses: Sequence[Floats], stamp_ns: int) -> Floats:
    """
    Return the pose at a stamp, interpolated or extrapolated.

    Positions are those of the polynomial of degree n - 1 through the samples. Neville's scheme
    makes it of interpolations between two poses each, so that it holds for orientations, too.

    Parameters
    ----------
    stamps_ns : sequence of int
        Different stamps of n >= 2 samples [ns], ascending.
    poses : sequence of array, shape (7,)
        x y z qx qy qz qw at these stamps [m].
    stamp_ns : int
        The stamp to return the pose at [ns].

    Returns
    -------
    T : array, shape (4, 4)
        The pose as a transform.

    """
    values = list(poses)
    for step in range(1, len(values)):
        values = [
            between(
                first,
                second,
                (stamp_ns - stamps_ns[row]) / (stamps_ns[row + step] - stamps_ns[row]),
            )
            for row, (first, second) in enumerate(pairwise(values))
        ]
    return matrix(values[0])


def between(first: Floats, second: Floats, share: float | Floats) -> Floats:
    """Return the poses (..., 7) between two poses: `share` (...) 0 is the first, 1 the second."""
    part = np.asarray(share)[..., None]
    position = first[..., :3] + part * (second[..., :3] - first[..., :3])
    turn = interpolate_quaternion(first[..., 3:], second[..., 3:], share)
    return np.concatenate([position, turn], axis=-1)


def sweep_to_frame(sweep: Sweep, T_frame_sweep: Floats, frame_id: str) -> Sweep:
    """
    Return a sweep in another frame without moving its points.

    Parameters
    ----------
    sweep : Sweep
        In any frame.
    T_frame_sweep : array, shape (4, 4)
        Maps its `frame_id` to the other frame.
    frame_id : str
        The other frame.

    Returns
    -------
    sweep : Sweep
        With the same arrays `points` and `times`; `origin`, `origins` and `T_frame_points` are of
        the other frame. `in_frame` moves the points.

    """
    R = T_frame_sweep[:3, :3]
    t = T_frame_sweep[:3, 3]
    known = sweep.T_frame_points
    return replace(
        sweep,
        frame_id=frame_id,
        origin=R @ sweep.origin + t,
        origins=None if sweep.origins is None else sweep.origins @ R.T + t,
        T_frame_points=T_frame_sweep if known is None else T_frame_sweep @ known,
    )


def boxes_to_frame(
    boxes: BoxArray,
    T_frame_boxes: Floats,
    frame_id: str,
    motion: FrameMotion | None = None,
    ticket: object = None,
) -> BoxArray:
    """
    Return boxes in another frame.

    Parameters
    ----------
    boxes : BoxArray
        n boxes in any frame; NaN stays NaN.
    T_frame_boxes : array, shape (4, 4)
        Maps their `frame_id` to the other frame, at their stamp.
    frame_id : str
        The other frame. If it is their own, the numbers are the same: to convert angles changes
        their last digits.
    motion : FrameMotion, optional
        That of their own frame in the other one.
    ticket : object, optional
        Of the result; default: theirs.

    Returns
    -------
    boxes : BoxArray
        Their kinematics are in the axes of the other frame, but over ground: a moving frame takes
        nothing off.

    """
    moved, kinematics = boxes.boxes, boxes.kinematics
    if frame_id != boxes.frame_id:
        moved = moved_boxes(moved, T_frame_boxes)
        if kinematics is not None:
            kinematics = rotated_kinematics(kinematics, T_frame_boxes[:3, :3])
    return replace(
        boxes,
        frame_id=frame_id,
        boxes=moved,
        motion=motion,
        ticket=boxes.ticket if ticket is None else ticket,
        kinematics=kinematics,
    )


def moved_boxes(boxes: Floats, T_frame_boxes: Floats) -> Floats:
    """Return boxes (n, 9) in another frame by a transform (4, 4); NaN stays NaN."""
    moved = boxes.copy()
    R = T_frame_boxes[:3, :3]
    moved[:, BOX_CENTER] = boxes[:, BOX_CENTER] @ R.T + T_frame_boxes[:3, 3]
    moved[:, ROLL:] = rpy_from_matrix(R @ matrix_from_rpy(moved[:, ROLL:]))
    return moved
