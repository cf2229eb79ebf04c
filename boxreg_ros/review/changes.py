"""What became of boxes: before and after, side by side, by track."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

from boxreg_ros.core.metrics import pose_errors
from boxreg_ros.rotations import wrap_angle
from boxreg_ros.structures import BoxArray, Floats, Ints, is_valid_box, REFINED, RefinedBoxes, YAW
import numpy as np
from numpy.typing import ArrayLike, NDArray


@dataclass(frozen=True, slots=True)
class TrackChanges:
    """
    What became of the boxes of one track, by stamp.

    Attributes
    ----------
    track_id, class_name : str
        As in the input; the class that most boxes have.
    stamps_ns : array, shape (n,)
        Header stamps [ns].
    given, boxes : array, shape (n, 9)
        Before and after in the fixed frame; NaN where a box has no place there, and before where
        it was put in.
    change : array, shape (n, 4)
        After minus before along the axes of the box [m] and in yaw [rad], half turns undone.
    deviations : array, shape (n, 4)
        Standard deviations of the same; NaN for boxes that are not refined.
    is_flipped : array, shape (n,)
        True where the heading was turned around.
    status : array of str, shape (n,)
        As in `RefinedBoxes`.
    reasons : Counter
        Why boxes were kept.
    num_points : array, shape (n,)
        Returns inside the input boxes.

    """

    track_id: str
    class_name: str
    stamps_ns: Ints
    given: Floats
    boxes: Floats
    change: Floats
    deviations: Floats
    is_flipped: NDArray[np.bool_]
    status: NDArray[np.str_]
    reasons: Counter[str]
    num_points: Ints

    @property
    def is_refined(self) -> NDArray[np.bool_]:
        """Return where boxes are refined, shape (n,)."""
        return np.asarray(self.status == REFINED)

    @property
    def shift(self) -> float:
        """Return how far refined centres moved, on average [m]; NaN where none is refined."""
        return mean(np.linalg.norm(self.change[self.is_refined, :3], axis=1))

    @property
    def turn(self) -> float:
        """Return how far refined boxes were turned, on average [deg]; NaN where none is."""
        return float(np.degrees(mean(np.abs(self.change[self.is_refined, 3]))))

    @property
    def deviation(self) -> float:
        """Return the median deviation of refined centres from above [m]; NaN without any."""
        return median(np.linalg.norm(self.deviations[self.is_refined, :2], axis=1))


class Changes:
    """
    Collects what became of every box, in few numbers each.

    Parameters
    ----------
    fixed_frame : str
        Boxes in another frame are counted, but have no place.

    """

    def __init__(self, fixed_frame: str) -> None:
        self._fixed_frame = fixed_frame
        self._names: list[tuple[str, str, str, str]] = []  # id, class, status and reason
        self._numbers: list[Floats] = []
        self._counts: list[Ints] = []

    def add(self, given: BoxArray, refined: RefinedBoxes) -> None:
        """Take the boxes of one stamp before and after; those put in come behind the others."""
        boxes, n = refined.boxes, len(refined.status)
        before, after = np.full((n, 9), np.nan), boxes.boxes.copy()
        before[: len(given.boxes)] = given.boxes
        has_place = is_valid_box(after)
        has_place &= boxes.frame_id == self._fixed_frame
        before[~has_place] = after[~has_place] = np.nan
        deviations = _deviations(after, refined.covariances)
        self._numbers.append(np.hstack([before, after, deviations]))
        self._counts.append(np.column_stack([np.full(n, boxes.stamp_ns), refined.num_points]))
        self._names += zip(
            boxes.track_ids, boxes.class_names, refined.status, refined.reasons, strict=True
        )

    def tracks(self) -> list[TrackChanges]:
        """Return all tracks, those that were moved most first."""
        numbers = np.concatenate([np.zeros((0, 22)), *self._numbers])
        counts = np.concatenate([np.zeros((0, 2), np.int64), *self._counts])
        given, boxes, deviations = np.split(numbers, [9, 18], axis=1)
        errors = pose_errors(given, boxes)  # in the axes of the boxes after
        change = -np.column_stack([errors.translation, wrap_angle(2 * errors.rotation[:, 2]) / 2])
        rows_of: dict[str, list[int]] = {}
        for row in np.argsort(counts[:, 0], kind='stable').tolist():
            rows_of.setdefault(self._names[row][0], []).append(row)
        found = []
        for name, rows in rows_of.items():
            _, classes, status, reasons = zip(*(self._names[row] for row in rows), strict=True)
            is_refined = np.array(status) == REFINED
            found.append(
                TrackChanges(
                    name, Counter(classes).most_common(1)[0][0], counts[rows, 0], given[rows],
                    boxes[rows], change[rows],
                    np.where(is_refined[:, None], deviations[rows], np.nan),
                    errors.is_flipped[rows] & is_refined, np.array(status),
                    Counter(filter(None, reasons)), counts[rows, 1],
                )
            )  # fmt: skip
        return sorted(found, key=lambda track: -np.nan_to_num(track.shift, nan=-1.0))


def mean(values: ArrayLike) -> float:
    """Return the mean of what is known; NaN where nothing is."""
    found = known(values)
    return float(found.mean()) if len(found) else np.nan


def median(values: ArrayLike) -> float:
    """Return the median of what is known; NaN where nothing is."""
    found = known(values)
    return float(np.median(found)) if len(found) else np.nan


def known(values: ArrayLike) -> Floats:
    """Return the values that are finite, in one row."""
    values = np.asarray(values, dtype=np.float64)
    return np.asarray(values[np.isfinite(values)])


def _deviations(boxes: Floats, covariances: Floats) -> Floats:
    """Return standard deviations (n, 4) along the heading, across it, up [m] and of yaw [rad]."""
    cos, sin = np.cos(boxes[:, YAW]), np.sin(boxes[:, YAW])
    axes = np.array([[cos, sin], [-sin, cos]])
    flat = np.einsum('kin,nij,kjn->nk', axes, covariances[:, :2, :2], axes)
    variances = np.column_stack([flat, covariances[:, 2, 2], covariances[:, 5, 5]])
    return np.asarray(np.sqrt(variances.clip(0)))
