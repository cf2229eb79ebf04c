"""
Folders of label segments, as the recorder of the live node writes them.

``index.csv`` lists the segments in the order of recording; each is a folder like that of `boxreg
relabel`. Where labels are read, such a folder stands for all its segments.

"""

from __future__ import annotations

from collections.abc import Iterable
import csv
from pathlib import Path
from typing import NamedTuple

from boxreg_ros.errors import RecordingError
from boxreg_ros.io.whole_files import written_whole

INDEX = 'index.csv'


class IndexRow(NamedTuple):
    """A segment in the index; the fields are the columns."""

    segment: str
    """Name of its folder."""
    first_stamp_ns: int
    last_stamp_ns: int
    """Largest stamp of its boxes, as `first_stamp_ns` is the smallest [ns]."""
    frames: int
    """Stamps; boxes and clouds are counted, too."""
    boxes: int
    clouds: int
    left_out: int
    """Boxes that a format cannot represent, summed over formats."""
    size: int
    """Of its files."""
    recovered: int
    """1 if it was made from the journal of a recording that was cut off, else 0."""


def read_index(folder: Path) -> list[IndexRow]:
    """Return the segments in the index of a folder, in order; RecordingError for other columns."""
    path = folder / INDEX
    if not path.exists():
        return []
    rows = []
    try:
        with path.open(newline='', encoding='utf-8') as file:
            for cells in csv.DictReader(file):
                numbers = [int(cells[name]) for name in IndexRow._fields[1:]]
                rows.append(IndexRow._make([cells['segment'], *numbers]))
    except (KeyError, TypeError, ValueError) as error:
        raise RecordingError(
            f'{path}: expected the columns {", ".join(IndexRow._fields)} with whole numbers, got '
            f'an error in {error}; restore it, or give the folder of one segment'
        ) from None
    return rows


def write_index(folder: Path, rows: Iterable[IndexRow]) -> None:
    """Replace the index of a folder; it appears whole or not at all."""
    with written_whole(folder / INDEX) as file:
        table = csv.writer(file, lineterminator='\n')
        table.writerow(IndexRow._fields)
        table.writerows(sorted(rows))


def segments_of(path: Path) -> list[Path]:
    """Return the folders of all segments in the index of a folder; none without an index."""
    return [path / row.segment for row in read_index(path)]
