"""
Rows of tables: what belongs to one item among arrays that hold the same of many.

A table is a named tuple whose fields have one row for each of its items. Items are given as pairs
of a table and a row in it: many small arrays take longer to stack than a few large ones. Rows of
records are taken by `take`, ten times as fast as by an index.

"""

from collections.abc import Sequence
from itertools import count, pairwise
from typing import Any, TypeVar

from boxreg_ros.structures import Ints
import numpy as np

_Key = TypeVar('_Key')


def numbered(items: Sequence[tuple[Any, int]]) -> tuple[list[Any], Ints, Ints]:
    """Return the tables of n items in the order they appear, their numbers and rows, (n,) each."""
    owners, rows = zip(*items, strict=True) if items else ((), ())
    ids = list(map(id, owners))
    tables = dict(zip(ids, owners, strict=True))
    number_of = dict(zip(tables, count()))
    number = np.fromiter(map(number_of.__getitem__, ids), int, len(ids))
    return [*tables.values()], number, np.array(rows, int)


def by_table(items: Sequence[tuple[Any, int]]) -> list[tuple[Any, Ints, Ints]]:
    """Return each table of some items, the places of its items among them, and their rows."""
    tables, number, row = numbered(items)
    if len(tables) == 1:
        return [(tables[0], np.arange(len(row)), row)]
    kind = np.min_scalar_type(len(tables))  # small numbers are fast to sort
    order = np.argsort(number.astype(kind), kind='stable')
    ends = np.cumsum(np.bincount(number)).tolist()
    parts = [order[begin:end] for begin, end in pairwise([0, *ends])]
    return [(table, part, row[part]) for table, part in zip(tables, parts, strict=False)]


def rows_by_key(keys: Sequence[_Key]) -> dict[_Key, Ints]:
    """Return the rows of each key among n keys, ascending; the keys in the order they appear."""
    number_of = {key: number for number, key in enumerate(dict.fromkeys(keys))}
    number = np.fromiter(map(number_of.__getitem__, keys), int, len(keys))
    ends = np.cumsum(np.bincount(number, minlength=len(number_of)))
    parts = np.split(np.argsort(number, kind='stable'), ends[:-1])
    return dict(zip(number_of, parts, strict=False))  # without keys there is one empty part


def rows_of(items: Sequence[tuple[Any, int]]) -> Any:
    """Return the rows of some items, at least one, as one table in their order."""
    parts = by_table(items)
    table, _, rows = parts[0]
    if len(parts) == 1:
        return table._make(part.take(rows, 0) for part in table)
    back = np.argsort(np.concatenate([places for _, places, _ in parts]))
    taken = [[part.take(rows, 0) for part in owner] for owner, _, rows in parts]
    return table._make(np.concatenate(column).take(back, 0) for column in zip(*taken, strict=True))
