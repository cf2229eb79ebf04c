"""Points of a recording near the boxes of some tracks, for the pictures of the report."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

from boxreg_ros.config import Config
from boxreg_ros.core.matching import Pair, StampMatcher
from boxreg_ros.core.observation import crop, GROUND_CLEARANCE
from boxreg_ros.review.changes import TrackChanges
from boxreg_ros.rotations import matrix_from_rpy
from boxreg_ros.structures import BoxArray, Floats, HEIGHT, ROLL, Sweep, X, Z
import numpy as np
from numpy.typing import NDArray

SHOWN_MARGIN = 0.6
"""Points up to this far outside a box are shown [m]."""
MAX_SWEEPS = 60
"""Sweeps of one track that are shown, spread over its duration."""
MAX_POINTS = 150
"""Points of one box that are shown."""


class BoxPoints(NamedTuple):
    """Points (M, 3) of a sweep near the box in one row of a track, in the fixed frame [m]."""

    row: int
    points: Floats


def gather_points(
    tracks: Sequence[TrackChanges], items: Iterable[Sweep | BoxArray], config: Config
) -> tuple[dict[str, list[BoxPoints]], Floats]:
    """
    Select some points of each track from a recording.

    Parameters
    ----------
    tracks : sequence of TrackChanges
        The tracks to show.
    items : iterable of Sweep and BoxArray
        The recording in the fixed frame. One item is held at a time, and few points are kept.
    config : Config
        Settings of the run.

    Returns
    -------
    points : dict
        The selected points of each track, by track id.
    origins : array, shape (n, 3)
        Positions of the sensor in the fixed frame [m].

    """
    wanted: dict[tuple[int, str], tuple[TrackChanges, int]] = {}
    for track in tracks:
        for row in reversed(_selected_rows(track)):  # of two boxes of one stamp use the first
            wanted[int(track.stamps_ns[row]), track.track_id] = track, row
    points: dict[str, list[BoxPoints]] = {track.track_id: [] for track in tracks}
    origins: list[Floats] = []
    for boxes, sweep in _pairs(items, config, origins):
        if sweep is None:
            continue
        for track_id in boxes.track_ids:
            found = wanted.pop((boxes.stamp_ns, track_id), None)
            if found is not None:
                track, row = found
                near = _points_near(track, row, sweep, config)
                points[track_id].append(BoxPoints(row, near))
    return points, np.reshape(origins, (-1, 3))


def in_box_frame(
    points: Sequence[BoxPoints], boxes: Floats, is_flipped: NDArray[np.bool_]
) -> Floats:
    """
    Return the points of all sweeps in the frame of the box of their sweep.

    Parameters
    ----------
    points : sequence of BoxPoints
        Points in the fixed frame.
    boxes : array, shape (n, 9)
        The boxes of the track in the fixed frame.
    is_flipped : array, shape (n,)
        Boxes whose heading is to be flipped first.

    Returns
    -------
    local : array, shape (M, 3)
        Points [m]; x forward, y left, z up from the centre of the box.

    """
    local = [np.zeros((0, 3))]
    for row, fixed in points:
        R = matrix_from_rpy(boxes[row, ROLL:])
        sign = np.array([-1, -1, 1]) if is_flipped[row] else 1
        local.append((fixed - boxes[row, : Z + 1]) @ R * sign)
    return np.concatenate(local)


def points_before_and_after(
    track: TrackChanges, points: Sequence[BoxPoints]
) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """
    Return the points of all sweeps in the frames of the input boxes and of the refined boxes.

    Parameters
    ----------
    track : TrackChanges
        The track.
    points : sequence of BoxPoints
        Its points in the fixed frame.

    Returns
    -------
    before, after : array, shape (M, 3)
        Points [m]; x forward, y left, z up from the centre of the box. Input boxes whose heading
        was flipped are flipped here too.
    is_object : array, shape (M,)
        False for points near the lower face of the refined box, which may be road.

    """
    before = in_box_frame(points, track.given, track.is_flipped)
    after = in_box_frame(points, track.boxes, np.zeros_like(track.is_flipped))
    half_height = np.nanmedian(track.boxes[:, HEIGHT]) / 2
    is_object = after[:, Z] > GROUND_CLEARANCE - half_height
    return before, after, is_object


def _pairs(
    items: Iterable[Sweep | BoxArray], config: Config, origins: list[Floats]
) -> Iterator[Pair]:
    """Yield boxes and sweeps paired by stamp; append the sensor positions to `origins`."""
    matcher = StampMatcher(config, Counter())
    for item in items:
        if isinstance(item, Sweep):
            origins.append(item.origin)
            yield from matcher.add_sweep(item)
        else:
            yield from matcher.add_boxes(item)
    yield from matcher.flush()


def _selected_rows(track: TrackChanges) -> list[int]:
    """Return rows of boxes with points in or near them, spread over the track."""
    has_points = track.is_refined | (track.num_points > 0)
    rows = np.flatnonzero(np.isfinite(track.change).all(axis=1) & has_points)
    picks = np.linspace(0, len(rows) - 1, min(MAX_SWEEPS, len(rows))).astype(int)
    return [int(row) for row in rows[picks]]


def _points_near(track: TrackChanges, row: int, sweep: Sweep, config: Config) -> Floats:
    """Return points (M, 3) near a box before or after, motion-compensated to its stamp."""
    delay = np.array([(sweep.stamp_ns - track.stamps_ns[row]) * 1e-9])
    both = np.array([track.given[row], track.boxes[row]])
    both[:, : Z + 1] -= _motion_to_stamp(track, row, delay)
    index, _, _, outside = crop(sweep.points, both, SHOWN_MARGIN)
    index = np.unique(index[outside.max(0) < SHOWN_MARGIN])
    step = max(1, -(-len(index) // MAX_POINTS))
    index = index[::step]
    is_at_stamp = config.sampling.deskew and config.sampling.box_time == 'stamp'
    if is_at_stamp and sweep.times is not None:
        delay = delay + sweep.times[index]
    return np.asarray(sweep.points[index] + _motion_to_stamp(track, row, delay))


def _motion_to_stamp(track: TrackChanges, row: int, delays: Floats) -> Floats:
    """Return how far the box moves (n, 3) from `delays` [s] after its stamp back to it [m]."""
    is_known = np.isfinite(track.boxes[:, X])
    times = (track.stamps_ns[is_known] - track.stamps_ns[row]) * 1e-9
    centers = track.boxes[is_known, : Z + 1]
    there = [np.interp(delays, times, coordinate) for coordinate in centers.T]
    return np.asarray(track.boxes[row, : Z + 1] - np.column_stack(there))
