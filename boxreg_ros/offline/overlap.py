"""Pairs of predicted and true boxes of one stamp that overlap."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from boxreg_ros.core.metrics import iou_3d
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.structures import BOX_EXTENT, Floats, Ints, is_valid_box
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment


class Overlaps(NamedTuple):
    """
    All boxes of one stamp.

    Attributes
    ----------
    predicted, true : array, shape (p,) and (t,)
        Rows in their tables.
    iou : array, shape (t, p)
        3D IoU of each true box with each predicted one.

    """

    predicted: Ints
    true: Ints
    iou: Floats


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
    Return the rows and columns of the one-to-one pairs with the greatest sum of IoU.

    Parameters
    ----------
    iou : array, shape (t, p)
        Overlap of each pair.
    least : float
        Pairs need more than 0 and at least this.
    is_preferred : array, shape (t, p), optional
        Pairs that count as one more IoU of 1: more than any other pair of one of the boxes.

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
    valid = valid[np.argsort(table.stamps_ns[valid], kind='stable')]
    stamps, first = np.unique(table.stamps_ns[valid], return_index=True)
    ends = [*first[1:], len(valid)][: len(first)]
    parts = zip(stamps.tolist(), first, ends, strict=True)
    return {stamp_ns: valid[begin:end] for stamp_ns, begin, end in parts}
