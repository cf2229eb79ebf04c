"""How steady a track is before and after registration, measured without true boxes."""

from __future__ import annotations

from dataclasses import dataclass

from boxreg_ros.core.observation import GROUND_CLEARANCE
from boxreg_ros.review.changes import mean, median, TrackChanges
from boxreg_ros.rotations import matrix_from_rpy, wrap_angle
from boxreg_ros.structures import BOX_EXTENT, Floats, HEIGHT, ROLL, YAW, Z
import numpy as np
from numpy.typing import NDArray

CELL = 0.1
"""Edge of the cubes that measure how sharp the points of all sweeps are in their boxes [m]."""
CELL_RANGE = 2**16
"""Cells along one axis whose numbers differ; derived: 6.5 km at `CELL`."""


@dataclass(frozen=True, slots=True)
class Quality:
    """Figures of the boxes of one track; NaN where they are unknown."""

    flips: int
    """Headings that turn by more than 90 degrees from one box to the next."""
    jitter: float
    """Mean distance of a centre from the middle of its two neighbours in time [m]."""
    yaw_jitter: float
    """The same of the yaw [rad]."""
    size_spread: float
    """Mean standard deviation of length, width and height over the track [m]."""
    cells: int
    """Cubes of edge `CELL` that the points of all sweeps fill in the frame of the boxes."""
    iou: float
    """Mean 3D IoU with the true boxes."""


def quality(track: TrackChanges, boxes: Floats, points: list[Floats], iou: Floats) -> Quality:
    """
    Return the figures of the input boxes or of the refined boxes of a track.

    Parameters
    ----------
    track : TrackChanges
        Has the stamps.
    boxes : array, shape (n, 9)
        `given` or `boxes` of the track [m, rad]; NaN where unknown.
    points : list of n arrays, shape (M_i, 3)
        Near each box, in the fixed frame [m].
    iou : array, shape (n,)
        3D IoU with true boxes; NaN where unknown.

    Returns
    -------
    figures : Quality
        NaN where they are unknown.

    """
    known = np.asarray(np.isfinite(boxes).all(axis=1))
    at = boxes[known]
    turn = wrap_angle(np.diff(at[:, YAW]))
    half_turns_removed = np.concatenate([[0.0], np.cumsum(wrap_angle(2 * turn) / 2)])
    return Quality(
        flips=int((np.abs(turn) > np.pi / 2).sum()),
        jitter=mean(np.linalg.norm(_off_neighbours(track, known, at[:, : Z + 1]), axis=1)),
        yaw_jitter=mean(np.abs(_off_neighbours(track, known, half_turns_removed[:, None]))),
        size_spread=mean(at[:, BOX_EXTENT].std(axis=0)) if len(at) else np.nan,
        cells=_filled_cells(track, boxes, points),
        iou=mean(iou),
    )


def _off_neighbours(track: TrackChanges, known: NDArray[np.bool_], values: Floats) -> Floats:
    """Return `values` (n, k) minus their neighbours interpolated at their time, (n - 2, k)."""
    times = track.stamps_ns[known] * 1e-9
    if len(times) < 3:
        return np.zeros((0, values.shape[1]))
    share = ((times[1:-1] - times[:-2]) / (times[2:] - times[:-2]).clip(1e-9))[:, None]
    return np.asarray(values[1:-1] - (1 - share) * values[:-2] - share * values[2:])


def _filled_cells(track: TrackChanges, boxes: Floats, points: list[Floats]) -> int:
    """
    Return the number of cubes of edge `CELL` that the points of all sweeps fill.

    In the frame of their boxes, those with a corrected heading turned first. Points near the
    lower face are left out: they may be road. So are those of boxes that are not known both before
    and after.

    """
    is_both = np.asarray(np.isfinite(np.hstack([track.given, track.boxes])).all(axis=1))
    R = matrix_from_rpy(np.nan_to_num(boxes[:, ROLL:]))
    if boxes is track.given:
        R[track.is_flipped, :, :2] *= -1  # x and y axes
    local = [np.zeros((0, 3))]
    for row, fixed in enumerate(points):
        if len(fixed) and is_both[row]:
            local.append((fixed - boxes[row, : Z + 1]) @ R[row])
    every = np.concatenate(local)
    floor = GROUND_CLEARANCE - median(track.boxes[:, HEIGHT]) / 2
    cells = np.floor(every[every[:, Z] > floor] / CELL).astype(np.int64) % CELL_RANGE
    return len(np.unique(cells @ np.array([CELL_RANGE**2, CELL_RANGE, 1])))
