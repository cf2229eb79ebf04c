"""
Rows of tables: what belongs to one item among arrays that hold the same of many.

A table is a named tuple whose fields have one row for each of its items. Items are given as pairs
of a table and a row in it: many small arrays take longer to stack than a few large ones.

"""

from collections.abc import Sequence
from itertools import accumulate, pairwise
from typing import Any

from boxreg_ros.structures import Ints
import numpy as np


def joined(items: Sequence[tuple[Any, int]]) -> tuple[list[Any], Ints]:
    """
    Return the different tables of some items, in the order of their first item.

    And the row (n,) of each item in their concatenation.

    """
    owners, rows = zip(*items, strict=True) if items else ((), ())
    ids = list(map(id, owners))
    of_id = dict(zip(ids, owners, strict=True))
    lengths = [len(table[0]) for table in of_id.values()]
    first = dict(zip(of_id, accumulate(lengths, initial=0), strict=False))
    before = np.array([first[number] for number in ids], int)
    return list(of_id.values()), before + np.array(rows, int)


def by_table(items: Sequence[tuple[Any, int]]) -> list[tuple[Any, Ints, Ints]]:
    """Return each table of some items, the places of its items among them, and their rows."""
    owners, rows = zip(*items, strict=True) if items else ((), ())
    ids = list(map(id, owners))
    of_id = dict(zip(ids, owners, strict=True))
    numbers = dict(zip(of_id, range(len(of_id)), strict=True))
    number, row = np.array([numbers[i] for i in ids], int), np.array(rows, int)
    order = np.argsort(number, kind='stable')
    ends = np.cumsum(np.bincount(number, minlength=len(of_id))).tolist()
    parts = [order[begin:end] for begin, end in pairwise([0, *ends])]
    return [(table, part, row[part]) for table, part in zip(of_id.values(), parts, strict=True)]


def column(tables: Sequence[Any], name: str) -> Any:
    """Return the field `name` of the concatenation of `tables`; of one table, no copy."""
    parts = [getattr(table, name) for table in tables]
    return parts[0] if len(parts) == 1 else np.concatenate(parts)
