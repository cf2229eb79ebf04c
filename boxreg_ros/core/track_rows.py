"""A table with one row for each of a limited number of tracks."""

from collections.abc import Sequence
from typing import Any

from boxreg_ros.structures import Ints
import numpy as np
from numpy.typing import NDArray


class TrackRows:
    """
    Keep one array per track, for at most `capacity` tracks; a new one begins with `fresh`.

    A new track takes the place of the one that was seen longest ago, but not of one that is seen
    together with it: where there are too many tracks at once, the first ones stay. `arrays` are
    those of all tracks, (n, ...).

    """

    def __init__(self, fresh: NDArray[Any], capacity: int) -> None:
        self._fresh = fresh[None]
        self._capacity = capacity
        self._row_of = dict[str, int]()  # of each track, those seen last at the end
        self.arrays = self._fresh[:0]

    @property
    def in_order(self) -> NDArray[Any]:
        """Copy of the arrays of all tracks, (n, ...), those seen last at the end."""
        copy: NDArray[Any] = self.arrays[list(self._row_of.values())]
        return copy

    def seen(self, track_ids: Sequence[str]) -> tuple[Ints, Ints]:
        """
        Mark tracks as seen now, and make rows for the new ones.

        Returns which of `track_ids` are kept, (m,), and their rows in `arrays`, (m,).

        """
        new_ids = []
        for track_id in track_ids:
            row = self._row_of.pop(track_id, None)
            if row is None:
                new_ids.append(track_id)
            else:
                self._row_of[track_id] = row
        together = set(track_ids) if new_ids else set[str]()
        for track_id in new_ids:
            if track_id not in self._row_of and not self._takes_row(track_id, together):
                break  # nor do those after it
        if len(self._row_of) > len(self.arrays):
            new = np.repeat(self._fresh, len(self._row_of) - len(self.arrays), axis=0)
            self.arrays = np.concatenate([self.arrays, new])
        rows = np.array([self._row_of.get(track_id, -1) for track_id in track_ids], int)
        places = np.flatnonzero(rows >= 0)
        return places, rows[places]

    def _takes_row(self, track_id: str, together: set[str]) -> bool:
        """Give a new track a row, unless all others are seen `together` with it; return if so."""
        row = len(self._row_of)
        if row == self._capacity:
            longest_ago = next(iter(self._row_of))
            if longest_ago in together:
                return False
            row = self._row_of.pop(longest_ago)
            self.arrays[row] = self._fresh[0]
        self._row_of[track_id] = row
        return True
