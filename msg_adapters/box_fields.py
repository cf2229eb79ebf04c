"""What each family of messages states of its serialised form: where it has its boxes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from boxreg_ros.structures import BoxArray, Floats
from msg_adapters.cdr import Fields
import numpy as np
from numpy.typing import NDArray

POSE_WIDTH, SIZE_WIDTH, COVARIANCE_WIDTH = 7, 3, 36
"""Numbers of a pose (position, quaternion), of a size and of a covariance."""

BoxLabels = tuple[list[str], list[str], Floats]
"""Ids, classes and scores of all boxes."""


@dataclass(frozen=True, slots=True)
class Rewrite:
    """The new boxes of a message, beside the old ones."""

    boxes: BoxArray
    """The new ones."""
    old_pose: Floats
    """(n, 7), position and quaternion; so is `new_pose`."""
    new_pose: Floats
    old_size: Floats
    """(n, 3) [m]."""
    covariance: Floats
    """(n, 36), NaN where that of the message remains."""


@dataclass(frozen=True, slots=True)
class BoxFields:
    """Where the messages of a type have their boxes."""

    frames: tuple[str, ...]
    """Of the array and of the boxes."""
    pose: str
    """First number of the pose; so is `size`."""
    size: str
    labels: Callable[[Fields], BoxLabels]
    """Reads ids, classes and scores."""
    others: tuple[str, ...] = ()
    """Further fields that the functions here use."""
    stamp: str = 'header.stamp.sec'
    """Seconds of the stamp, before its nanoseconds."""
    covariance: str = ''
    """First number of the covariance of the pose; empty if there is none."""
    is_ordinary: Callable[[Fields], bool] = lambda fields: True
    """Whether all its objects are boxes that arrays can represent."""
    rows: Callable[[Fields], NDArray[np.bool_]] | None = None
    """Which of the poses are those of boxes; by default all."""
    write: Callable[[Fields, Rewrite], None] = lambda fields, rewrite: None
    """Writes what depends on the box beside pose, size and covariance."""


def parts(counts: NDArray[np.int64]) -> Iterator[slice]:
    """Yield the rows of the elements of each item, of their numbers (n,)."""
    ends = np.append(0, np.cumsum(counts)).tolist()
    return map(slice, ends, ends[1:])


def finite_or(new: Floats, old: Floats) -> Floats:
    """Return the rows of `new`, and those of `old` where they are not finite."""
    return np.where(np.isfinite(new).all(1, keepdims=True), new, old)
