"""Rows of tables."""

from typing import NamedTuple

from boxreg_ros.core.tables import rows_of
import numpy as np


class Table(NamedTuple):
    values: np.ndarray


def test_rows_are_those_of_their_tables_however_many():
    """A recording of two hours at 10 Hz has more sweeps than 16 bits count."""
    tables = [Table(np.array([k, -k])) for k in range(70_000)]
    items = [(table, k % 2) for k, table in enumerate(tables)]
    known = [-k if k % 2 else k for k in range(70_000)]
    np.testing.assert_array_equal(rows_of(items).values, known)
    np.testing.assert_array_equal(rows_of(items[::-1]).values, known[::-1])
