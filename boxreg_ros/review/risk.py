"""
The risk of a box or a track: the error to expect, from evidence other than how far it moved.

Risks are metres along the heading of a car: the shift of a box `REFERENCE_LENGTH` long that costs
as much 3D IoU as the errors to expect. So boxes of all sizes and errors of all kinds compare.

"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from boxreg_ros.core.metrics import BOX_EXTENT
from boxreg_ros.review.changes import TrackChanges
from boxreg_ros.structures import Floats, KEPT
import numpy as np

REFERENCE_LENGTH = 4.5
"""Length of the car whose shift a risk is [m]. Chosen: a mid-size car."""
MEAN_OF_NORMAL = np.sqrt(2 / np.pi)
"""Mean magnitude of a normal variable over its deviation. Derived."""
MAX_LOSS = 1.0
"""Largest loss of 3D IoU."""
KEPT_LOSS = 0.25
"""Loss to expect of an input box that is kept: 1 - 3D IoU of the inputs of docs/results.md."""
FEW_POINTS = 10
"""Boxes with fewer points are reported as such. Chosen."""


class Risk(NamedTuple):
    """
    The risk of the boxes of one track.

    Attributes
    ----------
    boxes : array, shape (n,)
        Risk of each box [m].
    parts : mapping of str to array, shape (n,)
        Its parts by their reason in words [m], largest contributions included.

    """

    boxes: Floats
    parts: Mapping[str, Floats]

    @property
    def track(self) -> float:
        """Return the risk of the track: the mean over its boxes [m]."""
        return float(self.boxes.mean()) if len(self.boxes) else 0.0


def assess(track: TrackChanges) -> Risk:
    """
    Return the risk of each box of a track.

    The loss of 3D IoU to expect of independent errors is linear in their magnitudes: a shift d
    along an axis of extent L costs 2 d / L, an error e of the extent e / L, and a turn by a
    costs a l / (2 w). `MEAN_OF_NORMAL` turns deviations to mean magnitudes.

    """
    extents = np.nan_to_num(track.boxes[:, BOX_EXTENT], nan=1.0)
    length, width, _ = extents.T
    shift = 2 * track.deviations[:, :3] / extents
    size = track.extent_deviations / extents
    turn = track.deviations[:, 3] * length / (2 * width)
    misfit = _misfit(track) / length
    is_refined = track.is_refined
    losses = {
        'uncertain position': MEAN_OF_NORMAL * shift.sum(axis=1),
        'uncertain heading': MEAN_OF_NORMAL * turn,
        'uncertain size': MEAN_OF_NORMAL * size.sum(axis=1),
        'faces off their points': misfit,
    }
    losses = {reason: np.where(is_refined, loss, 0.0) for reason, loss in losses.items()}
    is_kept = track.status == KEPT
    losses['kept as in the input'] = np.where(is_kept, KEPT_LOSS, 0.0)
    parts = {reason: np.nan_to_num(loss) * REFERENCE_LENGTH / 2 for reason, loss in losses.items()}
    total = np.sum(list(parts.values()), axis=0)
    return Risk(total.clip(max=MAX_LOSS * REFERENCE_LENGTH / 2), parts)


def reasons_of(track: TrackChanges, risk: Risk, row: int | None = None) -> str:
    """Return why a track, or its box in `row`, has its risk, in words, largest part first."""
    values = {
        reason: part.mean() if row is None else part[row] for reason, part in risk.parts.items()
    }
    largest = sorted(values.items(), key=lambda item: -item[1])
    words = [f'{reason} ({value:.2f} m)' for reason, value in largest[:3] if value >= 0.01]
    points = float(np.median(track.num_points)) if row is None else float(track.num_points[row])
    if points < FEW_POINTS:
        words.append(f'few points ({points:.0f} per box)')
    words += [f'{count} kept: {name}' for name, count in track.reasons.most_common(2)]
    return '; '.join(words)


def _misfit(track: TrackChanges) -> Floats:
    """Return how far the points of the faces are off where they are expected, (n,) [m]."""
    squared = np.square(track.face_distances)
    observed = track.face_distances != 0
    count = observed.sum(axis=1).clip(min=1)
    return np.asarray(np.sqrt(squared.sum(axis=1) / count))
