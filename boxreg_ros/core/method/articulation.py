"""
Bodies that do not keep their shape, such as an articulated truck in one box (M27a).

The box around tractor and trailer is wider in a curve. One extent per track fits no stamp of it.

"""

from math import log

from boxreg_ros.core.method.compile import kernel, loop
from boxreg_ros.core.method.selection import nth
import numpy as np


@kernel
def extent_ranges(boxes, length, span, ranges):
    """
    Widen the range of the input extents of a track to the end of its window.

    Parameters
    ----------
    boxes : array, shape (N, 9)
        Input boxes of the window.
    length : int
        Observations; the others are padding.
    span : int
        The range is of medians of so many successive boxes: gross errors are not part of it.
    ranges : array, shape (2, 3)
        Least and largest logarithm of length, width and height, widened in place; `NO_RANGE`
        before `span` boxes.

    """
    values = np.empty(span)
    for k in range(ranges.shape[1]):
        for first in range(length + 1 - span):
            for i in range(span):
                values[i] = boxes[first + i, 3 + k]
            median = (log(nth(values, (span - 1) // 2)) + log(nth(values, span // 2))) / 2
            ranges[0, k] = min(ranges[0, k], median)
            ranges[1, k] = max(ranges[1, k], median)


@loop
def changes_shape(ranges, deviation, gate):
    """
    Return whether a body changes its width by more than its boxes err (M27a).

    `ranges` (2, 3) are those of `extent_ranges`, `deviation` is that of the input extents, as part
    of each, and `gate` how many of these are more than an error.

    """
    length, width, height = (
        ranges[1, 0] - ranges[0, 0], ranges[1, 1] - ranges[0, 1], ranges[1, 2] - ranges[0, 2]
    )  # fmt: skip
    return width > gate * max(deviation, length, height)
