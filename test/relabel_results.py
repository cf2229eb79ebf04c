"""Settings for quick runs of `boxreg relabel`, and the tables it writes."""

import csv
from pathlib import Path

from boxreg_ros.config import Config

QUICK = Config().updated({'solver.rounds': 1, 'sampling.points': 64})
"""Settings of a run that takes a fraction of a second."""


def rows_in(path):
    """Return the rows of a table, as dicts."""
    with path.open(newline='', encoding='utf-8') as file:
        return list(csv.DictReader(file))


def rows_of(out):
    """Return the rows of boxes.csv in an output folder, as dicts."""
    return rows_in(Path(out) / 'boxes.csv')
