"""Conversions between boxes and the records of label files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import count
from math import isfinite
from typing import Any, NamedTuple

from boxreg_ros.io.covariance_table import symmetric
from boxreg_ros.labels.protocol import INPUT_STATUS
from boxreg_ros.structures import BOX_CENTER, BOX_EXTENT, BoxArray, Floats, RefinedBoxes
from msg_adapters.poses import quaternions_of
import numpy as np
from numpy.typing import ArrayLike

FIRST_ASSIGNED_NUMBER = 10**6
"""Track numbers below keep their value; assigned numbers start here (see `TrackNumbers`)."""
LARGEST_ANGLE = 4 * np.pi
"""Angles up to two turns are radians [rad]; chosen: most degrees of a drive have larger ones."""


class ReadBox(NamedTuple):
    """A box (9,) as read from a file; `evidence` as of `refined_boxes`."""

    track_id: str
    class_name: str
    box: ArrayLike
    evidence: Mapping[str, Any] = {}


FrameBoxes = tuple[list[ReadBox], Mapping[str, int]]
"""Boxes of a frame, and the number of those left out by `Reason`."""
NO_FRAME_BOXES: FrameBoxes = ([], {})


def refined_of(stamp_ns: int, frame_id: str, items: Sequence[ReadBox]) -> RefinedBoxes:
    """Return the boxes of one stamp [ns]; see `refined_boxes`."""
    columns = zip(*items, strict=True) if items else [()] * len(ReadBox._fields)
    return refined_boxes(stamp_ns, frame_id, *map(list, columns))


def refined_boxes(
    stamp_ns: int,
    frame_id: str,
    track_ids: Sequence[str],
    class_names: Sequence[str],
    boxes: ArrayLike,
    evidence: Sequence[Mapping[str, Any]] = (),
) -> RefinedBoxes:
    """
    Return the boxes of one stamp as read from a file.

    Parameters
    ----------
    stamp_ns : int
        Of the boxes [ns].
    frame_id : str
        Frame of the boxes.
    track_ids, class_names : sequence of n str
        The id is empty for boxes without one.
    boxes : array_like, shape (n, 9)
        In `frame_id` [m, rad].
    evidence : sequence of n mappings, or empty
        Values of a box by the names of `evidence_of`, ``num_points`` and ``attributes``; others
        are ignored. Covariances are matrices row by row, or their upper triangle.

    Returns
    -------
    refined : RefinedBoxes
        For a value that is missing or None with the default: score NaN, status `INPUT_STATUS`, 0
        points, unit matrices, no reason, no attributes.

    """
    n = len(track_ids)
    items = evidence or [{}] * n
    scores = [item.get('score') for item in items]
    covariances = [_matrix(item.get('covariance'), 6) for item in items]
    extents = [_matrix(item.get('extent_covariance'), 3) for item in items]
    attributes = tuple(item.get('attributes') or {} for item in items)
    return RefinedBoxes(
        BoxArray(
            stamp_ns,
            frame_id,
            tuple(track_ids),
            tuple(class_names),
            np.array(scores, np.float64),
            np.asarray(boxes, np.float64).reshape(n, 9),
            attributes=attributes if any(attributes) else (),
        ),
        tuple(str(item.get('status') or INPUT_STATUS) for item in items),
        tuple(str(item.get('reason') or '') for item in items),
        np.array([item.get('num_points') or 0 for item in items], np.int64),
        np.reshape(covariances, (n, 6, 6)),
        extent_covariances=np.reshape(extents, (n, 3, 3)),
    )


def _matrix(values: ArrayLike | None, size: int) -> Floats:
    """Return a matrix of its rows or of its upper triangle; the unit matrix for None."""
    if values is None:
        return np.eye(size)
    numbers = np.asarray(values, np.float64)
    return numbers.reshape(size, size) if numbers.size == size**2 else symmetric(numbers, size)


def require_radians(angles: ArrayLike) -> Floats:
    """Return angles [rad]; ValueError if one is larger than programs that add up turns state."""
    values = np.asarray(angles, np.float64)
    largest = np.abs(values).max(initial=0.0)
    if largest > LARGEST_ANGLE:
        raise ValueError(
            f'expected angles in radians, got {largest:g}, which is in degrees: multiply all '
            f'angles by pi / 180'
        )
    return values


def numbers_of(boxes: BoxArray) -> Floats:
    """Return rows (n, 11) of score, x y z, qx qy qz qw, length width height, as in boxes.csv."""
    values = boxes.boxes
    return np.hstack(
        [
            boxes.scores[:, None],
            values[:, BOX_CENTER],
            quaternions_of(values),
            values[:, BOX_EXTENT],
        ]
    )


EVIDENCE_COLUMNS = {
    'status': 'string',
    'reason': 'string',
    'score': 'double',
    'covariance': 'double[]',
    'extent_covariance': 'double[]',
}
"""Columns of `evidence_of` in tables of Arrow, which the kits of the data sets ignore."""


def evidence_of(refined: RefinedBoxes, row: int) -> dict[str, Any]:
    """
    Return the values of `EVIDENCE_COLUMNS` of a box.

    Parameters
    ----------
    refined : RefinedBoxes
        The boxes of a stamp.
    row : int
        Of the box.

    Returns
    -------
    evidence : dict
        ``status`` and ``reason`` (empty for none); ``score``, None where unknown; ``covariance``
        of x y z roll pitch yaw, 36 numbers row by row [m^2, m rad, rad^2]; ``extent_covariance``
        of length width height, 9 numbers [m^2].

    """
    return {
        'status': refined.status[row],
        'reason': refined.reasons[row],
        'score': finite_or_none(refined.boxes.scores[row]),
        'covariance': refined.covariances[row].ravel().tolist(),
        'extent_covariance': refined.extent_covariances[row].ravel().tolist(),
    }


def finite_or_none(value: float) -> float | None:
    """Return `value` as a float, or None if it is not finite."""
    return float(value) if isfinite(value) else None


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
