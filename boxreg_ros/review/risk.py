"""
The risk of a box or a track: the error to expect, from evidence other than how far it moved.

Risks are metres along the heading of a car: the shift of a box `REFERENCE_LENGTH` long that costs
as much 3D IoU as the errors to expect. So boxes of all sizes and errors of all kinds compare.

"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import NamedTuple

from boxreg_ros.review.changes import TrackChanges
from boxreg_ros.structures import BOX_EXTENT, Floats, KEPT, LENGTH, X, Y
import numpy as np

REFERENCE_LENGTH = 4.5
"""Length of the car whose shift a risk is [m]. Chosen: a mid-size car."""
MEAN_OF_NORMAL = np.sqrt(2 / np.pi)
"""Mean magnitude of a normal variable over its deviation. Derived."""
MAX_LOSS = 1.0
"""Largest loss of 3D IoU."""
KEPT_LOSS = 0.25
"""Loss to expect of an input box that is kept: 1 - 3D IoU of the inputs of docs/results.md."""
USUAL_MISFIT = 0.05
"""Distance of a face from its points that is noise [m]. Chosen: near the median of true boxes."""
USUAL_OUTSIDE = 0.2
"""Part of the points in and near a box that are of other things. Chosen: near the upper quartile
of tracks with true boxes on PandaSet."""
NEAR_MARGIN = 0.6
"""How far outside of a box points count as near [m]: the default of `sampling.margin`."""
USUAL_FILL = 0.34
"""Part of its volume with that margin that a car fills; smaller objects fill less. Derived."""
SWITCH_SPEED = 10.0
"""Deviation from constant velocity that is an id switch [m/s], as in `core.registrar`."""
SWITCH_LOSS = 0.5
"""Loss to expect where the id of a track has switched: half its boxes are of another object."""
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
    is_refined = track.is_refined
    losses = {
        'uncertain position': MEAN_OF_NORMAL * shift.sum(axis=1),
        'uncertain heading': MEAN_OF_NORMAL * turn,
        'uncertain size': MEAN_OF_NORMAL * size.sum(axis=1),
        'faces off their points': _misfit(track, extents),
        'points left outside': _left_outside(track, extents),
    }
    losses = {reason: np.where(is_refined, loss, 0.0) for reason, loss in losses.items()}
    is_kept = track.status == KEPT
    losses['kept as in the input'] = np.where(is_kept, KEPT_LOSS, 0.0)
    losses['id switch'] = np.full(len(is_kept), SWITCH_LOSS * _has_id_switch(track))
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
    kept = Counter(filter(None, track.reasons.tolist()))
    words += [f'{count} kept: {name}' for name, count in kept.most_common(2)]
    return '; '.join(words)


def _misfit(track: TrackChanges, extents: Floats) -> Floats:
    """
    Return the loss of 3D IoU if the points of the faces were right, shape (n,).

    A face that is off by d costs d / L, L the extent across it; `USUAL_MISFIT` of d is noise.

    """
    excess = (np.abs(track.face_distances) - USUAL_MISFIT).clip(0)
    return np.asarray((excess / np.repeat(extents, 2, axis=1)).sum(axis=1))


def _left_outside(track: TrackChanges, extents: Floats) -> Floats:
    """
    Return the loss of 3D IoU that points outside of each box are evidence for, shape (n,).

    Of a box off its object, the part of the points that is outside is about the loss. The space
    around a small object has more room for points of others: they count less.

    """
    excess = (track.outside - USUAL_OUTSIDE).clip(0)
    fill = (extents / (extents + 2 * NEAR_MARGIN)).prod(axis=1) / USUAL_FILL
    return np.asarray(excess * fill.clip(max=1.0))


def _has_id_switch(track: TrackChanges) -> bool:
    """Return whether the boxes jump by more than half a length off constant velocity."""
    is_known = np.isfinite(track.boxes[:, X])
    boxes = track.boxes[is_known]
    seconds = np.diff(track.stamps_ns[is_known]) * 1e-9
    if len(seconds) < 2 or (seconds <= 0).any():
        return False
    velocity = np.diff(boxes[:, [X, Y]], axis=0) / seconds[:, None]
    jump = np.linalg.norm(np.diff(velocity, axis=0), axis=1) * seconds[1:]
    gate = boxes[1:-1, LENGTH] / 2 + SWITCH_SPEED * seconds[1:]
    return bool((jump > gate).any())
