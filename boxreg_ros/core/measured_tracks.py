"""Input boxes of tracks where they were measured: in a moving frame, before their stamp."""

from __future__ import annotations

from bisect import bisect_left, bisect_right, insort
from collections.abc import Sequence
from itertools import count, repeat
from math import inf
from operator import attrgetter
from typing import NamedTuple

from boxreg_ros.config import Config
from boxreg_ros.rotations import (
    matrix_from_quaternion,
    matrix_from_rpy,
    quaternion_from_matrix,
    rpy_from_matrix,
    wrap_angle,
)
from boxreg_ros.structures import (
    BOX_EXTENT,
    BoxArray,
    Floats,
    FrameMotion,
    Ints,
    is_valid_box,
    ROLL,
    YAW,
    Z,
)
import numpy as np
from numpy.typing import NDArray

SMOOTHING = 0.35
"""Reach of the local lines through a track [s]: noise must not be motion; chosen."""
DEFAULTS = Config()
"""Settings of the classes. One object: to check its values takes 0.3 ms."""


def displacements(motions: Sequence[FrameMotion | None], seconds: Floats) -> Floats:
    """
    Return how boxes move in the fixed frame if they were measured before their stamp.

    A box with stamp t that was brought to the fixed frame by the pose T(t) of its own frame, but
    was measured at t - s, was at T(t - s) inv(T(t)) times itself.

    Parameters
    ----------
    motions : sequence of A FrameMotion or None
        Poses of the frame that the boxes of each array were measured in; the last is that at the
        stamp. None for a frame that does not move.
    seconds : array, shape (C,)
        Times before the stamp [s]; outside of the known poses the motion is extrapolated.

    Returns
    -------
    T : array, shape (A, C, 4, 4)
        Maps the fixed frame to itself; the identity if one pose is known only.

    """
    found = np.tile(np.eye(4), (len(motions), len(seconds), 1, 1))
    moves = [row for row, motion in enumerate(motions) if motion and len(motion.stamps_ns) > 1]
    if not moves:
        return found
    known = [motion for motion in motions if motion and len(motion.stamps_ns) > 1]
    poses = np.concatenate([motion.T_fixed_frame for motion in known])
    quaternions = quaternion_from_matrix(poses[:, :3, :3])
    # One of both signs is the shortest rotation from the pose before.
    is_turned = (quaternions[:-1] * quaternions[1:]).sum(1) < 0
    quaternions[1:] *= np.cumprod(np.where(is_turned, -1.0, 1.0))[:, None]
    times = [(motion.stamps_ns - motion.stamps_ns[-1]) * 1e-9 for motion in known]
    ends = np.cumsum([len(of_array) for of_array in times])
    after = np.array([of.searchsorted(-seconds).clip(1, len(of) - 1) for of in times])
    after += (ends - [len(of_array) for of_array in times])[:, None]  # (A, C)
    stamp = np.concatenate(times)
    share = ((-seconds - stamp[after - 1]) / (stamp[after] - stamp[after - 1]))[..., None]
    turned = (1 - share) * quaternions[after - 1] + share * quaternions[after]
    placed = (1 - share) * poses[after - 1, :3, 3] + share * poses[after, :3, 3]
    last = poses[ends - 1, None]  # (A, 1, 4, 4)
    R = matrix_from_quaternion(turned) @ last[..., :3, :3].swapaxes(2, 3)
    found[moves, :, :3, :3] = R
    found[moves, :, :3, 3] = placed - (R @ last[..., :3, 3:])[..., 0]
    return found


class MeasuredArray:
    """The valid boxes of the tracks of a box array, and where they were for each latency."""

    def __init__(self, boxes: BoxArray, row_of: dict[str, int]) -> None:
        self.stamp_ns = boxes.stamp_ns
        self.motion = boxes.motion
        self.boxes = boxes.boxes[[*row_of.values()]]
        self.row_of = dict(zip(row_of, count()))
        self.of_candidates: Floats | None = None
        """(C, 4, 4), once it is needed."""
        self._measured = 0.0, self.boxes

    def measured(self, latency: float) -> Floats:
        """Return the boxes (n, 9) where they were measured."""
        if latency != self._measured[0]:
            T = displacements([self.motion], np.array([latency]))
            self._measured = latency, displaced(self.boxes, T.repeat(len(self.boxes), 1)[0])
        return self._measured[1]


class MeasuredTrack(NamedTuple):
    """The boxes of a track in the last seconds, as they were given, oldest first."""

    track_id: str
    arrays: list[MeasuredArray]

    def at(self, stamp_ns: int, latency: float, box: Floats) -> Floats:
        """
        Return the box of the object at a stamp, if its boxes have a latency.

        Parameters
        ----------
        stamp_ns : int
            [ns].
        latency : float
            Of the boxes [s]: one at a stamp shows the object so long before.
        box : array, shape (9,)
            The result heads as it does, within 90 degrees.

        Returns
        -------
        box : array, shape (9,)
            Interpolated between two boxes; beyond the last on a circle at constant speed; before
            the first that one [m, rad].

        """
        time_ns = stamp_ns + round(latency * 1e9)
        stamps_ns = np.array([array.stamp_ns for array in self.arrays])
        after = int(np.searchsorted(stamps_ns, time_ns))
        if after == len(stamps_ns):
            from boxreg_ros.core.motion import motion_at  # it imports numba

            boxes = self._measured(0, len(stamps_ns), latency)
            found = motion_at(stamps_ns, boxes, -1, DEFAULTS.vehicle).predict(time_ns)
        elif after == 0:
            found = self._measured(0, 1, latency)[0]
        else:
            begin_ns, end_ns = stamps_ns[after - 1 : after + 1].tolist()
            first, last = self._measured(after - 1, after + 1, latency)
            last[YAW] = first[YAW] + (last[YAW] - first[YAW] + np.pi / 2) % np.pi - np.pi / 2
            found = first + (time_ns - begin_ns) / (end_ns - begin_ns) * (last - first)
        if np.cos(found[YAW] - box[YAW]) < 0:
            found[YAW] += np.pi
        found[YAW] = wrap_angle(found[YAW])
        return found

    def _measured(self, begin: int, end: int, latency: float) -> Floats:
        """Return some boxes (n, 9) where they were measured."""
        return np.array(
            [
                array.measured(latency)[array.row_of[self.track_id]]
                for array in self.arrays[begin:end]
            ]
        )


_stamp = attrgetter('stamp_ns')


def _moved(T: Floats, points: Floats) -> Floats:
    """Return points (..., 3), each moved by its T (..., 4, 4)."""
    moved: Floats = (T[..., :3, :3] @ points[..., None])[..., 0] + T[..., :3, 3]
    return moved


def _unwrapped(yaw: Floats, is_known: NDArray[np.bool_]) -> Floats:
    """Return the yaw (A, K, C) of boxes without half turns between the known ones (A, K)."""
    rows = np.where(is_known, np.arange(len(yaw))[:, None], is_known.argmax(0))
    known_rows = np.maximum.accumulate(rows, axis=0)  # of each box, or of the one before it
    return np.unwrap(np.take_along_axis(yaw, known_rows[..., None], 0), period=np.pi, axis=0)


def _median(values: Floats, is_known: NDArray[np.bool_]) -> Floats:
    """Return the medians (K, d) of the known ones (A, K) of values (A, K, d)."""
    ascending = np.sort(np.where(is_known[..., None], values, np.inf), axis=0)
    count = is_known.sum(0)[None, :, None]
    lower, upper = (
        np.take_along_axis(ascending, row, 0)[0] for row in ((count - 1) // 2, count // 2)
    )
    middle: Floats = (lower + upper) / 2
    return middle


def _on_lines(
    seconds: NDArray[np.floating], values: Floats, is_known: NDArray[np.bool_]
) -> tuple[Floats, Floats]:
    """
    Return values and slopes of K tracks at C times, on local lines through their samples.

    Parameters
    ----------
    seconds : array, shape (A, C)
        Times of the samples, relative to those that are asked for [s].
    values : array, shape (A, K, C, d)
        The samples.
    is_known : array, shape (A, K)
        Which of them there are.

    Returns
    -------
    values, slopes : array, shape (K, C, d)
        The slopes are for each second.

    """
    near = np.clip(SMOOTHING - np.abs(seconds), 1e-6, None)
    weights = np.where(is_known[..., None], near[:, None], 0.0)  # (A, K, C)
    weights /= weights.sum(0)
    mean = np.einsum('akc,ac->kc', weights, seconds)
    offsets = seconds[:, None] - mean
    of_slope = weights * offsets
    spread = (of_slope * offsets).sum(0)
    middle = np.einsum('akc,akcd->kcd', weights, values)
    slope = np.einsum('akc,akcd->kcd', of_slope, values) / spread[..., None]
    return middle - mean[..., None] * slope, slope


class MeasuredTracks:
    """Input boxes of the last seconds, by array; tracks are put together where they are used."""

    def __init__(self, candidates: Floats) -> None:
        self._candidates = candidates
        self._arrays: list[MeasuredArray] = []  # by ascending stamps
        self._newest_of: dict[str, int] = {}  # stamp of the newest box of each track [ns]
        self.newest_ns = -(2**62)

    def add(self, boxes: BoxArray, oldest_ns: float) -> None:
        """
        Add the boxes of an array, and forget tracks and boxes that ended before a time.

        A box that is not newer than the others of its track is left out.

        """
        self.newest_ns = max(self.newest_ns, boxes.stamp_ns)
        row_of = {}
        for row in rows_with_latency(boxes):
            name = boxes.track_ids[row]
            if self._newest_of.get(name, -inf) < boxes.stamp_ns:
                self._newest_of[name] = boxes.stamp_ns
                row_of[name] = row
        if row_of:
            insort(self._arrays, MeasuredArray(boxes, row_of), key=_stamp)
        del self._arrays[: bisect_left(self._arrays, oldest_ns, key=_stamp)]
        for name in [name for name, newest in self._newest_of.items() if newest <= oldest_ns]:
            del self._newest_of[name]

    def covering(self, times_ns: Ints) -> list[str]:
        """Return the ids of the tracks whose boxes begin before all times and end after them."""
        before = self._arrays[: bisect_right(self._arrays, times_ns[0], key=_stamp)]
        begun = set[str]().union(*(array.row_of for array in before))
        newest_of = self._newest_of.items()
        return [name for name, newest in newest_of if newest >= times_ns[-1] and name in begun]

    def nearest_centers(self, names: Sequence[str], times_ns: Ints, candidates: Ints) -> Floats:
        """
        Return the centres of the boxes of tracks that are nearest to some times.

        Parameters
        ----------
        names : sequence of K str
            Ids of tracks that have boxes here.
        times_ns : array, shape (C,)
            Times [ns].
        candidates : array, shape (C,)
            Which candidate of the latency each of them is of, as in `smoothed`.

        Returns
        -------
        centers : array, shape (K, C, 3)
            Where they were measured, in the fixed frame [m].

        """
        arrays, boxes, is_known = self._table(names)
        gaps = np.array([array.stamp_ns for array in arrays])[:, None] - times_ns  # (A, C)
        known_gaps = np.where(is_known[..., None], np.abs(gaps)[:, None], np.inf)
        rows = len(arrays) - 1 - known_gaps[::-1].argmin(0)  # (K, C), of two the later one
        centers = boxes[rows, np.arange(len(names))[:, None], : Z + 1]
        return _moved(self._displacements(arrays)[rows, candidates], centers)

    def smoothed(self, names: Sequence[str], times_ns: Ints) -> tuple[Floats, Floats]:
        """
        Return the boxes of tracks at some times, each for its own candidate of the latency.

        They are on local lines through the boxes as the frame measured them so long before.

        Parameters
        ----------
        names : sequence of K
            Ids of tracks.
        times_ns : array, shape (C,)
            Times in the stamps of the boxes, one for each candidate [ns].

        Returns
        -------
        boxes : array, shape (K, C, 9)
            In the fixed frame, upright.
        velocities : array, shape (K, C, 3)
            Slopes of the lines through the centres [m/s].

        """
        arrays, boxes, is_known = self._table(names)
        T = self._displacements(arrays)
        poses = np.zeros((*boxes.shape[:2], len(times_ns), 4))  # centre and yaw
        R = T[..., :3, :3].reshape(len(T), -1, 3)  # (A, 3 C, 3): one product for each array
        turned = (boxes[..., : Z + 1] @ R.swapaxes(1, 2)).reshape(*poses.shape[:3], 3)
        poses[..., : Z + 1] = turned + T[:, None, :, :3, 3]
        yaw = boxes[:, :, None, YAW] + np.arctan2(T[:, None, :, 1, 0], T[:, None, :, 0, 0])
        poses[..., Z + 1] = _unwrapped(yaw, is_known)
        seconds = (np.array([array.stamp_ns for array in arrays])[:, None] - times_ns) * 1e-9
        middle, slope = _on_lines(seconds, poses, is_known)
        found = np.zeros((*middle.shape[:2], 9))
        found[..., : Z + 1], found[..., YAW] = middle[..., : Z + 1], middle[..., Z + 1]
        found[..., BOX_EXTENT] = _median(boxes[..., BOX_EXTENT], is_known)[:, None]
        return found, slope[..., : Z + 1]

    def at_stamp(self, boxes: BoxArray, latency: float) -> Floats:
        """Return the boxes (n, 9) of an array where their objects are at its stamp."""
        moved = boxes.boxes.copy()
        for row in rows_with_latency(boxes):
            name = boxes.track_ids[row]
            arrays = [array for array in self._arrays if name in array.row_of]
            if arrays:
                moved[row] = MeasuredTrack(name, arrays).at(boxes.stamp_ns, latency, moved[row])
        return moved

    def _table(
        self, names: Sequence[str]
    ) -> tuple[list[MeasuredArray], Floats, NDArray[np.bool_]]:
        """Return the arrays with boxes of K tracks, these boxes (A, K, 9), and which there are."""
        arrays = [array for array in self._arrays if not array.row_of.keys().isdisjoint(names)]
        rows = np.array([[*map(array.row_of.get, names, repeat(-1))] for array in arrays])
        is_known = rows >= 0
        boxes = np.array([array.boxes[own] for array, own in zip(arrays, rows, strict=True)])
        boxes[~is_known] = 0
        return arrays, boxes, is_known

    def _displacements(self, arrays: Sequence[MeasuredArray]) -> Floats:
        """Return T (A, C, 4, 4) from the boxes of arrays to where they were, by candidate."""
        missing = [array for array in arrays if array.of_candidates is None]
        found = displacements([array.motion for array in missing], self._candidates)
        for array, T in zip(missing, found, strict=True):
            array.of_candidates = T
        return np.array([array.of_candidates for array in arrays])


def rows_with_latency(boxes: BoxArray) -> list[int]:
    """Return the rows of valid boxes of a track; a pinned box holds at its stamp."""
    is_valid = is_valid_box(boxes.boxes) & ~boxes.is_pinned
    return [row for row in np.flatnonzero(is_valid).tolist() if boxes.track_ids[row]]


def displaced(boxes: Floats, T: Floats) -> Floats:
    """Return boxes (n, 9), each moved by its T (n, 4, 4)."""
    found = boxes.copy()
    R = T[:, :3, :3]
    found[:, : Z + 1] = np.einsum('nij,nj->ni', R, boxes[:, : Z + 1]) + T[:, :3, 3]
    is_turned = np.any(np.eye(3) != R, axis=(1, 2))
    turned = R[is_turned] @ matrix_from_rpy(boxes[is_turned, ROLL:])
    found[is_turned, ROLL:] = rpy_from_matrix(turned)
    return found
