"""Rows of tables, joined by hand."""

from typing import NamedTuple

from boxreg_ros.core.tables import by_table, column, joined
import numpy as np


class Table(NamedTuple):
    values: np.ndarray
    names: np.ndarray


FIRST = Table(np.array([1, 2]), np.array(['a', 'b']))
SECOND = Table(np.array([3, 4, 5]), np.array(['c', 'd', 'e']))


def test_rows_keep_their_order_and_may_repeat():
    tables, rows = joined([(SECOND, 2), (FIRST, 0), (SECOND, 0), (SECOND, 2)])
    # SECOND comes first: its rows are 0 to 2, those of FIRST 3 and 4.
    assert [id(table) for table in tables] == [id(SECOND), id(FIRST)]
    assert rows.tolist() == [2, 3, 0, 2]
    assert column(tables, 'values')[rows].tolist() == [5, 1, 3, 5]
    assert column(tables, 'names')[rows].tolist() == ['e', 'a', 'c', 'e']


def test_items_are_grouped_by_table():
    groups = by_table([(SECOND, 2), (FIRST, 0), (SECOND, 0)])
    assert [(id(table), places, rows) for table, places, rows in groups] == [
        (id(SECOND), [0, 2], [2, 0]),
        (id(FIRST), [1], [0]),
    ]


def test_one_table_is_not_copied():
    tables, rows = joined([(FIRST, 1)])
    assert column(tables, 'values') is FIRST.values
    assert rows.tolist() == [1]


def test_no_items():
    tables, rows = joined([])
    assert tables == []
    assert rows.dtype == int and not len(rows)
