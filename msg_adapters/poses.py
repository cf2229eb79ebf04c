"""Stamps, poses, covariances and copies, shared by the adapters of box messages."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from copy import copy
from operator import attrgetter
from types import SimpleNamespace
from typing import Any

from boxreg_ros.errors import UnsupportedMessage
from boxreg_ros.rotations import (
    matrix_from_quaternion,
    matrix_from_rpy,
    quaternion_from_matrix,
    quaternion_from_rpy,
    rotated_kinematics,
    rpy_from_quaternion,
)
from boxreg_ros.structures import BOX_CENTER, BOX_EXTENT, BoxArray, Floats, ROLL
import numpy as np
from numpy.typing import NDArray

UNIT_TOLERANCE = 0.01
"""Tolerance of a squared quaternion norm, the same as in tf2."""
MOTION_AXES = {'velocity': [0, 1, 2, 5], 'acceleration': [0, 1, 2]}
"""Places of `KINEMATICS` among the six numbers of a twist or an accel."""


def stamp_ns(header: Any) -> int:
    """Return the stamp of a header [ns]."""
    return int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec)


def require_fields(kind: str, items: Iterable[Any], names: Sequence[str]) -> None:
    """
    Raise UnsupportedMessage if a message lacks a field that an adapter reads.

    Recordings contain their own message definitions, and JSON has none, so a message of a known
    name may lack one.

    Parameters
    ----------
    kind : str
        Type of the message, for errors.
    items : iterable
        Parts of the message; one is enough where all have the same definition.
    names : sequence of str
        Paths of attributes, as ``'pose.position'``.

    Raises
    ------
    UnsupportedMessage
        If one of the items lacks one of them.

    """
    for item in items:
        for name in names:
            try:
                attrgetter(name)(item)
            except AttributeError:
                raise UnsupportedMessage(
                    f'{kind}: expected a message with the field {name}, got one without; '
                    f'convert it to the current definition'
                ) from None


def common_header(kind: str, header: Any, items: Sequence[Any]) -> Any:
    """
    Return the header of an array of boxes.

    Parameters
    ----------
    kind : str
        Type of the message, for errors.
    header : std_msgs/Header
        Of the array. Where the items name a frame, theirs counts: their poses are in it. Where its
        stamp is 0 that of the items counts, if they have the same.
    items : sequence
        Boxes with a header of their own.

    Raises
    ------
    UnsupportedMessage
        If they are in several frames.

    """
    own = header
    frames = {item.header.frame_id or header.frame_id for item in items} - {''}
    if len(frames) > 1:
        raise UnsupportedMessage(
            f'{kind}: expected all boxes of a message in one frame, got '
            f'{" and ".join(map(repr, sorted(frames)))}; split the array by frame, or transform '
            f'its boxes into one, where they are published, or in a copy of the recording'
        )
    if frames - {header.frame_id}:
        header = replaced(header, frame_id=frames.pop())
    if stamp_ns(own) == 0 and len({stamp_ns(item.header) for item in items}) == 1:
        return replaced(header, stamp=items[0].header.stamp)
    return header


def common_stamp_and_frame(kind: str, headers: Iterable[tuple[int, str]]) -> tuple[int, str]:
    """
    Return the one stamp and frame of boxes that have a header each.

    Parameters
    ----------
    kind : str
        Type of the message, for errors.
    headers : iterable of (int, str)
        Stamp [ns] and frame of each box.

    Returns
    -------
    stamp_ns : int
        [ns]; 0 without boxes.
    frame_id : str
        Empty without boxes.

    Raises
    ------
    UnsupportedMessage
        If the boxes have several stamps or frames.

    """
    found = set(headers)
    if len(found) > 1:
        names = ', '.join(f'{frame!r} at {stamp} ns' for stamp, frame in sorted(found))
        raise UnsupportedMessage(
            f'{kind}: expected one frame and one stamp for all boxes, got {names}; publish one '
            f'array per frame and stamp'
        )
    return found.pop() if found else (0, '')


def boxes_of(poses: Sequence[Any], sizes: Sequence[Any]) -> Floats:
    """
    Return boxes of poses and extents.

    Parameters
    ----------
    poses : sequence of n geometry_msgs/Pose
        Of the centres of the boxes, x forward, y left, z up.
    sizes : sequence of n geometry_msgs/Vector3, or of three numbers each
        Full length, width and height [m].

    Returns
    -------
    boxes : array, shape (n, 9)
        x y z length width height roll pitch yaw [m, rad], in the frame of the poses. A box whose
        quaternion is not of unit length gets NaN angles, so that it is an invalid box.

    Raises
    ------
    UnsupportedMessage
        If a value is not a number, or a size does not have three.

    """
    if not len(poses):
        return np.zeros((0, 9))
    numbers = np.empty((len(poses), 10))
    try:
        numbers[:, :3] = [(p.position.x, p.position.y, p.position.z) for p in poses]
        numbers[:, 3:7] = [quaternion_of(pose) for pose in poses]
        numbers[:, 7:] = [(s.x, s.y, s.z) if hasattr(s, 'x') else s for s in sizes]
    except (OverflowError, TypeError, ValueError) as error:
        raise UnsupportedMessage(
            f'boxes: expected numbers as position, orientation and size: {error}'
        ) from None
    return boxes_from(numbers[:, :7], numbers[:, 7:])


def boxes_from(poses: Floats, sizes: Floats) -> Floats:
    """
    Return boxes of numbers, as `boxes_of` does of messages.

    Parameters
    ----------
    poses : array, shape (n, 7)
        Positions of the centres [m], and quaternions x y z w.
    sizes : array, shape (n, 3)
        Full length, width and height [m].

    Returns
    -------
    boxes : array, shape (n, 9)
        x y z length width height roll pitch yaw [m, rad]; the angles of a quaternion that is not
        of unit length are NaN.

    """
    boxes = np.full((len(poses), 9), np.nan)
    boxes[:, BOX_CENTER] = poses[:, :3]
    boxes[:, BOX_EXTENT] = sizes
    quaternions_xyzw = poses[:, 3:]
    is_unit = _is_unit(quaternions_xyzw)
    boxes[is_unit, ROLL:] = rpy_from_quaternion(quaternions_xyzw[is_unit])
    return boxes


def quaternion_of(pose: Any) -> tuple[float, float, float, float]:
    """Return the orientation of a pose, x y z w."""
    q = pose.orientation
    return q.x, q.y, q.z, q.w


def quaternions_of(boxes: Floats) -> Floats:
    """Return quaternions (n, 4), x y z w with w >= 0, of boxes (n, 9); NaN stays NaN."""
    return quaternion_from_rpy(boxes[:, ROLL:])


def placed(boxes: BoxArray) -> Iterator[tuple[Floats, Floats]]:
    """Yield each box (9,) with its quaternion (4,), as `with_box` takes them."""
    return zip(boxes.boxes, quaternions_of(boxes.boxes), strict=True)


def replaced(msg: Any, **fields: Any) -> Any:
    """Return a copy of `msg` with some fields set; other fields are shared, except protobuf's."""
    if hasattr(msg, 'CopyFrom'):  # protobuf: fields of messages and lists cannot be assigned
        new = type(msg)()
        new.CopyFrom(msg)
        for name in fields:
            new.ClearField(name)
        new.MergeFrom(type(msg)(**fields))
        return new
    new = _copied(msg)
    if isinstance(msg, SimpleNamespace):  # mcap: a copy lacks the values of slots
        fields = {name: getattr(msg, name) for name in getattr(msg, '__slots__', ())} | fields
    for name, value in fields.items():
        setattr(new, name, value)
    return new


def _copied(msg: Any) -> Any:
    """Return a shallow copy, of a message of rclpy in a fifth of the time of `copy`."""
    names = getattr(type(msg), '__slots__', ())
    if not names or hasattr(msg, '__dict__'):
        return copy(msg)
    new = object.__new__(type(msg))
    for name in names:
        setattr(new, name, getattr(msg, name))
    return new


def with_frame(header: Any, frame_id: str) -> Any:
    """Return a header of the same stamp in another frame."""
    return replaced(header, frame_id=frame_id)


def with_xyz(vector: Any, xyz: Iterable[float]) -> Any:
    """Return a copy of a vector or point with other coordinates."""
    return replaced(vector, **dict(zip('xyz', map(float, xyz), strict=True)))


def with_position(pose: Any, position: Sequence[float]) -> Any:
    """Return a copy of a pose with another position."""
    return replaced(pose, position=with_xyz(pose.position, position))


def with_orientation(pose: Any, quaternion_xyzw: Sequence[float]) -> Any:
    """Return a copy of a pose with another orientation."""
    x, y, z, w = map(float, quaternion_xyzw)
    return replaced(pose, orientation=replaced(pose.orientation, x=x, y=y, z=z, w=w))


def with_box(pose: Any, size: Any, box: Floats, quaternion_xyzw: Floats) -> tuple[Any, Any]:
    """
    Return copies of a pose and a size with the values of a box.

    Parameters
    ----------
    pose, size : geometry_msgs/Pose, and Vector3 or a sequence
        Those of the message. Where position, orientation or size of `box` is not finite, they
        remain, so that no NaN is published.
    box : array, shape (9,)
        x y z length width height roll pitch yaw [m, rad].
    quaternion_xyzw : array, shape (4,)
        Its orientation, as of `quaternions_of`.

    Returns
    -------
    pose, size
        Of the classes of the arguments.

    """
    if np.isfinite(box[BOX_CENTER]).all():
        pose = with_position(pose, box[BOX_CENTER].tolist())
    if np.isfinite(quaternion_xyzw).all():
        pose = with_orientation(pose, quaternion_xyzw.tolist())
    if np.isfinite(box[BOX_EXTENT]).all():
        extent = box[BOX_EXTENT].tolist()
        if hasattr(size, 'x'):
            size = with_xyz(size, extent)
        else:
            size = copy(size)
            for axis, value in enumerate(extent):
                size[axis] = value
    return pose, size


def with_covariance(
    posed: Any, pose: Any, covariance: Floats | None, T_out_in: Floats | None
) -> Any:
    """
    Return a copy of a ``PoseWithCovariance`` with another pose and covariance.

    Parameters
    ----------
    posed : geometry_msgs/PoseWithCovariance
        That of the message.
    pose : geometry_msgs/Pose
        The new pose.
    covariance : array, shape (6, 6), or None
        Of x y z roll pitch yaw [m, rad]; if it is NaN or None, that of the message remains,
        rotated by `T_out_in`.
    T_out_in : array, shape (4, 4), or None
        Maps the frame of the message to that of `pose`; None if they are the same.

    Returns
    -------
    geometry_msgs/PoseWithCovariance
        A copy.

    """
    own = np.array(posed.covariance, dtype=np.float64).reshape(6, 6)
    if covariance is None or np.isnan(covariance).any():
        covariance = own if T_out_in is None else turned_covariances(own, T_out_in)
    return replaced(posed, pose=pose, covariance=np.array(covariance, np.float64).reshape(36))


def turned_covariances(covariances: Floats, T_frame_boxes: Floats) -> Floats:
    """
    Return covariances of boxes in another frame.

    Parameters
    ----------
    covariances : array, shape (..., 6, 6)
        Of x y z roll pitch yaw [m, rad].
    T_frame_boxes : array, shape (4, 4)
        Maps the frame of the boxes to the other one.

    Returns
    -------
    array, shape (..., 6, 6)
        The covariance of roll, pitch and yaw is not changed. That is exact for frames that differ
        by a rotation about z, and the tilt between frames in practice is small.

    """
    J = np.eye(6)
    J[:3, :3] = T_frame_boxes[:3, :3]
    return J @ covariances @ J.T


def rotated(vector: Any, T_out_in: Floats | None) -> Any:
    """Return a ``Vector3`` of the input frame in the output frame."""
    if T_out_in is None:
        return vector
    return with_xyz(vector, T_out_in[:3, :3] @ [vector.x, vector.y, vector.z])


def moved_polygon(polygon: Any, T_out_in: Floats | None) -> Any:
    """
    Return a polygon of the input frame in the output frame.

    Parameters
    ----------
    polygon : geometry_msgs/Polygon
        With points in the input frame [m].
    T_out_in : array, shape (4, 4), or None
        Maps the input frame to the output frame; None if they are the same.

    Returns
    -------
    geometry_msgs/Polygon
        A copy; `polygon` itself without a transform.

    """
    if T_out_in is None:
        return polygon
    R, t = T_out_in[:3, :3], T_out_in[:3, 3]
    points = [with_xyz(p, R @ [p.x, p.y, p.z] + t) for p in polygon.points]
    return replaced(polygon, points=points)


def rotated_motion(motion: Any, name: str, T_out_in: Floats | None) -> Any:
    """
    Return a twist or an accel of the input frame in the output frame.

    Parameters
    ----------
    motion : message
        ``Twist`` or ``Accel``, or one of these with a covariance.
    name : str
        ``twist`` or ``accel``: the field that has it where there is a covariance.
    T_out_in : array, shape (4, 4), or None
        Maps the input frame to the output frame; None if they are the same. Only its rotation is
        applied: velocities are over ground.

    Returns
    -------
    message
        A copy of the class of `motion`. Both parts of the covariance are rotated.

    """
    if not hasattr(motion, 'covariance'):
        linear = rotated(motion.linear, T_out_in)
        return replaced(motion, linear=linear, angular=rotated(motion.angular, T_out_in))
    inner = rotated_motion(getattr(motion, name), name, T_out_in)
    covariance = motion.covariance
    if T_out_in is not None:
        J = np.kron(np.eye(2), T_out_in[:3, :3])
        covariance = (J @ np.reshape(covariance, (6, 6)) @ J.T).ravel()
    return replaced(motion, **{name: inner, 'covariance': covariance})


def with_motion(motion: Any, name: str, found: NDArray[np.void], key: str) -> Any:
    """
    Return a twist or an accel with the one that was found, where it is known.

    Parameters
    ----------
    motion : message
        As in `rotated_motion`, in the axes that `found` is in.
    name : str
        As there.
    found : array, shape (1,)
        Record `KINEMATICS`.
    key : str
        ``velocity`` or ``acceleration``.

    """
    if not found[f'has_{key}'][0]:
        return motion
    own = _motion_numbers(motion, name)[None]
    return _with_motion_numbers(motion, name, with_kinematics(own, found, key)[0])


def _motion_numbers(motion: Any, name: str) -> Floats:
    """
    Return the numbers of a twist or an accel in the order of the message: 6, or 42.

    Those of a stamped one, with `name` as in `rotated_motion`, are followed by its covariance.

    """
    inner = getattr(motion, name) if hasattr(motion, 'covariance') else motion
    own = [getattr(part, axis) for part in (inner.linear, inner.angular) for axis in 'xyz']
    return np.concatenate([own, getattr(motion, 'covariance', [])]).astype(np.float64)


def _with_motion_numbers(motion: Any, name: str, numbers: Floats) -> Any:
    """Return a copy of a twist or an accel with the numbers of `_motion_numbers`."""
    if hasattr(motion, 'covariance'):
        inner = _with_motion_numbers(getattr(motion, name), name, numbers[:6])
        return replaced(motion, **{name: inner, 'covariance': numbers[6:]})
    linear = with_xyz(motion.linear, numbers[:3])
    return replaced(motion, linear=linear, angular=with_xyz(motion.angular, numbers[3:]))


def with_kinematics(own: Floats, kinematics: NDArray[np.void] | None, name: str) -> Floats:
    """
    Return the numbers of twists or accels where they are known, and `own` elsewhere.

    Parameters
    ----------
    own : array, shape (n, 6) or (n, 42)
        Of the message, as of `_motion_numbers`.
    kinematics : array, shape (n,), or None
        Records `KINEMATICS` in the axes of the message.
    name : str
        ``velocity`` or ``acceleration``, of the records.

    Returns
    -------
    array, of the shape of `own`
        Roll and pitch, and the acceleration of yaw, remain those of the message.

    """
    if kinematics is None:
        return own
    axes = MOTION_AXES[name]
    new = own.copy()
    new[:, axes] = kinematics[name]
    if own.shape[1] > 6:
        covariances = new[:, 6:].reshape(-1, 6, 6)  # a view
        covariances[:, axes, :] = 0.0
        covariances[:, :, axes] = 0.0
        rows, columns = np.ix_(axes, axes)
        covariances[:, rows, columns] = kinematics[f'{name}_covariance']
    return np.where(kinematics[f'has_{name}'][:, None], new, own)


def kinematics_of_axes(boxes: BoxArray) -> NDArray[np.void] | None:
    """
    Return the kinematics of boxes in the axes of each box.

    Parameters
    ----------
    boxes : BoxArray
        n boxes, with kinematics in the axes of their frame.

    Returns
    -------
    kinematics : array, shape (n,), or None
        Records `KINEMATICS`, unknown for boxes whose angles are NaN; None if `boxes` have none.

    """
    if boxes.kinematics is None:
        return None
    R = matrix_from_rpy(np.nan_to_num(boxes.boxes[:, ROLL:]))
    found = rotated_kinematics(boxes.kinematics, R.swapaxes(1, 2))
    is_known = np.isfinite(boxes.boxes[:, ROLL:]).all(1)
    found['has_velocity'] &= is_known
    found['has_acceleration'] &= is_known
    return found


def moved(pose: Any, T_out_in: Floats | None) -> Any:
    """
    Return a pose of the input frame in the output frame.

    Parameters
    ----------
    pose : geometry_msgs/Pose
        In the input frame [m].
    T_out_in : array, shape (4, 4), or None
        Maps the input frame to the output frame; None if they are the same.

    Returns
    -------
    geometry_msgs/Pose
        A copy; `pose` itself without a transform. An orientation that is not of unit length is
        copied as it is.

    """
    if T_out_in is None:
        return pose
    p = pose.position
    q = quaternion_of(pose)
    R = T_out_in[:3, :3]
    pose = with_position(pose, (R @ [p.x, p.y, p.z] + T_out_in[:3, 3]).tolist())
    if not _is_unit(np.array(q)):
        return pose
    return with_orientation(pose, quaternion_from_matrix(R @ matrix_from_quaternion(q)).tolist())


def forward_of(quaternion_xyzw: Sequence[Any] | Floats) -> Floats:
    """Return the x axes (3, ...) of orientations (4, ...)."""
    x, y, z, w = quaternion_xyzw
    return np.array([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)])


def _is_unit(quaternions_xyzw: Floats) -> Any:
    """Return which of quaternions (..., 4) have unit length."""
    with np.errstate(over='ignore'):  # numbers of malformed messages may be of any size
        squared_norms = np.square(quaternions_xyzw).sum(axis=-1)
    return np.abs(squared_norms - 1.0) < UNIT_TOLERANCE
