"""Input boxes of tracks where they were measured: in a moving frame, before their stamp."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from itertools import pairwise
from operator import attrgetter

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


def displacements(motion: FrameMotion, seconds: Floats) -> Floats:
    """
    Return how boxes move in the fixed frame if they were measured before their stamp.

    A box with stamp t that was brought to the fixed frame by the pose T(t) of its own frame, but
    was measured at t - s, was at T(t - s) inv(T(t)) times itself.

    Parameters
    ----------
    motion : FrameMotion
        Poses of the frame that the boxes were measured in; the last is that at the stamp.
    seconds : array, shape (C,)
        Times before the stamp [s]; outside of the known poses the motion is extrapolated.

    Returns
    -------
    T : array, shape (C, 4, 4)
        Maps the fixed frame to itself; the identity if one pose is known only.

    """
    found = np.tile(np.eye(4), (len(seconds), 1, 1))
    if len(motion.stamps_ns) < 2:
        return found
    poses = motion.T_fixed_frame
    quaternions = quaternion_from_matrix(poses[:, :3, :3])
    for before, after in pairwise(quaternions):
        after *= np.sign(before @ after) or 1.0  # one of both signs is the shortest rotation
    times = (motion.stamps_ns - motion.stamps_ns[-1]) * 1e-9
    after = np.searchsorted(times, -seconds).clip(1, len(times) - 1)
    share = ((-seconds - times[after - 1]) / (times[after] - times[after - 1]))[:, None]
    turned = (1 - share) * quaternions[after - 1] + share * quaternions[after]
    placed = (1 - share) * poses[after - 1, :3, 3] + share * poses[after, :3, 3]
    R_last, t_last = poses[-1, :3, :3], poses[-1, :3, 3]
    found[:, :3, :3] = matrix_from_quaternion(turned) @ R_last.T
    found[:, :3, 3] = placed - found[:, :3, :3] @ t_last
    return found


class MeasuredArray:
    """The stamp of a box array, and where its boxes were for each latency."""

    def __init__(self, boxes: BoxArray, candidates: Floats) -> None:
        self.stamp_ns = boxes.stamp_ns
        self._motion = boxes.motion
        self.of_candidates: Floats  # (C, 4, 4)
        if boxes.motion is None:  # the frame does not move
            self.of_candidates = np.broadcast_to(np.eye(4), (len(candidates), 4, 4))
        else:
            self.of_candidates = displacements(boxes.motion, candidates)
        self._known = (0.0, np.eye(4))

    def displacement(self, latency: float) -> Floats:
        """Return T (4, 4) from the boxes as given to where they were measured."""
        if self._motion is not None and latency != self._known[0]:
            self._known = latency, displacements(self._motion, np.array([latency]))[0]
        return self._known[1] if self._motion is not None else np.eye(4)


class MeasuredTrack:
    """The boxes of a track in the last seconds, as they were given, oldest first."""

    def __init__(self) -> None:
        self.arrays: list[MeasuredArray] = []
        self.boxes: list[Floats] = []

    @property
    def newest_ns(self) -> int:
        """Stamp of the newest box [ns]."""
        return self.arrays[-1].stamp_ns

    def add(self, array: MeasuredArray, box: Floats) -> None:
        """Add a box; one that is not newer than the others is left out."""
        if not self.arrays or array.stamp_ns > self.newest_ns:
            self.arrays.append(array)
            self.boxes.append(box)

    def forget_before(self, oldest_ns: float) -> None:
        """Remove the boxes with older stamps, but for the newest."""
        old = 0
        while old < len(self.arrays) - 1 and self.arrays[old].stamp_ns < oldest_ns:
            old += 1
        del self.arrays[:old], self.boxes[:old]

    def covers(self, times_ns: Ints) -> bool:
        """Return whether all times are within those of the boxes."""
        first_ns = self.arrays[0].stamp_ns
        return bool(first_ns <= times_ns[0] and times_ns[-1] <= self.newest_ns)

    def at(self, stamp_ns: int, latency: float, box: Floats) -> Floats:
        """
        Return the box (9,) of the object at a stamp, if its boxes have a latency [s].

        Between two boxes, or beyond the last on a circle at constant speed; it heads as `box`
        does.

        """
        time_ns = stamp_ns + round(latency * 1e9)
        stamps_ns = self._stamps_ns()
        after = int(np.searchsorted(stamps_ns, time_ns))
        if time_ns > self.newest_ns:
            from boxreg_ros.core.motion import motion_at  # it imports numba

            boxes = self._measured(0, len(stamps_ns), latency)
            found = motion_at(stamps_ns, boxes, -1, Config().vehicle).predict(time_ns)
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

    def nearest(self, time_ns: int) -> int:
        """Return the row of the box nearest to a time within those of the track [ns]."""
        after = bisect_left(self.arrays, time_ns, 1, len(self.arrays) - 1, key=_stamp)
        middle = self.arrays[after - 1].stamp_ns + self.arrays[after].stamp_ns
        return after - (2 * time_ns < middle)

    def _stamps_ns(self) -> Ints:
        return np.array([array.stamp_ns for array in self.arrays])

    def _measured(self, begin: int, end: int, latency: float) -> Floats:
        """Return some boxes (n, 9) where they were measured."""
        boxes = np.array(self.boxes[begin:end])
        T = np.array([array.displacement(latency) for array in self.arrays[begin:end]])
        return displaced(boxes, T)


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
    """Input boxes by track, and the box arrays that they are of."""

    def __init__(self, candidates: Floats) -> None:
        self._candidates = candidates
        self.by_id: dict[str, MeasuredTrack] = {}
        self.newest_ns = -(2**62)

    def add(self, boxes: BoxArray, oldest_ns: float) -> None:
        """Add the boxes of an array, and forget tracks and boxes that ended before a time."""
        self.newest_ns = max(self.newest_ns, boxes.stamp_ns)
        array = MeasuredArray(boxes, self._candidates)
        for row in rows_with_latency(boxes):
            name = boxes.track_ids[row]
            if name not in self.by_id:
                self.by_id[name] = MeasuredTrack()
            self.by_id[name].add(array, boxes.boxes[row])
        ended = [name for name, track in self.by_id.items() if track.newest_ns <= oldest_ns]
        for name in ended:
            del self.by_id[name]
        for track in self.by_id.values():
            track.forget_before(oldest_ns)

    def nearest_centers(self, names: Sequence[str], times_ns: Ints, candidates: Ints) -> Floats:
        """
        Return the centres of the boxes of tracks that are nearest to some times, (K, C, 3).

        Each of the C times has its own candidate of the latency, as in `smoothed`.

        """
        centers, T = [], []
        for name in names:
            track = self.by_id[name]
            for time_ns, candidate in zip(times_ns.tolist(), candidates.tolist(), strict=True):
                row = track.nearest(time_ns)
                centers.append(track.boxes[row][: Z + 1])
                T.append(track.arrays[row].of_candidates[candidate])
        found = _moved(np.array(T).reshape(-1, 4, 4), np.array(centers).reshape(-1, 3))
        return found.reshape(len(names), len(times_ns), 3)

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
        tracks = [self.by_id[name] for name in names]
        arrays = list({id(array): array for track in tracks for array in track.arrays}.values())
        arrays.sort(key=_stamp)
        row_of = {id(array): row for row, array in enumerate(arrays)}
        boxes = np.zeros((len(arrays), len(tracks), 9))
        is_known = np.zeros(boxes.shape[:2], bool)
        for column, track in enumerate(tracks):
            rows = [row_of[id(array)] for array in track.arrays]
            boxes[rows, column] = track.boxes
            is_known[rows, column] = True
        T = np.array([array.of_candidates for array in arrays])  # (A, C, 4, 4)
        poses = np.zeros((*boxes.shape[:2], len(times_ns), 4))  # centre and yaw
        poses[..., : Z + 1] = _moved(T[:, None], boxes[:, :, None, : Z + 1])
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
            track = self.by_id.get(boxes.track_ids[row])
            if track is not None:
                moved[row] = track.at(boxes.stamp_ns, latency, moved[row])
        return moved


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
