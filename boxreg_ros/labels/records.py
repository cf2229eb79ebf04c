"""Conversions between boxes and the records of label files."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import count
from typing import Any

from boxreg_ros.labels.protocol import INPUT_STATUS
from boxreg_ros.rotations import rpy_from_quaternion
from boxreg_ros.structures import BoxArray, Floats, RefinedBoxes
import numpy as np
from numpy.typing import ArrayLike

FIRST_ASSIGNED_NUMBER = 10**6
"""Track numbers below keep their value; assigned numbers start here (see `TrackNumbers`)."""
MIN_QUATERNION_NORM = 1e-6
"""A shorter quaternion states no orientation."""


def refined_boxes(  # noqa: PLR0913 (one argument per column of a label file)
    stamp_ns: int,
    frame_id: str,
    track_ids: Sequence[str],
    class_names: Sequence[str],
    boxes: ArrayLike,
    scores: Sequence[float | None] | Floats | None = None,
    status: Sequence[str | None] | None = None,
    num_points: ArrayLike | None = None,
    covariances: Sequence[ArrayLike | None] | None = None,
    reasons: Sequence[str | None] | None = None,
    extent_covariances: Sequence[ArrayLike | None] | None = None,
) -> RefinedBoxes:
    """
    Return the n boxes of one stamp as read from a file.

    Columns and entries that are None get defaults: score NaN, status `INPUT_STATUS`, 0 points,
    unit matrices as covariances, no reason.

    """
    n = len(track_ids)
    missing = [None] * n
    numbers = np.zeros(n, np.int64) if num_points is None else np.asarray(num_points, np.int64)
    matrices = np.zeros((n, 6, 6))  # (n, row, column)
    for i, covariance in enumerate(covariances or missing):
        matrices[i] = np.eye(6) if covariance is None else np.reshape(covariance, (6, 6))
    extents = np.zeros((n, 3, 3))  # (n, row, column)
    for i, covariance in enumerate(extent_covariances or missing):
        extents[i] = np.eye(3) if covariance is None else np.reshape(covariance, (3, 3))
    return RefinedBoxes(
        BoxArray(
            stamp_ns,
            frame_id,
            tuple(track_ids),
            tuple(class_names),
            np.array(missing if scores is None else scores, np.float64),
            np.asarray(boxes, np.float64).reshape(n, 9),
        ),
        tuple(item or INPUT_STATUS for item in status or missing),
        tuple(item or '' for item in reasons or missing),
        numbers,
        matrices,
        extent_covariances=extents,
    )


def boxes_from_quaternions(
    centres: ArrayLike, extents: ArrayLike, quaternions_xyzw: ArrayLike
) -> Floats:
    """Return boxes (n, 9) from rows; the angles are NaN where a quaternion is zero or NaN."""
    parts = [np.asarray(part, np.float64) for part in (centres, extents, quaternions_xyzw)]
    centre, extent, quaternion = (part.reshape(-1, part.shape[-1]) for part in parts)
    angles = np.full((len(centre), 3), np.nan)
    is_rotation = np.linalg.norm(quaternion, axis=1) > MIN_QUATERNION_NORM  # False for NaN
    if is_rotation.any():
        angles[is_rotation] = rpy_from_quaternion(quaternion[is_rotation])
    return np.hstack([centre, extent, angles])


EVIDENCE_COLUMNS = {
    'status': 'string',
    'reason': 'string',
    'score': 'double',
    'covariance': 'double[]',
    'extent_covariance': 'double[]',
}
"""Columns of `evidence_values` in tables of Arrow, which the kits of the data sets ignore."""


def evidence_values(refined: RefinedBoxes, row: int) -> tuple[Any, ...]:
    """Return the values of `EVIDENCE_COLUMNS` for a box."""
    return (
        refined.status[row],
        refined.reasons[row],
        finite_or_none(refined.boxes.scores[row]),
        refined.covariances[row].ravel().tolist(),
        refined.extent_covariances[row].ravel().tolist(),
    )


def finite_or_none(value: float) -> float | None:
    """Return `value` as a float, or None if it is not finite."""
    return float(value) if np.isfinite(value) else None


class TrackNumbers:
    """
    Assigns integers to tracks, for formats without text ids.

    A track id that is an integer below `FIRST_ASSIGNED_NUMBER` keeps it. Other ids get numbers
    from there on. Each box without an id gets a number of its own.

    """

    def __init__(self) -> None:
        self._numbers: dict[str, int] = {}
        self._next = count(FIRST_ASSIGNED_NUMBER)

    def names(self) -> dict[str, str]:
        """Return the track ids by the numbers assigned to them, as text."""
        return {str(number): name for name, number in self._numbers.items()}

    def of(self, track_id: str) -> int:
        """Return the number of a track."""
        if track_id.isascii() and track_id.isdigit() and len(track_id) <= 6:
            number = int(track_id)
            if str(number) == track_id:  # no leading zeros
                return number
        if not track_id:
            return next(self._next)
        if track_id not in self._numbers:
            self._numbers[track_id] = next(self._next)
        return self._numbers[track_id]
