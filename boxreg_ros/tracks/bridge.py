"""Boxes put in where a track is missing between two of its boxes."""

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
    Fill in the tracks that box arrays lack, between the boxes before and after.

    Results go in by stamp, and come out in the same order once nothing can be missing in them.
    Position, heading and extent of a box that is put in are on the way between its neighbours;
    it has the status ``interpolated`` and no points. Its covariance is theirs, and that of the
    acceleration which the class of the object makes expect.

    Parameters
    ----------
    seconds : float
        Farthest that two boxes of a track are apart for anything to be put in between [s]; with
        0 nothing is, and nothing waits.
    fixed_frame : str
        Results in another frame are passed on as they are.
    config : Config
        How objects move.

    """

    def __init__(self, seconds: float, fixed_frame: str, config: Config) -> None:
        self._longest_ns = round(seconds * 1e9)
        self._fixed_frame = fixed_frame
        self._config = config
        self._held: deque[_Held[_T]] = deque()
        self._last: dict[str, _Known] = {}
        self._newest_ns: int | None = None

    def add(self, refined: RefinedBoxes, item: _T) -> Iterator[tuple[RefinedBoxes, _T]]:
        """Take a result with whatever belongs to it; yield those that are complete."""
        if not self._longest_ns:
            yield refined, item
            return
        boxes, now_ns = refined.boxes, refined.boxes.stamp_ns
        is_late = self._newest_ns is not None and now_ns < self._newest_ns
        self._newest_ns = now_ns if self._newest_ns is None else max(now_ns, self._newest_ns)
        if boxes.frame_id == self._fixed_frame and not is_late:
            for i, name in enumerate(boxes.track_ids):
                box = boxes.boxes[i]
                if name and is_valid_box(box):
                    spread = refined.covariances[i]
                    known = _Known(now_ns, boxes.class_names[i], boxes.scores[i], box, spread)
                    self._fill(name, known)
        self._held.append(_Held(refined, item, is_late))
        oldest_ns = self._newest_ns - self._longest_ns
        self._last = {k: known for k, known in self._last.items() if known.stamp_ns >= oldest_ns}
        while self._held and self._held[0].refined.boxes.stamp_ns <= oldest_ns:
            yield self._held.popleft().whole()

    def flush(self) -> Iterator[tuple[RefinedBoxes, _T]]:
        """Yield what is still held."""
        while self._held:
            yield self._held.popleft().whole()

    def _fill(self, name: str, after: _Known) -> None:
        """Put in what is missing between the last box of a track and a new one."""
        before = self._last.get(name)
        if before is not None and before.stamp_ns == after.stamp_ns:
            return  # of boxes with one identity the first counts
        self._last[name] = after
        if before is None or after.stamp_ns - before.stamp_ns > self._longest_ns:
            return
        between = [
            held for held in self._held
            if before.stamp_ns < held.refined.boxes.stamp_ns < after.stamp_ns
            and held.refined.boxes.frame_id == self._fixed_frame and not held.is_late
        ]  # fmt: skip
        # Where there are boxes that cannot be used, or a second array, nothing is missing.
        full = {h.refined.boxes.stamp_ns for h in between if name in h.refined.boxes.track_ids}
        for held in between:
            stamp_ns = held.refined.boxes.stamp_ns
            if stamp_ns not in full:
                full.add(stamp_ns)
                held.put_in[name] = _between(before, after, stamp_ns, self._config)


class _Known(NamedTuple):
    """A box of a track, with its covariance (6, 6)."""

    stamp_ns: int
    class_name: str
    score: float
    box: Floats
    covariance: Floats


@dataclass(eq=False, slots=True)
class _Held(Generic[_T]):
    """A result that waits for what is to be put in."""

    refined: RefinedBoxes
    item: _T
    is_late: bool
    put_in: dict[str, _Known] = field(default_factory=dict)

    def whole(self) -> tuple[RefinedBoxes, _T]:
        n = len(self.put_in)
        if not n:
            return self.refined, self.item
        given, new = self.refined, self.put_in.values()
        boxes = replace(
            given.boxes,
            track_ids=(*given.boxes.track_ids, *self.put_in),
            class_names=(*given.boxes.class_names, *(known.class_name for known in new)),
            scores=np.append(given.boxes.scores, [known.score for known in new]),
            boxes=np.concatenate([given.boxes.boxes, [known.box for known in new]]),
        )
        whole = RefinedBoxes(
            boxes,
            (*given.status, *(INTERPOLATED,) * n),
            (*given.reasons, *('',) * n),
            np.append(given.num_points, np.zeros(n, np.int64)),
            np.concatenate([given.covariances, [known.covariance for known in new]]),
            given.is_final,
        )
        return whole, self.item


def _between(before: _Known, after: _Known, stamp_ns: int, config: Config) -> _Known:
    """Return the box on the way from one to another, at a stamp in between."""
    share = (stamp_ns - before.stamp_ns) / (after.stamp_ns - before.stamp_ns)
    boxes = np.array([before.box, after.box])
    first, second = matrix_from_rpy(boxes[:, ROLL:])
    if first[:, 0] @ second[:, 0] < 0:  # a heading that is turned around
        second = second * [-1.0, -1.0, 1.0]
    begin = np.append(before.box[X : Z + 1], quaternion_from_matrix(first))
    end = np.append(after.box[X : Z + 1], quaternion_from_matrix(second))
    T_fixed_box = interpolated(begin, end, share)
    box = (1 - share) * before.box + share * after.box
    box[X : Z + 1] = T_fixed_box[:3, 3]
    box[ROLL:] = rpy_from_matrix(T_fixed_box[:3, :3])
    # An acceleration a bends the way by a s t / 2, s after one end and t before the other.
    kind = config.class_config(before.class_name)
    flat = max(kind.acceleration, kind.cornering)
    changes = np.array([flat, flat, kind.vertical, kind.tilting, kind.tilting, kind.turning])
    bend = (stamp_ns - before.stamp_ns) * (after.stamp_ns - stamp_ns) * 1e-18 / 2
    spread = (1 - share) * before.covariance + share * after.covariance
    spread = spread + np.diag((changes * bend) ** 2)
    score = (1 - share) * before.score + share * after.score
    return _Known(stamp_ns, before.class_name, score, box, spread)
