"""
Scores of boxes against true boxes: overlap, errors of pose and extent, flips, jitter.

`match` pairs predictions with true boxes, by their ids or by their `overlaps`; `summarise` turns
pairs into one row of scores.

"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
import math
from typing import Any, NamedTuple

from boxreg_ros.config import words_of
from boxreg_ros.core.metrics import iou_3d, iou_bev, pose_errors
from boxreg_ros.core.tables import rows_by_key
from boxreg_ros.errors import RecordingError
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.rotations import wrap_angle
from boxreg_ros.structures import BOX_EXTENT, Floats, Ints, is_valid_box, YAW
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

RECALLS = (0.5, 0.7, 0.8)
"""IoU thresholds of the recalls."""
POINT_BINS = (0, 10, 30, 100, 300, 1000)
"""Lower limits of the groups by number of points."""
MAX_STEP = 1.0
"""Jitter is not computed across longer gaps [s]."""

MEANS = ('iou_bev', 'iou_3d', 'jitter', 'turn_jitter', 'true_jitter')
"""Fields of `Scores` that are means of those of `Matches`."""

Mask = NDArray[np.bool_]
Pairing = Callable[[BoxTable, BoxTable], Ints]
"""Returns the row of the prediction of each true box (n,), -1 where there is none."""


@dataclass(frozen=True, slots=True)
class Matches:
    """All n true boxes in scope, each with its prediction if there is one."""

    rows: Ints  # (n,) of the true boxes in their table
    predicted_rows: Ints  # (n,) of their predictions in the table of these; -1 without one
    class_names: tuple[str, ...]  # here and below: of the true boxes
    num_points: Ints
    is_matched: Mask  # (n,) a finite prediction exists; the errors below are 0 elsewhere
    iou_bev: Floats
    iou_3d: Floats
    translation: Floats  # (n, 3), as extent and rotation: errors as in `PoseErrors`
    extent: Floats
    rotation: Floats
    scale_iou: Floats  # (n,) 3D IoU after alignment of centre and heading
    is_flipped: Mask  # (n,) the heading error is larger than 90 degrees
    # (n,) norm of the second difference over time of the predicted centre [m/s^2]
    jitter: Floats
    turn_jitter: Floats  # of yaw [rad/s^2]; NaN without boxes within `MAX_STEP` on both sides
    true_jitter: Floats  # that of the true centre, as a reference
    unmatched: Ints  # rows of predictions without a true box
    invalid: int  # true boxes out of scope because of NaN or an extent that is not positive


@dataclass(frozen=True, slots=True)
class Scores:
    """Means over true boxes: errors over those with a prediction, recalls over all."""

    boxes: int  # true boxes in scope
    missing: int  # those without a prediction
    unmatched: int  # predictions without a true box
    iou_bev: float  # here and below: over matched boxes
    iou_3d: float
    iou_bev_median: float
    iou_3d_median: float
    # parts of the true boxes with each IoU of `RECALLS`; missing ones have 0
    recall_bev: tuple[float, ...]
    recall_3d: tuple[float, ...]
    ate: float  # average translation error [m], as in nuScenes
    ase: float  # 1 - IoU after alignment
    aoe: float  # average absolute yaw error [rad]
    aoe_median: float
    flips: float  # part of the matched boxes with a heading error larger than 90 degrees
    jitter: float  # means of the values in `Matches` [m/s^2, rad/s^2]
    turn_jitter: float
    true_jitter: float


def by_id(predicted: BoxTable, truth: BoxTable) -> Ints:
    """
    Return the prediction with the stamp and track id of each true box.

    For boxes that follow from the true ones, such as the results of several methods for one
    input: a box that is far off counts with its error.

    Parameters
    ----------
    predicted, truth : BoxTable
        In one frame.

    Returns
    -------
    rows : array, shape (n,)
        Row in `predicted` for each of the n true boxes, the first of several; -1 without one that
        is finite.

    """
    row_of: dict[tuple[int, str], int] = {}
    for row, key in enumerate(_keys(predicted)):
        row_of.setdefault(key, row)
    rows = np.array([row_of.get(key, -1) for key in _keys(truth)], np.int64)
    is_finite = np.append(np.isfinite(predicted.boxes).all(axis=1), False)
    return np.where(is_finite[rows], rows, -1)


def by_overlap(predicted: BoxTable, truth: BoxTable) -> Ints:
    """
    Return the prediction of each true box by the greatest sum of 3D IoU at each stamp.

    Parameters
    ----------
    predicted, truth : BoxTable
        In one frame; invalid boxes are paired with none.

    Returns
    -------
    rows : array, shape (n,)
        Row in `predicted` for each of the n true boxes; -1 without an overlap.

    """
    rows = np.full(len(truth.boxes), -1, np.int64)
    for stamp in overlaps(predicted, truth):
        true, found = best_pairs(stamp.iou)
        rows[stamp.true[true]] = stamp.predicted[found]
    return rows


def match(
    predicted: BoxTable,
    truth: BoxTable,
    min_points: int = 0,
    classes: Sequence[str] = (),
    pair: Pairing = by_id,
) -> Matches:
    """
    Compare predictions with true boxes of the same stamp and frame.

    Parameters
    ----------
    predicted : BoxTable
        Boxes to judge. Those whose true box is out of scope are ignored.
    truth : BoxTable
        True boxes; invalid ones are out of scope, and counted.
    min_points : int
        True boxes with fewer points are out of scope.
    classes : sequence of str
        So are true boxes whose class name has none of these words; case is ignored, none for all.
    pair : callable
        Says which prediction belongs to a true box: `by_id` or `by_overlap`.

    Returns
    -------
    matches : Matches
        All true boxes in scope, and the errors of their predictions.

    Raises
    ------
    RecordingError
        If the frames differ, or the truth has a track id twice at one stamp.

    """
    if len(predicted.boxes) and len(truth.boxes) and predicted.frame_id != truth.frame_id:
        raise RecordingError(
            f'predicted boxes: expected the frame of the true boxes, {truth.frame_id!r}, got '
            f'{predicted.frame_id!r}; relabel with --fixed-frame {truth.frame_id}'
        )
    _check_unique(_keys(truth))
    paired_rows = pair(predicted, truth)
    is_valid = is_valid_box(truth.boxes)
    is_in_class = np.array([has_word(name, classes) for name in truth.class_names], bool)
    scope = np.flatnonzero(is_valid & is_in_class & (truth.num_points >= min_points))
    predicted_rows = paired_rows[scope]
    is_matched = predicted_rows >= 0
    true_rows = scope[is_matched]
    boxes = predicted.boxes[predicted_rows[is_matched]]
    true_boxes = truth.boxes[true_rows]
    stamps = truth.stamps_ns[true_rows]
    tracks = [truth.track_ids[i] for i in true_rows]
    aligned = true_boxes.copy()
    aligned[:, BOX_EXTENT] = boxes[:, BOX_EXTENT]
    errors = pose_errors(boxes, true_boxes)
    of_matched = {
        'iou_bev': iou_bev(boxes, true_boxes),
        'iou_3d': iou_3d(boxes, true_boxes),
        **errors._asdict(),
        'scale_iou': iou_3d(aligned, true_boxes),
    }
    jitters = {
        'jitter': _second_difference(stamps, tracks, boxes[:, :3]),
        'turn_jitter': _second_difference(stamps, tracks, boxes[:, [YAW]], is_angle=True),
        'true_jitter': _second_difference(stamps, tracks, true_boxes[:, :3]),
    }
    return Matches(
        rows=scope,
        predicted_rows=predicted_rows,
        class_names=tuple(truth.class_names[i] for i in scope),
        num_points=truth.num_points[scope],
        is_matched=is_matched,
        **{name: _spread(values, is_matched) for name, values in of_matched.items()},
        **{name: _spread(values, is_matched, np.nan) for name, values in jitters.items()},
        unmatched=np.setdiff1d(np.arange(len(predicted.boxes)), paired_rows),
        invalid=int((~is_valid).sum()),
    )


def summarise(matches: Matches, mask: Mask | None = None) -> Scores:
    """Return the scores over the true boxes where `mask` (n,) is True, or over all."""
    chosen = np.ones(len(matches.is_matched), bool) if mask is None else mask
    rows = chosen & matches.is_matched
    yaw_errors = np.abs(matches.rotation[rows, 2])
    return Scores(
        boxes=int(chosen.sum()),
        missing=int(chosen.sum() - rows.sum()),
        unmatched=len(matches.unmatched) if mask is None else 0,
        iou_bev_median=_median(matches.iou_bev[rows]),
        iou_3d_median=_median(matches.iou_3d[rows]),
        recall_bev=tuple(_mean(matches.iou_bev[chosen] >= level) for level in RECALLS),
        recall_3d=tuple(_mean(matches.iou_3d[chosen] >= level) for level in RECALLS),
        ate=_mean(np.linalg.norm(matches.translation[rows], axis=1)),
        ase=_mean(1 - matches.scale_iou[rows]),
        aoe=_mean(yaw_errors),
        aoe_median=_median(yaw_errors),
        flips=_mean(matches.is_flipped[rows]),
        **{name: _mean(getattr(matches, name)[rows]) for name in MEANS},
    )


def has_word(class_name: str, words: Sequence[str]) -> bool:
    """Return whether a class name contains one of `words`, in any case; True without words."""
    if not words:
        return True
    return not {word.lower() for word in words}.isdisjoint(words_of(class_name))


def groups(matches: Matches) -> dict[str, dict[str, Scores]]:
    """Return scores by class and by number of points of the true box, without empty groups."""
    names = np.array(matches.class_names, object)
    by_class = {name: summarise(matches, np.equal(names, name)) for name in sorted(set(names))}
    by_points = {}
    for low, high in zip(POINT_BINS, (*POINT_BINS[1:], math.inf), strict=True):
        mask = (matches.num_points >= low) & (matches.num_points < high)
        if mask.any():
            name = f'{low}+' if high == math.inf else f'{low}-{high - 1}'
            by_points[name] = summarise(matches, mask)
    return {'by_class': by_class, 'by_points': by_points}


def _check_unique(true_keys: Sequence[tuple[int, str]]) -> None:
    """Refuse true boxes with the same stamp and track id."""
    for (stamp_ns, track_id), count in Counter(true_keys).most_common(1):
        if count == 1:
            return
        raise RecordingError(
            f'true boxes: expected each track id once per stamp, got {track_id!r} {count} times '
            f'at stamp {stamp_ns}; give every object an id of its own'
        )


def _spread(values: NDArray[Any], is_matched: Mask, absent: float = 0) -> NDArray[Any]:
    """Return the values of matched boxes as rows of all true boxes; `absent` elsewhere."""
    full = np.full((len(is_matched), *values.shape[1:]), absent, dtype=values.dtype)
    full[is_matched] = values
    return full


def _second_difference(
    stamps_ns: Ints, track_ids: Sequence[str], values: Floats, is_angle: bool = False
) -> Floats:
    """
    Return the norm (n,) of the second difference over time of the values (n, D) of each track.

    In units per s^2; NaN without a value of the track within `MAX_STEP` before and after.
    Differences of angles are wrapped.

    """
    norms = np.full(len(stamps_ns), np.nan)
    _, codes = np.unique(np.array(track_ids, str), return_inverse=True)
    order = np.lexsort((stamps_ns, codes))
    before, here, after = order[:-2], order[1:-1], order[2:]
    first_seconds = (stamps_ns[here] - stamps_ns[before]) / 1e9
    second_seconds = (stamps_ns[after] - stamps_ns[here]) / 1e9
    is_one_track = codes[before] == codes[after]
    is_near = is_one_track & (np.maximum(first_seconds, second_seconds) <= MAX_STEP)
    before, here, after = before[is_near], here[is_near], after[is_near]
    first = values[here] - values[before]
    second = values[after] - values[here]
    if is_angle:
        first = wrap_angle(first)
        second = wrap_angle(second)
    first_seconds = first_seconds[is_near, None]
    second_seconds = second_seconds[is_near, None]
    difference = second / second_seconds - first / first_seconds
    norms[here] = np.linalg.norm(2 * difference / (first_seconds + second_seconds), axis=1)
    return norms


def _keys(boxes: BoxTable) -> list[tuple[int, str]]:
    """Return stamp and track id of each box."""
    return list(zip(boxes.stamps_ns.tolist(), boxes.track_ids, strict=True))


def _mean(values: NDArray[Any]) -> float:
    """Return the mean of the finite values; NaN without any."""
    finite_values = values[np.isfinite(values)]
    return float(finite_values.mean()) if len(finite_values) else math.nan


def _median(values: NDArray[Any]) -> float:
    """Return the median; NaN without a value."""
    return float(np.median(values)) if len(values) else math.nan


class Overlaps(NamedTuple):
    """All boxes of one stamp."""

    predicted: Ints  # (p,) rows in their table
    true: Ints  # (t,)
    iou: Floats  # (t, p) 3D IoU of each pair


def overlaps(predicted: BoxTable, truth: BoxTable) -> Iterator[Overlaps]:
    """Yield the valid boxes of each stamp of two tables in one frame, in the order of stamps."""
    predicted_rows = _rows_by_stamp(predicted)
    true_rows = _rows_by_stamp(truth)
    none = np.zeros(0, np.int64)
    for stamp_ns in sorted(predicted_rows.keys() | true_rows.keys()):
        found = predicted_rows.get(stamp_ns, none)
        true = true_rows.get(stamp_ns, none)
        yield Overlaps(found, true, pairwise_iou(truth.boxes[true], predicted.boxes[found]))


def pairwise_iou(first: Floats, second: Floats) -> Floats:
    """Return the 3D IoU (n, m) of boxes (n, 9) with boxes (m, 9)."""
    iou = np.zeros((len(first), len(second)))
    radii = [np.linalg.norm(boxes[:, BOX_EXTENT], axis=1) / 2 for boxes in (first, second)]
    distances = np.linalg.norm(first[:, None, :3] - second[None, :, :3], axis=2)
    near = np.nonzero(distances < radii[0][:, None] + radii[1])
    iou[near] = iou_3d(first[near[0]], second[near[1]])
    return iou


def best_pairs(
    iou: Floats, least: float = 0.0, is_preferred: NDArray[np.bool_] | None = None
) -> tuple[Ints, Ints]:
    """
    Return the one-to-one pairs with the greatest sum of IoU.

    Parameters
    ----------
    iou : array, shape (t, p)
        Of each pair.
    least : float
        Pairs need at least this, and more than 0.
    is_preferred : array of bool, shape (t, p), optional
        Pairs that count as one more IoU of 1: more than any other pair of one of the boxes.

    Returns
    -------
    rows, columns : array, shape (k,)
        Of the k pairs.

    """
    gains = np.where(iou >= least, iou, 0.0)
    if is_preferred is not None:
        gains += is_preferred & (gains > 0)
    rows, columns = linear_sum_assignment(gains, maximize=True)
    is_pair = (iou[rows, columns] > 0) & (iou[rows, columns] >= least)
    return rows[is_pair], columns[is_pair]


def _rows_by_stamp(table: BoxTable) -> dict[int, Ints]:
    """Return the rows of the valid boxes of each stamp."""
    valid = np.flatnonzero(is_valid_box(table.boxes))
    of_stamp = rows_by_key(table.stamps_ns[valid].tolist())
    return {stamp_ns: valid[rows] for stamp_ns, rows in of_stamp.items()}
