"""Average precision of detections on many drives, and its standard errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from boxreg_ros.offline.box_scores import pairwise_iou
from boxreg_ros.structures import Floats
from measure.detector.network import flat
import numpy as np
from numpy.typing import NDArray

THRESHOLDS = (0.5, 0.7)
METRICS = tuple(f'{kind} {level}' for kind in ('BEV', '3D') for level in THRESHOLDS)


@dataclass(frozen=True, slots=True)
class Hits:
    """The detections (n,) of one class on one drive."""

    scores: Floats
    is_true: NDArray[np.bool_]  # by one of the `METRICS`
    count: int  # true boxes in scope


def hits_of(
    boxes: Floats, scores: Floats, truth: Floats, in_scope: NDArray[np.bool_]
) -> dict[str, Hits]:
    """
    Compare the detections (n, 9) of one frame and class with its true boxes (t, 9).

    The best first, each takes the free true box with the greatest IoU, if it reaches the
    threshold. Detections of true boxes out of scope (t,) count neither as true nor as false.

    """
    order = np.argsort(-scores, kind='stable')
    ious = {
        'BEV': pairwise_iou(flat(boxes[order]), flat(truth)),
        '3D': pairwise_iou(boxes[order], truth),
    }
    found = {}
    for metric in METRICS:
        kind, level = metric.split()
        is_free = np.ones(len(truth), bool)
        kept, is_true = [], []
        for row, iou in zip(order, ious[kind], strict=True):
            free = np.where(is_free, iou, 0.0)
            is_hit = free.max(initial=0.0) >= float(level)
            best = int(np.argmax(free)) if is_hit else 0
            is_free[best : best + 1] &= not is_hit
            if is_hit and not in_scope[best]:
                continue
            if not is_hit and iou[~in_scope].max(initial=0) > 0:
                continue
            kept.append(scores[row])
            is_true.append(is_hit)
        found[metric] = Hits(np.array(kept), np.array(is_true, bool), int(in_scope.sum()))
    return found


def joined(parts: Sequence[Hits]) -> Hits:
    """Return the detections of several frames or drives together."""
    return Hits(
        np.concatenate([np.zeros(0), *(part.scores for part in parts)]),
        np.concatenate([np.zeros(0, bool), *(part.is_true for part in parts)]),
        sum(part.count for part in parts),
    )


def average_precision(hits: Hits) -> float:
    """Return the area under the greatest precision at each recall or higher; NaN without truth."""
    if not hits.count:
        return np.nan
    is_true = hits.is_true[np.argsort(-hits.scores, kind='stable')]
    found = np.cumsum(is_true)
    precision = found / np.arange(1, len(found) + 1)
    highest = np.maximum.accumulate(precision[::-1])[::-1]
    return float(highest[is_true].sum() / hits.count)
