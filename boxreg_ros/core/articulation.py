"""
Bodies that do not keep their shape, such as an articulated truck in one box (M27a).

The box around tractor and trailer is wider in a curve. One extent per track fits no stamp of it.

"""

from boxreg_ros.core.method.constants import CONSTANTS
from boxreg_ros.core.problem import Problem
from boxreg_ros.structures import Floats
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray


def extent_ranges(problem: Problem, past: Floats, span: int) -> Floats:
    """
    Return the range of the input extents of each track up to the end of its window, (B, 2, 3).

    Least and largest logarithm of length, width and height, with the ranges `past` of the windows
    before; `NO_RANGE` before `span` boxes. They are of medians of `span` successive boxes: gross
    errors are not part of it.

    """
    if problem.length < span:
        return past
    logs = np.log(problem.boxes[..., 3:6])
    ordered = np.sort(sliding_window_view(logs, span, axis=1), axis=-1)
    medians = (ordered[..., (span - 1) // 2] + ordered[..., span // 2]) / 2  # (B, N - span + 1, 3)
    is_valid = problem.valid[:, span - 1 :, None]
    least = np.where(is_valid, medians, np.inf).min(1)
    largest = np.where(is_valid, medians, -np.inf).max(1)
    return np.stack([np.minimum(least, past[:, 0]), np.maximum(largest, past[:, 1])], axis=1)


def changes_shape(ranges: Floats, deviation: Floats) -> NDArray[np.bool_]:
    """
    Return which bodies change their width by more than their boxes err (M27a), (B,).

    `ranges` (B, 2, 3) are those of `extent_ranges`, `deviation` (B,) that of the input extents, as
    part of each.

    """
    length, width, height = (ranges[:, 1] - ranges[:, 0]).T
    expected = np.maximum(deviation, np.maximum(length, height))
    is_wider: NDArray[np.bool_] = width > CONSTANTS.gate * expected
    return is_wider
