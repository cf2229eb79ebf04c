"""Boxes before and after registration, side by side, by track."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, pairwise
from math import prod
from mmap import mmap
from typing import Any

from boxreg_ros.core.metrics import iou_3d, pose_errors
from boxreg_ros.core.tables import rows_by_key
from boxreg_ros.rotations import wrap_angle
from boxreg_ros.structures import (
    BoxArray,
    Floats,
    HUMAN,
    Ints,
    is_valid_box,
    REFINED,
    RefinedBoxes,
    REJECTED,
    YAW,
)
import numpy as np
from numpy.typing import ArrayLike, NDArray


@dataclass(frozen=True, slots=True)
class TrackChanges:
    """The boxes of one track before and after registration, by stamp."""

    track_id: str
    class_name: str
    """The most frequent one of the track."""
    input_ids: tuple[str, ...]
    """Track ids in the input; empty for boxes that the input does not have."""
    stamps_ns: Ints
    """(n,), of the headers [ns]."""
    given: Floats
    """(n, 9), input in the fixed frame; NaN where invalid, in another frame, or added."""
    boxes: Floats
    """(n, 9), result in the fixed frame; NaN where invalid or in another frame."""
    change: Floats
    """(n, 4), result minus input along the axes of the box [m] and in yaw [rad], flips removed."""
    deviations: Floats
    """(n, 4), of the result along the same axes; NaN for boxes that are not refined."""
    extent_deviations: Floats
    """(n, 3), of length, width and height [m]; NaN for boxes that are not refined."""
    face_distances: Floats
    near_points: Floats
    """(n, 2), as in `RefinedBoxes`, as are the face distances (n, 6)."""
    disagreement: Floats
    """(n,), 1 - 3D IoU of the result with the early estimate; 0 where that is not known."""
    is_flipped: NDArray[np.bool_]
    """(n,), where the heading was flipped by 180 degrees."""
    status: NDArray[np.str_]
    """(n,), as in `RefinedBoxes`."""
    reasons: NDArray[np.str_]
    """(n,), why a box was kept; empty for the others."""
    num_points: Ints
    """(n,), inside the input boxes."""
    attributes: tuple[Mapping[str, str], ...] = ()
    """Of each object, by name; empty where no box has any."""

    @property
    def is_label(self) -> NDArray[np.bool_]:
        """Return which boxes are labels, shape (n,): rejected ones are none."""
        return np.asarray(self.status != REJECTED)

    @property
    def labels(self) -> Floats:
        """Return the result (n, 9) without rejected boxes: NaN in their place."""
        is_label = self.is_label
        return self.boxes if is_label.all() else np.where(is_label[:, None], self.boxes, np.nan)

    @property
    def is_refined(self) -> NDArray[np.bool_]:
        """Return which boxes are refined or pinned, shape (n,)."""
        return np.isin(self.status, (REFINED, HUMAN))

    @property
    def shift(self) -> float:
        """Return the mean distance that refined centres moved [m]; NaN without any."""
        return mean(np.linalg.norm(self.change[self.is_refined, :3], axis=1))

    @property
    def turn(self) -> float:
        """Return the mean absolute yaw change of refined boxes [deg]; NaN without any."""
        return float(np.degrees(mean(np.abs(self.change[self.is_refined, 3]))))

    @property
    def deviation(self) -> float:
        """Return the median horizontal standard deviation of refined centres [m], or NaN."""
        return median(np.linalg.norm(self.deviations[self.is_refined, :2], axis=1))


BOXES_AT_ONCE = 2**12
"""Boxes whose arrays are reduced to a few numbers at once; chosen: they take 4 MB until then."""


class _Column:
    """Rows that become more; they are moved each time that there are twice as many."""

    def __init__(self, rows: NDArray[Any]) -> None:
        self.rows = self._room = rows

    def append(self, rows: NDArray[Any]) -> None:
        """Append rows; room that is not used yet takes no memory."""
        begin, end = len(self.rows), len(self.rows) + len(rows)
        if end > len(self._room):
            self._room = _room((2 * end, *rows.shape[1:]), rows.dtype)
            self._room[:begin] = self.rows
        self._room[begin:end] = rows
        self.rows = self._room[:end]


def _room(shape: tuple[int, ...], kind: np.dtype[Any]) -> NDArray[Any]:
    """Return an array; of numbers not by malloc, which keeps it once there is a larger one."""
    if kind.hasobject:
        return np.empty(shape, kind)
    return np.ndarray(shape, kind, mmap(-1, prod(shape) * kind.itemsize))


class Changes:
    """Collect all boxes before and after, in a few numbers each; NaN in other frames."""

    def __init__(self, fixed_frame: str) -> None:
        self._fixed_frame = fixed_frame
        self._waiting: list[tuple[BoxArray, RefinedBoxes, RefinedBoxes | None, list[str]]] = []
        self._boxes_waiting = 0
        self._columns: dict[str, _Column] = {}
        self._known_texts: dict[str, str] = {}

    def add(
        self,
        given: BoxArray,
        refined: RefinedBoxes,
        early: RefinedBoxes | None = None,
        added_ids: Sequence[str] = (),
    ) -> None:
        """
        Add the boxes of one array before and after registration.

        Parameters
        ----------
        given : BoxArray
            Of the input, in the fixed frame if there is a transform to it.
        refined : RefinedBoxes
            The boxes of `given` in their order, then those that were added.
        early : RefinedBoxes, optional
            The early estimate of the same boxes, where `refined` is another.
        added_ids : sequence of str
            Ids that a person gave the objects of the added boxes, empty for others; none if there
            are no such objects.

        """
        names = [*given.track_ids, *added_ids]
        names += [''] * (len(refined.status) - len(names))
        self._waiting.append((given, refined, early, names))
        self._boxes_waiting += len(names)
        if self._boxes_waiting >= BOXES_AT_ONCE:
            self._reduce()

    def _reduce(self) -> None:
        """Reduce the arrays that wait to rows of the columns."""
        arrays, self._waiting, self._boxes_waiting = self._waiting, [], 0
        given, results, early, names = zip(*arrays, strict=True)
        ends = np.cumsum([0, *map(len, names)])
        boxes = [refined.boxes for refined in results]
        before = np.full((int(ends[-1]), 9), np.nan)
        for begin, of_input in zip(ends, given, strict=False):
            before[begin : begin + len(of_input.boxes)] = of_input.boxes
        after = np.concatenate([of_result.boxes for of_result in boxes])
        counts = np.diff(ends)
        is_fixed = [of_result.frame_id == self._fixed_frame for of_result in boxes]
        is_usable = is_valid_box(after) & np.repeat(is_fixed, counts)
        before[~is_usable] = np.nan
        after[~is_usable] = np.nan
        errors = pose_errors(before, after)  # of the input, in the axes of the result
        yaw_change = wrap_angle(2 * errors.rotation[:, 2]) / 2  # half turns removed
        status = self._texts(refined.status for refined in results)
        is_refined = np.isin(status, (REFINED, HUMAN))
        unknown = np.where(is_refined, 0.0, np.nan)[:, None]
        variances = _joined(results, 'extent_covariances')[:, range(3), range(3)]
        disagreement = [
            _disagreement(after[begin:end], estimate)
            for (begin, end), estimate in zip(pairwise(ends), early, strict=True)
        ]
        attributes: list[Sequence[Mapping[str, str]]] = [
            of_result.attributes or ({},) * len(of_result.track_ids) for of_result in boxes
        ]
        columns = {
            'track_id': self._texts(of_result.track_ids for of_result in boxes),
            'class_name': self._texts(of_result.class_names for of_result in boxes),
            'input_ids': self._texts(names),
            'stamps_ns': np.repeat([of_result.stamp_ns for of_result in boxes], counts),
            'given': before,
            'boxes': after,
            'change': -np.column_stack([errors.translation, yaw_change]),
            'deviations': _deviations(after, _joined(results, 'covariances')) + unknown,
            'extent_deviations': np.sqrt(variances.clip(0)) + unknown,
            'face_distances': _joined(results, 'face_distances'),
            'near_points': _joined(results, 'near_points').astype(np.float64),
            'is_flipped': errors.is_flipped & is_refined,
            'disagreement': np.concatenate(disagreement),
            'status': status,
            'reasons': self._texts(refined.reasons for refined in results),
            'num_points': _joined(results, 'num_points'),
            'attributes': np.fromiter(chain.from_iterable(attributes), object),
        }
        for name, column in columns.items():
            self._columns.setdefault(name, _Column(column[:0])).append(column)

    def _texts(self, texts: Iterable[Iterable[str]]) -> NDArray[Any]:
        """Return texts as objects, equal ones as the same one."""
        found = (self._known_texts.setdefault(text, text) for text in chain.from_iterable(texts))
        return np.fromiter(found, object)

    def tracks(self) -> list[TrackChanges]:
        """Return all tracks, by descending mean shift; their arrays are parts of larger ones."""
        if self._boxes_waiting:
            self._reduce()
        if not self._columns:
            return []
        in_time = np.argsort(self._columns['stamps_ns'].rows, kind='stable')
        rows_of = rows_by_key(self._columns['track_id'].rows[in_time].tolist())
        order = in_time[np.concatenate([*rows_of.values()])]
        for column in self._columns.values():
            column.rows[:] = column.rows[order]
        ends = np.cumsum([0, *map(len, rows_of.values())])
        found = []
        for begin, end in pairwise(ends.tolist()):
            own: dict[str, Any] = {
                name: column.rows[begin:end] for name, column in self._columns.items()
            }
            attributes = own['attributes'].tolist()
            own |= {
                'track_id': own['track_id'][0],
                'class_name': Counter(own['class_name'].tolist()).most_common(1)[0][0],
                'input_ids': tuple(own['input_ids'].tolist()),
                'status': own['status'].astype(str),
                'reasons': own['reasons'].astype(str),
                'attributes': tuple(attributes) if any(attributes) else (),
            }
            found.append(TrackChanges(**own))
        return sorted(found, key=lambda track: -np.nan_to_num(track.shift, nan=-1.0))


def _joined(results: Sequence[RefinedBoxes], name: str) -> NDArray[Any]:
    """Return one column of several results."""
    return np.concatenate([getattr(refined, name) for refined in results])


def mean(values: ArrayLike) -> float:
    """Return the mean of the finite values; NaN without any."""
    found = known(values)
    return float(found.mean()) if len(found) else np.nan


def median(values: ArrayLike) -> float:
    """Return the median of the finite values; NaN without any."""
    found = known(values)
    return float(np.median(found)) if len(found) else np.nan


def known(values: ArrayLike) -> Floats:
    """Return the finite values as one row."""
    values = np.asarray(values, dtype=np.float64)
    return np.asarray(values[np.isfinite(values)])


def _disagreement(boxes: Floats, early: RefinedBoxes | None) -> Floats:
    """Return 1 - 3D IoU of boxes (n, 9) with refined early estimates; 0 without one."""
    found = np.zeros(len(boxes))
    if early is not None:
        rows = [row for row, word in enumerate(early.status[: len(boxes)]) if word == REFINED]
        found[rows] = np.nan_to_num(1 - ious(boxes[rows], early.boxes.boxes[rows]))
    return found


def ious(boxes: Floats, truth: Floats) -> Floats:
    """Return the 3D IoU of `boxes` and `truth` (n, 9), NaN where one of them is, (n,)."""
    both = np.isfinite(boxes).all(axis=1) & np.isfinite(truth).all(axis=1)
    found = np.full(len(boxes), np.nan)
    found[both] = iou_3d(boxes[both], truth[both])
    return found


def _deviations(boxes: Floats, covariances: Floats) -> Floats:
    """
    Return standard deviations (n, 4) along the heading of boxes, across and up [m], and of yaw.

    The covariances (n, 6, 6) are of x y z roll pitch yaw in the fixed frame.

    """
    cos = np.cos(boxes[:, YAW])
    sin = np.sin(boxes[:, YAW])
    axes = np.array([[cos, sin], [-sin, cos]])  # (axis of the box, x or y, n)
    horizontal = np.einsum('kin,nij,kjn->nk', axes, covariances[:, :2, :2], axes)
    variances = np.column_stack([horizontal, covariances[:, 2, 2], covariances[:, 5, 5]])
    return np.asarray(np.sqrt(variances.clip(0)))
