"""
Stamps of boxes of another file joined with those of ours: the one place of it.

Other programs round stamps to microseconds, to milliseconds, or to doubles of seconds (0.2 us).
So a stamp is taken for the nearest one of the other file within `LARGEST_OFFSET_NS`.

"""

from __future__ import annotations

from typing import NamedTuple

from boxreg_ros.structures import Ints
import numpy as np
from numpy.typing import NDArray

LARGEST_OFFSET_NS = 1_000_000
"""Stamps so close are the same one [ns]; derived: a stamp whose milliseconds were cut off."""
MAX_FRAME_STEP = 1.5
"""Frames further apart lack one between them [median periods]; derived: rounding to whole ones."""


class JoinedStamps(NamedTuple):
    """Stamps (n,) of one file in terms of those of another."""

    stamps_ns: Ints
    """(n,), each replaced by that of the other file where one is near [ns]."""
    num_stamps: int
    """Different stamps."""
    num_common: int
    """Those that have one in the other file."""
    num_moved: int
    """Those of them that were not equal to the nanosecond."""
    largest_offset_ns: int
    """Largest difference that was bridged [ns]."""
    nearest_ns: int | None
    """Smallest difference of a stamp without another; None if all have one, or there is none."""

    def finding(self, what: str, others: str) -> str:
        """Return in words that stamps were not equal, or have no other; empty if all are equal."""
        if not self.num_common and self.nearest_ns is not None:
            return (
                f'none of {self.num_stamps} stamps of {what} is one of {others}, the nearest is '
                f'{self.nearest_ns * 1e-9:.6f} s away'
            )
        if not self.num_moved:
            return ''
        return (
            f'{self.num_moved} of {self.num_stamps} stamps of {what} are up to '
            f'{self.largest_offset_ns / 1000:g} us from those of {others}: joined with the nearest'
        )


def joined_stamps(stamps_ns: Ints, others_ns: Ints) -> JoinedStamps:
    """
    Return stamps joined with those of another file.

    Parameters
    ----------
    stamps_ns : array, shape (n,)
        Stamps of the rows of a file [ns], in any order, repeated.
    others_ns : array, shape (m,)
        Those of the other file.

    Returns
    -------
    joined : JoinedStamps
        A stamp takes that of the nearest other one within `LARGEST_OFFSET_NS`, unless a stamp
        nearer to it takes that.

    """
    own = np.unique(stamps_ns)
    others = np.unique(others_ns)
    if not len(own) or not len(others):
        return JoinedStamps(stamps_ns, len(own), 0, 0, 0, None)
    nearest = nearest_rows(own, others)
    is_mutual = nearest_rows(others, own)[nearest] == np.arange(len(own))
    offsets = np.abs(others[nearest] - own)
    is_common = is_mutual & (offsets <= LARGEST_OFFSET_NS)
    joined = np.where(is_common, others[nearest], own)
    is_moved = is_common & (offsets > 0)
    return JoinedStamps(
        joined[np.searchsorted(own, stamps_ns)],
        len(own),
        int(is_common.sum()),
        int(is_moved.sum()),
        int(offsets[is_moved].max(initial=0)),
        None if is_common.all() else int(offsets[~is_common].min()),
    )


def nearest_rows(stamps_ns: Ints, among_ns: Ints) -> Ints:
    """
    Return the row of the nearest stamp to each of some others.

    Parameters
    ----------
    stamps_ns : array, shape (n,)
        In any order [ns].
    among_ns : array, shape (m,)
        Ascending, m > 0 [ns].

    Returns
    -------
    rows : array, shape (n,)
        Rows of `among_ns`; of two that are as near the later one.

    """
    after = np.searchsorted(among_ns, stamps_ns).clip(0, len(among_ns) - 1)
    before = (after - 1).clip(0)
    is_before = stamps_ns - among_ns[before] < among_ns[after] - stamps_ns
    return np.where(is_before, before, after)


def unknown_stamps(stamps_ns: Ints, frames_ns: Ints) -> NDArray[np.bool_]:
    """
    Return which stamps (n,) lie between two frames that follow each other, or beyond all.

    Frames that were left out, or have nothing, are no such gap: it is at most `MAX_FRAME_STEP`
    times the median period of the frames (m,), which are in any order, repeated.

    """
    frames = np.unique(frames_ns)
    if not len(frames):
        return np.zeros(len(stamps_ns), bool)
    is_beyond = (stamps_ns < frames[0]) | (stamps_ns > frames[-1])
    if len(frames) < 2:
        return np.asarray(is_beyond)
    after = np.searchsorted(frames, stamps_ns).clip(1, len(frames) - 1)
    first, last = frames[after - 1], frames[after]
    is_inside = (first < stamps_ns) & (stamps_ns < last)
    is_step = last - first <= MAX_FRAME_STEP * np.median(np.diff(frames))
    return np.asarray(is_beyond | is_inside & is_step)
