"""Interpolation of missing boxes in short gaps of a track."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Generic, NamedTuple, TypeVar

from boxreg_ros.config import Config
from boxreg_ros.io.transforms import interpolated
from boxreg_ros.rotations import matrix_from_rpy, quaternion_from_matrix, rpy_from_matrix
from boxreg_ros.structures import (
    Floats,
    INTERPOLATED,
    is_valid_box,
    RefinedBoxes,
    ROLL,
    X,
    Z,
)
import numpy as np

_T = TypeVar('_T')


class Bridge(Generic[_T]):
    """
    Add interpolated boxes to arrays in which a track is missing between two of its boxes.

    Results are added by stamp, and leave in the same order once no box can be added to them any
    more. Position, heading and extents of an added box are interpolated between the boxes before
    and after it; its status is ``interpolated`` and its number of points 0. Its covariance is
    interpolated too, plus that of the acceleration which is usual for its class.

    Parameters
    ----------
    seconds : float
        Longest time between two boxes of a track that is bridged [s]; with 0 nothing is added
        and no result waits.
    fixed_frame : str
        Results in another frame pass unchanged.
    config : Config
        Motion model of each class.

    """

    def __init__(self, seconds: float, fixed_frame: str, config: Config) -> None:
        self._max_gap_ns = round(seconds * 1e9)
        self._fixed_frame = fixed_frame
        self._config = config
        self._held: deque[_Held[_T]] = deque()
        self._last: dict[str, _TrackBox] = {}  # the newest box of each track
        self._newest_ns: int | None = None

    def add(self, refined: RefinedBoxes, item: _T) -> Iterator[tuple[RefinedBoxes, _T]]:
        """
        Add a result.

        Parameters
        ----------
        refined : RefinedBoxes
            The result.
        item : object
            Returned with the result.

        Yields
        ------
        refined, item
            Results that are complete.

        """
        if not self._max_gap_ns:
            yield refined, item
            return
        stamp_ns = refined.boxes.stamp_ns
        newest_ns = stamp_ns if self._newest_ns is None else self._newest_ns
        is_late = stamp_ns < newest_ns
        self._newest_ns = max(stamp_ns, newest_ns)
        if refined.boxes.frame_id == self._fixed_frame and not is_late:
            for box in _track_boxes(refined):
                self._fill_gap(box)
        self._held.append(_Held(refined, item, is_late))
        oldest_ns = self._newest_ns - self._max_gap_ns
        self._last = {
            track_id: box for track_id, box in self._last.items() if box.stamp_ns >= oldest_ns
        }
        while self._held and self._held[0].stamp_ns <= oldest_ns:
            yield self._held.popleft().complete()

    def flush(self) -> Iterator[tuple[RefinedBoxes, _T]]:
        """Yield the results that are still held."""
        while self._held:
            yield self._held.popleft().complete()

    def _fill_gap(self, after: _TrackBox) -> None:
        """Interpolate between the last box of a track and a new one."""
        before = self._last.get(after.track_id)
        if before is not None and before.stamp_ns == after.stamp_ns:
            return  # of two boxes with the same id and stamp the first counts
        self._last[after.track_id] = after
        if before is None or after.stamp_ns - before.stamp_ns > self._max_gap_ns:
            return
        between = [held for held in self._held if self._lies_between(held, before, after)]
        # A stamp with a box of the track is no gap, even if that box is invalid. Of two arrays
        # of one stamp only the first gets a box.
        occupied = {
            held.stamp_ns for held in between if after.track_id in held.refined.boxes.track_ids
        }
        for held in between:
            if held.stamp_ns not in occupied:
                occupied.add(held.stamp_ns)
                held.added.append(_interpolated(before, after, held.stamp_ns, self._config))

    def _lies_between(self, held: _Held[_T], before: _TrackBox, after: _TrackBox) -> bool:
        if held.is_late or held.refined.boxes.frame_id != self._fixed_frame:
            return False
        return before.stamp_ns < held.stamp_ns < after.stamp_ns


class _TrackBox(NamedTuple):
    """A box of a track with its covariances, of x y z roll pitch yaw and of the extents."""

    track_id: str
    stamp_ns: int
    class_name: str
    score: float
    box: Floats
    covariance: Floats
    extent_covariance: Floats


@dataclass(eq=False, slots=True)
class _Held(Generic[_T]):
    """A result that waits for boxes to be added."""

    refined: RefinedBoxes
    item: _T
    is_late: bool
    added: list[_TrackBox] = field(default_factory=list)

    @property
    def stamp_ns(self) -> int:
        return self.refined.boxes.stamp_ns

    def complete(self) -> tuple[RefinedBoxes, _T]:
        """Return the result with the added boxes behind its own, and its item."""
        if not self.added:
            return self.refined, self.item
        n = len(self.added)
        old = self.refined
        boxes = replace(
            old.boxes,
            track_ids=(*old.boxes.track_ids, *(box.track_id for box in self.added)),
            class_names=(*old.boxes.class_names, *(box.class_name for box in self.added)),
            scores=np.append(old.boxes.scores, [box.score for box in self.added]),
            boxes=np.concatenate([old.boxes.boxes, [box.box for box in self.added]]),
        )
        complete = RefinedBoxes(
            boxes=boxes,
            status=(*old.status, *(INTERPOLATED,) * n),
            reasons=(*old.reasons, *('',) * n),
            num_points=np.append(old.num_points, np.zeros(n, np.int64)),
            covariances=np.concatenate([old.covariances, [box.covariance for box in self.added]]),
            is_final=old.is_final,
            extent_covariances=np.concatenate(
                [old.extent_covariances, [box.extent_covariance for box in self.added]]
            ),
            face_distances=np.concatenate([old.face_distances, np.zeros((n, 6))]),
            outside=np.append(old.outside, np.zeros(n)),
        )
        return complete, self.item


def _track_boxes(refined: RefinedBoxes) -> Iterator[_TrackBox]:
    """Yield the valid boxes of a result that have a track id."""
    boxes = refined.boxes
    for i, track_id in enumerate(boxes.track_ids):
        if track_id and is_valid_box(boxes.boxes[i]):
            yield _TrackBox(
                track_id, boxes.stamp_ns, boxes.class_names[i], boxes.scores[i], boxes.boxes[i],
                refined.covariances[i], refined.extent_covariances[i],
            )  # fmt: skip


def _interpolated(before: _TrackBox, after: _TrackBox, stamp_ns: int, config: Config) -> _TrackBox:
    """Return the box of a track at a stamp between two of its boxes."""
    since_before_ns = stamp_ns - before.stamp_ns
    until_after_ns = after.stamp_ns - stamp_ns
    fraction = since_before_ns / (after.stamp_ns - before.stamp_ns)
    R_before, R_after = matrix_from_rpy(np.array([before.box, after.box])[:, ROLL:])
    if R_before[:, 0] @ R_after[:, 0] < 0:  # a 180 degree flip is not a rotation of the object
        R_after = R_after * [-1.0, -1.0, 1.0]
    T_fixed_box = interpolated(
        np.append(before.box[X : Z + 1], quaternion_from_matrix(R_before)),
        np.append(after.box[X : Z + 1], quaternion_from_matrix(R_after)),
        fraction,
    )
    box = (1 - fraction) * before.box + fraction * after.box
    box[X : Z + 1] = T_fixed_box[:3, 3]
    box[ROLL:] = rpy_from_matrix(T_fixed_box[:3, :3])
    covariance = (1 - fraction) * before.covariance + fraction * after.covariance
    # With a constant acceleration a, the object is a s t / 2 off the straight line between its
    # ends, at the time s after one and t before the other.
    half_product = since_before_ns * until_after_ns * 1e-18 / 2
    deviations = _accelerations(before.class_name, config) * half_product
    covariance = covariance + np.diag(deviations**2)
    score = (1 - fraction) * before.score + fraction * after.score
    extents = (1 - fraction) * before.extent_covariance + fraction * after.extent_covariance
    return _TrackBox(before.track_id, stamp_ns, before.class_name, score, box, covariance, extents)


def _accelerations(class_name: str, config: Config) -> Floats:
    """Return usual accelerations of x y z [m/s^2] and roll pitch yaw [rad/s^2], shape (6,)."""
    model = config.class_config(class_name)
    horizontal = max(model.acceleration, model.cornering)
    return np.array(
        [horizontal, horizontal, model.vertical, model.tilting, model.tilting, model.turning]
    )
