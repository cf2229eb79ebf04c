"""Scores of whole tracks: misses, ghosts, ids per object, HOTA and IDF1, by overlap."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
import math
from typing import Any

from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.offline.box_scores import best_pairs, Overlaps, overlaps
from boxreg_ros.structures import ADDED, Floats, Ints
import numpy as np

LEAST_IOU = 0.5
"""3D IoU of a box that is found; literature: threshold of IDF1 and of most recalls."""


@dataclass(frozen=True, slots=True)
class TrackScores:
    """
    Scores of boxes as tracks. Boxes are matched by overlap at each stamp, not by their ids.

    As in CLEAR MOT, a pair of ids goes on while its boxes overlap: where the truth has two boxes
    of one object, the ids do not change places.

    """

    recall: float  # part of the true boxes that are found with `LEAST_IOU`
    precision: float  # the same of the predicted boxes
    misses: int  # true boxes that are not found
    ghosts: int  # predicted boxes that find none
    ids_per_object: float  # predicted ids that find a true object, mean over the objects found
    added: int  # boxes that the input did not have
    added_iou: float  # their mean 3D IoU; 0 for a ghost
    added_ghosts: int  # those of them that overlap no true box
    given_iou: float  # of the other boxes, likewise
    hota: float  # NaN without trackeval, as the next three
    det_a: float  # its part for detection
    ass_a: float  # its part for association
    idf1: float


def has_trackeval() -> bool:
    """Return whether the package for HOTA and IDF1 is installed."""
    return find_spec('trackeval') is not None


def track_scores(predicted: BoxTable, truth: BoxTable, scope: Ints | None = None) -> TrackScores:
    """
    Return the scores of tracks.

    Parameters
    ----------
    predicted, truth : BoxTable
        In one frame; invalid boxes are ignored.
    scope : array of int, shape (k,), optional
        Rows of the true boxes that count, by default all. A predicted box that finds one of the
        others is ignored.

    Returns
    -------
    scores : TrackScores
        A box finds another at a 3D IoU of `LEAST_IOU`.

    """
    is_in_scope = np.ones(len(truth.boxes), bool)
    if scope is not None:
        is_in_scope[:] = False
        is_in_scope[scope] = True
    stamps = [_scoped(stamp, is_in_scope) for stamp in overlaps(predicted, truth)]
    num_true = sum(len(stamp.true) for stamp in stamps)
    num_predicted = sum(len(stamp.predicted) for stamp in stamps)
    found = 0
    ids: dict[str, set[str]] = {}  # predicted ids that find each object
    last: dict[str, str] = {}  # the newest of them
    iou_of: dict[bool, list[float]] = {True: [], False: []}  # of added boxes, and of the others
    for stamp in stamps:
        found += len(best_pairs(stamp.iou, LEAST_IOU)[0])
        objects = [truth.track_ids[row] for row in stamp.true]
        names = [predicted.track_ids[row] for row in stamp.predicted]
        goes_on = np.array([[last.get(one) == name for name in names] for one in objects], bool)
        pairs = best_pairs(stamp.iou, LEAST_IOU, goes_on.reshape(stamp.iou.shape))
        for row, column in zip(*pairs, strict=True):
            last[objects[row]] = names[column]
            ids.setdefault(objects[row], set()).add(names[column])
        for row, value in zip(stamp.predicted, _iou_of_predicted(stamp), strict=True):
            iou_of[predicted.status[row] in ADDED].append(float(value))
    return TrackScores(
        recall=_part(found, num_true),
        precision=_part(found, num_predicted),
        misses=num_true - found,
        ghosts=num_predicted - found,
        ids_per_object=_part(sum(map(len, ids.values())), len(ids)),
        added=len(iou_of[True]),
        added_iou=_part(sum(iou_of[True]), len(iou_of[True])),
        added_ghosts=iou_of[True].count(0.0),
        given_iou=_part(sum(iou_of[False]), len(iou_of[False])),
        **_trackeval_scores(stamps, predicted, truth),
    )


def _scoped(stamp: Overlaps, is_in_scope: Any) -> Overlaps:
    """Return a stamp without the true boxes out of scope and the boxes that find them."""
    rows, columns = best_pairs(stamp.iou, LEAST_IOU)
    is_other = ~is_in_scope[stamp.true]
    is_ignored = np.zeros(len(stamp.predicted), bool)
    is_ignored[columns[is_other[rows]]] = True
    return Overlaps(
        stamp.predicted[~is_ignored], stamp.true[~is_other], stamp.iou[~is_other][:, ~is_ignored]
    )


def _iou_of_predicted(stamp: Overlaps) -> Floats:
    """Return the IoU of each predicted box of a stamp with the true box that it finds, else 0."""
    rows, columns = best_pairs(stamp.iou)
    iou = np.zeros(len(stamp.predicted))
    iou[columns] = stamp.iou[rows, columns]
    return iou


def _trackeval_scores(
    stamps: Sequence[Overlaps], predicted: BoxTable, truth: BoxTable
) -> dict[str, float]:
    """Return HOTA, its parts, and IDF1, by the package trackeval; NaN where it is missing."""
    if not has_trackeval():
        return dict.fromkeys(('hota', 'det_a', 'ass_a', 'idf1'), math.nan)
    from trackeval.metrics import HOTA, Identity

    true_codes, num_true_ids = _codes(truth, [stamp.true for stamp in stamps])
    codes, num_ids = _codes(predicted, [stamp.predicted for stamp in stamps])
    data = {
        'gt_ids': true_codes,
        'tracker_ids': codes,
        'similarity_scores': [stamp.iou for stamp in stamps],
        'num_gt_dets': sum(map(len, true_codes)),
        'num_tracker_dets': sum(map(len, codes)),
        'num_gt_ids': num_true_ids,
        'num_tracker_ids': num_ids,
    }
    hota = HOTA().eval_sequence(data)
    identity = Identity({'THRESHOLD': LEAST_IOU, 'PRINT_CONFIG': False}).eval_sequence(data)
    return {
        'hota': float(np.mean(hota['HOTA'])),
        'det_a': float(np.mean(hota['DetA'])),
        'ass_a': float(np.mean(hota['AssA'])),
        'idf1': float(identity['IDF1']),
    }


def _codes(table: BoxTable, rows: Sequence[Ints]) -> tuple[list[Ints], int]:
    """
    Return the track ids of the rows of each stamp as numbers from 0, and their number.

    Boxes that have one id at a stamp are of different tracks: trackeval would count each as found.

    """
    code_of: dict[tuple[str, int], int] = {}
    codes = []
    for stamp_rows in rows:
        seen = Counter[str]()
        own = []
        for row in stamp_rows:
            name = table.track_ids[row]
            own.append(code_of.setdefault((name, seen[name]), len(code_of)))
            seen[name] += 1
        codes.append(np.array(own, np.int64))
    return codes, len(code_of)


def _part(part: float, whole: int) -> float:
    return part / whole if whole else math.nan
