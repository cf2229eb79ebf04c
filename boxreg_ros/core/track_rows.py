"""A table with one row for each of a limited number of tracks."""

from collections.abc import Sequence
from itertools import repeat
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
        self._row_of = dict[str, int]()
        self._track_ids: list[str] = []  # of each row
        self._seen = np.zeros(capacity, int)  # when each row was seen last, by a count
        self._count = 0
        self.arrays = self._fresh[:0]

    @property
    def in_order(self) -> NDArray[Any]:
        """Copy of the arrays of all tracks, (n, ...), those seen last at the end."""
        copy: NDArray[Any] = self.arrays[np.argsort(self._seen[: len(self.arrays)])]
        return copy

    def seen(self, track_ids: Sequence[str]) -> tuple[Ints, Ints]:
        """
        Mark tracks as seen now, and make rows for the new ones.

        Returns which of `track_ids` are kept, (m,), and their rows in `arrays`, (m,).

        """
        places, rows = self._places(track_ids)
        begin = self._count
        self._seen[rows] = begin + places
        self._count += len(track_ids)
        if len(places) == len(track_ids):
            return places, rows
        for track_id in track_ids:
            if track_id not in self._row_of and not self._takes_row(track_id, begin):
                break  # nor do those after it
        new = np.repeat(self._fresh, len(self._row_of) - len(self.arrays), axis=0)
        self.arrays = np.concatenate([self.arrays, new]) if len(new) else self.arrays
        return self._places(track_ids)

    def _places(self, track_ids: Sequence[str]) -> tuple[Ints, Ints]:
        """Return which tracks have rows, (m,), and these, (m,)."""
        rows = np.fromiter(map(self._row_of.get, track_ids, repeat(-1)), int, len(track_ids))
        places = (rows >= 0).nonzero()[0]
        return places, rows[places]

    def _takes_row(self, track_id: str, begin: int) -> bool:
        """Give a new track a row, unless all others were seen from `begin` on; return if so."""
        row = len(self._row_of)
        if row < self._capacity:
            self._track_ids.append(track_id)
        else:
            row = int(self._seen.argmin())
            if self._seen[row] >= begin:
                return False
            del self._row_of[self._track_ids[row]]
            self._track_ids[row] = track_id
            self.arrays[row] = self._fresh[0]
        self._row_of[track_id] = row
        self._seen[row] = self._count
        self._count += 1
        return True
